"""Why it came to a contact: the ego's reaction against the careful driver, with numbers worked out by hand.

The story: the ego drives at 20 m/s, 30 m behind a leader of the same speed that brakes at 6 m/s2 from 2.0 s on until it
stands, with its centre at 35 + 2 * 20 + 20^2 / (2 * 6) = 108.33 m.  The careful driver sees the braking at 2.1 s and
brakes from 2.85 s on.  At 2.9 s the ego's centre is at 58 m, and 108.33 - 5 - 58 = 45.33 m are left to stop in: that
takes 20^2 / (2 * 45.33) = 4.41 m/s2, so that 4.5 m/s2 are enough.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from metrics_tracks import TIME, braking, car, cruise, drift

from sumo_adv.datatypes import Track
from sumo_adv.metrics.case import Case
from sumo_adv.metrics.cause import Action, Cause, CauseKind, cause_of
from sumo_adv.metrics.verdict import judge_attempt, with_answers

LEADER = braking("adversary", 35.0, 0.0, 20.0, 2.0, 6.0)
STEADY = cruise("ego", 0.0, 0.0, 20.0)


def why(
    ego: Track, adversary: Track = LEADER, others: tuple[Track, ...] = (), unattacked: Track | None = STEADY,
    ttc: float = 1.0,
) -> Cause | None:  # fmt: skip
    case = Case(ego, adversary, others, 1.0, unattacked=unattacked)
    return cause_of(case, judge_attempt(case, ttc_threshold=ttc))


def test_an_ego_that_does_nothing_did_not_react() -> None:
    """The contact: 30 m = 3 t^2, 3.16 s after 2.0 s, which is 2.3 s after the careful driver braked."""
    cause = why(STEADY)
    assert cause is not None and cause.kind is CauseKind.NO_REACTION
    assert (cause.alarm, cause.careful, cause.enough) == (pytest.approx(2.1), pytest.approx(2.85), 4.5)
    assert cause.moment == pytest.approx(2.0 + 10**0.5, abs=0.02)
    assert cause.sentence == (
        "Your driver did not react before the contact, 2.3 s after the careful one began to act; "
        "braking at 4.5 m/s2 would have been enough."
    )


def test_an_ego_that_brakes_later_than_the_careful_driver_was_late() -> None:
    cause = why(braking("ego", 0.0, 0.0, 20.0, 3.9, 2.0))
    assert cause is not None and cause.kind is CauseKind.LATE
    assert (cause.action, cause.began) == (Action.BRAKED, pytest.approx(3.9))
    assert (cause.braking, cause.hardest) == (pytest.approx(2.0), pytest.approx(2.0))
    assert cause.sentence == (
        "Your driver began to brake 1.0 s after the careful one, at 2.0 m/s2; 4.5 m/s2 would have been enough."
    )


def test_an_ego_that_brakes_in_time_and_at_less_than_needed_did_too_little() -> None:
    cause = why(braking("ego", 0.0, 0.0, 20.0, 2.9, 3.0))
    assert cause is not None and cause.kind is CauseKind.TOO_LITTLE
    assert cause.sentence == (
        "Your driver braked in time and too gently, at 3.0 m/s2; 4.5 m/s2 would have been enough."
    )


def test_braking_that_the_ego_did_without_the_attack_is_no_reaction() -> None:
    """It brakes at 2 m/s2 for a red light, attacked or not."""
    ego = braking("ego", 0.0, 0.0, 20.0, 2.9, 2.0)
    cause = why(ego, unattacked=ego)
    assert cause is not None and (cause.kind, cause.began) == (CauseKind.NO_REACTION, None)


def test_braking_harder_than_for_the_red_light_is_a_reaction() -> None:
    """It brakes at 1 m/s2 from 2.0 s on without the attack, and attacked at 3 m/s2 from 4.0 s on."""
    speed = np.where(TIME <= 4.0, 20.0 - np.clip(TIME - 2.0, 0.0, 2.0), 18.0 - 3.0 * (TIME - 4.0))
    way = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.1)])
    cause = why(car("ego", way, 0.0, np.maximum(speed, 0.0)), unattacked=braking("ego", 0.0, 0.0, 20.0, 2.0, 1.0))
    assert cause is not None and cause.kind is CauseKind.LATE
    assert (cause.began, cause.braking) == (pytest.approx(4.0), pytest.approx(3.0))


def test_an_ego_that_lets_go_says_so() -> None:
    """It brakes at 4.5 m/s2 from 2.9 to 3.9 s, and then no more."""
    speed = 20.0 - 4.5 * np.clip(TIME - 2.9, 0.0, 1.0)
    cause = why(car("ego", np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.1)]), 0.0, speed))
    assert cause is not None and (cause.kind, cause.held) == (CauseKind.LET_GO, True)
    assert (cause.began, cause.let_go, cause.braking) == (
        pytest.approx(2.9), pytest.approx(3.9), pytest.approx(4.5),
    )  # fmt: skip
    assert cause.sentence == (
        f"Your driver braked in time, at 4.5 m/s2, and released the brake {cause.moment - 3.9:.1f} s before the "
        "contact; held, that braking would have been enough."
    )


def test_an_ego_that_stops_in_time_and_drives_on_says_so() -> None:
    """It stands from 6.2 s to 8.0 s, then speeds up at 2 m/s2: 12 m to the leader's back take 3.5 s."""
    speed = np.where(TIME <= 8.0, np.maximum(20.0 - 6.0 * np.maximum(TIME - 2.9, 0.0), 0.0), 2.0 * (TIME - 8.0))
    cause = why(car("ego", np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.1)]), 0.0, speed))
    assert cause is not None and (cause.kind, cause.stopped) == (CauseKind.LET_GO, True)
    assert cause.let_go == pytest.approx(8.0)
    assert cause.sentence == "Your driver stopped, and drove on 3.5 s before the contact."


