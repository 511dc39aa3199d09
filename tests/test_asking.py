"""Structured answers: taking the JSON out, sending faults back, many samples at once."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from model_server import Asked, ModelServer, Say, StepClock, status
from pydantic import BaseModel, ConfigDict

from sumo_adv.errors import BudgetError, ModelError
from sumo_adv.llm.asking import MeteredModel, ask, ask_many, read_answer
from sumo_adv.llm.chat import Budget, Ledger, without_thought
from sumo_adv.llm.client import open_model


class Choice(BaseModel):
    """The answer type of the tests."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    label: str
    risk: float


GOOD = '{"label": "Cut-in", "risk": 0.5}'


def metered(server: ModelServer, budget: Budget | None = None, **given: float) -> MeteredModel:
    ledger = Ledger(budget)
    return MeteredModel(open_model("test-model", server.settings(**given), ledger, clock=StepClock()), ledger)


@pytest.mark.parametrize(
    "text",
    [
        GOOD,
        f"```json\n{GOOD}\n```",
        f"Sure! Of {{all}} the {{'options'}} I take:\n```\n{GOOD}\n```\nIs that good?",
        f'First {{"label": "Draft"}}, no: {GOOD} it is.',
        f'<think>{{"label": "No", "risk": 0}} hm</think>\n{GOOD}',
        f'{{"label": "No", "risk": 0}} so I think</think>{GOOD}',
        f"\ufeff{GOOD}",
    ],
)
def test_an_answer_is_read_from_prose_and_fences(text: str) -> None:
    assert read_answer(without_thought(text), Choice) == (Choice(label="Cut-in", risk=0.5), None)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "It is empty."),
        ("I cannot.", "There is no JSON object in it."),
        ('{"label": "Cut-in", "risk": ', "Its JSON cannot be read: Expecting value: line 1 column 29"),
        ('[{"label": "Cut-in", "ri', "Its JSON cannot be read: Unterminated string"),
        ('{"a": {"label": "Cut-in", "risk": 1} "b": 2}', "Its JSON cannot be read: Expecting ',' delimiter"),
        ('{"label": "Cut-in", "risk": NaN}', "Its JSON cannot be read: NaN is no number"),
        ('{"label": "Cut-in"}', "It is not of the shape asked for. risk: Field required."),
        ('{"label": "x", "risk": 1, "bv": 2}', "bv: Extra inputs are not permitted (given: 2)."),
        ('{"label": 3, "risk": "high"}', "label: Input should be a valid string (given: 3); risk: Input should be"),
        ('{"x":' * 100_000, "Its JSON cannot be read"),
        ('{"risk": ' + "9" * 5000 + "}", "Its JSON cannot be read"),
        ("[1, 2]", "valid dictionary"),
    ],
)
def test_the_fault_of_an_answer_is_named(text: str, says: str) -> None:
    answer, fault = read_answer(text, Choice)
    assert answer is None and fault is not None and says in fault


def test_all_keys_at_fault_are_listed() -> None:
    answer, fault = read_answer(json.dumps({"label": "x", "risk": 1} | {f"key{k}": k for k in range(12)}), Choice)
    assert answer is None and fault is not None
    assert fault.count("Extra inputs are not permitted") == 12 and "key11: " in fault


@given(st.text(), st.dictionaries(st.text(), st.integers()), st.text(alphabet="{}[]\"',: \n`x1"))
def test_any_text_can_be_read(before: str, inner: dict[str, int], after: str) -> None:
    read_answer(before + json.dumps(inner) + after, Choice)
    assert read_answer(f"{before.replace('{', '')} {GOOD}", Choice)[0] == Choice(label="Cut-in", risk=0.5)


def test_a_fault_goes_back_and_the_second_answer_counts() -> None:
    answers = [Say("<think>secret</think>{}", reasoning="more"), Say(GOOD)]
    with ModelServer(answers) as server:
        model = metered(server)
        answer = ask(model, "analyzer", "System.", "User.", Choice)
    assert answer.label == "Cut-in"
    roles = [role for role, _ in server.asked[1].messages]
    assert roles == ["system", "user", "assistant", "user"]
    assert server.asked[1].messages[2][1] == "{}"
    assert "label: Field required; risk: Field required." in server.asked[1].last
    assert "secret" not in str(server.asked[1].body) and "more" not in str(server.asked[1].body)
    counts = model.ledger.as_dict()
    assert (counts["calls"], counts["re_asks"]) == (2, 1)


def test_the_sentence_of_a_check_is_sent_back() -> None:
    def check(answer: Choice) -> str | None:
        return None if answer.risk <= 1 else f"The risk {answer.risk:g} is above 1."

    with ModelServer([{"label": "a", "risk": 7}, {"label": "a", "risk": 6}, {"label": "a", "risk": 1}]) as server:
        assert ask(metered(server), "analyzer", "S", "U", Choice, check=check, re_asks=2).risk == 1.0
    assert "The risk 7 is above 1." in server.asked[1].last and "The risk 6 is above 1." in server.asked[2].last


def test_after_the_last_re_ask_the_answer_is_refused_by_name() -> None:
    with (
        ModelServer(lambda request: "Never.") as server,
        pytest.raises(
            ModelError,
            match=r"answer from test-model was refused 2 times; try another model. Last fault: .*no JSON object",
        ),
    ):
        ask(metered(server), "analyzer", "S", "U", Choice)
    assert len(server.asked) == 2
    with (
        ModelServer(lambda request: "") as server,
        pytest.raises(ModelError, match=r"refused once; try another model. Last fault: It is empty."),
    ):
        ask(metered(server), "analyzer", "S", "U", Choice, re_asks=0)


def test_many_samples_come_in_their_order_and_failed_ones_are_dropped() -> None:
    def script(request: Asked) -> Say:
        return Say(GOOD) if next(turns) != 1 else Say("Never.")

    turns = iter(range(100))
    with ModelServer(script) as server:
        model = metered(server)
        answers = ask_many(model, "analyzer", "S", "U", Choice, samples=5, re_asks=0)
    assert len(answers) == 4 and len(server.asked) == 5
    assert model.ledger.as_dict()["dropped"] == 1


def test_a_question_fails_if_all_its_samples_fail() -> None:
    with ModelServer(lambda request: status(401)) as server, pytest.raises(ModelError, match="key"):
        ask_many(metered(server), "analyzer", "S", "U", Choice, samples=3)
    with ModelServer(lambda request: GOOD) as server, pytest.raises(BudgetError, match="2 calls"):
        ask_many(metered(server, Budget(calls=2)), "analyzer", "S", "U", Choice, samples=3)
