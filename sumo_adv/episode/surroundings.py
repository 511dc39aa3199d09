"""Build what the ego's driver sees: other vehicles, the path, its place in the lane, and the road map.

Each part is made when it is first read.
"""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from sumo_adv.datatypes import Bools, Floats, VehicleState
from sumo_adv.drivers import Observation, Road, Vehicle
from sumo_adv.drivers.protocol import wishes_of
from sumo_adv.drivers.timing import engine_work
from sumo_adv.episode.ego_place import LanePlace
from sumo_adv.episode.encounter_detector import WAY_AHEAD_M, logged_path
from sumo_adv.episode.right_of_way import Meetings
from sumo_adv.episode.road_here import RoadHere
from sumo_adv.errors import SimulationError
from sumo_adv.geometry import PATH_STEP_M, crosses_box, same_layer, wrap
from sumo_adv.metrics.reference.sight import in_reach, path_through
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.sumo_states import heading_of
from sumo_adv.simulation.tracks import acceleration

if TYPE_CHECKING:
    from sumo_adv.episode.drive import Drive

# -- line of sight --------------------------------------------------------------------------------------------------

BUILDING = "building"  # the types of SUMO's polygons that are buildings begin with it (as named by polyconvert)


def read_buildings(files: Iterable[Path]) -> tuple[Floats, ...]:
    """Read the buildings from SUMO's additional files.

    These are polygons whose type begins with ``building``. Polygons in degrees (``geo``) are left out.

    Args:
        files: The files, which may be compressed (``.gz``).

    Returns:
        The outlines, each ``(n, 2)`` [m].
    """
    outlines = []
    for file in files:
        with gzip.open(file, "rb") if file.suffix == ".gz" else file.open("rb") as stream:
            for _, element in ElementTree.iterparse(stream):
                if element.tag != "poly" or not element.get("type", "").startswith(BUILDING):
                    continue
                if element.get("geo", "false") in ("true", "1"):
                    continue
                points = [tuple(map(float, p.split(",")[:2])) for p in element.get("shape", "").split()]
                if len(points) > 2:
                    outlines.append(np.array(points))
    return tuple(outlines)


class Sight:
    """Tells what can be seen past buildings and boxes."""

    def __init__(self, buildings: Sequence[Floats] = ()) -> None:
        """Index the buildings.

        Args:
            buildings: The outlines, each ``(n, 2)`` [m].
        """
        from shapely import Polygon, STRtree

        self._tree = STRtree([Polygon(outline) for outline in buildings]) if len(buildings) else None

    def visible(self, eye: tuple[float, float], boxes: Sequence[VehicleState], eye_z: float = 0.0) -> Bools:
        """Return which boxes can be seen from a point.

        A box is visible if its centre or one of its corners is. Buildings block the view, and so do other boxes on its
        layer or on that of the eye.

        Args:
            eye: The point (x, y) [m].
            boxes: The boxes, which block the view of each other.
            eye_z: The height of the road at the point [m].

        Returns:
            Whether each box is visible, ``(n,)``.
        """
        if not boxes:
            return np.zeros(0, bool)
        targets = np.stack([_targets(box) for box in boxes])  # (n, 5, 2)
        blocked = np.zeros(targets.shape[:2], bool)
        z = np.array([box.z for box in boxes])
        for k, box in enumerate(boxes):
            half = (box.length / 2, box.width / 2)
            through = crosses_box(eye, (targets[..., 0], targets[..., 1]), (box.x, box.y, box.heading), half)
            through[k] = False
            through &= (same_layer(box.z, z) | same_layer(box.z, eye_z))[:, None]
            blocked |= through
        if self._tree is not None:
            from shapely import linestrings

            lines = linestrings(np.stack([np.broadcast_to(eye, targets.shape), targets], axis=2).reshape(-1, 2, 2))
            hit = self._tree.query(lines, predicate="intersects")[0]
            blocked.reshape(-1)[hit] = True
        return np.asarray(~blocked.all(axis=1))


def _targets(box: VehicleState) -> Floats:
    """Return the centre and the corners of a box, ``(5, 2)``."""
    c, s = np.cos(box.heading), np.sin(box.heading)
    local = np.array([(0, 0), (1, 1), (1, -1), (-1, -1), (-1, 1)]) * (box.length / 2, box.width / 2)
    return np.asarray(local @ np.array([[c, s], [-s, c]]) + (box.x, box.y))


# -- what the driver sees -------------------------------------------------------------------------------------------

PATH_LENGTH_M, PATH_RENEWED_M = 120.0, 40.0  # of the path for the driver, and after which distance it is renewed
LAMP_RIGHT, LAMP_LEFT, LAMP_BRAKE = 1, 2, 8  # SUMO's bits for lamps of a vehicle


