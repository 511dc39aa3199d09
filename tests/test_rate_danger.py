"""How dangerous errors look, from places and speeds alone."""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Boxes
from sumo_adv.rate.proposal import ERROR_KINDS, danger_levels
from sumo_adv.simulation.human_errors import ErrorKind

EGO = Boxes(*(np.array(v) for v in (0.0, 0.0, 0.0, 15.0)), 4.8, 1.8)


def levels(x: float, y: float, speed: float, heading: float = 0.0) -> dict[ErrorKind, int]:
    neighbour = Boxes(*(np.array([v]) for v in (x, y, heading, speed)), np.array([4.8]), np.array([1.8]))
    return {kind: int(level) for kind, level in zip(ERROR_KINDS, danger_levels(EGO, neighbour)[0], strict=True)}


def test_a_vehicle_beside_the_ego() -> None:
    """3.5 m to the left there are 1.7 m between the boxes. Both errors to the right close them."""
    dangers = levels(0.0, 3.5, 15.0)
    assert dangers[ErrorKind.INATTENTION] == 0
    assert dangers[ErrorKind.DRIFT_RIGHT] == dangers[ErrorKind.CHANGE_RIGHT] == 3
    assert dangers[ErrorKind.DRIFT_LEFT] == dangers[ErrorKind.CHANGE_LEFT] == 0
    assert levels(0.0, -3.5, 15.0)[ErrorKind.DRIFT_LEFT] == 3


def test_a_leader_that_brakes_late_and_hard() -> None:
    """It stops after 22.5 + 18.75 m, the ego after 15 + 25 m if it brakes: 20 m between them are enough for that."""
    assert levels(24.8, 0.0, 15.0)[ErrorKind.LATE_BRAKING] == 2
    assert levels(24.8, 0.0, 15.0)[ErrorKind.INATTENTION] == 0
    far = levels(150.0, 0.0, 15.0)
    assert set(far.values()) == {0}


def test_a_vehicle_that_comes_from_the_side() -> None:
    """Both are 3 s from the crossing: a driver at 8 m/s that goes on is there when the ego is; from 80 m it is not."""
    crossing = levels(45.0, -24.0, 8.0, np.pi / 2)
    assert crossing[ErrorKind.PRIORITY] >= 2 and crossing[ErrorKind.RED_LIGHT] >= 2
    assert levels(45.0, -80.0, 8.0, np.pi / 2)[ErrorKind.PRIORITY] == 0


def test_the_ego_that_brakes_lets_a_crossing_vehicle_pass() -> None:
    """The ego would be at 75 m after 5 s; braking it stops at 40 m."""
    assert levels(75.0, -40.0, 8.0, np.pi / 2)[ErrorKind.PRIORITY] == 2
