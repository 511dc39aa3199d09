"""FISS+ as an ego: an external planner that samples trajectories in the frame of a lane.

Sun et al. 2023, "FISS+: Efficient and focused trajectory generation and refinement using fast iterative search and
sampling strategy" (IROS), in the authors' package ``fiss-planner`` (Apache-2.0), which the extra ``planners`` installs.
FISS+ plans, and the Stanley controller of the same package follows the plan. This file adapts both to our protocol:

    ours                                          theirs
    time of the simulation                        time since the ego was taken over; a plan begins at its own time 0
    centre of the box                             rear axle
    path, ``road.sides``                          a map of lanes with neighbours
    ``road.stop_lines``                           a stop line that is active while the ego must wait
    other vehicles as they are now                predictions: along the lanes, against the path, or straight on
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import fiss_planner as fiss
import numpy as np

from sumo_adv.datatypes import VehicleState
from sumo_adv.drivers.lattice_frame import ALONG_PATH_RAD, RoadFrame
from sumo_adv.drivers.protocol import WHEELBASE_M, Action, Observation, Road, Steer
from sumo_adv.drivers.sumo_driven import sumo_type
from sumo_adv.geometry import wrap

REAR_AXLE_OFFSET_M = WHEELBASE_M / 2  # behind the centre, as in ``protocol.py``
FORESEEN_S, FORESEEN_STEP_S = 6.0, 0.1  # length and step of predictions, a second more than the longest plan
HARDEST_BRAKING_M_S2 = 8.0
MAX_PLANNED_LATERAL_M_S2 = 4.0  # the planner's own limit
KEPT_PATH_BEHIND_M = 15.0  # how much of the last path is kept
LANE_POINT_SPACING_M = 1.0  # between the points of a lane
LINE_ID, OWN_LANE_ID = 1, 1  # ids in the planner's map
LINE_SETBACK_M = 1.5  # the planner stops its minimal gap before a line, so the line is set this far behind the real one
LINE_TOLERANCE_M = 1.0  # how far a line must be off before the map is drawn again
AGAINST_PATH_RAD = 3 * math.pi / 4  # a vehicle at more than this to the path comes against it
ONCOMING_PATH_DISTANCE_M = 8.0  # oncoming vehicles at most this far from the path follow its bends


class FissPlusEgo:
    """The controller. Its state: the planner with its last plan, the tracking controller, the path's frame and map."""

    name = "fiss_plus"
    forkable = True  # one thread, and memory that it shares with nothing
    needs_observation = True

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        """Read the parameters.

        Args:
            parameters: Those of IDM, which drives if no path is known.

        Raises:
            UsageError: A parameter is unknown or out of range.
        """
        self.sumo_type: Mapping[str, str] = sumo_type("idm", parameters or {})
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Forget everything; the seed is not needed."""
        self._begun: float | None = None  # simulation time [s] at which the planner's clock was 0
        self._points: Sequence[tuple[float, float]] | None = None
        self._frame: RoadFrame | None = None
        self._drawn: tuple[RoadFrame, str, float] | None = None  # frame, lane and line for which the map was drawn
        self._wheel = 0.0  # [rad], in the last step

    def act(self, observation: Observation) -> Action:
        """Return pedals and wheel for the step.

        Returns:
            None (SUMO drives) without a path, and when the route leaves the network.
        """
        ego, road = observation.ego, observation.road
        if observation.path is not None and observation.path is not self._points:
            self._points, self._frame = observation.path, RoadFrame(_joined(self._frame, observation.path))
        if self._frame is None or road is None or road.leaves:
            return None
        if self._begun is None:
            self._begun = observation.time
            self._planner, self._controller = _planner(ego)
        self._update_map(self._frame, ego, road)
        others = [self._predict(self._frame, vehicle) for vehicle in observation.others]
        since = round(observation.time - self._begun, 6)  # its choices are discrete: the last digit could change them
        plan = self._planner.step(since, self._rear_axle(ego), others, road.limit)
        if plan.emergency or len(np.asarray(plan.trajectory.t)) < 2:
            self._wheel = self._frame.wheel(ego, MAX_PLANNED_LATERAL_M_S2)
            return Steer(-HARDEST_BRAKING_M_S2, self._wheel)
        command = self._controller.compute(self._rear_axle(ego), plan.trajectory, observation.dt)
        self._wheel = float(command.steer)
        return Steer(float(command.accel), self._wheel)

    def _rear_axle(self, ego: VehicleState) -> Any:
        x, y = ego.x - REAR_AXLE_OFFSET_M * math.cos(ego.heading), ego.y - REAR_AXLE_OFFSET_M * math.sin(ego.heading)
        return fiss.EgoState(x, y, ego.heading, ego.speed, ego.acceleration, math.tan(self._wheel) / WHEELBASE_M)

    def _update_map(self, frame: RoadFrame, ego: VehicleState, road: Road) -> None:
        """Draw the map if path, lane or stop line are new; close the line while the ego must wait."""
        here = frame.locate(ego)[0]
        line = here + road.stop_lines[0].ahead if road.stop_lines else math.inf
        if self._drawn is None or self._drawn[:2] != (frame, ego.lane) or not _same(self._drawn[2], line):
            self._drawn = (frame, ego.lane, line)
            self._map = _road_map(frame, here, road, line)
            self._planner.set_map(self._map, [OWN_LANE_ID])
        self._planner.set_stop_line_active(LINE_ID, road.must_wait)

    def _predict(self, frame: RoadFrame, other: VehicleState) -> Any:
        """Predict a vehicle with the planner's own predictions if it goes the ego's way or crosses it.

        The planner knows no lanes that lead against the ego's: an oncoming vehicle keeps its offset from the path.
        """
        number = zlib.crc32(other.id.encode()) & 0x7FFFFFFF
        s, d, turn = frame.locate(other)
        place, size = (other.x, other.y, other.heading, other.speed), (other.length, other.width)
        state = (number, *place, *size, FORESEEN_S, FORESEEN_STEP_S)
        if abs(turn) < ALONG_PATH_RAD:
            return fiss.predict_lane_following(self._map, *state)
        if abs(turn) < AGAINST_PATH_RAD or abs(d) > ONCOMING_PATH_DISTANCE_M:
            return fiss.predict_constant_velocity(*state)
        times = np.arange(0.0, FORESEEN_S, FORESEEN_STEP_S)
        x, y, heading = frame.path.at(s - other.speed * times, d)
        return fiss.Obstacle.from_arrays(number, other.length, other.width, times, x, y, wrap(heading + math.pi))


def _joined(before: RoadFrame | None, points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Put the last path before a new path.

    A path begins at the ego's centre, and FISS+ plans for the rear axle, which is behind it. If the new path is beside
    the last one, the last one is moved sideways.
    """
    if before is None:
        return list(points)
    begins, offset = (float(q[0]) for q in before.project(*(np.array([q]) for q in (*points[0], 0.0)))[:2])
    first, spacing = max(begins - KEPT_PATH_BEHIND_M, 0.0), LANE_POINT_SPACING_M
    x, y, _ = before.path.at(np.arange(first, begins - spacing / 2, spacing), offset)
    return [*zip(x.tolist(), y.tolist(), strict=True), *points]


