"""What all parts of this package share: a request to a language model, its reply, and the protocol of a model."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

Messages = tuple[tuple[str, str], ...]
CHARACTERS_PER_TOKEN = 4  # of English text and code, roughly
CUT = "length"  # the finish_reason of an answer that ended at the token limit
T = TypeVar("T")
_THOUGHT = re.compile(r"<think(?:ing)?>.*?</think(?:ing)?>", re.DOTALL)
_END_OF_THOUGHT = re.compile(r"</think(?:ing)?>")
_UNENDED_THOUGHT = re.compile(r"^\s*<think(?:ing)?>")


@dataclass(frozen=True, slots=True)
class ChatRequest:
    """One question to a model.

    messages: (role, content) pairs.
    schema: JSON schema of the answer, None for free text; ``schema_name`` is its name.
    sample: number that tells repeated questions apart.
    temperature: None for the temperature of the settings.
    """

    agent: str
    messages: Messages
    schema: Mapping[str, Any] | None = None
    schema_name: str = ""
    sample: int = 0
    temperature: float | None = None


@dataclass(frozen=True, slots=True)
class ChatReply:
    """One answer of a model.

    reasoning: kept in recordings and never sent back.
    prompt_tokens, completion_tokens: estimates if the server does not count them.
    seconds: duration of the question with all its retries [s], rounded to ms.
    mode: how the schema was sent: json_schema, json_object or text.
    finish: the server's finish_reason, "" if it gives none; ``CUT`` is the token limit.
    """

    text: str
    reasoning: str = ""
    prompt_tokens: int = 0
    completion_tokens: int = 0
    cached_tokens: int = 0
    seconds: float = 0.0
    retries: int = 0
    mode: str = "text"
    finish: str = ""


class ChatModel(Protocol):
    """A language model that answers questions. Implementations can be called from several threads."""

    @property
    def name(self) -> str:
        """The model's name in files and messages."""
        ...

    def complete(self, request: ChatRequest) -> ChatReply:
        """The model's reply. Raises ModelError, BudgetError."""
        ...


def estimate_tokens(messages: Sequence[tuple[str, str]]) -> int:
    """Rough number of tokens of messages: a quarter of their characters, rounded up."""
    return -(-sum(len(content) for _, content in messages) // CHARACTERS_PER_TOKEN)


def without_thought(text: str) -> str:
    """A model's text without <think> parts. The opening tag may be missing; without a closing one all is thought."""
    text = _END_OF_THOUGHT.split(_THOUGHT.sub("", text))[-1]
    return "" if _UNENDED_THOUGHT.match(text) else text.strip()


def one_line(text: str) -> str:
    """A text on one line: control characters become spaces, and every run of spaces becomes one space."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def run_in_thread(work: Callable[[], T]) -> Future[T]:
    """Run ``work`` in a daemon thread. Ctrl-C interrupts the wait for its result, and the program can end before it."""
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future