def test_an_ego_that_would_have_passed_ahead_braked_into_the_path() -> None:
    """A crossing car is 1 m beside the ego's path at 3.25 s.  At 20 m/s the ego's back is past it at 3.175 s; with
    5 m/s2 from 2.4 s on, the ego's centre is at 63.2 m at 3.25 s and not at 63.5 m."""
    cause = why(braking("ego", 0.0, 0.0, 20.0, 2.4, 5.0), cruise("adversary", 60.0, -36.0, 10.0, np.pi / 2))
    assert cause is not None and (cause.kind, cause.enough) == (CauseKind.BRAKED_IN, 0.0)
    assert cause.sentence == (
        "Your driver braked into the adversary's path, at 5.0 m/s2; keeping its speed would have been enough."
    )


def test_an_ego_that_leaves_its_lane_into_a_vehicle_beside_it_steered_in() -> None:
    """Boxes of 2 m in lanes 3.2 m apart touch at 1.2 m; at 0.1 rad the ego's corner is 0.25 m further to the left."""
    cause = why(drift("ego", 0.0, 0.0, 20.0, 3.0, 3.0, 3.2), cruise("adversary", 0.0, 3.2, 20.0))
    assert cause is not None and cause.kind is CauseKind.STEERED_IN
    assert cause.shift == pytest.approx(0.95, abs=0.15)
    assert cause.sentence == f"Your driver steered into the adversary's path, {cause.shift:.1f} m to the left."


def test_swerving_by_less_than_a_width_in_time_is_not_far_enough() -> None:
    """Half a metre to the right from 2.5 s on, and boxes of 2 m still overlap."""
    cause = why(drift("ego", 0.0, 0.0, 20.0, 2.5, 2.0, -0.5))
    assert cause is not None and (cause.kind, cause.action) == (CauseKind.TOO_LITTLE, Action.STEERED)
    assert cause.sentence == (
        "Your driver steered away in time and not far enough, by 0.5 m to the right; "
        "braking at 4.5 m/s2 would have been enough."
    )


def test_staying_in_the_lane_that_it_left_without_the_attack_is_no_steering() -> None:
    cause = why(STEADY, unattacked=drift("ego", 0.0, 0.0, 20.0, 2.0, 3.0, 3.2))
    assert cause is not None and (cause.kind, cause.shift) == (CauseKind.NO_REACTION, None)


