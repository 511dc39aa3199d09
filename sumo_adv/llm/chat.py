"""The shared parts of this package: requests and replies, the protocol of a model, and a run's budget and ledger."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from sumo_adv.config import ModelSettings
from sumo_adv.errors import BudgetError, ModelError

Messages = tuple[tuple[str, str], ...]
CHARACTERS_PER_TOKEN = 4  # of English text and code, roughly
CUT_SHORT = "length"  # the finish_reason of an answer that ended at the token limit
T = TypeVar("T")
_START_OF_THOUGHT = re.compile(r"<think(?:ing)?>")
_END_OF_THOUGHT = re.compile(r"</think(?:ing)?>")
_UNENDED_THOUGHT = re.compile(r"^\s*<think(?:ing)?>")
LEDGER_COUNTS = (
    "calls", "prompt_tokens", "completion_tokens", "cached_tokens", "milliseconds", "retries", "re_asks", "dropped",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ChatRequest:
    """One question to a model.

    Attributes:
        agent: The agent that asks.
        messages: Pairs (role, content).
        schema: The JSON schema of the answer; None for free text.
        schema_name: The name of the schema.
        sample: A number that distinguishes repeated questions.
    """

    agent: str
    messages: Messages
    schema: Mapping[str, Any] | None = None
    schema_name: str = ""
    sample: int = 0


@dataclass(frozen=True, slots=True)
class ChatReply:
    """One answer of a model.

    Attributes:
        text: The answer.
        reasoning: The model's reasoning. It is kept in recordings and never sent back.
        prompt_tokens: The number of tokens of the question; an estimate if the server does not count them.
        completion_tokens: The number of tokens of the answer; an estimate if the server does not count them.
        cached_tokens: The number of the question's tokens that the server had cached.
        seconds: The duration of the question with all its retries [s], rounded to ms.
        retries: The number of retries.
        mode: How the schema was sent: json_schema, json_object or text.
        finish: The server's finish_reason, or "" if it gives none. ``CUT_SHORT`` means the token limit.
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
        """Answer a question.

        Raises:
            ModelError: The model failed.
            BudgetError: The run's budget is used up.
        """
        ...


