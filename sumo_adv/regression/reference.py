"""Find the reference driver that passes a case before it is kept: a case that no driver can pass is no test.

``careful`` drives each case as ``regress --ego careful`` does. If it does not pass, the case counts as passed by those
of ``manoeuvre`` and ``reg157`` that avoid the collision by the verdict, in its kinematic check and in the loop.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from sumo_adv.datatypes import Level
from sumo_adv.files import scratch_prefix
from sumo_adv.metrics.reference import COMPETENT
from sumo_adv.regression.case import Expectation, read_case
from sumo_adv.regression.keep import keep_run
from sumo_adv.regression.runner import CaseMeasurements, CaseResult, judged
from sumo_adv.regression.suite import measure_cases
from sumo_adv.report.read import read_outcome
from sumo_adv.report.run_outcome import level_named

DRIVER, ITS_CHECK = "careful", "cc_human"


@dataclass(frozen=True, slots=True)
class Reference:
    """The result of reference drivers on an attack.

    Attributes:
        passed_by: The drivers that pass it.
        expect: What should be expected of an ego.
        why: Why ``careful`` does not pass, in a sentence; empty if it does.
    """

    passed_by: tuple[str, ...]
    expect: Expectation
    why: str = ""


def references(
    runs: Sequence[Path], expect: Expectation | None, workers: int, tell: Callable[[], None]
) -> list[Reference]:
    """Test the attacks of runs with reference drivers.

    Args:
        runs: The folders of the runs.
        expect: What is expected of an ego; None expects what the reference driver does.
        workers: The number of processes.
        tell: Called when a run is done.

    Returns:
        The results, in order.

    Raises:
        UsageError: The attack of a run cannot be kept.
        SumoAdvError: No worker process starts.
    """
    with TemporaryDirectory(prefix=scratch_prefix()) as scratch:
        suite, by_case = Path(scratch) / "suite", dict[str, CaseMeasurements]()
        cases = []
        for k, run in enumerate(runs):
            folder, _ = keep_run(run, suite, _below(_least(run)), f"{k:06d}")
            case = read_case(folder)
            tested = expect is not None and not expect.no_worse
            cases.append(replace(case, expect=expect) if tested and expect is not None else case)

        def done(measured: CaseMeasurements) -> None:
            by_case[measured.case] = measured
            tell()

        measure_cases(cases, DRIVER, Path(scratch) / "runs", workers, 1, done)
        answers = []
        for case, run in zip(cases, runs, strict=True):
            measured = by_case[case.name]
            result = judged(case, measured, None)
            passes = result.result is CaseResult.PASS
            of_contacts = case.expect.min_ttc is None  # the verdict judges only contacts
            passed_by = (DRIVER,) if passes else _by_the_verdict(run) if of_contacts else ()
            chosen = expect or _below(_expected(case.level, measured, bool(passed_by)))
            answers.append(Reference(passed_by, chosen, "" if passes else result.sentence))
        return answers


def _below(level: Level) -> Expectation:
    """Return the expectation that an ego avoids a level."""
    return Expectation.model_validate({"avoid": str(level)})


def _least(run: Path) -> Level:
    """Return the level that a reference driver must stay below: a collision, or the near miss that was found."""
    return min(level_named((read_outcome(run).get("outcome") or {}).get("level")), Level.COLLISION)


def _expected(found: Level, measured: CaseMeasurements, passed: bool) -> Level:
    """Return the level that an ego must stay below.

    It is the lowest one that a reference driver stays below, and at most the level that was found.
    """
    least = min(found, Level.COLLISION)
    if passed or measured.broken:
        return least
    return min(found, max(least, Level(min(level_named(measured.level) + 1, Level.SERIOUS))))


def _by_the_verdict(run: Path) -> tuple[str, ...]:
    """Return the drivers other than the careful one that avoid the collision of a run by its verdict."""
    avoiding = (read_outcome(run).get("outcome") or {}).get("preventable_by") or ()
    return tuple(name for name in avoiding if name in COMPETENT and name != ITS_CHECK)
