"""What refinement keeps of an attempt: how the ego went in it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from situation_samples import leader, situation

from sumo_adv.config import Settings
from sumo_adv.episode.assessment import observed_motion
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.simulation.sumo_states import Snapshot

SIZES = {"ego": (5.0, 2.0), "bv": (5.0, 2.0)}
SETTINGS = Settings(duration=2.0)
TRIGGER = 100.0  # s; the ego's path begins at its place then, and goes east


def went(places: Mapping[float, tuple[float, float]], *, start: float = TRIGGER) -> AttemptResult:
    """The ego at (x of its box centre, speed) by seconds after the trigger."""
    snapshots = [
        Snapshot(TRIGGER + t, {"ego": (x + 2.5, 0.0, 90.0, v, "a"), "bv": (40.0, 0.0, 90.0, 0.0, "a")})
        for t, (x, v) in places.items()
    ]
    return AttemptResult(None, None, start, snapshots, SIZES)  # type: ignore[arg-type]


def found() -> FoundEncounter:
    here = situation([leader()])
    later = replace(here, time=TRIGGER + 1.5)
    return FoundEncounter(
        "ego", TRIGGER, (), {0.0: here, 1.5: later}, (), (), None, SIZES, (0.0, 0.0, 100.0)  # type: ignore[arg-type]
    )  # fmt: skip


def test_the_course_has_the_stations_and_speeds_from_the_takeover_on() -> None:
    """10 m/s for half a second, then it brakes by 5 m/s2 to a stop at 15 m after 2.5 s."""
    places = {}
    for k in range(30):
        t = round(0.1 * k, 1)
        u = min(max(t - 0.5, 0.0), 2.0)
        places[t] = (10.0 * min(t, 0.5) + 10.0 * u - 2.5 * u * u, 10.0 - 5.0 * u)
    course = observed_motion(went(places), found(), 0.0, SETTINGS)
    assert course is not None
    assert len(course.s) == len(course.v) == 21  # 2 s, and where it began
    assert [course.s[k] for k in (0, 5, 15, 20)] == pytest.approx([0.0, 5.0, 12.5, 14.375])
    assert [course.v[k] for k in (0, 5, 15, 20)] == pytest.approx([10.0, 10.0, 5.0, 2.5])


def test_once_the_attempt_is_over_it_goes_on_at_an_even_speed() -> None:
    """A contact after 0.3 s, at 2.7 m and 8 m/s; 1.7 s later that is 2.7 + 13.6 m."""
    course = observed_motion(
        went({0.0: (0.0, 10.0), 0.1: (1.0, 10.0), 0.2: (1.9, 9.0), 0.3: (2.7, 8.0)}), found(), 0.0, SETTINGS
    )
    assert course is not None
    assert course.s[:5] == pytest.approx([0.0, 1.0, 1.9, 2.7, 3.5])
    assert (course.s[20], course.v[20]) == pytest.approx((16.3, 8.0))
    assert np.diff(course.s[3:]) == pytest.approx([0.8] * 17)


def test_what_was_before_a_later_takeover_does_not_belong_to_it() -> None:
    later = went({0.1 * k: (1.0 * k, 10.0) for k in range(30)}, start=TRIGGER + 1.5)
    course = observed_motion(later, found(), 1.5, SETTINGS)
    assert course is not None
    assert course.s[0] == pytest.approx(15.0)  # found() has the same path for both moments


def test_the_trigger_itself_is_not_recorded_and_is_taken_from_what_was_foreseen() -> None:
    """What an attempt records begins a step after the trigger, at 1 m: the course begins at 0 m all the same."""
    course = observed_motion(went({0.1 * k: (1.0 * k, 10.0) for k in range(1, 30)}), found(), 0.0, SETTINGS)
    assert course is not None
    assert course.s[:3] == pytest.approx([0.0, 1.0, 2.0]) and course.v[0] == 10.0
    assert course.seen == 30


def test_an_ego_that_is_gone_at_once_has_none() -> None:
    assert observed_motion(went({0.0: (0.0, 10.0)}), found(), 0.0, SETTINGS) is None
    assert observed_motion(went({}), found(), 0.0, SETTINGS) is None


def test_the_lane_that_counts_is_that_of_the_moment_of_the_attack() -> None:
    """The ego is in a lane of 4 m at 17.5 s, and of 3.2 m at 20.5 s, when the attack takes over."""
    wide, narrow = (
        replace(given, road=replace(given.road, lane_width=width))
        for given, width in zip(found().situations.values(), (4.0, 3.2), strict=True)
    )
    encounter = replace(found(), time=17.5, situations={0.0: wide, 3.0: narrow})
    assert (encounter.half_lane(17.5), encounter.half_lane(20.5)) == (2.0, 1.6)
