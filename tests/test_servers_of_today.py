"""Thinking models, answers that are cut off, and every error that servers report, against a server on loopback."""

from __future__ import annotations

import itertools
import json
import re
from typing import Any

import pytest
from model_server import Answer, Asked, Drop, ModelServer, Raw, Say, StepClock, status
from pydantic import BaseModel

from sumo_adv.errors import ModelError
from sumo_adv.llm.asking import MeteredModel, ask
from sumo_adv.llm.chat import Ledger, without_thought
from sumo_adv.llm.client import open_model

THINKING = "The gap closes, so the vehicle may brake hard. Or not."
FIELDS = ("reasoning_effort", "chat_template_kwargs", "thinking")


class Choice(BaseModel):
    """An answer."""

    risk: int


def asked_for(server: ModelServer, *, re_asks: int = 1, **settings: Any) -> tuple[int, Ledger]:
    """The risk that the server's model answers."""
    ledger = Ledger()
    model = open_model("test-model", server.settings(**settings), ledger, clock=StepClock())
    return ask(MeteredModel(model, ledger), "analyzer", "S", "U", Choice, re_asks=re_asks).risk, ledger


def refusal(script: Any, **settings: Any) -> tuple[str, int]:
    """The message of a question that fails, and how often the server was asked."""
    with ModelServer(script) as server, pytest.raises(ModelError) as caught:
        asked_for(server, **settings)
    assert str(caught.value).endswith(".") and "\n" not in str(caught.value)
    return str(caught.value), len(server.asked)


def error(code: int, *, error_code: Any = None, kind: str = "test", message: str = "as it is") -> Raw:
    """An error as OpenAI's servers send it."""
    return Raw(code, json.dumps({"error": {"message": message, "type": kind, "code": error_code}}).encode())


def fields_of(request: Asked) -> list[str]:
    return [name for name in FIELDS if name in request.body]


@pytest.mark.parametrize(
    "answer",
    [
        Say("", reasoning='Draft: {"risk": 1}. Better: {"risk": 3}'),
        Say("", reasoning='So {"risk": 3}', reasoning_key="reasoning"),
        Say('<think>Perhaps {"risk": 1}.</think>{"risk": 3}'),
        Say('<think>It is {"risk": 3}</think>'),
        Say("", finish="tool_calls", more={"tool_calls": [{"function": {"name": "a", "arguments": '{"risk": 3}'}}]}),
        Say("", finish="function_call", more={"function_call": {"name": "Choice", "arguments": {"risk": 3}}}),
        Say({"risk": 3}, finish=None),
        Say({"risk": 3}, finish="length"),
        Say({"risk": 3}, finish="eos"),
    ],
)  # fmt: skip
def test_the_answer_is_read_where_it_stands(answer: Say) -> None:
    with ModelServer([answer]) as server:
        assert asked_for(server)[0] == 3
    assert len(server.asked) == 1 and fields_of(server.asked[0]) == []


def test_thought_is_no_answer() -> None:
    assert without_thought("<think>a</think> b <thinking>c</thinking>") == "b"
    assert without_thought("a</think>b") == "b"
    assert without_thought("<think>a, and never an end") == ""


def test_thought_ends_at_its_first_closing_tag() -> None:
    """The same as with a regular expression, in every order of five parts."""
    thought, end = re.compile(r"<think(?:ing)?>.*?</think(?:ing)?>", re.DOTALL), re.compile(r"</think(?:ing)?>")
    for parts in itertools.product(("<think>", "<thinking>", "</think>", "</thinking>", "a\n", "b"), repeat=5):
        text = "".join(parts)
        left = end.split(thought.sub("", text))[-1]
        assert without_thought(text) == ("" if left.lstrip().startswith("<think") else left.strip()), text


