"""Convert the observation of the ego's driver to a CommonRoad scenario with a planning problem.

As in the observation, positions are centres of boxes in the network's frame, and headings are in rad, counter-clockwise
from +x. Time step 0 is now. Ids are numbers. A lane or a vehicle keeps its number in all scenes of a run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from commonroad.common.util import Interval
from commonroad.geometry.shape import Rectangle
from commonroad.planning.goal import GoalRegion
from commonroad.planning.planning_problem import PlanningProblem
from commonroad.prediction.prediction import TrajectoryPrediction
from commonroad.scenario.lanelet import Lanelet, LaneletNetwork, LaneletType, RoadUser
from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType, StaticObstacle
from commonroad.scenario.scenario import Scenario
from commonroad.scenario.traffic_sign import TrafficSign, TrafficSignElement, TrafficSignIDZamunda
from commonroad.scenario.trajectory import Trajectory
from shapely import LineString

from sumo_adv.datatypes import Floats, VehicleState
from sumo_adv.drivers import Lane, Observation, Road, Vehicle
from sumo_adv.errors import UsageError
from sumo_adv.geometry import along, stations, wrap
from sumo_adv.simulation.lane_links import numbered_lane

try:
    from commonroad.scenario.state import CustomState, InitialState
except ImportError:  # commonroad-io 2022.1 has one class for all states
    from commonroad.scenario.trajectory import State as CustomState
    from commonroad.scenario.trajectory import State as InitialState

HORIZON_S = 6.0  # time over which other road users are predicted
STEP_S = 0.1  # CommonRoad's time step
BEHIND_M = 15.0  # length of the reference path before the first point of the observation's path
GOAL_LENGTH_M, GOAL_WIDTH_M = 10.0, 4.0  # size of the goal, which is at the end of the reference path
LATEST_GOAL_STEP = 100_000  # last step at which the goal may be reached; a run ends before
LIMIT_BRAKING_M_S2 = 2.0  # braking before a lower speed limit
CENTRE_LINE_TOLERANCE_M = 0.01  # points this near to the line without them are left out; planners search all points
SHUT_LINE_LENGTH_M = 0.5  # length of the obstacle behind a line at which the ego must wait
OBSTACLE_TYPES = {
    "passenger": ObstacleType.CAR, "private": ObstacleType.CAR, "taxi": ObstacleType.TAXI,
    "delivery": ObstacleType.TRUCK, "truck": ObstacleType.TRUCK, "trailer": ObstacleType.TRUCK,
    "bus": ObstacleType.BUS, "coach": ObstacleType.BUS, "motorcycle": ObstacleType.MOTORCYCLE,
    "moped": ObstacleType.MOTORCYCLE, "bicycle": ObstacleType.BICYCLE, "pedestrian": ObstacleType.PEDESTRIAN,
    "emergency": ObstacleType.PRIORITY_VEHICLE, "tram": ObstacleType.TRAIN,
}  # fmt: skip
"""CommonRoad's types by SUMO's vehicle class. Other classes have the type unknown."""

Predict: TypeAlias = Callable[[VehicleState, Floats], Floats]
"""A function that predicts a road user. It takes the road user's state and times from now on ``(n,)`` [s]. It returns
x, y [m] and heading [rad] at these times, ``(n, 3)``."""


def constant_velocity(vehicle: VehicleState, times: Floats) -> Floats:
    """Predict that a road user continues straight at its present speed; see ``Predict``."""
    gone = vehicle.speed * times
    x, y = vehicle.x + gone * math.cos(vehicle.heading), vehicle.y + gone * math.sin(vehicle.heading)
    return np.column_stack([x, y, np.full(len(times), vehicle.heading)])


@dataclass(frozen=True, slots=True)
class Scene:
    """One observation in CommonRoad's terms.

    Attributes:
        scenario: Lanelets with links, neighbours and limits; the other road users with their predictions.
        problem: The ego's initial state, and a goal at the end of the reference path.
        reference_path: Points ``(n, 2)`` [m], a metre apart, along the ego's lane and route: from 15 m before the first
            point of ``observation.path`` on.
        speed_limit: The highest speed for the ego now [m/s]. It is ``observation.road.limit``, or less before a lower
            posted limit, so that braking with 2 m/s2 reaches that limit in time. Turns on a junction have such limits.
        observation: The observation that the scene shows.
        lanelets: The numbers of the lanelets by SUMO's lane ids.
        obstacles: The numbers of the obstacles by SUMO's vehicle ids.
    """

    scenario: Scenario
    problem: PlanningProblem
    reference_path: Floats
    speed_limit: float
    observation: Observation = field(repr=False)  # printing it would read its lazy values, perhaps too late
    lanelets: Mapping[str, int]
    obstacles: Mapping[str, int]

    @property
    def initial_state(self) -> Any:
        """The ego's present state, an ``InitialState`` with the centre of its box at time step 0."""
        return self.problem.initial_state


