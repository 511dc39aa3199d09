"""Each gate failed by hand, one at a time, and none by decent driving; many adversaries at once as one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from metrics_tracks import TIME, car, cruise, drift

from sumo_adv.datatypes import Bools, Boxes, Floats, Limits, Track
from sumo_adv.metrics.gates import failed_gates, kinematic_gates, motion, near_pairs, off_road, third_party

FAR = cruise("ego", 0, 500, 10)


def gates(track: Track, **more: object) -> tuple[str, ...]:
    values: dict[str, object] = {"on_road": None, "ego": FAR, "others": (), "end": None, "start": 1.0} | more
    return failed_gates(track, Limits(), **values)  # type: ignore[arg-type]


def circle(speed: float, radius: float) -> Track:
    angle = speed / radius * TIME
    heading = (angle + np.pi) % (2 * np.pi) - np.pi
    return car("adversary", radius * np.sin(angle), radius * (1 - np.cos(angle)), speed, heading)


def speeding(acceleration: Floats) -> Track:
    speed = 12.0 + np.concatenate([[0.0], np.cumsum(acceleration[1:]) * 0.1])
    x = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.1)])
    return replace(car("adversary", x, 0.0, speed), acceleration=acceleration)


def test_decent_driving_fails_nothing() -> None:
    assert gates(cruise("adversary", 0, 0, 20)) == ()
    assert gates(drift("adversary", 0, 3.2, 15, 2.0, 4.0, 0.0)) == ()
    assert gates(circle(8.0, 20.0)) == ()  # 3.2 m/s2 on a radius of 20 m


def test_a_circle_of_ten_metres_at_seven_metres_a_second_is_too_much_sideways() -> None:
    track = circle(7.0, 10.0)
    assert motion(track).lateral == pytest.approx(np.full(len(TIME), 4.9))
    assert gates(track) == ("lateral",)


def test_turning_tighter_than_a_car_can_is_a_curvature() -> None:
    assert gates(circle(3.0, 4.0)) == ("curvature",)  # 0.25 1/m, 2.25 m/s2


def test_a_wobble_that_turns_on_the_spot_shows_but_noise_at_a_stand_does_not() -> None:
    turning = car("adversary", 0.0, 0.0, 0.0, np.clip(TIME, 0, 3.0))
    assert "curvature" in gates(turning)
    shaking = car("adversary", 0.0, 0.0, 0.0, 0.001 * np.sin(50 * TIME))
    assert gates(shaking) == ()


def test_a_step_follows_the_mean_of_its_headings() -> None:
    turned = np.where(TIME < 3.0, 0.0, 0.6)  # within one step, far tighter than any car turns
    x, y = (np.cumsum(of(np.where(TIME < 3.0, 0.0, np.where(TIME < 3.05, 0.3, 0.6)))) for of in (np.cos, np.sin))
    assert "continuity" not in gates(car("adversary", x, y, 10.0, turned))
    x, y = np.cumsum(np.cos(turned)), np.cumsum(np.sin(turned - 0.6 * (np.abs(TIME - 3.0) < 0.05)))
    assert "continuity" in gates(car("adversary", x, y, 10.0, -turned))


def test_braking_and_accelerating_beyond_the_limits_and_the_jerk_of_getting_there() -> None:
    ramp = np.clip((TIME - 2.0) * 10.0, 0.0, 1.0)  # 0.1 s to full
    gentle = np.clip((TIME - 2.0) * 1.25, 0.0, 1.0) * (TIME < 3.6)
    assert gates(speeding(-5.0 * ramp * (TIME < 3.0))) == ("jerk",)
    assert gates(speeding(5.0 * np.clip((TIME - 2.0) * 2, 0, 1)), end=4.0) == ("longitudinal",)
    assert gates(speeding(-8.0 * gentle), end=3.5) == ()
    assert gates(speeding(-9.0 * gentle), end=3.5) == ("longitudinal", "friction_circle")


def test_what_came_before_the_trigger_is_not_the_planner_s() -> None:
    """SUMO's own braking of 6 m/s2 at once before 1 s; ours takes over gently."""
    acceleration = np.where(TIME < 0.75, -6.0, 0.0)
    assert gates(speeding(acceleration)) == ()
    assert gates(speeding(acceleration), start=0.5) == ("jerk",)


def test_a_jump_a_slide_and_a_lying_speed_are_not_continuous() -> None:
    straight = cruise("adversary", 0, 0, 10)
    assert gates(replace(straight, x=straight.x + 3.0 * (TIME > 4.0))) == ("continuity",)
    assert gates(replace(straight, y=0.4 * TIME * 10)) == ("continuity",)  # 4 m/s sideways, heading straight on
    assert gates(replace(straight, speed=straight.speed + 3.0)) == ("continuity",)
    lane_change = replace(straight, y=np.clip(TIME - 3, 0, 3) * 3.2 / 3)  # SUMO's own, 3.2 m in 3 s
    assert gates(lane_change) == ()


