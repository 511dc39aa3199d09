"""An attempt made step by step: what moves each adversary, what each step reports, and how the attempt ends."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from sumo_samples import vehicle
from test_drive import Scripted, driving

from sumo_adv.drivers import Steer
from sumo_adv.episode.attempt import Command, OngoingAttempt, apart_of
from sumo_adv.episode.drive import Drive
from sumo_adv.geometry import Pose

STEADY = Steer(0.0, 0.0)
STANDS = {"leader": Pose(122.5, -3.2, 0.0, 0.0)}


class AtTwenty:
    """Leads its adversary at 20 m/s along the middle lane, and remembers when it planned."""

    message = "It is at 20 m/s."
    acceleration = 0.5

    def __init__(self, fails_at: float = math.inf) -> None:
        self.planned: list[tuple[float, float]] = []  # s after the takeover, the ego's x [m] then
        self._x, self._fails_at = 147.5, fails_at

    def replan(self, now: float, ego: tuple[float, float, float, float]) -> str | None:
        self.planned.append((now, ego[0]))
        return "It lost its way." if now >= self._fails_at else None

    def advance(self) -> Pose:
        self._x += 2.0
        return Pose(self._x, 0.0, 0.0, 20.0)


@pytest.fixture
def drive(tmp_path: Path) -> Iterator[Drive]:
    """The ego at x = 97.5 m with 17 m/s, the leader 25 m ahead, and ``beside`` 50 m ahead in the lane to the left."""
    with driving(tmp_path, Scripted(), more=vehicle("beside", "eastbound", 1, 150.0, 17.0)) as it:
        yield it


def test_without_controllers_adversaries_go_straight_on_unless_they_are_put_somewhere(drive: Drive) -> None:
    attempt = OngoingAttempt(drive, {"leader": None, "beside": None}, steps=50, replan=5)
    state = attempt.step(Command(ego=STEADY))
    assert (drive.state("ego").x, drive.state("leader").x) == pytest.approx((99.2, 124.2))
    assert state.apart == pytest.approx({"leader": 25.0, "beside": math.hypot(50.0, 3.2)})
    state = attempt.step(Command({"leader": Pose(122.5, -3.2, 0.0, 0.0)}, STEADY))
    assert state.apart["leader"] == pytest.approx(122.5 - 100.9)
    assert (state.steps, state.driven) == (2, None)


def test_it_ends_when_the_ego_touches_one_of_them_and_both_go_on_as_planned(drive: Drive) -> None:
    """Boxes of 5 m, 25 m apart at first: 25 - 1.7 k < 5 from the 12th step on."""
    attempt = OngoingAttempt(drive, {"leader": None, "beside": None}, steps=50, replan=5)
    while attempt.state.driven is None:
        attempt.step(Command(STANDS, STEADY))
    state, driven = attempt.state, attempt.state.driven
    assert (state.steps, state.apart["leader"]) == (12, 0.0)
    assert (driven.ending, driven.message) == ("contact", "")
    assert driven.beyond["leader"].x == pytest.approx([122.5] * 40)
    assert driven.beyond["beside"].time[[0, -1]] == pytest.approx([1.4, 5.3])
    assert driven.beyond["beside"].x[[0, -1]] == pytest.approx([147.5 + 1.7 * 13, 147.5 + 1.7 * 52])


def test_the_attempt_goes_on_where_adversaries_touch_each_other(drive: Drive) -> None:
    attempt = OngoingAttempt(drive, {"leader": None, "beside": None}, steps=50, replan=5)
    state = attempt.step(Command({"leader": Pose(148.0, -1.5, 0.0, 17.0)}, STEADY))
    assert apart_of(drive, "leader", "beside") == 0.0 and state.driven is None


def test_controllers_plan_every_so_many_steps_and_lead_where_no_pose_is_given(drive: Drive) -> None:
    beside, leader = AtTwenty(fails_at=0.4), AtTwenty()
    attempt = OngoingAttempt(drive, {"leader": leader, "beside": beside}, steps=50, replan=2)
    states = [attempt.step(Command(STANDS, STEADY)) for _ in range(5)]
    assert beside.planned == [(0.0, 97.5), (0.2, pytest.approx(100.9)), (0.4, pytest.approx(104.3))]
    assert leader.planned == []  # the caller moves it
    assert drive.state("beside").x == pytest.approx(147.5 + 4 * 2.0)
    assert [s.steps for s in states] == [1, 2, 3, 4, 4]
    driven = states[-1].driven
    assert driven is not None
    assert (driven.ending, driven.message, driven.beyond) == ("planner_failed", "It lost its way.", {})


def test_what_controllers_say_is_told_at_the_time_limit(drive: Drive) -> None:
    attempt = OngoingAttempt(drive, {"leader": None, "beside": AtTwenty()}, steps=2, replan=2)
    assert attempt.step(Command(ego=STEADY)).driven is None
    driven = attempt.step(Command(ego=STEADY)).driven
    assert driven is not None
    assert (driven.ending, driven.message) == ("time_limit", "It is at 20 m/s.")


def test_it_ends_when_the_ego_has_left(drive: Drive) -> None:
    attempt = OngoingAttempt(drive, {"leader": None, "beside": None}, steps=50, replan=5)
    attempt.step()
    sumo = drive.simulation.api
    sumo.vehicle.moveTo("ego", "eastbound_0", sumo.lane.getLength("eastbound_0") - 0.5)  # its route ends there
    driven = attempt.step().driven
    assert driven is not None and driven.ending == "ego_left"


def test_it_ends_when_all_of_them_have_parted(drive: Drive) -> None:
    attempt = OngoingAttempt(drive, {"leader": None, "beside": None}, steps=50, replan=5)
    far = {"leader": Pose(200.0, -3.2, 0.0, 17.0)}
    attempt.step(Command(far, STEADY))
    assert attempt.step(Command({"leader": Pose(210.0, -3.2, 0.0, 17.0)}, STEADY)).driven is None  # one is near
    gone = {"leader": Pose(220.0, -3.2, 0.0, 17.0), "beside": Pose(230.0, 0.0, 0.0, 17.0)}
    driven = attempt.step(Command(gone, STEADY)).driven
    assert driven is not None
    assert (driven.ending, driven.beyond) == ("passed", {})
