"""One unattacked drive in the engine process. The road, the traffic and the steps are those of ``sumo-adv run``.

A wrapper around the driver records its answers and the time that they take. It can also set the driver's clock forward.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Track, VehicleState
from sumo_adv.drivers import Action, EgoController, Observation, Pose, StopLine, make_ego
from sumo_adv.drivers.protocol import wishes_of
from sumo_adv.drivers.timing import Stopwatch
from sumo_adv.episode.drive import Drive, ego_type_file
from sumo_adv.episode.encounter_search import EncounterSearch
from sumo_adv.episode.right_of_way import LINE_PASSED_M
from sumo_adv.episode.task import Task
from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.files import scratch_prefix
from sumo_adv.geometry import seen_from_segments, wrap
from sumo_adv.metrics.boxes import corners
from sumo_adv.simulation.network import RoadMap, read_network

# Between a car and the lane that it is in: 60 degrees, for cars that turn on a junction
MAX_DRIVEN_LANE_ANGLE_RAD = 1.05
# After the beginning; if the input names no ego, it is chosen then, because traffic is present by that time
EGO_CHOICE_TIME_S = 15.0
# A line this near can be passed in one step; the next line is this much farther away
LINE_PASSING_DISTANCE_M = 3.0
NEXT_LINE_DISTANCE_M = 1.0
MIN_WAIT_S = 1.0  # the ego must have had to wait for this long, because a shorter time does not suffice to brake
MIN_DRIVE_SPEED_M_S = 0.1
ROAD_SEARCH_DISTANCE_M = 5.0  # the road is read up to this far around the ego's motion


@dataclass(frozen=True, slots=True)
class PassedLine:
    """A stop line that the ego passed although it had to wait.

    Attributes:
        time: The time at which the ego passed the line [s].
        signal: The state of the traffic light, as in ``StopLine``.
    """

    time: float
    signal: str | None


@dataclass(frozen=True, slots=True)
class UnattackedDrive:
    """The recording of one drive.

    Attributes:
        ego: The ego's motion of n states, while the driver under test drove it.
        others: The motions of the other vehicles.
        off_road: The distances of the ego's corners from the carriageway [m], ``(n, 4)``; 0 on it.
        off_lane: The distances of the ego's centre from the nearest lane that leads its way [m], ``(n,)``; 0 in it.
        poses: For each ``Pose`` that the driver returned, the ego before the step and the pose.
        act: The time that each answer took [s].
        lines: The stop lines that the ego passed while it had to wait.
        failure: Why the drive ended early; empty if it did not.
    """

    ego: Track
    others: tuple[Track, ...]
    off_road: Floats
    off_lane: Floats
    poses: tuple[tuple[VehicleState, Pose], ...]
    act: Floats
    lines: tuple[PassedLine, ...] = ()
    failure: str = ""


class ObservedDriver:
    """A wrapper that records a driver's answers and sets its clock forward.

    Attributes:
        poses: For each ``Pose`` that the driver returned, the ego before the step and the pose.
        seconds: The time that each answer took [s].
        lines: The stop lines that the ego passed while it had to wait.
    """

    def __init__(self, driver: EgoController, later: float) -> None:
        """Wrap a driver.

        Args:
            driver: The driver.
            later: The time by which the driver's clock is ahead of the simulation's [s].
        """
        self._driver, self._later = driver, later
        self._line: StopLine | None = None  # the next one, in the last observation
        self._since = math.inf  # s, since when the ego must wait there
        self.name, self.forkable, self.sumo_type = driver.name, False, driver.sumo_type
        self.needs_observation, self.wishes = driver.needs_observation, wishes_of(driver)
        self.poses: list[tuple[VehicleState, Pose]] = []
        self.seconds: list[float] = []
        self.lines: list[PassedLine] = []

    def reset(self, seed: int) -> None:
        """Reset the driver."""
        self._driver.reset(seed)

    def act(self, observation: Observation) -> Action:
        """Return the driver's answer, and record it."""
        self._watch_lines(observation)
        seen = replace(observation, time=observation.time + self._later) if self._later else observation
        with (watch := Stopwatch()):
            action = self._driver.act(seen)
        self.seconds.append(watch.seconds)
        if isinstance(action, Pose):
            self.poses.append((observation.ego, action))
        return action

    def _watch_lines(self, observation: Observation) -> None:
        """Record a line at which the ego had to wait and which is no longer ahead."""
        road, front = observation.road, observation.ego.length / 2
        lines = () if road is None else road.stop_lines
        line = next((line for line in lines if line.ahead > front - LINE_PASSED_M), None)
        last, time = self._line, observation.time
        passed = last is not None and last.ahead - front < LINE_PASSING_DISTANCE_M
        passed = passed and (line is None or last is None or line.ahead > last.ahead + NEXT_LINE_DISTANCE_M)
        if (
            passed
            and last is not None
            and time - self._since >= MIN_WAIT_S - 1e-6
            and observation.ego.speed > MIN_DRIVE_SPEED_M_S
        ):
            self.lines.append(PassedLine(time, last.signal))
        must_wait = line is not None and line.must_wait
        self._since = min(self._since, time) if must_wait and not passed else time if must_wait else math.inf
        self._line = line


