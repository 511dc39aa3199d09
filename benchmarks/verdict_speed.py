"""How long the verdicts take.  ``python benchmarks/verdict_speed.py``; best of several runs, one core.

Bounds (issue 3): TTC of the ego against 100 vehicles x 91 steps < 10 ms, a gate verdict on 120 steps with 10 others
< 5 ms, the levels of a collision with five reference drivers < 200 ms, a full verdict < 150 ms; 150 rollouts against
``cc_human`` < 200 ms, with ``manoeuvre`` < 500 ms; scoring of 60 predicted rollouts (avoidability, three delays)
< 30 ms.  What a run adds to the full verdict: the rows of ``criticality.csv.gz``, markings and realism, each < 50 ms.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from shapely import box

from sumo_adv.datatypes import Boxes, Floats, LaneStrip, Role, Track
from sumo_adv.metrics.case import Case
from sumo_adv.metrics.criticality import ttc
from sumo_adv.metrics.further import further_figures
from sumo_adv.metrics.markings import markings_crossed
from sumo_adv.metrics.reference.counterfactual import Encounters, driver_outcomes
from sumo_adv.metrics.verdict import judge_attempt
from sumo_adv.report.tables import series_rows
from sumo_adv.report.verdicts import realism_figures
from sumo_adv.simulation.network import Drivable

DT = 0.1
TIME = np.arange(0.0, 12.0, DT)


def best(work: Callable[[], object], runs: int = 15) -> float:
    """Least time of several runs [ms]."""
    took = []
    for _ in range(runs):
        start = time.perf_counter()
        work()
        took.append(time.perf_counter() - start)
    return 1000 * min(took)


def track(name: str, x: Floats, y: Floats, speed: float) -> Track:
    """A car of 5 x 1.8 m along +x."""
    heading = np.arctan2(np.gradient(y, DT), speed)
    role = Role(name) if name in {"ego", "adversary"} else Role.BACKGROUND
    return Track(name, role, TIME, x, y, heading, np.full(len(TIME), speed), np.zeros(len(TIME)), 5.0, 1.8)


def cut_in(speed: float, ahead: float, duration: float) -> Track:
    """A lane change of 3.2 m towards the ego from 2 s on."""
    u = np.clip((TIME - 2.0) / duration, 0.0, 1.0)
    return track("adversary", ahead + speed * TIME, 3.2 * (1 - u**3 * (10 - 15 * u + 6 * u * u)), speed)


def rollouts(tracks: list[Track]) -> Boxes:
    """Tracks as ``(n, steps)``."""
    x, y, heading, speed = (np.stack([getattr(t, n) for t in tracks]) for n in ("x", "y", "heading", "speed"))
    return Boxes(x, y, heading, speed, 5.0, 1.8)


def main() -> int:
    """Print a line a figure; 1 if one is over its bound."""
    generator = np.random.default_rng(0)
    x, y, heading, speed = generator.uniform(-50, 50, (4, 100, 91))
    vehicles = Boxes(x, y, heading, speed, 5.0, 2.0)
    x, y, heading, speed = generator.uniform(-50, 50, (4, 91))
    vehicle = Boxes(x, y, heading, speed, 5.0, 2.0)
    ego, adversary = track("ego", 15 * TIME, 0 * TIME, 15.0), cut_in(9.0, 50.0, 5.0)
    others = [track(f"b{i}", 20 * i - 50 + 14 * TIME, 0 * TIME - 3.2 * (i % 3 + 1) - 1, 14.0) for i in range(10)]

    def on_road(x: Floats, y: Floats) -> np.ndarray:
        return np.abs(y) < 6.0

    road = Drivable(box(-500.0, -20.0, 2000.0, 20.0))
    strips = [LaneStrip(np.array([[0.0, 3.2 * k], [900.0, 3.2 * k]]), 3.2, False) for k in range(-15, 15)]
    case = Case(ego, adversary, tuple(others), 1.0, on_road=on_road)
    missed = replace(case, adversary=track("adversary", 50 + 15 * TIME, 0 * TIME - 3.2, 15.0))
    wide = rollouts([cut_in(9.0 + i / 25, 3.0 + i / 2, 1.5 + i / 40) for i in range(150)])
    encounters = Encounters(rollouts([ego] * 150), wide, np.full(150, 10), np.full(150, 80), DT)
    figures = (
        ("ttc, 100 vehicles x 91 steps", 10.0, lambda: ttc(vehicle, vehicles)),
        ("verdict without a collision, 10 others", 5.0, lambda: judge_attempt(missed)),
        ("verdict on a collision, 5 drivers", 205.0, lambda: judge_attempt(case)),
        ("cc_human on 150 rollouts", 200.0, lambda: driver_outcomes(encounters, ("cc_human",))),
        ("cc_human, manoeuvre on 150 rollouts", 500.0, lambda: driver_outcomes(encounters, ("cc_human", "manoeuvre"))),
        ("further figures", 145.0, lambda: further_figures(case)),
        ("series rows, 120 steps, 10 others", 50.0, lambda: series_rows(ego, [ego, adversary, *others], "adversary")),
        ("markings, 120 steps, 30 lanes", 50.0, lambda: markings_crossed(adversary, strips, road)),
        ("realism, 120 steps, 10 others", 50.0, lambda: realism_figures(adversary, others, road)),
    )
    over = False
    for name, bound, work in figures:
        took = best(work)
        over |= took > bound
        print(f"{name:40s} {took:7.2f} ms  (bound {bound:g} ms)")
    return int(over)


if __name__ == "__main__":
    sys.exit(main())
