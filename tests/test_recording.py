"""Recordings of models: written line by line, answered from by content, the same again every time."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from model_server import KEY, Asked, ModelServer, Say, StepClock, status
from pydantic import BaseModel

from sumo_adv.config import ModelSettings
from sumo_adv.errors import BudgetError, ModelError, UsageError
from sumo_adv.llm.asking import MeteredModel, ask, ask_many
from sumo_adv.llm.chat import Budget, ChatReply, ChatRequest, Ledger
from sumo_adv.llm.client import open_model
from sumo_adv.llm.recording import Recorder, Replay


class Number(BaseModel):
    """The answer type of the tests."""

    value: int


def story(model: MeteredModel) -> list[object]:
    """Questions of every kind, and their results."""
    results: list[object] = [
        ask(model, "analyzer", "Be brief.", "How many?", Number),
        ask(model, "analyzer", "Be brief.", "How many?", Number),
        ask_many(model, "generator", "Be brief.", "How many then?", Number, samples=4),
    ]
    try:
        ask(model, "modifier", "Be brief.", "Fail: \u2713 \ud800", Number)
    except ModelError as error:
        results.append(str(error))
    return results


def script(asked: Asked) -> object:
    """Another number every time; the first answer is no JSON; Fail is an error of the server."""
    if "Fail" in asked.last:
        return status(400, f"that is not for {KEY}")
    turn = next(_TURNS)
    return Say("None.") if turn == 0 else Say({"value": turn}, reasoning="because")


_TURNS = iter(range(10_000))


def recorded(path: Path) -> tuple[list[object], dict[str, object]]:
    """The story with a real server, its recording at ``path``, and the ledger."""
    global _TURNS
    _TURNS = iter(range(10_000))
    ledger = Ledger()
    with ModelServer(script) as server, Recorder(path, "test-model", note="written by a test") as recorder:  # type: ignore[arg-type]
        model = open_model("test-model", server.settings(), ledger, clock=StepClock())
        return story(MeteredModel(recorder.wrap(model), ledger)), ledger.as_dict()


def replayed(path: Path, again: Path | None = None) -> tuple[list[object], dict[str, object]]:
    ledger = Ledger()
    model = open_model(f"replay:{path}", ModelSettings(), ledger)
    if again is None:
        return story(MeteredModel(model, ledger)), ledger.as_dict()
    with Recorder(again, model.name, note="written by a test") as recorder:
        return story(MeteredModel(recorder.wrap(model), ledger)), ledger.as_dict()


def test_a_replayed_story_is_the_same_down_to_the_ledger(tmp_path: Path) -> None:
    first, second = tmp_path / "one.jsonl", tmp_path / "two.jsonl"
    answers, counted = recorded(first)
    assert counted["calls"] == 8 and counted["re_asks"] == 1  # 3 of the analyzer, 4 samples, 1 failure
    assert answers[0] == Number(value=1) and answers[1] == Number(value=2)
    assert replayed(first) == (answers, counted)
    assert replayed(first, second) == (answers, counted)
    assert sorted(second.read_text().splitlines()) == sorted(first.read_text().splitlines())


def test_the_key_is_in_no_recording_and_reasoning_is_kept(tmp_path: Path) -> None:
    recorded(tmp_path / "one.jsonl")
    text = (tmp_path / "one.jsonl").read_text()
    assert KEY not in text and "***" in text
    lines = [json.loads(line) for line in text.splitlines()]
    assert lines[0] == {
        "kind": "sumo_adv recording of a language model", "schema": 1, "model": "test-model",
        "note": "written by a test",
    }  # fmt: skip
    assert lines[2]["reply"]["reasoning"] == "because" and lines[2]["request"]["agent"] == "analyzer"
    assert Replay.open(tmp_path / "one.jsonl").name == "replay of test-model"


def test_every_line_is_there_as_soon_as_it_is_answered(tmp_path: Path) -> None:
    path = tmp_path / "one.jsonl"
    request = ChatRequest("analyzer", (("user", "What?"),))
    with Recorder(path, "m") as recorder:
        recorder.add(request, ChatReply("Yes."))
        assert len(path.read_text().splitlines()) == 2
        recorder.add(request, BudgetError("Spent.", retries=2, seconds=1.5))
    recorder.add(request, ChatReply("Too late."))
    with path.open("a") as file:
        file.write('{"request": {"agent": "ana')  # killed while writing
    replay = Replay.open(path)
    assert replay.complete(request).text == "Yes."
    with pytest.raises(BudgetError, match=r"^Spent\.$") as caught:
        replay.complete(request)
    assert (caught.value.retries, caught.value.seconds) == (2, 1.5)
    with pytest.raises(ModelError, match="answers this question of the analyzer only 2 times; record the run again"):
        replay.complete(request)


@pytest.mark.parametrize(
    ("request_", "says"),
    [
        (ChatRequest("modifier", (("user", "What?"),)), "has no question of the modifier"),
        (ChatRequest("analyzer", (("user", "What is it?"),)), "line 3, differs from character 9 on: 'What is that?'"),
        (ChatRequest("analyzer", (("user", "What?"),), sample=2), "in line 2, is sample 0 instead of 2"),
    ],
)  # fmt: skip
def test_an_unknown_question_is_reported_with_the_nearest(tmp_path: Path, request_: ChatRequest, says: str) -> None:
    with Recorder(tmp_path / "one.jsonl", "m") as recorder:
        recorder.add(ChatRequest("analyzer", (("user", "What?"),)), ChatReply("Yes."))
        recorder.add(ChatRequest("analyzer", (("user", "What is that?"),)), ChatReply("Yes."))
    with pytest.raises(ModelError) as caught:
        Replay.open(tmp_path / "one.jsonl").complete(request_)
    assert says in str(caught.value)


def test_a_folder_of_recordings_answers_as_one(tmp_path: Path) -> None:
    questions = [ChatRequest("analyzer", (("user", text),)) for text in ("Where?", "When?")]
    for name, question in zip(("a", "b"), questions, strict=True):
        with Recorder(tmp_path / f"{name}.jsonl", f"model-{name}") as recorder:
            recorder.add(question, ChatReply(f"From {name}."))
    replay = Replay.open(tmp_path)
    assert replay.name == "replay of model-a and model-b"
    assert [replay.complete(question).text for question in questions] == ["From a.", "From b."]
    with pytest.raises(ModelError, match=r"the nearest, in line 2 of b\.jsonl, differs from character 5 on"):
        replay.complete(ChatRequest("analyzer", (("user", "When!"),)))
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="has no recording"):
        Replay.open(tmp_path / "empty")


def test_a_budget_holds_in_a_replay_too(tmp_path: Path) -> None:
    recorded(tmp_path / "one.jsonl")
    ledger = Ledger(Budget(calls=2))
    model = open_model(f"replay:{tmp_path / 'one.jsonl'}", ModelSettings(), ledger)
    assert ask(MeteredModel(model, ledger), "analyzer", "Be brief.", "How many?", Number).value == 1
    with pytest.raises(BudgetError, match="2 calls"):
        ask(MeteredModel(model, ledger), "analyzer", "Be brief.", "How many?", Number)


HEADER = '{"kind": "sumo_adv recording of a language model", "schema": 1, "model": "m", "note": ""}\n'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"", "not a recording of this program; give the model.jsonl of a run"),
        (b"hello\nworld\n", "not a recording of this program"),
        (b"\xff\xfe", "not text in utf-8"),
        (HEADER.replace('"schema": 1', '"schema": 2').encode(), "schema 2, but this program reads 1; record it again"),
        (HEADER.encode() + b"{}\n", "Line 2 of the recording"),
        (HEADER.encode() + b"\n[1\n", "Line 3 of the recording"),
    ],
)
def test_files_that_are_no_recordings_are_refused(tmp_path: Path, text: bytes, says: str) -> None:
    (tmp_path / "one.jsonl").write_bytes(text)
    with pytest.raises(UsageError, match=says):
        open_model(f"replay:{tmp_path / 'one.jsonl'}", ModelSettings(), Ledger())


def test_a_missing_folder_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="cannot be written: no such file or directory"):
        Recorder(tmp_path / "none" / "one.jsonl", "m")