@pytest.mark.parametrize("tag", ["<think>", "<thinking>", "</think>", "a</think><think>"])
def test_tags_without_end_are_read_at_once(tag: str) -> None:
    """A regular expression with ``.*?`` takes hours for these 2 MB."""
    assert without_thought(tag * (2_000_000 // len(tag))) == ""


def test_a_model_that_only_thinks_is_asked_for_less_in_the_way_that_its_server_knows() -> None:
    """The server refuses the first field and knows the second one, which is sent from then on."""

    def script(request: Asked) -> Answer:
        if "reasoning_effort" in request.body:
            return status(400, "Unknown parameter: reasoning_effort")
        if request.body.get("chat_template_kwargs") == {"enable_thinking": False, "thinking": False}:
            return Say({"risk": 2})
        return Say("", reasoning=THINKING, finish="length")

    with ModelServer(script) as server:
        ledger = Ledger()
        metered = MeteredModel(open_model("test-model", server.settings(), ledger, clock=StepClock()), ledger)
        assert [ask(metered, "analyzer", "S", user, Choice).risk for user in "UV"] == [2, 2]
    assert [fields_of(each) for each in server.asked] == [[], ["reasoning_effort"], *[["chat_template_kwargs"]] * 2]
    counts = ledger.as_dict()
    assert (counts["calls"], counts["completion_tokens"], counts["retries"]) == (2, 30, 2)


def test_a_model_that_never_stops_thinking_is_refused_with_what_to_set() -> None:
    message, times = refusal(lambda request: Say("<think>" + THINKING, finish="length"))
    assert "raise llm_answer_tokens or the server's own limit" in message and "cut at the token limit" in message
    assert times == 5  # the question, three ways to ask for less thinking, and the question again


def test_an_answer_that_was_cut_is_asked_again_in_fewer_words() -> None:
    with ModelServer([Say('{"risk": 12', finish="length"), Say({"risk": 1})]) as server:
        assert asked_for(server)[0] == 1
    assert "cut at the token limit; answer in fewer words" in server.asked[1].last


def test_the_token_limit_is_sent_under_the_name_that_the_server_knows() -> None:
    def script(request: Asked) -> Answer:
        old = "max_tokens" in request.body
        return status(400, "use max_completion_tokens") if old else Say({"risk": 1})

    with ModelServer(script) as server:
        assert asked_for(server, llm_answer_tokens=900)[0] == 1
    assert server.asked[-1].body["max_completion_tokens"] == 900 and len(server.asked) == 2


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        (Say("", finish="content_filter"), "content filter withheld it; switch the filter off there"),
        (Say("", finish="tool_calls"), "called a tool, and none was offered"),
        (Say("", finish="function_call"), "called a tool, and none was offered"),
        (Say("", finish="insufficient_system_resource"), "ended with 'insufficient_system_resource'; try again later"),
    ],
)
def test_a_finish_without_an_answer_has_its_sentence(answer: Say, says: str) -> None:
    message, times = refusal([answer])
    assert says in message and times == 1


PERMANENT = {
    "a spent quota": (error(429, error_code="insufficient_quota"), "no quota left for this key (status 429"),
    "a spent quota by its type": (error(429, kind="insufficient_quota"), "add credit to the account"),
    "a long question by code": (error(400, error_code="context_length_exceeded"), "longer than the model's context"),
    "a long question by words": (error(400, message="This model's context window is 9"), "--max-model-len"),
    "a bad key as 400": (error(400, error_code="invalid_api_key"), "set SUMO_ADV_LLM_API_KEY"),
    "401": (error(401), "does not accept the key"),
    "402": (error(402), "demands a payment"),
    "403": (error(403), "does not let this key use the model"),
    "404": (error(404), "does not know this model or address"),
    "404 of the model": (error(404, error_code="model_not_found"), "this model (status 404: as it is); check the name"),
    "405": (Raw(405), "takes no questions at this address"),
    "413": (error(413), "finds the question too large"),
    "422": (error(422), "rejected the question (status 422: as it is)"),
    "200 with an error": (error(200), "reports an error (status 200: as it is); try again later"),
    "200 with the code 402": (error(200, error_code=402), "demands a payment"),
}  # fmt: skip
TEMPORARY = {
    "408": (error(408), "gave up waiting"),
    "409": (error(409), "conflict with another question"),
    "429": (error(429, error_code="rate_limit_exceeded"), "lower llm_concurrency"),
    "500": (error(500), "failed inside"),
    "502": (Raw(502, b"<html>Bad Gateway</html>"), "gateway that gets no answer"),
    "503": (error(503), "overloaded or still starting"),
    "504": (Raw(504), "waited too long for the model"),
    "529": (error(529, kind="overloaded_error"), "overloaded or still starting"),
    "200 with the code 429": (error(200, error_code=429), "limits how often it is asked"),
    "200 with a server's error": (error(200, error_code="server_error"), "failed inside"),
}


@pytest.mark.parametrize("case", PERMANENT)
def test_an_error_that_lasts_fails_at_once(case: str) -> None:
    """A 422 may mean the response format, so it is asked in all three ways."""
    answer, says = PERMANENT[case]
    message, times = refusal(lambda request: answer)
    assert says in message and times == (3 if case == "422" else 1)


