"""What episodes learn: collected beside each run, and written into the bank at the end, in the plan's order."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from sumo_adv.datatypes import Parameter, Planner
from sumo_adv.errors import BankError, UsageError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import (
    Composition,
    Evidence,
    IntentRecord,
    SceneSignature,
    composition_of,
    plain_composition,
)
from sumo_adv.parsing import parse_json


@dataclass(frozen=True, slots=True)
class Lesson:
    """One call of ``MemoryBank.record``."""

    evidence: Evidence
    intent: IntentRecord | None
    planner: Planner | None


@dataclass(frozen=True, slots=True)
class CompositionLesson:
    """One call of ``MemoryBank.record_composition``."""

    composition: Composition
    attempts: tuple[bool, ...]


@dataclass(frozen=True, slots=True)
class SettingLesson:
    """One call of ``MemoryBank.keep``."""

    key: str
    value: object


Lessons = Lesson | CompositionLesson | SettingLesson


class Collector(MemoryBank):
    """A bank that only reads; what would be recorded in it is kept in ``lessons``."""

    lessons: list[Lessons]

    def record(self, evidence: Evidence, *, intent: IntentRecord | None = None, planner: Planner | None = None) -> None:
        """Keep it for later."""
        self.lessons.append(Lesson(evidence, intent, planner))

    def record_composition(self, composition: Composition, attempts: Sequence[bool]) -> bool:
        """Keep it for later."""
        self.lessons.append(CompositionLesson(composition, tuple(attempts)))
        return any(attempts) or composition.key in self.settings(composition.key)

    def keep(self, key: str, value: object) -> None:
        """Keep it for later."""
        self.lessons.append(SettingLesson(key, value))


def as_text(lessons: Iterable[Lessons]) -> str:
    """Lessons as JSON (never = null)."""
    return json.dumps([_plain(lesson) for lesson in lessons], indent=1, ensure_ascii=False, allow_nan=False)


def _plain(lesson: Lessons) -> dict[str, Any]:
    if isinstance(lesson, CompositionLesson):
        return {"composition": plain_composition(lesson.composition), "attempts": lesson.attempts}
    plain = asdict(lesson)
    if isinstance(lesson, Lesson) and plain["evidence"]["min_ttc"] == float("inf"):
        plain["evidence"]["min_ttc"] = None
    return plain


def lessons_of(text: str, what: str) -> list[Lessons]:
    """What ``as_text`` wrote. Raises UsageError that names ``what`` for anything else."""
    try:
        return [_lesson(entry) for entry in parse_json(text)]
    except (ValueError, LookupError, TypeError, AttributeError, BankError) as error:
        reason = f"{type(error).__name__}: {error}"[:300]
        raise UsageError(f"{what} is damaged ({reason}); delete the run's folder to have it run again.") from error


def _lesson(entry: dict[str, Any]) -> Lessons:
    if "composition" in entry:
        attempts = tuple(entry["attempts"])
        if not all(isinstance(succeeded, bool) for succeeded in attempts):
            raise ValueError("the attempts with a composition must be true or false")
        return CompositionLesson(composition_of(entry["composition"]), attempts)
    if "key" in entry:
        return SettingLesson(str(entry["key"]), entry["value"])
    return Lesson(_evidence(entry["evidence"]), _intent(entry["intent"]), _planner(entry["planner"]))


def _evidence(e: dict[str, Any]) -> Evidence:
    acceleration = e["acceleration"]
    knots = tuple((float(t), float(a)) for t, a in acceleration) if isinstance(acceleration, list) else acceleration
    never = e["min_ttc"] is None
    return Evidence(**{
        **e, "scene": SceneSignature(**e["scene"]), "acceleration": knots,
        "min_ttc": float("inf") if never else e["min_ttc"],
    })  # fmt: skip


def _intent(i: dict[str, Any] | None) -> IntentRecord | None:
    return None if i is None else IntentRecord(**{**i, "applies": tuple(i["applies"])})


def _planner(p: dict[str, Any] | None) -> Planner | None:
    return None if p is None else Planner(**{**p, "parameters": tuple(Parameter(**q) for q in p["parameters"])})


def teach(bank: MemoryBank, lessons: Iterable[Lessons]) -> int:
    """Record lessons in their order, but evidence that the bank holds; the number of pieces written.

    Evidence comes first, then compositions and settings. So it may be broken off among the evidence and done again.
    Raises BankError.
    """
    held = {_key(e) for e in bank.evidence()}
    written = 0
    later = list[CompositionLesson | SettingLesson]()
    for lesson in lessons:
        if not isinstance(lesson, Lesson):
            later.append(lesson)
            continue
        if (key := _key(lesson.evidence)) in held:
            continue
        held.add(key)
        in_bank = lesson.planner is None or any(
            p.hash == lesson.planner.hash for p in bank.planners(lesson.evidence.label)
        )
        bank.record(lesson.evidence, intent=lesson.intent, planner=None if in_bank else lesson.planner)
        written += 1
    for lesson in later:
        if isinstance(lesson, CompositionLesson):
            written += bank.record_composition(lesson.composition, lesson.attempts)
        else:
            bank.keep(lesson.key, lesson.value)
    return written


def _key(evidence: Evidence) -> str:
    return json.dumps({**asdict(evidence), "created": ""}, sort_keys=True)
