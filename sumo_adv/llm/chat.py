"""The nouns of talking to a language model: a question, a reply, and who answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

Messages = tuple[tuple[str, str], ...]
CHARACTERS_A_TOKEN = 4  # of English text and code, roughly


@dataclass(frozen=True, slots=True)
class ChatRequest:
    """One question. ``messages``: (role, content) pairs; ``shape``: JSON schema of the answer, None = free text;
    ``sample``: tells repeated questions apart; ``temperature``: None = that of the settings."""

    agent: str
    messages: Messages
    shape: Mapping[str, Any] | None = None
    shape_name: str = ""
    sample: int = 0
    temperature: float | None = None


@dataclass(frozen=True, slots=True)
class ChatReply:
    """One answer. ``reasoning`` is kept and never sent back; ``seconds`` [s, to the ms] with all retries; ``mode``:
    how the shape was asked for: json_schema, json_object or text. Tokens are estimates where a server counts none."""

    text: str
    reasoning: str = ""
    prompt_tokens: int = 0
    completion_tokens: int = 0
    cached_tokens: int = 0
    seconds: float = 0.0
    retries: int = 0
    mode: str = "text"


class ChatModel(Protocol):
    """Who answers. Safe to call from several threads."""

    @property
    def name(self) -> str:
        """What files and messages call it."""
        ...

    def complete(self, request: ChatRequest) -> ChatReply:
        """The answer. Raises ModelError, BudgetError."""
        ...


def estimate_tokens(messages: Sequence[tuple[str, str]]) -> int:
    """How many tokens messages are, roughly: a quarter of their characters, rounded up."""
    return -(-sum(len(content) for _, content in messages) // CHARACTERS_A_TOKEN)