class Surroundings:
    """Makes the observations of a simulation that was just loaded."""

    def __init__(self, road: RoadMap, meetings: Meetings, drive: Drive, additional: Sequence[Path] = ()) -> None:
        """Read the buildings if the driver asks for them.

        Args:
            road: The network.
            meetings: Finds where ways over a junction meet.
            drive: The simulation.
            additional: Files with buildings.
        """
        self._map, self._drive = road, drive
        drive.heights = road.heights
        self._road = RoadHere(road, meetings, drive)
        self._wishes = wishes_of(drive.controller)
        self._path = LaneLine(road, drive, self._wishes.path_ahead)
        self._sight = Sight(read_buildings(additional) if self._wishes.sees_buildings else ())

    def __call__(self, ego: VehicleState, near: Sequence[str]) -> Observation:
        """Return what the ego's driver sees now.

        Args:
            ego: The state of the ego.
            near: The ids of the vehicles near the ego.
        """
        drive = self._drive
        place = drive.place(self._map)  # needed even if it is not read, because it may restore the ego's route
        path = partial(self._path, ego, place)
        senses = SensesNow(drive, ego, near, self._sight, path)
        road = self._road(ego, place)
        return ObservationNow.made(drive, ego, place, senses, road, path, visible_only=self._wishes.visible_only)


Points = Sequence[tuple[float, float]]


class ObservationNow(Observation):
    """An observation whose parts are worked out when they are first read."""

    _place: LanePlace | None
    _senses: SensesNow
    _find_path: Callable[[], Points | None]
    _visible_only: bool

    @classmethod
    def made(
        cls, drive: Drive, ego: VehicleState, place: LanePlace | None, senses: SensesNow, road: Road | None,
        find_path: Callable[[], Points | None], *, visible_only: bool,
    ) -> ObservationNow:  # fmt: skip
        """Make the observation of one step.

        The constructor is that of ``Observation``, so that ``dataclasses.replace`` works.

        Args:
            drive: The simulation.
            ego: The state of the ego.
            place: The place of the ego on its route; None while it is off all lanes.
            senses: Tells of the vehicles near the ego.
            road: The road at the ego.
            find_path: Returns the path.
            visible_only: Whether to leave out vehicles that are out of sight.

        Returns:
            The observation.
        """
        way = drive.way
        demands = (None, None, math.inf) if way is None else (way.wanted_lane, way.wanted_speed, way.sight)
        seen = cls(drive.now, drive.recording.step_length, ego, (), None, None, None, road, *demands)
        vars(seen).clear()  # the constructor has set parts that are worked out later
        vars(seen).update(_place=place, _senses=senses, _find_path=find_path, _visible_only=visible_only)
        return seen

    @cached_property
    @engine_work
    def others(self) -> Sequence[VehicleState]:
        states = self._senses.vehicles
        return tuple(state for state in states if state.visible) if self._visible_only else states

    @cached_property
    def lane_heading(self) -> float | None:
        return self._in_lane[0]

    @cached_property
    def lane_offset(self) -> float | None:
        return self._in_lane[1]

    @cached_property
    @engine_work
    def _in_lane(self) -> tuple[float | None, float | None]:
        return (None, None) if self._place is None else in_lane(self._place, self.ego)

    @cached_property
    @engine_work
    def path(self) -> Points | None:
        self._senses.check("the path")
        return self._find_path()


def in_lane(place: LanePlace, ego: VehicleState) -> tuple[float, float]:
    """Place the ego in its lane.

    Args:
        place: The place of the ego on its route.
        ego: The state of the ego.

    Returns:
        The heading of the lane at the ego's centre [rad], and the offset of the ego's centre from the lane's centre [m,
        left positive].
    """
    points = place.lane.shape.tolist()
    best = (math.inf, 0.0, 0.0)
    last = len(points) - 2
    for k, ((ax, ay), (bx, by)) in enumerate(pairwise(points)):
        length = math.hypot(bx - ax, by - ay)
        if length < 1e-6:
            continue
        c, s = (bx - ax) / length, (by - ay) / length
        along, left = c * (ego.x - ax) + s * (ego.y - ay), c * (ego.y - ay) - s * (ego.x - ax)
        beyond = max(along - length if k < last else 0.0, -along if k > 0 else 0.0, 0.0)
        best = min(best, (math.hypot(beyond, left), math.atan2(s, c), left))
    return best[1], best[2]