@pytest.mark.parametrize("case", TEMPORARY)
def test_an_error_that_may_pass_is_asked_again(case: str) -> None:
    answer, says = TEMPORARY[case]
    message, times = refusal(lambda request: answer)
    assert says in message and "also after 3 retries" in message and times == 4
    with ModelServer([answer, Say({"risk": 1})]) as server:
        assert asked_for(server)[0] == 1


# -- the way in which the schema is sent ----------------------------------------------------------------------------

LITERAL = (
    "[{'type': 'literal_error', 'loc': ('body', 'response_format', 'type'), 'msg': \"Input should be 'text' or "
    "'json_object'\", 'input': 'json_schema', 'ctx': {'expected': \"'text' or 'json_object'\"}}]"
)
"""What llama-cpp-python's server says of ``json_schema``, with status 500."""
REFUSALS = {
    "llama-cpp-python": error(500, kind="internal_server_error", message=LITERAL),
    "a router without such a provider": error(404, message="No endpoints found that support response_format"),
    "a gateway": error(501, message="json_schema is not implemented"),
    "a grammar that cannot be made": error(500, message="failed to parse grammar"),
    "FastAPI": Raw(422, json.dumps({"detail": [{"loc": ["body", "response_format"], "msg": "bad"}]}).encode()),
    "an error with status 200": error(200, message="response_format.type json_schema is unsupported"),
    "plain text": Raw(500, b"pydantic: response_format"),
}


@pytest.mark.parametrize("server_of", REFUSALS)
def test_an_error_of_any_status_that_names_the_form_steps_down(server_of: str) -> None:
    def script(request: Asked) -> Answer:
        return REFUSALS[server_of] if request.mode == "json_schema" else Say({"risk": 3})

    with ModelServer(script) as server:
        assert asked_for(server)[0] == 3
    assert [each.mode for each in server.asked] == ["json_schema", "json_object"]
    assert '"risk"' in server.asked[1].system  # the schema is in the first message


def test_the_last_form_is_text_with_the_schema() -> None:
    def script(request: Asked) -> Answer:
        refused = error(500, message="unknown field 'response_format'")
        return refused if "response_format" in request.body else Say({"risk": 3})

    with ModelServer(script) as server:
        assert asked_for(server)[0] == 3
    assert [each.mode for each in server.asked] == ["json_schema", "json_object", "text"]
    assert '"risk"' in server.asked[2].system


@pytest.mark.parametrize("form", ["json_object", "text"])
def test_a_setting_chooses_the_form(form: str) -> None:
    with ModelServer([Say({"risk": 3})]) as server:
        assert asked_for(server, llm_response_format=form)[0] == 3
    assert server.asked[0].mode == form and '"risk"' in server.asked[0].system


# -- servers that go and come ---------------------------------------------------------------------------------------


def test_a_server_that_drops_connections_is_asked_until_the_question_ends() -> None:
    """Eight drops are more than ``llm_retries``: 0.5 + 1 + 2 + 4 + 4 x 8 s = 39.5 s at most."""
    with ModelServer([*[Drop()] * 8, Say({"risk": 3})]) as server:
        assert asked_for(server, llm_retries=1)[0] == 3
    # Waits end at 15.5 s, and the next of 4 s would pass the deadline: 2.5 s are left for what the machine takes.
    message, times = refusal(lambda request: Drop(), llm_question_seconds=18.0)
    assert "broke the connection" in message and "raise llm_question_seconds" in message and times > 4


def test_a_server_that_loads_its_model_is_waited_for() -> None:
    loading = Raw(503, b'{"error": {"code": 503, "message": "Loading model", "type": "unavailable_error"}}')
    with ModelServer([*[loading] * 6, Say({"risk": 3})]) as server:
        assert asked_for(server)[0] == 3
    assert len(server.asked) == 7


def test_a_server_that_restarts_is_waited_for() -> None:
    """It drops the first connection and is gone; it listens again at the same place when the client has waited."""
    first = ModelServer([Drop()])
    port = int(first.base_url.split(":")[2].split("/")[0])
    again: list[ModelServer] = []

    class Restart(StepClock):
        """The server goes in the first wait and comes back in the fifth."""

        def sleep(self, seconds: float) -> None:
            super().sleep(seconds)
            if len(self.slept) == 1:
                first.__exit__()
            if len(self.slept) == 5:
                again.append(ModelServer([Say({"risk": 3})], port=port).__enter__())

    first.__enter__()
    ledger = Ledger()
    model = open_model("test-model", first.settings(), ledger, clock=Restart())
    try:
        assert ask(MeteredModel(model, ledger), "analyzer", "S", "U", Choice).risk == 3
    finally:
        for server in again:
            server.__exit__()
    assert ledger.as_dict()["retries"] == 5
