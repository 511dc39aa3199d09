"""A logged vehicle is taken over without the noise of its log; what the log breaks is named and does not count."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sumo_adv.datatypes import Limits, Role, Track
from sumo_adv.metrics.case import log_breaches, make_case, smoothed
from sumo_adv.metrics.gates import failed_gates

TIME = 0.1 * np.arange(31)
NOISE = np.array(
    [0.0] * 5 + [1.0, -1.0, 0.0, 0.0, -1.0, 1.0]
)  # m/s in the log's 1.0 s; a line through the last six is 0


def track(name: str, speed: object, *, y: float = 0.0, heading: object = 0.0) -> Track:
    """Eastwards at 10 m/s, as the positions say; speeds and headings as given."""
    v, h = (np.broadcast_to(np.asarray(q, float), TIME.shape).copy() for q in (speed, heading))
    a = np.concatenate([[0.0], np.diff(v) / 0.1])
    return Track(name, Role.BACKGROUND, TIME, 10.0 * TIME, np.full(31, y), h, v, a, 4.5, 1.8)


def noisy() -> Track:
    """A log until 1.0 s with a last speed of 11 m/s, and an adversary that goes on at an even 10 m/s."""
    return track("bv", 10.0 + np.concatenate([NOISE, np.zeros(20)]))


def gates(adversary: Track) -> tuple[str, ...]:
    """The gates that fail from the first driven step, at 1.1 s, on."""
    ego = track("ego", 10.0, y=20.0)
    return failed_gates(adversary, Limits(), on_road=None, ego=ego, others=[], end=None, start=1.05)


def test_the_adversary_is_not_judged_by_the_last_state_of_the_log() -> None:
    """From 11 to 10 m/s within a step is -10 m/s2, which the adversary did not drive."""
    assert "longitudinal" in gates(noisy())
    assert gates(smoothed(noisy(), 1.0, Limits())) == ()


def test_the_case_names_what_the_log_breaks() -> None:
    """From 11 to 9 m/s within a step is -20 m/s2."""
    tracks = [noisy(), track("ego", 10.0, y=20.0)]
    broken = ("longitudinal", "friction_circle", "jerk", "continuity")
    case = make_case(tracks, "ego", ["bv"], 1.0, {}, logged=Limits())
    assert case is not None and case.log_gates == broken == log_breaches(noisy(), 1.0, Limits())
    assert gates(case.adversary) == ()
    as_it_is = make_case(tracks, "ego", ["bv"], 1.0, {})
    assert as_it_is is not None and as_it_is.log_gates == () and "longitudinal" in gates(as_it_is.adversary)


def test_what_the_adversary_adds_still_counts() -> None:
    """It brakes from 10 to 7 m/s within the step to 2.0 s: -30 m/s2."""
    speed = 10.0 + np.concatenate([NOISE, np.zeros(20)])
    speed[20:] = 7.0
    assert {"longitudinal", "jerk"} <= set(gates(smoothed(track("bv", speed), 1.0, Limits())))


def test_a_line_through_the_last_half_second() -> None:
    """Braking by an even 2 m/s2 is kept: 8 m/s at 1.0 s. Headings that turn by an even 0.2 rad/s are kept as well."""
    braking = track("bv", 10.0 - 2.0 * TIME, heading=0.2 * TIME)
    after = smoothed(braking, 1.0, Limits())
    assert after.speed == pytest.approx(braking.speed) and after.heading == pytest.approx(braking.heading)
    assert after.acceleration[5:12] == pytest.approx(np.full(7, -2.0))


def test_a_jump_of_the_heading_is_evened_out_and_places_stay() -> None:
    """0.3 rad in the last of six states: a line of 0.43 rad/s through their mean of 0.05 rad ends at 0.157 rad."""
    jumped = track("bv", 10.0, heading=np.where(np.arange(31) == 10, 0.3, 0.0))
    after = smoothed(jumped, 1.0, Limits())
    assert after.heading[10] == pytest.approx(0.05 + 0.25 * (0.25 * 0.3) / 0.175)
    assert (after.x == jumped.x).all() and (after.y == jumped.y).all()


def test_a_vehicle_that_was_just_seen_stays_as_it_is() -> None:
    """Three states show no noise."""
    short = noisy().between(0.8, np.inf)
    assert smoothed(short, 1.0, Limits()) is short
    standing = replace(noisy(), speed=np.zeros(31))
    assert (smoothed(standing, 1.0, Limits()).speed >= 0.0).all()