class CheckWorker:
    """Drives one scenario after the other in the engine process."""

    def __init__(self, slots: Sequence[Connection] = ()) -> None:
        """Prepare to drive. The connections ``slots`` are not used."""
        self._folder = tempfile.TemporaryDirectory(prefix=scratch_prefix())
        self._roads: dict[Path, RoadMap] = {}
        self._driver: EgoController | None = None

    def choose(self, task: Task) -> str:
        """Choose the vehicle that a run of the task would choose as its ego.

        Raises:
            UsageError: There is no such vehicle within ``EGO_CHOICE_TIME_S``.
        """
        drive = self._made(replace(task, ego_driver="idm", ego_parameters={}), make_ego("idm", {}))
        try:
            search = EncounterSearch(
                drive, self._road(task), replace(task, trigger=task.spec.recorded_from + EGO_CHOICE_TIME_S)
            )
            search.until_encounter()
            if drive.ego is None:
                raise UsageError(f"No vehicle of {task.spec.network.name} could be the ego; give a scenario with one.")
            return drive.ego
        finally:
            drive.simulation.close()

    def drive(self, task: Task, *, fresh: bool = True, later: float = 0.0) -> UnattackedDrive:
        """Drive from the task's beginning to its end, or until the ego has left the network.

        A fault of the driver or of SUMO during the drive is recorded as the drive's ``failure``.

        Args:
            task: The task.
            fresh: Whether to create a new driver. Otherwise, the last drive's object drives again after its ``reset``.
            later: The time by which the driver's clock is ahead of the simulation's [s].

        Raises:
            UsageError: The driver cannot be created.
            SimulationError: The ego was not inserted.
        """
        if fresh or self._driver is None:
            self._driver = make_ego(task.ego_driver, task.ego_parameters)
        driver, road = ObservedDriver(self._driver, later), self._road(task)
        drive = self._made(task, driver)
        try:
            failure = _to_the_end(drive, road, task)
            return _recorded(drive, road, task, driver, failure)
        finally:
            drive.simulation.close()

    def _made(self, task: Task, driver: EgoController) -> Drive:
        demand = (*task.spec.routes, *task.spec.additional)
        types = ego_type_file(driver, Path(self._folder.name), demand)
        spec = replace(task.spec, additional=(*task.spec.additional, types))
        return Drive(spec, driver, task.settings.seed, deadline=task.settings.ego_deadline)

    def _road(self, task: Task) -> RoadMap:
        network = task.spec.network
        if network not in self._roads:
            self._roads[network] = read_network(network)
        return self._roads[network]


def _to_the_end(drive: Drive, road: RoadMap, task: Task) -> str:
    """Drive, and return why the driver or SUMO failed, or an empty string."""
    search = EncounterSearch(drive, road, replace(task, trigger=math.inf, only=()))  # so that no encounter begins
    try:
        search.until_encounter()
    except SimulationError as error:
        return str(error)
    return ""


def _recorded(drive: Drive, road: RoadMap, task: Task, driver: ObservedDriver, failure: str) -> UnattackedDrive:
    name = drive.ego or task.ego
    tracks = {track.id: track for track in drive.tracks()}
    ego = tracks.pop(str(name), None)
    if ego is None:
        raise SimulationError(failure or f"The ego '{name}' was not inserted before {drive.now:.0f} s.")
    return UnattackedDrive(
        ego, tuple(tracks.values()), distance_off_road(road, ego), off_lane(road, ego), tuple(driver.poses),
        np.array(driver.seconds), tuple(driver.lines), failure,
    )  # fmt: skip


def distance_off_road(road: RoadMap, track: Track) -> Floats:
    """Measure how far the corners of a vehicle are from the carriageway [m], ``(n, 4)``; 0 on it."""
    from shapely import distance, points

    x, y = float(np.median(track.x)), float(np.median(track.y))
    area = road.drivable(x, y, float(np.hypot(track.x - x, track.y - y).max()) + ROAD_SEARCH_DISTANCE_M).area
    return np.asarray(distance(points(corners(track.boxes())), area))


def off_lane(road: RoadMap, track: Track) -> Floats:
    """Measure how far the centre of a vehicle is from the nearest lane that leads its way [m], ``(n,)``; 0 in it."""
    nearest = np.full(len(track.x), np.inf)
    low, high = (
        np.array([track.x.min(), track.y.min()]) - ROAD_SEARCH_DISTANCE_M,
        np.array([track.x.max(), track.y.max()]) + ROAD_SEARCH_DISTANCE_M,
    )
    for lane in road.lanes.values():
        around = (lane.shape.max(axis=0) > low) & (lane.shape.min(axis=0) < high)
        if lane.carriageway and len(lane.shape) > 1 and around.all():
            nearest = np.minimum(nearest, _from_lane(lane.shape, track) - lane.width / 2)
    return np.maximum(nearest, 0.0)


def _from_lane(shape: Floats, track: Track) -> Floats:
    """Measure the distance from the parts of a centreline ``(k, 2)`` that lead a vehicle's way.

    Returns:
        The distances [m], ``(n,)``; inf if no part leads its way.
    """
    step = np.diff(shape, axis=0)
    _, away = seen_from_segments(shape, track.x, track.y)
    turned: Bools = (
        np.abs(wrap(np.arctan2(step[:, 1], step[:, 0]) - track.heading[:, None])) > MAX_DRIVEN_LANE_ANGLE_RAD
    )
    return np.asarray(np.where(turned, np.inf, away).min(axis=1))
