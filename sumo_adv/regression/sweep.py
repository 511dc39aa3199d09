"""An attack over ranges of its numbers: where a driver passes and where it fails.

The numbers are those of the attack (parameters of the adversary's planner, ``delay``, ``acceleration``) and those of
the scenario (``ego.speed``, ``ego.depart``, ``ego.position``). At each point of a grid, the attack is made once, as a
kept case is (``runner.py``). Without ``whole``, a coarse grid comes first, and then only points between neighbours with
different results. A region that lies between points of the coarse grid is missed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import count, groupby, product
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.config import MAX_ATTACK_DELAY_S, forget_environment
from sumo_adv.datatypes import Attempt, Floats, Level
from sumo_adv.episode.assessment import attempt_of, checked, runner_of
from sumo_adv.episode.encounter_finder import EncounterFinder
from sumo_adv.episode.warm import WarmProcesses
from sumo_adv.errors import UsageError
from sumo_adv.files import scratch_prefix
from sumo_adv.regression.attack import breaks
from sumo_adv.regression.case import Expectation, KeptCase
from sumo_adv.regression.runner import elsewhere, settings_for, task_for
from sumo_adv.simulation.inputs import EgoRoute

REFERENCE = "careful"  # the driver that corresponds to the reference driver cc_human
MIN_COARSE_INTERVALS = 4  # minimum number of intervals of the first grid along an axis
OF_THE_SCENARIO: Mapping[str, tuple[str, float]] = {
    "ego.speed": ("m/s", 70.0), "ego.depart": ("s", 86_400.0), "ego.position": ("m", 1e6),
}  # fmt: skip
"""The numbers of the scenario, each with its unit and highest value."""


class PointResult(StrEnum):
    """The result at a point."""

    PASS = "pass"
    FAIL = "fail"
    INVALID = "invalid"  # the adversary could not move like that, or its planner failed
    NO_ENCOUNTER = "no encounter"  # the ego never reached the trigger's situation
    ERROR = "error"  # the ego's driver or the simulation failed


@dataclass(frozen=True, slots=True)
class Axis:
    """A number and the range that is swept.

    Attributes:
        name: The name of the number.
        low: The lowest value.
        high: The highest value.
        unit: Its unit; empty without one.
    """

    name: str
    low: float
    high: float
    unit: str = ""

    def values(self, points: int) -> Floats:
        """Return evenly spaced values, ``(points,)``.

        Args:
            points: The number of values.
        """
        return np.linspace(self.low, self.high, points)


@dataclass(frozen=True, slots=True)
class Point:
    """The result of one attempt, or of a point between neighbours with equal results.

    Attributes:
        result: The result.
        level: The level of the attempt.
        min_ttc: The minimum TTC [s]; inf means never.
        delta_v: The ego's delta-v [m/s]; None without a collision.
        measured: False if the point has the result of its neighbours.
    """

    result: PointResult
    level: Level = Level.NONE
    min_ttc: float = float("inf")
    delta_v: float | None = None
    measured: bool = True


Index = tuple[int, ...]
Points = Mapping[Index, Point]


def axis_of(case: KeptCase, given: str) -> Axis:
    """Parse ``NAME=LOW:HIGH`` as an axis of a case.

    Args:
        case: The kept case.
        given: The text.

    Raises:
        UsageError: The text is no axis, or the case has no such number or range.
    """
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


def numbers_of(case: KeptCase) -> tuple[str, ...]:
    """Return the names of the numbers of a case that can be swept.

    Args:
        case: The kept case.
    """
    return tuple(_bounds(case))


def _bounds(case: KeptCase) -> dict[str, tuple[str, float, float]]:
    """Return the unit and the bounds of each number, by name."""
    p = case.proposal
    bounds = {q.name: (q.unit, q.low, q.high) for q in p.planner.parameters}
    bounds["delay"] = ("s", 0.0, MAX_ATTACK_DELAY_S)
    if not isinstance(p.acceleration, tuple):
        bounds["acceleration"] = ("m/s2", -12.0, 8.0)
    if isinstance(case.run_input.ego, EgoRoute):
        bounds |= {name: (unit, 0.0, most) for name, (unit, most) in OF_THE_SCENARIO.items()}
    return bounds


def at_numbers(case: KeptCase, numbers: Mapping[str, float]) -> KeptCase:
    """Return a case with other numbers. It is attacked with exactly these, however the ego arrives.

    Args:
        case: The kept case.
        numbers: The numbers by name; others are kept.
    """
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
    """Attacks a driver with the numbers of points. Use it in a ``with`` statement."""

    def __init__(self) -> None:
        """Start without processes."""
        super().__init__()
        forget_environment()

    def measure(
        self, case: KeptCase, ego: str, expect: Expectation, numbers: Sequence[Mapping[str, float]],
        tell: Callable[[], None] = lambda: None,
    ) -> list[Point]:  # fmt: skip
        """Return the result at each point, in order.

        Points with the same scenario and start are attempts of one encounter.

        Args:
            case: The kept case.
            ego: The driver under test.
            expect: What is expected of the ego.
            numbers: The numbers of each point.
            tell: Called as each point ends.

        Raises:
            SumoAdvError: The driver or the simulation failed.
        """
        points: dict[int, Point] = {}

        def encounter(k: int) -> tuple[tuple[str, float], ...]:
            apart = ("delay", *OF_THE_SCENARIO)
            return tuple((name, value) for name, value in numbers[k].items() if name in apart)

        for _, group in groupby(sorted(range(len(numbers)), key=encounter), key=encounter):
            some = list(group)
            came = self._encounter(case, ego, expect, [numbers[k] for k in some], tell)
            points |= dict(zip(some, came, strict=True))
        return [points[k] for k in range(len(numbers))]

    def _encounter(
        self, case: KeptCase, ego: str, expect: Expectation, numbers: Sequence[Mapping[str, float]],
        tell: Callable[[], None],
    ) -> list[Point]:  # fmt: skip
        """Return the results at points with the same scenario and start."""
        cases = [at_numbers(case, each) for each in numbers]
        settings = settings_for(cases[0], ego)
        with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch, self._engine.episode() as engine:
            task = task_for(cases[0], settings, Path(scratch))
            record = EncounterFinder(cases[0].run_input, settings, task, engine, lambda *_: None).seek()
            if record is None or elsewhere(cases[0], record.found):
                for _ in cases:
                    tell()
                return [Point(PointResult.NO_ENCOUNTER)] * len(cases)
            runner = runner_of(engine, self._sandboxes.of(settings), record.found, settings)
            points = []
            proposals = [each.proposal for each in cases]
            for p, result in zip(proposals, runner.attempt(proposals), strict=True):
                attempt = attempt_of(0, "sweep", p, result, record.found, settings)
                if (expect.level or Level.NONE) > Level.COLLISION:  # only these levels need the reference drivers
                    attempt = checked(attempt, result, runner, settings.goal, Level.COLLISION)
                verdict = attempt.verdict
                delta_v = verdict.delta_v if verdict.collided else None
                points.append(Point(_result(attempt, expect), verdict.level, verdict.min_ttc, delta_v))
                tell()
            return points


def _result(attempt: Attempt, expect: Expectation) -> PointResult:
    """Return the result of an attempt."""
    if attempt.ending == "crashed":
        return PointResult.ERROR
    if attempt.ending == "planner_failed" or not attempt.verdict.feasible:
        return PointResult.INVALID
    return PointResult.FAIL if breaks(expect, attempt.verdict) else PointResult.PASS


def swept(
    measure: Callable[[Sequence[Index]], Sequence[Point]], axes: int, points: int, *, whole: bool = False
) -> dict[Index, Point]:
    """Return the results at all points of a grid.

    Args:
        measure: Returns the results at some points.
        axes: The number of axes.
        points: The number of points along each axis.
        whole: Whether to measure each point. Otherwise a coarse grid is refined along the border of different results.
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
    """Yield the points of the coarser grid that are the corners of the cell around a point."""
    return product(*({k // step * step, -(-k // step) * step} for k in index))


def border(points: Points) -> list[tuple[float, ...]]:
    """Return the places half-way between a point that passes and the next one that fails, along each axis.

    Points between them that neither pass nor fail are passed over.

    Args:
        points: The results by index.

    Returns:
        The places, in steps of the grid.
    """
    places = []
    judged = (PointResult.PASS, PointResult.FAIL)
    for index, point in points.items():
        for axis in range(len(index)) if point.result in judged else ():
            for far in count(1):
                other = points.get(tuple(k + far * (n == axis) for n, k in enumerate(index)))
                if other is None or other.result in judged:
                    break
            if other is not None and other.result != point.result:
                places.append(tuple(k + 0.5 * far * (n == axis) for n, k in enumerate(index)))
    return places


def changes_nothing(points: Points) -> bool:
    """Return whether all measured points pass or fail with the same outcome, to all digits.

    Args:
        points: The results by index.
    """
    measured = [point for point in points.values() if point.measured]
    judged = all(point.result in (PointResult.PASS, PointResult.FAIL) for point in measured)
    return judged and len(measured) > 1 and len(set(measured)) == 1


@dataclass(frozen=True, slots=True)
class Sweep:
    """A sweep of some drivers over the same numbers.

    Attributes:
        name: The name of the attack.
        axes: One or two axes.
        count: The number of points along each axis.
        drivers: The points of each driver, by name; the driver under test comes first.
    """

    name: str
    axes: tuple[Axis, ...]
    count: int
    drivers: Mapping[str, Points]

    def numbers(self, index: Sequence[float]) -> dict[str, float]:
        """Return the numbers at a place of the grid.

        Args:
            index: The place, in steps along each axis.
        """
        return {
            axis.name: round(axis.low + k * (axis.high - axis.low) / (self.count - 1), 6)
            for axis, k in zip(self.axes, index, strict=True)
        }

    def lines(self, names: Sequence[str]) -> list[str]:
        """Describe the results of each driver: counts, share of passes, and border.

        Args:
            names: The names of all numbers that the case has.
        """
        lines = []
        swept_names = " and ".join(axis.name for axis in self.axes)
        others = [name for name in names if name not in {axis.name for axis in self.axes}]
        for driver, points in self.drivers.items():
            results = [point.result for point in points.values()]
            counts = ", ".join(f"{results.count(result)} {result}" for result in PointResult)
            share = f" ({100 * results.count(PointResult.PASS) / len(results):.0f} % pass)"
            measured = sum(point.measured for point in points.values())
            lines.append(f"{driver}: {counts}{share}; {measured} of {len(points)} points were measured.")
            if changes_nothing(points):
                more = f"; the case also has {', '.join(others)}" if others else ""
                change = "changes" if len(self.axes) == 1 else "change"
                lines.append(f"  {swept_names} {change} nothing for {driver}{more}")
            else:
                lines.append(f"  {self._border_words(points)}")
        return lines

    def _border_words(self, points: Points) -> str:
        """Say where the border of a driver is: each place, or with two numbers the range of each."""
        places = [self.numbers(place) for place in border(points)]
        if not places:
            return "no border in the range"
        where = []
        for axis in self.axes:
            values = sorted({place[axis.name] for place in places})
            if len(self.axes) > 1 and len(values) > 1:
                words = f"from {values[0]:g} to {values[-1]:g}"
            else:
                words = f"= {', '.join(f'{value:g}' for value in values)}"
            where.append(f"{axis.name} {words} {axis.unit}".rstrip())
        return f"border at {', '.join(where)}"

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each driver and point; an infinite TTC is None."""
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
        """Return the content of ``sweep.json``."""
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
