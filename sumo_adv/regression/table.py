"""The results of a suite as a table for a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from sumo_adv.regression.measured import Judged, Measured, Result
from sumo_adv.regression.suite import SuiteRun

HEAD = ("case", "result", "level", "min TTC", "delta-v", "baseline", "")


def lines(run: SuiteRun) -> list[str]:
    """A line a case, and a sum; the baseline's column only if there is a baseline."""
    rows = [_row(case) for case in run.cases]
    shown = [k for k in range(len(HEAD)) if k != 5 or any(case.before for case in run.cases)]
    widths = [max(len(row[k]) for row in (HEAD, *rows)) for k in range(len(HEAD))]
    table = ["  ".join(row[k].ljust(widths[k]) for k in shown).rstrip() for row in (HEAD, *rows)]
    return [*table, "", sentence(run)]


def sentence(run: SuiteRun) -> str:
    """How many cases have which result."""
    counts = [f"{many} {result}" for result, many in run.counts.items() if many or result is Result.PASS]
    return f"{len(run.cases)} case{'s' * (len(run.cases) != 1)} of {run.suite} against {run.ego}: {', '.join(counts)}."


def _row(case: Judged) -> Sequence[str]:
    m = case.measured
    measured = case.result not in (Result.NO_ENCOUNTER, Result.ERROR)
    figures = (m.level, _number(m.min_ttc, "s"), _number(m.delta_v, "m/s")) if measured else ("-", "-", "-")
    return (m.case, str(case.result), *figures, _before(case.before), case.sentence.split("\n")[0])


def _number(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.2f} {unit}"


def _before(m: Measured | None) -> str:
    if m is None or m.broken:
        return "-"
    return f"{m.level}, {_number(m.min_ttc, 's')}" if not m.collided else f"{m.level}, {_number(m.delta_v, 'm/s')}"