def estimate_tokens(messages: Sequence[tuple[str, str]]) -> int:
    """Estimate the number of tokens of messages (role, content): a quarter of their characters, rounded up."""
    return -(-sum(len(content) for _, content in messages) // CHARACTERS_PER_TOKEN)


def without_thought(text: str) -> str:
    """Remove the <think> parts from a model's text.

    The opening tag may be missing. If the text begins with an opening tag and has no closing tag, nothing is left.
    """
    kept, position = list[str](), 0
    while (start := _START_OF_THOUGHT.search(text, position)) and (end := _END_OF_THOUGHT.search(text, start.end())):
        kept.append(text[position : start.start()])
        position = end.end()
    text = _END_OF_THOUGHT.split("".join((*kept, text[position:])))[-1]
    return "" if _UNENDED_THOUGHT.match(text) else text.strip()


def one_line(text: str) -> str:
    """Put a text on one line. Control characters become spaces, and every run of spaces becomes one space."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def run_in_thread(work: Callable[[], T]) -> Future[T]:
    """Run a function in a daemon thread.

    Ctrl-C interrupts the wait for the result, and the program can end before the function does.

    Args:
        work: The function.

    Returns:
        The future of its result.
    """
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future


@dataclass(frozen=True, slots=True)
class Budget:
    """The limits of one run. None means no limit.

    Attributes:
        calls: The number of calls.
        tokens: The number of tokens.
        seconds: The sum of the durations of all questions, including parallel ones [s].
    """

    calls: int | None = None
    tokens: int | None = None
    seconds: float | None = None


class Ledger:
    """Counts calls, tokens, time, retries, re-asks and dropped answers per agent. It can be used from several threads.

    Durations are summed in whole milliseconds, so the sum does not depend on the order of parallel answers.

    Attributes:
        budget: The limits of the run.
        waited: The time during which at least one question was open [s]. A replay adds almost none.
    """

    def __init__(self, budget: Budget | None = None, clock: Callable[[], float] = time.perf_counter) -> None:
        """Begin with zero counts.

        Args:
            budget: The limits of the run; None means no limits.
            clock: Returns the time [s] by which waiting is measured.
        """
        self.budget = budget or Budget()
        self.waited = 0.0
        self._clock, self._open, self._since = clock, 0, 0.0
        self._lock = threading.Lock()
        self._agents: dict[str, dict[str, int]] = {}

    @classmethod
    def for_settings(cls, settings: ModelSettings) -> Ledger:
        """Make an empty ledger with the budget of the settings."""
        return cls(Budget(settings.llm_max_calls, settings.llm_max_tokens, settings.llm_max_seconds))

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Count the time in this context as waiting for an open question."""
        with self._lock:
            self._since = self._since if self._open else self._clock()
            self._open += 1
        try:
            yield
        finally:
            with self._lock:
                self._open -= 1
                self.waited += 0.0 if self._open else self._clock() - self._since

    def waited_so_far(self) -> float:
        """Return ``waited`` plus the time of the questions that are open now [s]."""
        with self._lock:
            return self.waited + (self._clock() - self._since if self._open else 0.0)

    def admit(self, request: ChatRequest) -> None:
        """Count a call before it is made.

        Raises:
            BudgetError: The call would exceed the budget, by an estimate of its tokens.
        """
        estimate = estimate_tokens(request.messages)
        with self._lock:
            spent, allowed = self._totals(), self.budget
            tokens = spent["prompt_tokens"] + spent["completion_tokens"]
            if allowed.calls is not None and spent["calls"] >= allowed.calls:
                raise BudgetError(
                    f"The run has used its {allowed.calls} calls of language models; raise llm_max_calls for more."
                )
            if allowed.tokens is not None and tokens + estimate > allowed.tokens:
                raise BudgetError(
                    f"The next question would exceed the {allowed.tokens} tokens of the run, of which {tokens} are "
                    "used; raise llm_max_tokens for more."
                )
            if allowed.seconds is not None and spent["milliseconds"] >= 1000 * allowed.seconds:
                raise BudgetError(
                    f"The run has used its {allowed.seconds:g} s of language models; raise llm_max_seconds for more."
                )
            self._add(request.agent, "calls", 1)

    def count(self, agent: str, answer: ChatReply | ModelError) -> None:
        """Count the retries and duration of a question, and the tokens of its reply."""
        with self._lock:
            for name in ("prompt_tokens", "completion_tokens", "cached_tokens", "retries"):
                self._add(agent, name, getattr(answer, name, 0))  # an error has no tokens
            self._add(agent, "milliseconds", round(1000 * answer.seconds))

    def count_one(self, agent: str, name: str) -> None:
        """Count one event of an agent.

        Args:
            agent: The agent.
            name: ``re_asks`` for a question that is repeated because its answer was unusable, or ``dropped`` for a
                sample without a usable answer.
        """
        with self._lock:
            self._add(agent, name, 1)

    def seconds_left(self) -> float | None:
        """Return the remaining time budget [s], or None if there is no limit."""
        with self._lock:
            if self.budget.seconds is None:
                return None
            return max(0.0, self.budget.seconds - self._totals()["milliseconds"] / 1000)

    def as_dict(self) -> dict[str, Any]:
        """Return the totals and, under ``agents``, the same counts per agent. Seconds are rounded to ms."""
        with self._lock:
            agents = {agent: _with_seconds(counts) for agent, counts in sorted(self._agents.items())}
            return {**_with_seconds(self._totals()), "agents": agents}

    def _add(self, agent: str, name: str, number: int) -> None:
        counts = self._agents.setdefault(agent, dict.fromkeys(LEDGER_COUNTS, 0))
        counts[name] += number

    def _totals(self) -> dict[str, int]:
        return {name: sum(counts[name] for counts in self._agents.values()) for name in LEDGER_COUNTS}


def _with_seconds(counts: dict[str, int]) -> dict[str, Any]:
    return {
        ("seconds" if k == "milliseconds" else k): (v / 1000 if k == "milliseconds" else v) for k, v in counts.items()
    }


class BudgetedModel:
    """A model with a ledger. It checks the budget before each question and counts the cost after it."""

    def __init__(self, model: ChatModel, ledger: Ledger) -> None:
        self._model = model
        self._ledger = ledger
        self.name = model.name

    def complete(self, request: ChatRequest) -> ChatReply:
        """Answer a question.

        Raises:
            ModelError: The model failed.
            BudgetError: The call would exceed the budget.
        """
        self._ledger.admit(request)
        try:
            with self._ledger.waiting():
                reply = self._model.complete(request)
        except ModelError as error:
            self._ledger.count(request.agent, error)
            raise
        self._ledger.count(request.agent, reply)
        return reply