class Scenes:
    """Makes the scenes of one run.

    The lanelet network stays the same object as long as ``observation.road.lanes`` is the same object.
    """

    def __init__(
        self, predict: Predict = constant_velocity, *, horizon: float = HORIZON_S, step: float = STEP_S,
        shut_lines: bool = True,
    ) -> None:  # fmt: skip
        """Set what all scenes of the run have in common.

        Args:
            predict: Predicts the other road users.
            horizon: The time over which they are predicted [s].
            step: CommonRoad's time step [s]. The run's step may differ.
            shut_lines: Whether a static obstacle stands behind the next line while the ego must wait there. It is
                useful because few CommonRoad planners know right of way.
        """
        self._predict, self._step, self._shut_lines = predict, step, shut_lines
        self._times = step * np.arange(1.0, round(horizon / step) + 1.0)
        self._numbers: dict[tuple[str, str], int] = {}
        self._lanes: Sequence[Lane] | None = None
        self._network: LaneletNetwork | None = None

    def __call__(self, seen: Observation, yaw_rate: float = 0.0) -> Scene:
        """Make the scene of one step.

        Args:
            seen: The observation. It must have ``path`` and ``road``.
            yaw_rate: The ego's yaw rate [rad/s].

        Raises:
            UsageError: The ego is off the road, so there is no path.
        """
        if seen.path is None or seen.road is None:
            raise UsageError("Off the road, there is no CommonRoad scene: return None if observation.path is None.")
        path = _reference_path(np.array(seen.path))
        scenario = Scenario(self._step)
        scenario.add_objects(self.lanelet_network(seen.road.lanes))
        for vehicle in seen.others:
            scenario.add_objects(self.obstacle(vehicle))
        if self._shut_lines and seen.road.must_wait:
            line = seen.road.stop_lines[0].ahead
            if line > seen.ego.length / 2:  # otherwise the obstacle would overlap the ego
                scenario.add_objects(self._shut_line(path, seen.ego, line, seen.road.width))
        problem = PlanningProblem(self._number("problem", ""), _initial_state(seen.ego, yaw_rate), _goal(path))
        lanelets = {lane.id: self._number("lane", lane.id) for lane in seen.road.lanes}
        obstacles = {vehicle.id: self._number("vehicle", vehicle.id) for vehicle in seen.others}
        return Scene(scenario, problem, path, _speed_limit(seen.road), seen, lanelets, obstacles)

    def lanelet_network(self, lanes: Sequence[Lane]) -> LaneletNetwork:
        """Convert the lanes of ``observation.road`` to lanelets, with their speed limits as signs."""
        if self._network is None or lanes is not self._lanes:
            numbers = {lane.id: self._number("lane", lane.id) for lane in lanes}
            network = LaneletNetwork.create_from_lanelet_list([_lanelet(lane, numbers) for lane in lanes])
            for limit in sorted({lane.limit for lane in lanes}):
                limited = {numbers[lane.id] for lane in lanes if lane.limit == limit}
                network.add_traffic_sign(_limit_sign(self._number("limit", f"{limit:g}"), limit, limited), limited)
            self._lanes, self._network = lanes, network
        return self._network

    def obstacle(self, vehicle: VehicleState) -> DynamicObstacle:
        """Convert another road user to an obstacle, with its prediction from time step 1 on.

        Raises:
            UsageError: The prediction has the wrong shape.
        """
        places = np.array(self._predict(vehicle, self._times))
        if places.shape != (len(self._times), 3):
            raise UsageError(
                f"The prediction of {vehicle.id!r} has the shape {places.shape}: it must have x, y and heading for "
                f"each of the {len(self._times)} times."
            )
        gone = np.diff(places[:, :2], axis=0, prepend=[(vehicle.x, vehicle.y)])
        speeds = np.hypot(gone[:, 0], gone[:, 1]) / self._step
        states = [
            CustomState(time_step=k, position=place[:2], orientation=wrap(float(place[2])), velocity=float(speed))
            for k, (place, speed) in enumerate(zip(places, speeds, strict=True), 1)
        ]
        shape = Rectangle(length=vehicle.length, width=vehicle.width)
        kind = vehicle.kind if isinstance(vehicle, Vehicle) else "passenger"
        yaw_rate = vehicle.yaw_rate if isinstance(vehicle, Vehicle) else 0.0
        return DynamicObstacle(
            self._number("vehicle", vehicle.id), OBSTACLE_TYPES.get(kind, ObstacleType.UNKNOWN), shape,
            _initial_state(vehicle, yaw_rate), TrajectoryPrediction(Trajectory(1, states), shape),
        )  # fmt: skip

    def _shut_line(self, path: Floats, ego: VehicleState, ahead: float, width: float) -> StaticObstacle:
        """Make an obstacle across the ego's lane, just behind a line that is ``ahead`` [m] of the ego's centre."""
        at = stations(path[:, 0], path[:, 1])
        centre = float(along(path, ego.x, ego.y)) + ahead + SHUT_LINE_LENGTH_M / 2
        k = min(max(int(np.searchsorted(at, centre)), 1), len(path) - 1)
        (ax, ay), (bx, by) = path[k - 1].tolist(), path[k].tolist()
        share = (centre - at[k - 1]) / (at[k] - at[k - 1])
        state = InitialState(
            time_step=0, position=np.array([ax + share * (bx - ax), ay + share * (by - ay)]),
            orientation=math.atan2(by - ay, bx - ax), velocity=0.0, acceleration=0.0, yaw_rate=0.0, slip_angle=0.0,
        )  # fmt: skip
        shape = Rectangle(length=SHUT_LINE_LENGTH_M, width=width)
        return StaticObstacle(self._number("line", ""), ObstacleType.UNKNOWN, shape, state)

    def _number(self, sort: str, name: str) -> int:
        """Return the number of an object. Numbers begin at 1, and an object keeps its number."""
        return self._numbers.setdefault((sort, name), len(self._numbers) + 1)