def test_what_no_reference_driver_is_alarmed_about_no_one_could_know() -> None:
    """From the lane beside, abreast: 1.2 m within 0.5 s, and 0.375 m take 0.4 s to be perceived."""
    cause = why(STEADY, drift("adversary", 0.0, 3.2, 20.0, 3.0, 1.0, 0.0))
    assert cause is not None and (cause.kind, cause.alarm, cause.enough) == (CauseKind.UNFORESEEABLE, None, None)
    assert cause.sentence == "No one could have known before the contact."


def test_a_contact_that_braking_in_time_does_not_avoid_says_how_the_careful_driver_is_hit() -> None:
    """The leader, 20 m ahead, stops within 20^2 / (2 * 30) = 6.7 m from 2.0 s on: the ego reaches its back after
    20 + 6.7 - 5 = 21.7 m, at 3.08 s.  The careful driver brakes from 2.85 s on, which is 0.2 s before; the force of its
    brakes has just begun to grow by then."""
    cause = why(STEADY, braking("adversary", 20.0, 0.0, 20.0, 2.0, 30.0))
    assert cause is not None and (cause.kind, cause.careful) == (CauseKind.UNFORESEEABLE, pytest.approx(2.85))
    assert cause.moment == pytest.approx(2.0 + 21.7 / 20.0, abs=0.01)
    assert cause.sentence == (
        "A careful driver would have braked 0.2 s before the contact, but would still have been hit 0.2 s later, "
        "at 19.6 m/s."
    )


def test_a_driver_that_avoids_only_the_recorded_motion_is_not_said_to_avoid_it() -> None:
    """As in the first story, but in the loop the adversary plans again and hits the careful driver, too."""
    case = Case(STEADY, LEADER, (), 1.0, unattacked=STEADY)
    verdict = judge_attempt(case)
    assert verdict.preventability is not None
    hit = {name: "collides" for name, answer in verdict.preventability.answers.items() if answer == "avoids"}
    cause = cause_of(case, with_answers(verdict, replace(verdict.preventability, in_loop=hit)))
    assert cause is not None
    assert cause.sentence.endswith("When the adversary plans again, no reference driver avoids it.")


def test_a_danger_from_another_vehicle_is_not_the_adversarys() -> None:
    """A vehicle beyond the adversary brakes as the adversary does, 1 s earlier; the adversary's alarm is as before."""
    other = braking("third", 60.0, 0.0, 20.0, 1.0, 6.0)
    cause = why(STEADY, others=(other,))
    assert cause is not None and cause.alarm == pytest.approx(2.1)


def test_a_near_miss_of_an_ego_that_braked_in_time_was_evaded() -> None:
    """5.5 m/s2 from 2.9 s on: it stops after 36.4 of the 45.3 m."""
    cause = why(braking("ego", 0.0, 0.0, 20.0, 2.9, 5.5), ttc=4.0)
    assert cause is not None and (cause.kind, cause.enough) == (CauseKind.EVADED, None)
    assert cause.sentence == "Your driver braked in time, at 5.5 m/s2; there was no contact."


def test_without_a_contact_or_near_miss_there_is_no_cause() -> None:
    assert why(STEADY, cruise("adversary", 35.0, 0.0, 20.0)) is None


def test_a_vehicle_that_runs_into_the_egos_back_is_not_explained_by_the_ego() -> None:
    assert why(STEADY, cruise("adversary", -35.0, 0.0, 30.0)) is None


@pytest.mark.parametrize("angle", [0.0, 2.0])
def test_where_the_scene_lies_changes_nothing(angle: float) -> None:
    """The late driver, turned and moved."""

    def moved(t: Track) -> Track:
        c, s = np.cos(angle), np.sin(angle)
        heading = (t.heading + angle + np.pi) % (2 * np.pi) - np.pi
        return car(t.id, 50 + c * t.x - s * t.y, -20 + s * t.x + c * t.y, t.speed, heading)

    cause = why(moved(braking("ego", 0.0, 0.0, 20.0, 3.9, 2.0)), moved(LEADER), unattacked=moved(STEADY))
    assert cause is not None
    assert (cause.kind, cause.began, cause.enough, cause.shift) == (CauseKind.LATE, pytest.approx(3.9), 4.5, None)