def test_off_the_road_is_a_corner_more_than_the_tolerance_off() -> None:
    def on_road(x: Floats, y: Floats) -> Bools:
        return np.abs(y) <= 1.75

    assert gates(cruise("adversary", 0, 0.85, 10), on_road=on_road) == ()  # 10 cm off
    assert gates(cruise("adversary", 0, 1.0, 10), on_road=on_road) == ("off_road",)


def test_a_third_party_hit_before_the_ego_is_named_and_one_hit_after_is_not() -> None:
    parked = cruise("parked", 55, 0, 0)  # reached after 5 s
    assert gates(cruise("adversary", 0, 0, 10), others=[parked]) == ("third_party",)
    assert gates(cruise("adversary", 0, 0, 10), others=[parked], end=4.0) == ()
    overlapping = cruise("trailer", 2, 0, 10)  # logs hold boxes that overlap from the start
    assert gates(cruise("adversary", 0, 0, 10), others=[overlapping]) == ()


def test_only_the_motion_up_to_the_contact_counts() -> None:
    late = speeding(-20.0 * (TIME > 5.0) * (TIME < 5.5))
    assert gates(late, end=4.0) == ()
    assert "longitudinal" in gates(late)


# ---- many at once


def stacked(tracks: list[Track]) -> Boxes:
    """Tracks on one grid as boxes ``(n, steps)``."""
    x, y, heading, speed = (np.stack([getattr(t, n) for t in tracks]) for n in ("x", "y", "heading", "speed"))
    return Boxes(x, y, heading, speed, 5.0, 2.0)


def test_many_adversaries_fail_the_gates_that_each_fails_alone() -> None:
    tracks = [cruise("a", 0, 0, 20), circle(7.0, 10.0), circle(3.0, 4.0), speeding(-5.0 * (TIME > 2.0) * (TIME < 3.0))]
    tracks.append(replace(tracks[0], x=tracks[0].x + 3.0 * (TIME > 4.0)))
    broken = kinematic_gates(stacked(tracks), np.stack([t.acceleration for t in tracks]), TIME, Limits())
    failed = [{name for name, steps in broken.items() if steps[k, 10:].any()} for k in range(len(tracks))]
    assert failed == [set(), {"lateral"}, {"curvature"}, {"jerk"}, {"continuity"}]
    assert failed == [set(gates(track)) for track in tracks]


def test_only_the_steps_asked_for_are_tested_against_the_road_and_the_inset_decides() -> None:
    """Cars 2 m wide on a road to y = 2: at y = 1.1 the side is 0.1 m off, which an inset of 0.15 m allows."""
    boxes = stacked([cruise("a", 0, 0.9, 10), cruise("b", 0, 1.1, 10)])
    judged = np.zeros(boxes.x.shape, bool)
    judged[:, 3:5] = True

    def on_road(x: Floats, y: Floats) -> Bools:
        assert x.size == 2 * 2 * 4  # corners
        return np.abs(y) <= 2.0

    assert not off_road(boxes, judged, on_road).any()
    assert off_road(boxes, judged, on_road, inset=0.05).tolist() == [[False] * len(TIME), judged[1].tolist()]


def test_a_third_party_that_is_touched_between_two_steps_counts_up_to_the_end_of_its_row() -> None:
    """Both boxes are 1 x 1 m. One passes the other at 60 m/s: 3 m before it at 2.0 s, 3 m behind it at 2.1 s.

    They touch once the centres are 1 m apart along the way, after 2 m or 0.033 s.
    """
    standing = Boxes(0.0 * TIME[None], 0.0 * TIME[None], 0.0 * TIME[None], 0.0 * TIME[None], 1.0, 1.0)
    y = -3.0 + 60.0 * (TIME[None] - 2.0)
    passing = Boxes(0.9 + 0.0 * y, y, np.pi / 2 + 0.0 * y, 60.0 + 0.0 * y, 1.0, 1.0)
    assert third_party(standing, passing, TIME, np.array([2.2])).tolist() == [True]
    assert third_party(standing, passing, TIME, np.array([2.03])).tolist() == [False]


def test_pairs_that_cannot_touch_are_left_out() -> None:
    """The first of the others stands in the way 50 m ahead and is reached within 6 s; the second is 30 m aside."""
    adversaries, others = (
        stacked([cruise("a", 0, 0, 10), cruise("b", 0, 100, 10)]),
        [cruise("c", 55, 0, 0), cruise("d", 55, 30, 0)],
    )
    rows, columns = near_pairs(adversaries, stacked(others), TIME, np.array([6.0, 6.0]))
    assert (rows.tolist(), columns.tolist()) == ([0], [0])
    rows, columns = near_pairs(adversaries, stacked(others), TIME, np.array([3.0, 6.0]))
    assert (rows.tolist(), columns.tolist()) == ([], [])
