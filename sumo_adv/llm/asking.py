"""Ask a model for an answer of a given type: extract the JSON from the reply, check it, and ask again if it is wrong.

The repeated question contains the exact fault. Recordings depend on the texts of faults, so a changed text needs new
recordings.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from sumo_adv.errors import BudgetError, ModelError
from sumo_adv.llm.chat import CUT_SHORT, ChatModel, ChatRequest, Ledger, Messages, run_in_thread, without_thought

T = TypeVar("T", bound=BaseModel)
MAX_LISTED_FAULTS = 200  # faults of an answer that are sent back; a serious answer has fewer
MAX_OBJECTS_IN_PROSE = 40  # objects that are read from prose
MAX_ECHO_CHARACTERS = 6000  # characters of a refused answer that are sent back

_OBJECT = re.compile(r'\{(?=\s*["}])')
_FENCE = re.compile(r"```[a-zA-Z]*[ \t]*\n(.*?)```", re.DOTALL)


@dataclass(frozen=True, slots=True)
class MeteredModel:
    """A model, and the ledger that counts its repeated questions and dropped answers."""

    model: ChatModel
    ledger: Ledger


def ask(
    metered: MeteredModel,
    agent: str,
    system: str,
    user: str,
    answer_type: type[T],
    *,
    check: Callable[[T], str | None] = lambda _: None,
    re_asks: int = 1,
    sample: int = 0,
    schema: Mapping[str, Any] | None = None,
) -> T:
    """Ask a model one question.

    Args:
        metered: The model, and its ledger.
        agent: The agent that asks.
        system: The system message.
        user: The user message.
        answer_type: The type of the answer.
        check: Returns None for a usable answer, or otherwise a sentence for the model that says what is wrong.
        re_asks: How often a fault is sent back as a further turn of the conversation.
        sample: A number that distinguishes repeated questions.
        schema: A JSON schema that is more specific than the type; None means the schema of ``answer_type``.

    Returns:
        The answer.

    Raises:
        ModelError: The model failed, or no answer was usable. The message contains the last fault.
        BudgetError: The run's budget is used up.
    """
    messages: Messages = (("system", system), ("user", user))
    schema = answer_type.model_json_schema() if schema is None else schema
    for turn in range(re_asks + 1):
        request = ChatRequest(agent, messages, schema, answer_type.__name__, sample)
        reply = metered.model.complete(request)
        text = without_thought(reply.text)
        answer, fault = read_answer(text, answer_type)
        if answer is None and not text:  # some servers put the answer with the reasoning
            answer, _ = read_answer(reply.reasoning or reply.text, answer_type)
        if answer is None and reply.finish == CUT_SHORT:
            fault = f"It was cut at the token limit; answer in fewer words. {fault}"
        if answer is not None:
            fault = check(answer)
            if fault is None:
                return answer
        if turn < re_asks:
            metered.ledger.count_one(agent, "re_asks")
            again = f"That answer cannot be used. {fault}\nAnswer again: one JSON object, whole, and nothing else."
            messages = (*messages, ("assistant", text[:MAX_ECHO_CHARACTERS] or "(nothing)"), ("user", again))
    times = "once" if re_asks == 0 else f"{re_asks + 1} times"
    advice = "raise llm_answer_tokens or the server's own limit" if reply.finish == CUT_SHORT else "try another model"
    raise ModelError(
        f"The {agent}'s answer from {metered.model.name} was refused {times}; {advice}. Last fault: {fault}"
    )


def ask_many(
    metered: MeteredModel,
    agent: str,
    system: str,
    user: str,
    answer_type: type[T],
    *,
    samples: int,
    check: Callable[[T], str | None] = lambda _: None,
    re_asks: int = 1,
    schema: Mapping[str, Any] | None = None,
) -> list[T]:
    """Ask one question several times in parallel. The other arguments are those of ``ask``.

    Args:
        samples: The number of times.

    Returns:
        The answers, in the order of their sample numbers. Failed samples are left out and counted as dropped.

    Raises:
        BudgetError: The budget was used up during a sample.
        ModelError: All samples failed; this is the first failure.
    """
    ask_once = partial(ask, metered, agent, system, user, answer_type, check=check, re_asks=re_asks, schema=schema)
    waiting = [run_in_thread(partial(ask_once, sample=k)) for k in range(samples)]
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
        metered.ledger.count_one(agent, "dropped")
    return answers


def read_answer(text: str, answer_type: type[T]) -> tuple[T | None, str | None]:
    """Read an answer from a model's text.

    The answer is the first JSON object of the given type. The whole text is tried first, then fenced blocks, then
    objects in prose. Fenced blocks are tried from the last to the first, and so are objects in prose.

    Args:
        text: The model's text.
        answer_type: The type of the answer.

    Returns:
        The answer and None, or None and the fault.
    """
    decoder = json.JSONDecoder(parse_constant=_reject_constant)
    in_prose, fault = _objects_in_prose(text, decoder)
    for value in (*_whole([text, *reversed(_FENCE.findall(text))], decoder), *reversed(in_prose)):
        try:
            return answer_type.model_validate(value), None
        except ValidationError as error:
            fault = fault or _faults(error)
    return None, fault or ("There is no JSON object in it." if text else "It is empty.")


def _whole(parts: Iterable[str], decoder: json.JSONDecoder) -> Iterator[Any]:
    for part in parts:
        try:
            yield decoder.decode(part)
        except (ValueError, RecursionError):
            continue


def _objects_in_prose(text: str, decoder: json.JSONDecoder) -> tuple[list[Any], str | None]:
    """Find the JSON objects in prose, and the fault of the first object that cannot be read."""
    objects: list[Any] = []
    fault: str | None = None
    at = 0
    for _ in range(MAX_OBJECTS_IN_PROSE):
        begin = _OBJECT.search(text, at)
        if begin is None:
            break
        try:
            value, at = decoder.raw_decode(text, begin.start())
            objects.append(value)
        except json.JSONDecodeError as error:
            fault = fault or f"Its JSON cannot be read: {error}."
            at = max(error.pos, begin.end())
        except (ValueError, RecursionError) as error:
            why = "it is nested too deep" if isinstance(error, RecursionError) else str(error)
            fault = fault or f"Its JSON cannot be read: {why}."
            break
    return objects, fault


def _reject_constant(word: str) -> float:
    raise ValueError(f"{word} is no number of JSON")


def _faults(error: ValidationError) -> str:
    errors = error.errors(include_url=False)
    texts = [
        f"{'.'.join(str(p) for p in e['loc']) or 'the answer'}: {e['msg']}{_given(e)}"
        for e in errors[:MAX_LISTED_FAULTS]
    ]
    more = f"; and {len(errors) - MAX_LISTED_FAULTS} more" if len(errors) > MAX_LISTED_FAULTS else ""
    return f"It is not of the shape asked for. {'; '.join(texts)}{more}."


def _given(fault: Any) -> str:
    if fault["type"] in ("missing", "value_error"):
        return ""
    given = repr(fault["input"])
    return f" (given: {given if len(given) <= 80 else given[:77] + '...'})"