class LaneLine:
    """Gives the centreline of the ego's lane and route ahead.

    It stays the same object until it is renewed: after the ego has moved by ``PATH_RENEWED_M``, or once its lanes
    change.
    """

    def __init__(self, road: RoadMap, drive: Drive, ahead: float | None = None) -> None:
        """Start without a line.

        Args:
            road: The network.
            drive: The simulation.
            ahead: The minimum length of the line ahead of the ego [m]; None keeps the default.
        """
        self._road, self._drive = road, drive
        self._length = PATH_LENGTH_M if ahead is None else max(PATH_LENGTH_M, ahead + PATH_RENEWED_M)
        self._lanes: tuple[str, ...] = ()
        self._from, self._line = (0.0, 0.0), tuple[tuple[float, float], ...]()

    def __call__(self, ego: VehicleState, place: LanePlace | None) -> Sequence[tuple[float, float]] | None:
        """Return the line.

        Args:
            ego: The state of the ego.
            place: The place of the ego on its route; None while it is off all lanes.

        Returns:
            Points (x, y) [m], one every metre, from where the ego was when the line was last renewed. None off the
            road.
        """
        drive, logged, vclass = self._drive, self._drive.replayed(), self._drive.kind(ego.id)
        lanes: tuple[str, ...] = (ego.lane,) if place is None else (place.lane.id,)
        if place is not None and not logged:
            begin = place.front - ego.length / 2
            lanes = self._road.chain(place.lane.id, begin, self._length, place.route, vclass, drive.closed)
        fresh = math.dist(self._from, (ego.x, ego.y)) <= PATH_RENEWED_M
        if fresh and lanes[:1] == self._lanes[:1] and all(a == b for a, b in zip(lanes, self._lanes, strict=False)):
            return self._line
        path = logged_path(self._road, drive) if logged else None
        if place is not None and not logged:
            ways = self._road.ways(
                place.lane.id, begin, max(WAY_AHEAD_M, self._length), place.route, vclass=vclass, closed=drive.closed
            )
            path, lanes = (ways[0].path, ways[0].lanes) if ways else (None, lanes)
        if path is None:
            return None
        count = round(self._length / PATH_STEP_M)
        self._line = tuple(zip(path.x[:count:2].tolist(), path.y[:count:2].tolist(), strict=True))
        self._lanes, self._from = lanes, (ego.x, ego.y)
        return self._line


class SensesNow:
    """What can be told of the vehicles near the ego in one step.

    Raises:
        SimulationError: It is asked after the step is over.
    """

    def __init__(
        self, drive: Drive, ego: VehicleState, near: Sequence[str], sight: Sight,
        find_path: Callable[[], Points | None],
    ) -> None:  # fmt: skip
        """Take the states of this step.

        Args:
            drive: The simulation.
            ego: The state of the ego.
            near: The ids of the vehicles near the ego.
            sight: Tells what can be seen past buildings and boxes.
            find_path: Returns the ego's path.
        """
        self._drive, self._ego, self._near, self._sight, self._time = drive, ego, near, sight, drive.now
        self._find_path, self._limit = find_path, math.inf if drive.way is None else drive.way.sight
        self._snapshot, self._before = drive.snapshot, drive.recording.before

    @cached_property
    def vehicles(self) -> tuple[Vehicle, ...]:
        """The states of these vehicles in the step; they can be read after it, too."""
        make, newest, before = self._drive.simulation.state_as, self._snapshot, self._before
        step = self._drive.recording.step_length
        return tuple(make(Vehicle, newest, n, acceleration(n, newest, before, step), self) for n in self._near)

    @engine_work
    def kind(self, vehicle: str) -> str:
        self.check()
        return self._drive.kind(vehicle)

    @engine_work
    def yaw_rate(self, vehicle: str) -> float:
        self.check()
        if self._before is None or vehicle not in self._before.raw:
            return 0.0
        newest, before = (heading_of(s.raw[vehicle][2]) for s in (self._snapshot, self._before))
        return wrap(newest - before) / self._drive.recording.step_length

    def indicator(self, vehicle: str) -> str | None:
        lamps = self._lamps(vehicle)
        return "left" if lamps & LAMP_LEFT else "right" if lamps & LAMP_RIGHT else None

    def brake_light(self, vehicle: str) -> bool:
        return bool(self._lamps(vehicle) & LAMP_BRAKE)

    @engine_work
    def visible(self, vehicle: str) -> bool:
        self.check()
        return bool(self._seen[self._near.index(vehicle)])

    @cached_property
    def _seen(self) -> Bools:
        if not self._near:
            return np.zeros(0, bool)
        seen = self._sight.visible((self._ego.x, self._ego.y), self.vehicles, self._ego.z)
        points = None if math.isinf(self._limit) else self._find_path()
        return seen if points is None else seen & in_reach(path_through(points), self._ego, self.vehicles, self._limit)

    @engine_work
    def _lamps(self, vehicle: str) -> int:
        self.check()
        return 0 if vehicle in self._drive.obstacles else self._drive.simulation.lamps(vehicle)

    def check(self, what: str = "more of a vehicle") -> None:
        """Check that the step is not over.

        Args:
            what: What is read, for the message.

        Raises:
            SimulationError: The step is over.
        """
        if self._drive.now != self._time:
            raise SimulationError(
                f"{what} of an observation of {self._time:g} s was read at {self._drive.now:g} s: "
                "read what you need in the call of act that got it"
            )
