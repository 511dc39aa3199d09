"""Asking a model for an answer of a given shape: take the JSON out, check it, and ask again with the exact error."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from sumo_adv.errors import BudgetError, ModelError
from sumo_adv.llm.chat import ChatModel, ChatRequest, Messages
from sumo_adv.llm.ledger import Ledger
from sumo_adv.llm.threads import start

T = TypeVar("T", bound=BaseModel)
FAULTS = 5  # told at a time
OBJECTS = 40  # looked for in prose
ECHO = 6000  # characters of a refused answer that are sent back

_THOUGHT = re.compile(r"<think(?:ing)?>.*?</think(?:ing)?>", re.DOTALL)
_END_OF_THOUGHT = re.compile(r"</think(?:ing)?>")
_OBJECT = re.compile(r'\{(?=\s*["}])')
_FENCE = re.compile(r"```[a-zA-Z]*[ \t]*\n(.*?)```", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Line:
    """A model and the ledger that its re-asked and dropped answers are counted in."""

    model: ChatModel
    ledger: Ledger


def right(answer: Any) -> str | None:
    """The check that finds nothing wrong."""
    return None


def ask(
    line: Line,
    agent: str,
    system: str,
    user: str,
    shape: type[T],
    *,
    check: Callable[[T], str | None] = right,
    re_asks: int = 1,
    sample: int = 0,
) -> T:
    """The model's answer as ``shape``. ``check`` gives None, or a sentence on what is wrong.

    A fault is sent back as a further turn, at most ``re_asks`` times. Raises ModelError (then "refused", with what was
    wrong) and BudgetError.
    """
    messages: Messages = (("system", system), ("user", user))
    schema = shape.model_json_schema()
    for turn in range(re_asks + 1):
        request = ChatRequest(agent, messages, schema, shape.__name__, sample)
        text = without_thought(line.model.complete(request).text)
        answer, fault = read_answer(text, shape)
        if answer is not None:
            fault = check(answer)
            if fault is None:
                return answer
        if turn < re_asks:
            line.ledger.count_re_ask(agent)
            again = f"That answer cannot be used. {fault}\nAnswer again: one JSON object, whole, and nothing else."
            messages = (*messages, ("assistant", text[:ECHO] or "(nothing)"), ("user", again))
    asked = "once" if re_asks == 0 else f"{re_asks + 1} times"
    raise ModelError(f"The {agent}'s answer from {line.model.name} was refused, asked {asked}. {fault}")


def ask_many(
    line: Line,
    agent: str,
    system: str,
    user: str,
    shape: type[T],
    *,
    samples: int,
    check: Callable[[T], str | None] = right,
    re_asks: int = 1,
) -> list[T]:
    """``samples`` answers to one question, asked at the same time, in the order of their numbers.

    Answers that fail are left out and counted as dropped. Raises the first one's ModelError if all fail, and
    BudgetError if one does for that.
    """
    one = partial(ask, line, agent, system, user, shape, check=check, re_asks=re_asks)
    waiting = [start(partial(one, sample=k)) for k in range(samples)]
    answers: list[T] = []
    failed: list[ModelError] = []
    for future in waiting:
        try:
            answers.append(future.result())
        except ModelError as error:
            failed.append(error)
    if spent := next((error for error in failed if isinstance(error, BudgetError)), None):
        raise spent
    if failed and not answers:
        raise failed[0]
    for _ in failed:
        line.ledger.count_dropped(agent)
    return answers


def without_thought(text: str) -> str:
    """A model's text without its <think> parts, also where the opening tag is missing."""
    text = _THOUGHT.sub("", text)
    return _END_OF_THOUGHT.split(text)[-1].strip()


def read_answer(text: str, shape: type[T]) -> tuple[T | None, str | None]:
    """(answer, None), or (None, what is wrong): of the JSON objects in ``text`` the first that is of the shape, looked
    for in the whole text, in fences and in prose, the last ones first."""
    decoder = json.JSONDecoder(parse_constant=_no_number)
    found, broken = _in_prose(text, decoder)
    fault = broken
    for value in (*_whole([text, *reversed(_FENCE.findall(text))], decoder), *reversed(found)):
        try:
            return shape.model_validate(value), None
        except ValidationError as error:
            fault = fault or _faults(error)
    return None, fault or ("There is no JSON object in it." if text else "It is empty.")


def _whole(parts: Iterable[str], decoder: json.JSONDecoder) -> Iterator[Any]:
    for part in parts:
        try:
            yield decoder.decode(part)
        except (ValueError, RecursionError):
            continue


def _in_prose(text: str, decoder: json.JSONDecoder) -> tuple[list[Any], str | None]:
    """The objects between other words, and what is wrong with the first that begins like one and is none."""
    found: list[Any] = []
    broken: str | None = None
    at = 0
    for _ in range(OBJECTS):
        begin = _OBJECT.search(text, at)
        if begin is None:
            break
        try:
            value, at = decoder.raw_decode(text, begin.start())
            found.append(value)
        except json.JSONDecodeError as error:
            broken = broken or f"Its JSON cannot be read: {error}."
            at = max(error.pos, begin.end())
        except (ValueError, RecursionError) as error:
            why = "it is nested too deep" if isinstance(error, RecursionError) else str(error)
            broken = broken or f"Its JSON cannot be read: {why}."
            break
    return found, broken


def _no_number(word: str) -> float:
    raise ValueError(f"{word} is no number of JSON")


def _faults(error: ValidationError) -> str:
    found = error.errors(include_url=False)
    said = [f"{'.'.join(str(p) for p in e['loc']) or 'the answer'}: {e['msg']}{_given(e)}" for e in found[:FAULTS]]
    more = f"; and {len(found) - FAULTS} more" if len(found) > FAULTS else ""
    return f"It is not of the shape asked for. {'; '.join(said)}{more}."


def _given(fault: Any) -> str:
    if fault["type"] in ("missing", "value_error"):
        return ""
    given = repr(fault["input"])
    return f" (given: {given if len(given) <= 80 else given[:77] + '...'})"
