"""Recordings: files with the exchanges between a run and its models, and a model that answers from such a file.

A file holds one JSON object per line. The first line is a header (schema, model, note). Every other line holds a
request, and the reply or the error.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from sumo_adv.errors import BudgetError, ModelError, UsageError
from sumo_adv.llm.chat import ChatModel, ChatReply, ChatRequest, Messages
from sumo_adv.parsing import parse_json

KIND = "sumo_adv recording of a language model"
RECORDING_SCHEMA = 1
REPLAYED_PREFIX = "replay of "
DIFFERENCE_CONTEXT = 30  # characters shown on both sides of the first difference of two questions


class Recorder:
    """A recording that is being written. Use it in a ``with`` statement. ``wrap`` a model to record its exchanges."""

    def __init__(self, path: Path, model: str, *, note: str = "") -> None:
        """Open the file and write the header.

        Args:
            path: The file.
            model: The name of the model.
            note: The origin of the answers.

        Raises:
            ModelError: The file cannot be written.
        """
        self._path = path
        self._lock = threading.Lock()
        header = {"kind": KIND, "schema": RECORDING_SCHEMA, "model": model.removeprefix(REPLAYED_PREFIX), "note": note}
        try:
            self._file = path.open("w", encoding="utf-8", newline="\n")
        except OSError as error:
            raise _unwritable(path, error) from error
        self._write(header)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file. A second call does nothing."""
        with self._lock:
            self._file.close()

    def wrap(self, model: ChatModel) -> ChatModel:
        """Return a model that answers like ``model`` and records the exchanges."""
        return _RecordedModel(model, self)

    def add(self, request: ChatRequest, answer: ChatReply | ModelError) -> None:
        """Write one exchange and flush. After ``close``, this does nothing.

        Raises:
            ModelError: The file cannot be written.
        """
        question = {
            "agent": request.agent, "sample": request.sample, "messages": [list(m) for m in request.messages],
            "shape": request.schema_name, "temperature": None,  # None means the temperature of the settings
        }  # fmt: skip
        if isinstance(answer, ModelError):
            kind = "budget" if isinstance(answer, BudgetError) else "model"
            result: dict[str, Any] = {"error": {
                "kind": kind, "message": str(answer), "retries": answer.retries, "seconds": answer.seconds,
            }}  # fmt: skip
        else:
            result = {"reply": asdict(answer)}
        self._write({"request": question, **result})

    def _write(self, line: dict[str, Any]) -> None:
        with self._lock:
            if self._file.closed:
                return
            try:
                self._file.write(json.dumps(line) + "\n")
                self._file.flush()
            except OSError as error:
                raise _unwritable(self._path, error) from error


def _unwritable(path: Path, error: OSError) -> ModelError:
    reason = (error.strerror or str(error)).lower()
    return ModelError(f"The recording {path} cannot be written: {reason}; give another folder.")


class _RecordedModel:
    def __init__(self, model: ChatModel, recorder: Recorder) -> None:
        self._model = model
        self._recorder = recorder
        self.name = model.name

    def complete(self, request: ChatRequest) -> ChatReply:
        try:
            reply = self._model.complete(request)
        except ModelError as error:
            self._recorder.add(request, error)
            raise
        self._recorder.add(request, reply)
        return reply


@dataclass(frozen=True, slots=True)
class Exchange:
    """One exchange of a recording.

    Attributes:
        place: The line and, if there are several files, the file.
        agent: The agent that asked.
        sample: The number that distinguishes repeated questions.
        messages: Pairs (role, content).
        answer: The reply or the error.
    """

    place: str
    agent: str
    sample: int
    messages: Messages
    answer: ChatReply | ModelError

    @property
    def key(self) -> str:
        """The key of the question; see ``question_key``."""
        return question_key(self.agent, self.messages, self.sample)


def question_key(agent: str, messages: Messages, sample: int) -> str:
    """Return the SHA-256 of a question's content, by which ``Replay`` looks it up."""
    return hashlib.sha256(json.dumps([agent, sample, [list(m) for m in messages]]).encode()).hexdigest()


