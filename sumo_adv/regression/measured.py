"""What a case came to when it ran, and what that means for what is expected of the ego."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from typing import Any

from pydantic import TypeAdapter

from sumo_adv.datatypes import Level
from sumo_adv.regression.case import Case, Expectation

NO_CONCERN = 4.0  # s: a larger TTC is no danger to a driver (Minderhoud and Bovy 2001), so it is not compared
LOWER_TTC = 0.1  # s, a step of the simulation: a smaller loss of TTC is not worse
HARDER = 0.447  # m/s (1 mph, the bound of negligible severity): a smaller gain of delta-v is not worse


class Result(StrEnum):
    """How a case ended. Only ``PASS`` passes; ``NO_ENCOUNTER`` and ``INVALID`` say nothing about the ego."""

    PASS = "pass"
    FAIL = "fail"
    NO_ENCOUNTER = "no encounter"  # the ego never came into the trigger's situation
    INVALID = "invalid"  # the adversary could not drive the attack as a car can
    ERROR = "error"  # the ego's driver or the simulation broke


UNTESTED = (Result.NO_ENCOUNTER, Result.INVALID)


@dataclass(frozen=True, slots=True)
class Measured:
    """The outcome of a case. Times in s, speeds in m/s, never = None.

    broken: why nothing was measured, with ``missed``: because there was no encounter. level, collided, rear_end,
    failed_gates, min_ttc, delta_v, severity, contact_time, preventable_by: of the attempt's verdict. touched: another
    vehicle or object that the ego ran into. planner: why the adversary's planner failed. seconds: that it took. cause,
    cause_sentence: the kind of cause of a contact or near miss, and the cause in words.
    """

    case: str
    ego: str
    broken: str = ""
    missed: bool = False
    level: str = "none"
    collided: bool = False
    rear_end: bool = False
    failed_gates: tuple[str, ...] = ()
    min_ttc: float | None = None
    delta_v: float | None = None
    severity: str | None = None
    contact_time: float | None = None
    preventable_by: tuple[str, ...] = ()
    touched: str | None = None
    planner: str = ""
    seconds: float = 0.0
    cause: str | None = None
    cause_sentence: str = ""

    @property
    def compared_ttc(self) -> float:
        """The least TTC as far as it matters [s]."""
        return NO_CONCERN if self.min_ttc is None else min(self.min_ttc, NO_CONCERN)


@dataclass(frozen=True, slots=True)
class Judged:
    """A case with its result and the reason, in a sentence. ``before``: the same case in the baseline."""

    measured: Measured
    result: Result
    why: str
    before: Measured | None = None

    @property
    def sentence(self) -> str:
        """The reason, and why the ego was hit or nearly hit where the case fails."""
        cause = self.measured.cause_sentence if self.result is Result.FAIL and self.measured.touched is None else ""
        return " ".join(filter(None, (self.why, cause)))

    def row(self) -> dict[str, Any]:
        """As the JSON file has it."""
        return {"result": str(self.result), "why": self.why, **asdict(self.measured)}


def judged(case: Case, measured: Measured, before: Measured | None) -> Judged:
    """Whether a case came to what is expected of the ego. ``before``: what the baseline measured, None without one."""
    m = measured
    if m.missed:
        return Judged(m, Result.NO_ENCOUNTER, m.broken, before)
    if m.broken:
        return Judged(m, Result.ERROR, m.broken, before)
    if m.planner:
        return Judged(m, Result.INVALID, f"The adversary's planner failed: {m.planner}", before)
    if m.touched is not None:
        return Judged(m, Result.FAIL, f"The ego ran into {m.touched}.", before)
    if m.collided and m.failed_gates:
        gates = ", ".join(m.failed_gates)
        return Judged(m, Result.INVALID, f"The adversary collides, but no car can drive so ({gates}).", before)
    why = _broken_expectation(case.expect, m, before)
    return Judged(m, Result.FAIL if why else Result.PASS, why or _remark(m), before)


def _broken_expectation(expect: Expectation, m: Measured, before: Measured | None) -> str:
    """What does not hold, or empty."""
    if expect.level is not None and Level[m.level.upper()] >= expect.level:
        return f"The attack reaches {m.level}; it must stay below {expect.avoid}."
    counts = not m.rear_end and not m.failed_gates
    if expect.min_ttc is not None and counts and m.min_ttc is not None and m.min_ttc <= expect.min_ttc:
        return f"The least TTC is {m.min_ttc:.2f} s; it must stay above {expect.min_ttc:g} s."
    return _worse(m, before) if expect.no_worse else ""


def _worse(measured: Measured, before: Measured | None) -> str:
    """Why a case is worse than in the baseline, or empty. A baseline that broke or missed the encounter had no hit."""
    before = before or Measured(measured.case, "")
    hit, hit_before = (m.collided and not m.rear_end for m in (measured, before))
    if hit and not hit_before:
        return "The ego is hit, and was not in the baseline."
    if hit:
        harder = (measured.delta_v or 0.0) - (before.delta_v or 0.0)
        return f"The ego is hit {harder:.1f} m/s harder than in the baseline." if harder > HARDER else ""
    if before.broken or hit_before or measured.rear_end or measured.failed_gates:
        return ""
    lost = before.compared_ttc - measured.compared_ttc
    return f"The least TTC is {lost:.2f} s lower than in the baseline." if lost > LOWER_TTC else ""


def _remark(m: Measured) -> str:
    if m.rear_end:
        return "The adversary runs into the ego's back, which is not held against the ego."
    return ""


MEASURED = TypeAdapter(Measured)


def measured_of(row: Mapping[str, Any]) -> Measured:
    """A measurement from a row of the JSON file. Raises ValidationError."""
    names = {f.name for f in fields(Measured)}
    return MEASURED.validate_python({k: v for k, v in row.items() if k in names})
