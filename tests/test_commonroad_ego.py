"""An ego that a planner of one method drives: what it does between plans, without one, and in SUMO."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from road_samples import drive, steps
from sumo_samples import vehicle

pytest.importorskip("commonroad", reason="needs commonroad-io")

from sumo_adv.commonroad import PlannerEgo, Scene
from sumo_adv.datatypes import VehicleState
from sumo_adv.drivers import Observation, PlannedPose, Road, Steer, UserEgo
from sumo_adv.errors import DriverError

PATH = tuple((float(x), 0.0) for x in range(200))


def state(step: int, x: float, speed: float, y: float = 0.0) -> Any:
    """What a planner returns, as CommonRoad spells it."""
    return SimpleNamespace(time_step=step, position=(x, y), orientation=0.0, velocity=speed)


class Steady(PlannerEgo):
    """Goes straight on at its speed for half a second; keeps the scenes that it was given."""

    found = True  # whether there is a plan

    def plan(self, scene: Scene) -> Sequence[Any] | None:
        self.given = [*getattr(self, "given", ()), scene]
        x, speed = float(scene.initial_state.position[0]), float(scene.initial_state.velocity)
        return [state(k, x + 0.1 * k * speed, speed) for k in range(6)] if self.found else None


def seen(step: int, x: float, dt: float = 0.1, **given: Any) -> Observation:
    """10 m/s eastward at y = 0."""
    ego = VehicleState("ego", x, 0.0, 0.0, 10.0, 0.0, 5.0, 2.0, "road_0")
    return Observation(step * dt, dt, ego, (), **{"path": PATH, "road": Road(15.0), **given})


def test_it_plans_every_fifth_step_and_drives_along_the_plan_in_between() -> None:
    ego = Steady()
    ego.reset(0)
    answers = [ego.act(seen(k, 20.0 + k)) for k in range(10)]
    assert all(isinstance(answer, PlannedPose) for answer in answers)
    assert [answer.x for answer in answers] == pytest.approx([21.0 + k for k in range(10)])
    assert [scene.observation.time for scene in ego.given] == pytest.approx([0.0, 0.5])
    assert answers[0].plan == [(20.0 + k, 0.0) for k in range(6)] and answers[3].plan == [
        (23.0 + k, 0.0) for k in range(3)
    ]


def test_between_two_states_of_the_plan_it_is_between_their_places() -> None:
    """Steps of 0.05 s, and states every 0.1 s."""
    ego = Steady()
    ego.reset(0)
    answers = [ego.act(seen(k, 20.0 + 0.5 * k, dt=0.05)) for k in range(3)]
    assert [answer.x for answer in answers] == pytest.approx([20.5, 21.0, 21.5])


def test_an_ego_that_is_not_where_it_planned_to_be_plans_anew() -> None:
    ego = Steady()
    ego.reset(0)
    ego.act(seen(0, 20.0))
    ego.act(seen(1, 21.4))  # planned: 21.0
    ego.act(seen(2, 22.6))  # planned: 22.0
    assert [scene.observation.time for scene in ego.given] == pytest.approx([0.0, 0.2])


def test_without_a_plan_it_brakes_along_its_path_and_asks_in_each_step() -> None:
    """From 0.5 s on there is no plan. The path goes straight on, so the wheel is straight."""
    ego = Steady()
    ego.reset(0)
    answers = [ego.act(seen(k, 20.0 + k)) for k in range(5)]
    ego.found = False
    answers += [ego.act(seen(k, 20.0 + k)) for k in (5, 6)]
    assert [type(answer) for answer in answers] == [PlannedPose] * 5 + [Steer] * 2
    assert (answers[-1].acceleration, answers[-1].steering) == pytest.approx((-9.0, 0.0))
    assert [scene.observation.time for scene in ego.given] == pytest.approx([0.0, 0.5, 0.6])


def test_sumo_drives_where_there_is_no_path_and_where_the_route_ends() -> None:
    ego = Steady()
    ego.reset(0)
    assert ego.act(seen(0, 20.0, path=None)) is None
    assert ego.act(seen(1, 20.0, road=Road(15.0, leaves=True))) is None


@pytest.mark.parametrize(
    ("states", "says"),
    [
        ([SimpleNamespace(time_step=1, velocity=1.0)], "no attribute 'position'.*each needs time_step, position"),
        ([state(2, 1.0, 1.0), state(1, 2.0, 1.0)], "whose time_step does not grow from 1 on"),
        ([state(1, math.nan, 1.0)], "or that are not finite"),
    ],
)
def test_states_that_cannot_be_driven_are_refused(states: list[Any], says: str) -> None:
    class Wrong(PlannerEgo):
        def plan(self, scene: Scene) -> Sequence[Any]:
            return states

    ego = UserEgo("mine:Wrong", Wrong())
    ego.reset(0)
    with pytest.raises(DriverError, match=f"'mine:Wrong' failed in act at 0.0 s: .*{says}"):
        ego.act(seen(0, 20.0))


def test_a_planner_drives_in_sumo(tmp_path: Path) -> None:
    """At 12 m/s it goes 1.2 m north in each step; the yaw rate of its initial state is that of the last step."""

    class North(PlannerEgo):
        def plan(self, scene: Scene) -> Sequence[Any]:
            x, y = scene.initial_state.position
            assert scene.initial_state.yaw_rate == pytest.approx(0.0, abs=1e-6)
            return [
                SimpleNamespace(time_step=k, position=(x, y + 1.2 * k), orientation=math.pi / 2, velocity=12.0)
                for k in range(1, 31)
            ]

    ego = North()
    ego.reset(0)
    coming = vehicle("ego", "south_in north_out", 1, 110.0, 12.0)
    with drive(tmp_path, "priority_crossing", [coming], lambda seen: (seen.ego.x, seen.ego.y), ego.act) as (
        moving, watcher,
    ):  # fmt: skip
        steps(moving, 20)
    (x, y), (last_x, last_y) = watcher.kept[0], watcher.kept[-1]
    assert last_x == pytest.approx(x) and last_y - y == pytest.approx(1.2 * (len(watcher.kept) - 1), abs=0.05)