class Replay:
    """A model that answers from a recording.

    It looks up a question by its content. A repeated question gets its answers in the recorded order.
    """

    def __init__(self, path: Path, model: str, exchanges: Sequence[Exchange]) -> None:
        """Index the exchanges.

        Args:
            path: The recording, for messages.
            model: The name of the recorded model.
            exchanges: The recorded exchanges.
        """
        self.name = REPLAYED_PREFIX + model
        self._path = path
        self._exchanges = tuple(exchanges)
        self._lock = threading.Lock()
        self._answers: dict[str, list[ChatReply | ModelError]] = {}
        for exchange in exchanges:
            self._answers.setdefault(exchange.key, []).append(exchange.answer)
        self._times: dict[str, int] = {}

    @classmethod
    def open(cls, path: Path | str) -> Replay:
        """Read a recording, or all recordings (``*.jsonl``) of a folder. An incomplete last line is ignored.

        Raises:
            UsageError: A file is not a recording, or the folder has none.
        """
        path = Path(path)
        if not path.is_dir():
            return cls(path, *_read(path, ""))
        recordings = [_read(file, f" of {file.name}") for file in sorted(path.glob("*.jsonl"))]
        if not recordings:
            raise UsageError(f"The folder {path} has no recording; give a model.jsonl of a run, or a folder of them.")
        models = dict.fromkeys(model for model, _ in recordings)
        return cls(path, " and ".join(models), [exchange for _, exchanges in recordings for exchange in exchanges])

    def complete(self, request: ChatRequest) -> ChatReply:
        """Return the recorded reply.

        Raises:
            ModelError: The recorded answer is an error, or the question is not recorded.
        """
        key = question_key(request.agent, request.messages, request.sample)
        with self._lock:
            turn = self._times.get(key, 0)
            self._times[key] = turn + 1
        answers = self._answers.get(key, [])
        if turn >= len(answers):
            raise ModelError(self._missing(request, len(answers)))
        answer = answers[turn]
        if isinstance(answer, ModelError):
            raise type(answer)(str(answer), retries=answer.retries, seconds=answer.seconds)
        return answer

    def _missing(self, request: ChatRequest, times: int) -> str:
        if times:
            return (
                f"The recording {self._path} answers this question of the {request.agent} only {times} times; "
                "record the run again."
            )
        of_agent = [e for e in self._exchanges if e.agent == request.agent]
        if not of_agent:
            return f"The recording {self._path} has no question of the {request.agent}; record the run again."
        new = _text(request.messages)
        nearest = max(of_agent, key=lambda e: (_common_prefix(_text(e.messages), new), e.sample == request.sample))
        old = _text(nearest.messages)
        if old == new:
            difference = f"is sample {nearest.sample} instead of {request.sample}"
        else:
            at = _common_prefix(old, new)
            there, here = (repr(text[max(0, at - DIFFERENCE_CONTEXT) : at + DIFFERENCE_CONTEXT]) for text in (old, new))
            difference = f"differs from character {at + 1} on: {there} recorded, {here} asked"
        return (
            f"The recording {self._path} lacks this question of the {request.agent}; record the run again "
            f"(the nearest, in {nearest.place}, {difference})."
        )


def _read(path: Path, of_file: str) -> tuple[str, list[Exchange]]:
    """Read the model and the exchanges of a file. ``of_file`` follows the line in the place of each exchange."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not text in UTF-8"
        raise UsageError(f"The recording {path} cannot be read: {reason.lower()}.") from error
    lines = text.split("\n")[:-1]
    header = _json(lines[0]) if lines else None
    if not isinstance(header, dict) or header.get("kind") != KIND:
        raise UsageError(f"The file {path} is not a recording of this program; give the model.jsonl of a run.")
    if header.get("schema") != RECORDING_SCHEMA:
        raise UsageError(
            f"The recording {path} has schema {header.get('schema')!r}, but this program reads {RECORDING_SCHEMA}; "
            "record it again."
        )
    exchanges = [
        _exchange(path, f"line {number}{of_file}", line)
        for number, line in enumerate(lines[1:], start=2)
        if line.strip()
    ]
    return str(header.get("model")), exchanges


def _exchange(path: Path, place: str, line: str) -> Exchange:
    value = _json(line)
    try:
        question = value["request"]
        messages = tuple((str(role), str(content)) for role, content in question["messages"])
        answer: ChatReply | ModelError
        if "reply" in value:
            answer = _reply(value["reply"])
        else:
            error = value["error"]
            kind = BudgetError if error["kind"] == "budget" else ModelError
            answer = kind(str(error["message"]), retries=int(error["retries"]), seconds=float(error["seconds"]))
        return Exchange(place, str(question["agent"]), int(question["sample"]), messages, answer)
    except (KeyError, TypeError, ValueError) as cause:
        raise UsageError(
            f"{place[0].upper()}{place[1:]} of the recording {path} is no exchange with a model; record the run again."
        ) from cause


def _reply(value: dict[str, Any]) -> ChatReply:
    kinds: dict[str, Any] = {f.name: type(f.default) for f in fields(ChatReply) if f.name not in ("text", "finish")}
    named = {name: kind(value[name]) for name, kind in kinds.items()}
    return ChatReply(str(value["text"]), **named, finish=str(value.get("finish", "")))


def _json(line: str) -> Any:
    try:
        return parse_json(line)
    except ValueError:
        return None


def _text(messages: Messages) -> str:
    return "\n".join(content for _, content in messages)


def _common_prefix(a: str, b: str) -> int:
    """Return the length of the common prefix of two texts."""
    return next((k for k, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
