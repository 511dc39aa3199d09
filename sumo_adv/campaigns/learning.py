"""What episodes learn: collected beside each run, and written into the bank at the end, in the plan's order."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from sumo_adv.datatypes import Parameter, Planner
from sumo_adv.errors import BankError, UsageError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import Evidence, IntentRecord, SceneSignature
from sumo_adv.parsing import parse_json


@dataclass(frozen=True, slots=True)
class Lesson:
    """One call of ``MemoryBank.record``."""

    evidence: Evidence
    intent: IntentRecord | None
    planner: Planner | None


class Collector(MemoryBank):
    """A bank that only reads; what would be recorded in it is kept in ``lessons``."""

    lessons: list[Lesson]

    def record(self, evidence: Evidence, *, intent: IntentRecord | None = None, planner: Planner | None = None) -> None:
        """Keep it for later."""
        self.lessons.append(Lesson(evidence, intent, planner))


def as_text(lessons: Iterable[Lesson]) -> str:
    """Lessons as JSON (never = null)."""
    plain = [asdict(lesson) for lesson in lessons]
    for each in plain:
        if each["evidence"]["min_ttc"] == float("inf"):
            each["evidence"]["min_ttc"] = None
    return json.dumps(plain, indent=1, ensure_ascii=False, allow_nan=False)


def lessons_of(text: str, what: str) -> list[Lesson]:
    """What ``as_text`` wrote. Raises UsageError that names ``what`` for anything else."""
    try:
        table = parse_json(text)
        return [Lesson(_evidence(e["evidence"]), _intent(e["intent"]), _planner(e["planner"])) for e in table]
    except (ValueError, LookupError, TypeError, AttributeError, BankError) as error:
        message = f"{type(error).__name__}: {error}"[:300]
        raise UsageError(f"{what} is damaged ({message}); delete the run's folder to have it run again.") from error


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


def teach(bank: MemoryBank, lessons: Iterable[Lesson]) -> int:
    """Record lessons in their order, but evidence that the bank holds; the number of pieces written.

    So it may be broken off and done again. Raises BankError.
    """
    held = {_key(e) for e in bank.evidence()}
    written = 0
    for lesson in lessons:
        if (key := _key(lesson.evidence)) in held:
            continue
        held.add(key)
        has_planner = lesson.planner is None or any(
            p.hash == lesson.planner.hash for p in bank.planners(lesson.evidence.label)
        )
        bank.record(lesson.evidence, intent=lesson.intent, planner=None if has_planner else lesson.planner)
        written += 1
    return written


def _key(evidence: Evidence) -> str:
    return json.dumps({**asdict(evidence), "created": ""}, sort_keys=True)