def _planner(ego: VehicleState) -> tuple[Any, Any]:
    """Return the planner and the controller for a car of the ego's size."""
    car, config = fiss.VehicleParams(), fiss.LocalPlannerConfig()
    car.length, car.width = ego.length, ego.width
    car.max_decel, car.max_lat_accel = HARDEST_BRAKING_M_S2, MAX_PLANNED_LATERAL_M_S2
    car.wheelbase, car.rear_axle_to_center = WHEELBASE_M, REAR_AXLE_OFFSET_M
    config.planner.type, config.emergency_decel = fiss.PlannerType.FISS_PLUS, HARDEST_BRAKING_M_S2
    return fiss.LocalPlanner(config, car), fiss.make_controller("stanley_pid", car)


def _road_map(frame: RoadFrame, here: float, road: Road, line: float) -> Any:
    """Draw the ego's lane, which is its path, and the lanes beside it as far as they lead the same way.

    Args:
        frame: The frame of the path.
        here: The ego's station [m].
        road: The road at the ego.
        line: Station of the next stop line [m]; inf if there is none.
    """
    offsets = sorted((0.0, *road.sides))  # from right to left
    ids = [OWN_LANE_ID if offset == 0.0 else OWN_LANE_ID + 1 + k for k, offset in enumerate(offsets)]
    made = fiss.RoadMap()
    for k, offset in enumerate(offsets):
        end = frame.path.length if offset == 0.0 else min(here + road.until, frame.path.length)
        stations = np.linspace(0.0, end, max(round(end / LANE_POINT_SPACING_M), 1) + 1)
        lane = fiss.MapLane()
        lane.id, lane.speed_limit = ids[k], road.limit
        lane.left, lane.centerline, lane.right = (
            np.stack(frame.path.at(stations, offset + side * road.width / 2)[:2], axis=1) for side in (1, 0, -1)
        )
        if k + 1 < len(offsets):
            lane.left_neighbor, lane.can_change_left = ids[k + 1], True
        if k > 0:
            lane.right_neighbor, lane.can_change_right = ids[k - 1], True
        made.add_lane(lane)
    if line < frame.path.length:
        made.add_stop_line(fiss.StopLine(LINE_ID, OWN_LANE_ID, line + LINE_SETBACK_M, False))
    made.finalize()
    return made


def _same(drawn: float, line: float) -> bool:
    return drawn == line or abs(drawn - line) < LINE_TOLERANCE_M
