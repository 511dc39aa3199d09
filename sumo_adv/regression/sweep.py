"""An attack over ranges of its numbers: where a driver passes and where it fails.

The numbers are those of the attack (parameters of the adversary's planner, ``delay``, ``acceleration``) and those of
the scenario (``ego.speed``, ``ego.depart``, ``ego.position``). At each point of a grid the attack is made once, as a
kept case is (``runner.py``). Without ``whole`` a coarse grid comes first, and then only points between neighbours that
came to different results: a region that lies between points of the coarse grid is not seen.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import groupby, product
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.config import MAX_ATTACK_DELAY_S, forget_environment
from sumo_adv.datatypes import Floats, Level
from sumo_adv.episode.assessment import attempt_of, checked, runner_of
from sumo_adv.episode.encounter_finder import EncounterFinder
from sumo_adv.episode.warm import WarmProcesses
from sumo_adv.errors import UsageError
from sumo_adv.files import scratch_prefix
from sumo_adv.regression.attack import breaks
from sumo_adv.regression.case import Expectation, KeptCase
from sumo_adv.regression.runner import elsewhere, settings_for, task_for
from sumo_adv.simulation.inputs import EgoRoute

REFERENCE = "careful"  # the driver that is the reference driver cc_human
MIN_COARSE_INTERVALS = 4  # of the first grid along an axis
OF_THE_SCENARIO: Mapping[str, tuple[str, float]] = {
    "ego.speed": ("m/s", 70.0), "ego.depart": ("s", 86_400.0), "ego.position": ("m", 1e6),
}  # fmt: skip
"""Numbers of the scenario: unit, and the highest value."""


class PointResult(StrEnum):
    """What came of a point."""

    PASS = "pass"
    FAIL = "fail"
    INVALID = "invalid"  # the adversary could not drive so, or its planner failed
    NO_ENCOUNTER = "no encounter"  # the ego never came into the trigger's situation


@dataclass(frozen=True, slots=True)
class Axis:
    """A number and the range that is swept.

    Attributes:
        name: The number.
        low: The lowest value.
        high: The highest value.
        unit: Its unit; empty without one.
    """

    name: str
    low: float
    high: float
    unit: str = ""

    def values(self, points: int) -> Floats:
        """Evenly spaced values, ``(points,)``."""
        return np.linspace(self.low, self.high, points)


@dataclass(frozen=True, slots=True)
class Point:
    """One attempt, or a point that lies between equal neighbours. min_ttc [s], inf = never; delta_v [m/s].
    measured: False if it has the result of its neighbours."""

    result: PointResult
    level: Level = Level.NONE
    min_ttc: float = float("inf")
    delta_v: float | None = None
    measured: bool = True


Index = tuple[int, ...]
Points = Mapping[Index, Point]


def axis_of(case: KeptCase, given: str) -> Axis:
    """The axis that ``NAME=LOW:HIGH`` means for a case. Raises UsageError: it means none."""
    name, equals, values = (part.strip() for part in given.partition("="))
    try:
        low, high = (float(value) for value in values.split(":"))
    except ValueError:
        raise UsageError(f"--over takes NAME=LOW:HIGH, such as gap=5:20, not '{given}'.") from None
    if not equals or not low < high or not np.isfinite([low, high]).all():
        raise UsageError(f"--over {given} needs a LOW below its HIGH.")
    bounds = _bounds(case)
    if name not in bounds:
        known = ", ".join(f"{own}={low:g}:{high:g}" for own, (_, low, high) in bounds.items())
        raise UsageError(f"The attack has no number '{name}'; it has {known}.")
    unit, least, most = bounds[name]
    if low < least or high > most:
        raise UsageError(f"The number '{name}' goes from {least:g} to {most:g} {unit}, not from {low:g} to {high:g}.")
    return Axis(name, low, high, unit)


def _bounds(case: KeptCase) -> dict[str, tuple[str, float, float]]:
    """By name of a number its unit and its bounds."""
    p = case.proposal
    bounds = {q.name: (q.unit, q.low, q.high) for q in p.planner.parameters}
    bounds["delay"] = ("s", 0.0, MAX_ATTACK_DELAY_S)
    if not isinstance(p.acceleration, tuple):
        bounds["acceleration"] = ("m/s2", -12.0, 8.0)
    if isinstance(case.run_input.ego, EgoRoute):
        bounds |= {name: (unit, 0.0, most) for name, (unit, most) in OF_THE_SCENARIO.items()}
    return bounds


def at_numbers(case: KeptCase, numbers: Mapping[str, float]) -> KeptCase:
    """The case with other numbers. It is attacked with exactly these, however the ego arrives."""
    run_input, p = case.run_input, case.proposal
    ego = run_input.ego
    if isinstance(ego, EgoRoute):
        ego = replace(
            ego, speed=numbers.get("ego.speed", ego.speed), depart=numbers.get("ego.depart", ego.depart),
            position=numbers.get("ego.position", ego.position),
        )  # fmt: skip
        run_input = replace(run_input, ego=ego)
    parameters = {**p.parameters, **{k: v for k, v in numbers.items() if k in p.parameters}}
    p = replace(
        p, parameters=parameters, delay=numbers.get("delay", p.delay),
        acceleration=numbers.get("acceleration", p.acceleration),
    )  # fmt: skip
    return replace(case, run_input=run_input, proposal=p, situation=None)


class SweepRunner(WarmProcesses):
    """Attacks a driver with the numbers of points; a context manager."""

    def __init__(self) -> None:
        super().__init__()
        forget_environment()

    def measure(
        self, case: KeptCase, ego: str, expect: Expectation, numbers: Sequence[Mapping[str, float]]
    ) -> list[Point]:
        """What comes of each point, in order.

        Points with the same scenario and start are attempts of one encounter.

        Raises:
            SumoAdvError: The driver or the simulation broke.
        """
        points: dict[int, Point] = {}

        def encounter(k: int) -> tuple[tuple[str, float], ...]:
            apart = ("delay", *OF_THE_SCENARIO)
            return tuple((name, value) for name, value in numbers[k].items() if name in apart)

        for _, group in groupby(sorted(range(len(numbers)), key=encounter), key=encounter):
            some = list(group)
            points |= dict(zip(some, self._encounter(case, ego, expect, [numbers[k] for k in some]), strict=True))
        return [points[k] for k in range(len(numbers))]

    def _encounter(
        self, case: KeptCase, ego: str, expect: Expectation, numbers: Sequence[Mapping[str, float]]
    ) -> list[Point]:
        cases = [at_numbers(case, each) for each in numbers]
        settings = settings_for(cases[0], ego)
        with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch, self._engine.episode() as engine:
            task = task_for(cases[0], settings, Path(scratch))
            record = EncounterFinder(cases[0].run_input, settings, task, engine, lambda *_: None).seek()
            if record is None or elsewhere(cases[0], record.found):
                return [Point(PointResult.NO_ENCOUNTER)] * len(cases)
            runner = runner_of(engine, self._sandboxes.of(settings), record.found, settings)
            points = []
            proposals = [each.proposal for each in cases]
            for p, result in zip(proposals, runner.attempt(proposals), strict=True):
                attempt = attempt_of(0, "sweep", p, result, record.found, settings)
                if (expect.level or Level.NONE) > Level.COLLISION:  # only then reference drivers decide
                    attempt = checked(attempt, result, runner, settings.goal, Level.COLLISION)
                verdict = attempt.verdict
                lost = attempt.ending in ("planner_failed", "crashed") or not verdict.feasible
                came = PointResult.FAIL if breaks(expect, verdict) else PointResult.PASS
                points.append(
                    Point(
                        PointResult.INVALID if lost else came, verdict.level, verdict.min_ttc,
                        verdict.delta_v if verdict.collided else None,
                    )
                )  # fmt: skip
            return points


def swept(
    measure: Callable[[Sequence[Index]], Sequence[Point]], axes: int, points: int, *, whole: bool = False
) -> dict[Index, Point]:
    """The results at all points of a grid.

    Args:
        measure: Returns what comes of some points.
        axes: The number of axes.
        points: The points along each axis.
        whole: Measure each point. Otherwise a coarse grid is refined along the border of different results.
    """
    step = 1
    while not whole and (points - 1) % (2 * step) == 0 and (points - 1) // (2 * step) >= MIN_COARSE_INTERVALS:
        step *= 2
    first = list(product(range(0, points, step), repeat=axes))
    found = dict(zip(first, measure(first), strict=True))
    while step > 1:
        step //= 2
        new = [i for i in product(range(0, points, step), repeat=axes) if i not in found]
        around = {i: [found[k] for k in _around(i, 2 * step)] for i in new}
        mixed = [i for i in new if len({each.result for each in around[i]}) > 1]
        came = dict(zip(mixed, measure(mixed), strict=True)) if mixed else {}
        found |= {i: came[i] if i in came else replace(around[i][0], measured=False) for i in new}
    return dict(sorted(found.items()))


def _around(index: Index, step: int) -> Iterator[Index]:
    """The points of the coarser grid that are the corners of the cell in which a point lies."""
    return product(*({k // step * step, -(-k // step) * step} for k in index))


def border(points: Points) -> list[tuple[float, ...]]:
    """The places, in steps of the grid, half-way between neighbours along the last axis of which one passes and the
    other fails; with two axes also along the first one."""
    places = []
    for index, point in points.items():
        for axis in range(len(index)):
            other = tuple(k + (n == axis) for n, k in enumerate(index))
            if other in points and {point.result, points[other].result} == {PointResult.PASS, PointResult.FAIL}:
                places.append(tuple(k + 0.5 * (n == axis) for n, k in enumerate(index)))
    return places


@dataclass(frozen=True, slots=True)
class Sweep:
    """A sweep of some drivers over the same numbers.

    Attributes:
        name: The attack's name.
        axes: One or two axes.
        count: Points along each axis.
        drivers: By name of a driver the points; the driver under test first.
    """

    name: str
    axes: tuple[Axis, ...]
    count: int
    drivers: Mapping[str, Points]

    def numbers(self, index: Sequence[float]) -> dict[str, float]:
        """The numbers at a place of the grid."""
        return {
            axis.name: round(axis.low + k * (axis.high - axis.low) / (self.count - 1), 6)
            for axis, k in zip(self.axes, index, strict=True)
        }

    def rows(self) -> list[dict[str, Any]]:
        """A row for each driver and point; never is None."""
        return [
            {
                "driver": driver, **self.numbers(index), "result": str(point.result), "level": str(point.level),
                "min_ttc": round(point.min_ttc, 4) if np.isfinite(point.min_ttc) else None,
                "delta_v": None if point.delta_v is None else round(point.delta_v, 4), "measured": point.measured,
            }
            for driver, points in self.drivers.items()
            for index, point in points.items()
        ]  # fmt: skip

    def document(self) -> dict[str, Any]:
        """What ``sweep.json`` holds."""
        return {
            "schema": 1, "name": self.name, "points": self.count,
            "over": [{"name": a.name, "low": a.low, "high": a.high, "unit": a.unit} for a in self.axes],
            "drivers": {
                driver: {
                    **{str(r): sum(p.result is r for p in points.values()) for r in PointResult},
                    "measured": sum(p.measured for p in points.values()),
                    "border": [self.numbers(place) for place in border(points)],
                }
                for driver, points in self.drivers.items()
            },
            "rows": self.rows(),
        }  # fmt: skip
