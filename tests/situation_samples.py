"""Situations made by hand: an ego that goes east at 10 m/s along y = 0 from x = 0, and one car it may meet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sumo_adv.datatypes import DriverModel, VehicleState
from sumo_adv.geometry import Frame, Path, make_path
from sumo_adv.situation import Baseline, RoadAhead, Situation, Target, Traffic, relate

KRAUSS = DriverModel("krauss", acceleration=2.6, deceleration=4.5, tau=1.0, min_gap=2.5, speed=15.0)


def line(*points: tuple[float, float]) -> Path:
    """A path through corners."""
    return make_path(list(points))


def car(
    name: str, x: float, y: float, heading: float = 0.0, speed: float = 10.0, acceleration: float = 0.0
) -> VehicleState:
    """A car of 5 x 2 m."""
    return VehicleState(name, x, y, heading, speed, acceleration, 5.0, 2.0, "")


def target(
    state: VehicleState, relation: str, ways: Sequence[tuple[Path, str, float]], ego_path: Path, *, offset: float = 0.0
) -> Target:
    """A BV at the start of its ways (path, movement, distance of the junction)."""
    lines = tuple(relate(path, movement, junction, False, ego_path) for path, movement, junction in ways)
    return Target(state, relation, lines, 0.0, offset, 0.0, ((3.2, "same"),), 0.5)


def situation(targets: Sequence[Target], *, model: DriverModel = KRAUSS, speed: float = 10.0) -> Situation:
    """The ego at the origin with an unattacked profile of 5 s at constant ``speed`` in steps of 0.1 s."""
    k = np.arange(51.0)
    ego_path = line((0.0, 0.0), (400.0, 0.0))
    baseline = Baseline(ego_path, 0.1 * speed * k, 0.0 * k + speed, 0.0 * k, model)
    ego = car("ego", 0.0, 0.0, speed=speed)
    by_id = {t.state.id: t for t in targets}
    return Situation(100.0, 0.1, 3.0, Frame(0.0, 0.0, 0.0), ego, baseline, RoadAhead(3.2), Traffic(), by_id)


def changed(given: Situation, **values: Any) -> Situation:
    """A situation with other values of its own fields or of those of its baseline, road and traffic."""
    for name, value in values.items():
        groups = [g for g in ("baseline", "road", "traffic") if hasattr(getattr(given, g), name)]
        if groups:
            given = replace(given, **{groups[0]: replace(getattr(given, groups[0]), **{name: value})})
        else:
            given = replace(given, **{name: value})
    return given


EGO_PATH = line((0.0, 0.0), (400.0, 0.0))


def neighbour(x: float = 20.0, y: float = 3.2, speed: float = 12.0) -> Target:
    """A car in the lane to the left, ahead."""
    return target(
        car("bv", x, y, speed=speed), "neighbour", [(line((x, y), (x + 250.0, y)), "none", math.inf)], EGO_PATH
    )


def leader(gap: float = 20.0, speed: float = 10.0) -> Target:
    """A car in the ego's lane with ``gap`` metres between the bumpers."""
    x = gap + 5.0
    return target(
        car("bv", x, 0.0, speed=speed), "leader", [(line((x, 0.0), (x + 250.0, 0.0)), "none", math.inf)], EGO_PATH
    )


def crossing() -> Target:
    """A car 25 m south of the ego's path at x = 30 that may go north across it or turn left, westwards."""
    bend = [(30.0 - 6.0 + 6.0 * math.cos(a), -8.0 + 6.0 * math.sin(a)) for a in np.arange(0.05, math.pi / 2, 0.05)]
    ways = [
        (line((30.0, -25.0), (30.0, 150.0)), "straight", 15.0),
        (line((30.0, -25.0), (30.0, -8.0), *bend, (24.0, -2.0), (-150.0, -2.0)), "left", 15.0),
    ]
    return target(car("bv", 30.0, -25.0, math.pi / 2, 8.0), "crossing", ways, EGO_PATH)
