"""The blind driver: the road counts for it, vehicles do not."""

from __future__ import annotations

from dataclasses import replace

import pytest
from situation_samples import car

from sumo_adv.drivers import Observation, Steer
from sumo_adv.drivers.blind import BlindEgo
from sumo_adv.drivers.protocol import Road, StopLine

EAST = [(float(x), 0.0) for x in range(0, 200, 5)]


def seen(speed: float, road: Road, *others: float) -> Observation:
    """The ego at the start of a straight road to the east, and vehicles that stand this far ahead [m]."""
    standing = [replace(car(f"v{k}", x, 0.0, speed=0.0)) for k, x in enumerate(others)]
    return Observation(0.0, 0.1, car("ego", 0.0, 0.0, speed=speed), standing, path=EAST, road=road)


def test_it_goes_for_the_speed_limit_whatever_is_ahead() -> None:
    """IDM's free road: 2.6 (1 - (10 / 20)^4) = 2.44 m/s2, also with a vehicle 8 m ahead."""
    for others in ((), (8.0,)):
        action = BlindEgo().act(seen(10.0, Road(20.0), *others))
        assert isinstance(action, Steer)
        assert action.acceleration == pytest.approx(2.4375)
        assert action.steering == pytest.approx(0.0, abs=1e-6)


def test_it_waits_at_a_line_that_it_must_not_pass() -> None:
    """Its front, at 2.5 m, is to stop 0.5 m before the line: from 10 m/s 20 m before that take 2.5 m/s2."""
    near, far = (Road(20.0, stop_lines=(StopLine(room + 3.0, "red", None, True),)) for room in (20.0, 30.0))
    actions = [BlindEgo().act(seen(10.0, road)) for road in (near, far)]
    assert all(isinstance(action, Steer) for action in actions)
    assert [action.acceleration for action in actions] == pytest.approx([-2.5, 2.4375])
    standing = BlindEgo().act(seen(0.0, Road(20.0, stop_lines=(StopLine(3.0, None, "yield", True),))))
    assert isinstance(standing, Steer) and standing.acceleration == -3.0


def test_sumo_drives_it_off_the_network() -> None:
    assert BlindEgo().act(seen(10.0, Road(20.0, leaves=True))) is None
