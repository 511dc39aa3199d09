"""Exchanges with a model as lines of JSON: written while a run goes on, and answered from later.

The first line is a header (schema, model, note); each other one holds a request, and a reply or an error.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from sumo_adv.errors import BudgetError, ModelError, UsageError
from sumo_adv.llm.chat import ChatModel, ChatReply, ChatRequest, Messages

KIND = "sumo_adv recording of a language model"
SCHEMA = 1
REPLAYED = "replay of "
AROUND = 30  # characters shown of where two questions part


class Recorder:
    """An open recording; ``wrap`` a model to have its exchanges written. Use it in a ``with`` statement."""

    def __init__(self, path: Path, model: str, *, note: str = "") -> None:
        """Begin the file. ``note`` says where the answers come from. Raises ModelError if it cannot be written."""
        self._path = path
        self._lock = threading.Lock()
        header = {"kind": KIND, "schema": SCHEMA, "model": model.removeprefix(REPLAYED), "note": note}
        try:
            self._file = path.open("w", encoding="utf-8", newline="\n")
        except OSError as error:
            raise _unwritable(path, error) from error
        self._write(header)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; may be called twice."""
        with self._lock:
            self._file.close()

    def wrap(self, model: ChatModel) -> ChatModel:
        """The model, with every exchange written."""
        return _Recorded(model, self)

    def add(self, request: ChatRequest, answer: ChatReply | ModelError) -> None:
        """Write one exchange and flush. Raises ModelError. What comes after ``close`` is left out."""
        asked = {
            "agent": request.agent, "sample": request.sample, "messages": [list(m) for m in request.messages],
            "shape": request.shape_name, "temperature": request.temperature,
        }  # fmt: skip
        if isinstance(answer, ModelError):
            kind = "budget" if isinstance(answer, BudgetError) else "model"
            got: dict[str, Any] = {"error": {
                "kind": kind, "message": str(answer), "retries": answer.retries, "seconds": answer.seconds,
            }}  # fmt: skip
        else:
            got = {"reply": asdict(answer)}
        self._write({"request": asked, **got})

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
    return ModelError(f"The recording {path} cannot be written: {reason}; give another folder or correct that.")


class _Recorded:
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
    """One line of a recording."""

    number: int
    agent: str
    sample: int
    messages: Messages
    answer: ChatReply | ModelError

    @property
    def key(self) -> str:
        """What a question is found by."""
        return question_key(self.agent, self.messages, self.sample)


def question_key(agent: str, messages: Messages, sample: int) -> str:
    """SHA-256 of a question's content."""
    return hashlib.sha256(json.dumps([agent, sample, [list(m) for m in messages]]).encode()).hexdigest()


class Replay:
    """A model that answers from a recording, by the content of the question; repeated ones in the order recorded."""

    def __init__(self, path: Path, model: str, exchanges: Sequence[Exchange]) -> None:
        self.name = REPLAYED + model
        self._path = path
        self._exchanges = tuple(exchanges)
        self._lock = threading.Lock()
        self._answers: dict[str, list[ChatReply | ModelError]] = {}
        for exchange in exchanges:
            self._answers.setdefault(exchange.key, []).append(exchange.answer)
        self._asked: dict[str, int] = {}

    @classmethod
    def open(cls, path: Path | str) -> Replay:
        """Read a recording. A last line that was cut off is left out. Raises UsageError."""
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            reason = getattr(error, "strerror", None) or "it is not text in UTF-8"
            raise UsageError(f"The recording {path} cannot be read: {reason.lower()}.") from error
        lines = text.split("\n")[:-1]
        header = _json(lines[0]) if lines else None
        if not isinstance(header, dict) or header.get("kind") != KIND:
            raise UsageError(f"The file {path} is no recording of a language model by this program.")
        if header.get("schema") != SCHEMA:
            raise UsageError(
                f"The recording {path} has the schema {header.get('schema')!r}; this program reads {SCHEMA}."
            )
        exchanges = [_exchange(path, number, line) for number, line in enumerate(lines[1:], start=2) if line.strip()]
        return cls(path, str(header.get("model")), exchanges)

    def complete(self, request: ChatRequest) -> ChatReply:
        """The recorded answer. Raises ModelError: the recorded one, or that the question is not there."""
        key = question_key(request.agent, request.messages, request.sample)
        with self._lock:
            turn = self._asked.get(key, 0)
            self._asked[key] = turn + 1
        answers = self._answers.get(key, [])
        if turn >= len(answers):
            raise ModelError(self._missing(request, len(answers)))
        answer = answers[turn]
        if isinstance(answer, ModelError):
            raise type(answer)(str(answer), retries=answer.retries, seconds=answer.seconds)
        return answer

    def _missing(self, request: ChatRequest, times: int) -> str:
        if times:
            return f"The recording {self._path} answers this question of the {request.agent} only {times} times."
        own = [e for e in self._exchanges if e.agent == request.agent]
        if not own:
            return f"The recording {self._path} has no question of the {request.agent}."
        asked = _flat(request.messages)
        nearest = max(own, key=lambda e: (_common(_flat(e.messages), asked), e.sample == request.sample))
        said = f"The recording {self._path} does not have this question of the {request.agent}; the nearest, in line"
        there, at = _flat(nearest.messages), _common(_flat(nearest.messages), asked)
        if there == asked:
            return f"{said} {nearest.number}, is sample {nearest.sample} instead of {request.sample}."
        old, new = (repr(text[max(0, at - AROUND) : at + AROUND]) for text in (there, asked))
        return f"{said} {nearest.number}, differs from character {at + 1} on: {old} there, {new} asked."


def _exchange(path: Path, number: int, line: str) -> Exchange:
    value = _json(line)
    try:
        asked = value["request"]
        messages = tuple((str(role), str(content)) for role, content in asked["messages"])
        answer: ChatReply | ModelError
        if "reply" in value:
            answer = _reply(value["reply"])
        else:
            found = value["error"]
            kind = BudgetError if found["kind"] == "budget" else ModelError
            answer = kind(str(found["message"]), retries=int(found["retries"]), seconds=float(found["seconds"]))
        return Exchange(number, str(asked["agent"]), int(asked["sample"]), messages, answer)
    except (KeyError, TypeError, ValueError) as error:
        raise UsageError(f"Line {number} of the recording {path} is no exchange with a model.") from error


def _reply(value: dict[str, Any]) -> ChatReply:
    return ChatReply(
        text=str(value["text"]), reasoning=str(value["reasoning"]), prompt_tokens=int(value["prompt_tokens"]),
        completion_tokens=int(value["completion_tokens"]), cached_tokens=int(value["cached_tokens"]),
        seconds=float(value["seconds"]), retries=int(value["retries"]), mode=str(value["mode"]),
    )  # fmt: skip


def _json(line: str) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None


def _flat(messages: Messages) -> str:
    return "\n".join(content for _, content in messages)


def _common(a: str, b: str) -> int:
    """How many characters two texts begin alike with."""
    low, high = 0, min(len(a), len(b))
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if a[:middle] == b[:middle] else (low, middle - 1)
    return low