def _lanelet(lane: Lane, numbers: Mapping[str, int]) -> Lanelet:
    centre = np.array(LineString(lane.centre).simplify(CENTRE_LINE_TOLERANCE_M).coords)
    made = numbered_lane(numbers[lane.id], centre, lane.width, junction=lane.junction, links=lane, numbers=numbers)
    left = made.opposite_left if made.beside_left is None else made.beside_left
    right = made.opposite_right if made.beside_right is None else made.beside_right
    return Lanelet(
        made.left, centre, made.right, made.number, list(made.entries), list(made.exits),
        left, None if left is None else left == made.beside_left,
        right, None if right is None else right == made.beside_right,
        lanelet_type={LaneletType.INTERSECTION if lane.junction else LaneletType.UNKNOWN},
        user_one_way={RoadUser.VEHICLE} if lane.allowed else set(),
    )  # fmt: skip


def _limit_sign(number: int, limit: float, lanelets: set[int]) -> TrafficSign:
    element = TrafficSignElement(TrafficSignIDZamunda.MAX_SPEED, [f"{limit:.4f}"])
    return TrafficSign(number, [element], lanelets, np.zeros(2), virtual=True)


def _initial_state(vehicle: VehicleState, yaw_rate: float) -> Any:
    """Return the state of a vehicle now. If it stands, its acceleration is 0, not the braking of the last step."""
    acceleration = vehicle.acceleration if vehicle.speed > 0.0 else 0.0
    return InitialState(
        time_step=0, position=np.array([vehicle.x, vehicle.y]), orientation=vehicle.heading, velocity=vehicle.speed,
        acceleration=acceleration, yaw_rate=yaw_rate, slip_angle=0.0,
    )  # fmt: skip


def _goal(path: Floats) -> GoalRegion:
    heading = math.atan2(*(path[-1] - path[-2])[::-1].tolist())
    place = Rectangle(GOAL_LENGTH_M, GOAL_WIDTH_M, center=path[-1], orientation=heading)
    return GoalRegion([CustomState(time_step=Interval(1, LATEST_GOAL_STEP), position=place)])


def _speed_limit(road: Road) -> float:
    ahead = (math.sqrt(limit.speed**2 + 2 * LIMIT_BRAKING_M_S2 * max(limit.ahead, 0.0)) for limit in road.limits)
    return min((road.limit, *ahead))


def _reference_path(path: Floats) -> Floats:
    """Extend a path backwards along a straight line.

    A path may begin at the ego's centre, but the ego's rear and its rear axle are behind that.
    """
    first = path[1] - path[0]
    first = first / np.hypot(*first)
    return np.vstack([path[0] - np.arange(BEHIND_M, 0.5, -1.0)[:, None] * first, path])
