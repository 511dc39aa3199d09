"""Describe the road at the ego, for drivers that plan for themselves.

Each attribute is worked out when it is first read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import TYPE_CHECKING

from sumo_adv.datatypes import Floats, VehicleState
from sumo_adv.drivers.protocol import Conflict, Lane, Road, SpeedLimit, StopLine
from sumo_adv.drivers.timing import engine_work
from sumo_adv.episode.ego_place import LanePlace
from sumo_adv.episode.right_of_way import Foe, Line, Link, Meetings, RightOfWay, sign_of, signal_of
from sumo_adv.episode.road_near import RoadNear
from sumo_adv.errors import SimulationError
from sumo_adv.geometry import along
from sumo_adv.simulation.network import Connection, RoadMap
from sumo_adv.simulation.network import NetworkLane as NetLane

if TYPE_CHECKING:
    from sumo_adv.episode.drive import Drive

UNADVISED_SPEED_M_S, UNADVISED_DISTANCE_M = 1.0, 10.0
# A slower ego closer to the end of its lane gets no advised speed. SUMO's advice is at most the speed that the ego was
# given, so a creeping ego would never speed up again.
LEAVING_S = 0.3  # s; the ego leaves this long before its front bumper reaches the end of its route
ROAD_SEEN_M = 120.0  # m; how far ahead the road is described


@dataclass(frozen=True, slots=True)
class Stretch:
    """A lane of the ego's path.

    Attributes:
        lane: The lane.
        ahead: The distance from the ego's centre to the beginning of the lane [m]; negative on the lane.
    """

    lane: NetLane
    ahead: float


@dataclass(frozen=True, slots=True)
class Junction:
    """A junction on the ego's path.

    Attributes:
        link: The way over the junction.
        way: The connection of that way.
        ahead: The distance from the ego's centre to the beginning of the way [m]; negative on the junction.
    """

    link: Link
    way: Connection
    ahead: float


class RoadHere:
    """Makes the ``Road`` of each step of a simulation.

    While the ego is off all lanes, the road is described at its last place.

    Attributes:
        map: The network.
        meetings: Finds where ways over a junction meet.
        drive: The simulation.
        near: Describes the lanes and the carriageway near the ego.
        rule: Decides whether the ego must wait at a line.
    """

    def __init__(self, road: RoadMap, meetings: Meetings, drive: Drive) -> None:
        """Start before the first step.

        Args:
            road: The network.
            meetings: Finds where ways over a junction meet.
            drive: The simulation.
        """
        self.map, self.meetings, self.drive = road, meetings, drive
        self.near = RoadNear(road)
        self.rule = RightOfWay(meetings)
        self._last: LanePlace | None = None

    def __call__(self, ego: VehicleState, place: LanePlace | None) -> Road | None:
        """Return the road at the ego now.

        Args:
            ego: The state of the ego.
            place: The place of the ego on its route; None while it is off all lanes.

        Returns:
            The road; None before the ego was on a lane.
        """
        self._last = place or self._last
        return None if self._last is None else RoadNow(self, ego, self._last)


class RoadNow(Road):
    """The ``Road`` of one step.

    Raises:
        SimulationError: An attribute that needs the simulation is first read after the step is over.
    """

    def __init__(self, here: RoadHere, ego: VehicleState, place: LanePlace) -> None:
        """Describe the road at this step.

        Args:
            here: Makes the roads of the simulation.
            ego: The state of the ego.
            place: The place of the ego on its route.
        """
        self.__dict__.update(_here=here, _ego=ego, _place=place, _time=here.drive.now)

    _here: RoadHere
    _ego: VehicleState
    _place: LanePlace
    _time: float

    def _now(self) -> RoadHere:
        """Return the maker of the road, or raise SimulationError if the step is over."""
        if self._here.drive.now != self._time:
            raise SimulationError(
                f"observation.road of {self._time:g} s was read at {self._here.drive.now:g} s: "
                "read what you need in the call of act that got it"
            )
        return self._here

    @cached_property
    @engine_work
    def limit(self) -> float:
        simulation, lane = self._now().drive.simulation, self._place.lane.id
        return simulation.limit(self._ego.id, lane if lane != self._ego.lane else None)

    @cached_property
    @engine_work
    def sides(self) -> tuple[float, ...]:
        here, lane = self._now(), self._place.lane
        beside = () if lane.internal else here.map.beside(lane, here.drive.kind(self._ego.id))
        return tuple(offset for other, offset in beside if not here.drive.closed(other.id))

    @cached_property
    def _left(self) -> float:
        """The distance from the front bumper to the end of the lane [m]."""
        return self._place.lane.length - self._place.front

    @cached_property
    @engine_work
    def until(self) -> float:
        return self._left + self._ego.length / 2

    @cached_property
    @engine_work
    def width(self) -> float:
        return self._place.lane.width

    @cached_property
    @engine_work
    def advised(self) -> float | None:
        at_line = (
            self._ego.speed < UNADVISED_SPEED_M_S
            and self._left < UNADVISED_DISTANCE_M
            and not self._place.lane.internal
        )
        drive = self._now().drive
        return drive.simulation.advised(self._ego.id) if drive.heeding and not at_line else None

    @cached_property
    @engine_work
    def leaves(self) -> bool:
        drive = self._now().drive
        arrival = drive.simulation.arrival(self._ego.id, drive.route())
        if arrival is None or arrival.edge != self._place.lane.edge or arrival.edge in self._place.route[1:]:
            return False
        left = self._place.lane.station_of(arrival.position) - self._place.front
        return left < LEAVING_S * self._ego.speed + 0.5

    @cached_property
    @engine_work
    def lanes(self) -> tuple[Lane, ...]:
        here, (stretches, junctions) = self._now(), self._stretches
        met = frozenset(m.lane for junction in junctions for m in here.meetings.of(junction.link))
        drive = here.drive

        def now(lane: str) -> tuple[float, bool]:
            return drive.simulation.lane_limit(lane), not drive.closed(lane)

        return here.near.lanes((self._ego.x, self._ego.y), [s.lane for s in stretches], met, now)

    @cached_property
    @engine_work
    def edges(self) -> tuple[Floats, ...]:
        lanes = [stretch.lane for stretch in self._stretches[0]]
        return self._now().near.edges((self._ego.x, self._ego.y), self._place.route, lanes)

    @cached_property
    @engine_work
    def limits(self) -> tuple[SpeedLimit, ...]:
        limits: list[SpeedLimit] = []
        for stretch in self._stretches[0]:
            speed = self._now().drive.simulation.lane_limit(stretch.lane.id)
            if not limits or limits[-1].speed != speed:
                limits.append(SpeedLimit(stretch.ahead, speed))
        return tuple(limits)

    @cached_property
    @engine_work
    def stop_lines(self) -> tuple[StopLine, ...]:
        here, ego, lines = self._now(), self._ego, list(self._lines())
        if not lines:
            return ()
        foes = self._foes
        stood = here.drive.simulation.stood(ego.id) if ego.speed < UNADVISED_SPEED_M_S else 0.0
        return tuple(
            StopLine(
                line.room + ego.length / 2, signal_of(line.letter, light=_lit(line)), sign_of(line.letter),
                here.rule.must_wait(line, ego.length, ego.speed, stood, foes),
            )
            for line in lines
        )  # fmt: skip

    @cached_property
    @engine_work
    def conflicts(self) -> tuple[Conflict, ...]:
        here, conflicts = self._now(), []
        for junction in self._stretches[1]:
            own = self._line(junction, 0.0)
            for meeting in here.meetings.of(junction.link):
                ahead = junction.ahead + meeting.at
                if 0.0 <= ahead <= ROAD_SEEN_M:
                    yields = here.rule.yields(own, meeting, self._letter(meeting.other))
                    conflicts.append(Conflict(ahead, meeting.lane, meeting.x, meeting.y, yields, meeting.joins))
        return tuple(sorted(conflicts, key=lambda c: c.ahead))

    @cached_property
    def _stretches(self) -> tuple[tuple[Stretch, ...], tuple[Junction, ...]]:
        """The lanes of the path, and the junctions on it."""
        here, place = self._here, self._place
        lanes, ways = here.map.lanes, here.meetings.ways
        centre = place.front - self._ego.length / 2
        chain, junctions, lane, ahead = [Stretch(place.lane, -centre)], [], place.lane, -centre
        if (link := here.meetings.link_of.get(lane.id)) is not None:  # the ego is on it
            before = sum(lanes[n].length for n in ways[link].via[: ways[link].via.index(lane.id)])
            junctions.append(Junction(link, ways[link], ahead - before))
        while (ahead := ahead + lane.length) < ROAD_SEEN_M:
            onward = here.map.onward(lane, place.route, here.drive.kind(self._ego.id), here.drive.closed)
            if not onward:
                break
            way = onward[0]
            if way.link in ways and not lane.internal:
                junctions.append(Junction(way.link, ways[way.link], ahead))
            for name in way.via:
                chain.append(Stretch(lanes[name], ahead))
                ahead += lanes[name].length
            lane = lanes[way.to]
            chain.append(Stretch(lane, ahead))
        return tuple(chain), tuple(junctions)

    def _lines(self) -> Iterator[Line]:
        """Yield the lines on the path, nearest first, including one between the front bumper and the centre."""
        for junction in self._stretches[1]:
            bay = self._here.map.lanes[junction.way.via[0]].length if len(junction.way.via) > 1 else 0.0
            entry = self._line(junction, 0.0)
            if entry.room > -self._ego.length / 2 and (_lit(entry) or (sign_of(entry.letter) and not bay)):
                yield entry
            if bay and sign_of(entry.letter) and -self._ego.length / 2 < entry.room + bay < ROAD_SEEN_M:
                yield self._line(junction, bay)

    def _line(self, junction: Junction, begin: float) -> Line:
        """Describe the line on the junction's way that is ``begin`` metres from the beginning of the way."""
        room = junction.ahead + begin - self._ego.length / 2
        limit = min(self._now().drive.simulation.lane_limit(name) for name in junction.way.via)
        return Line(junction.link, junction.way, room, begin, self._letter(junction.link), limit)

    def _letter(self, link: Link) -> str:
        """Return SUMO's letter for a way over a junction: that of its light now or, without a light, of its sign."""
        way = self._here.meetings.ways[link]
        name, index = way.light
        return way.state if index < 0 else self._light(name)[index]

    @cached_property
    def _light(self) -> Callable[[str], str]:
        """A function that returns the state of a traffic light. It asks SUMO once for each light."""
        return cache(self._now().drive.simulation.light)

    @cached_property
    def _foes(self) -> Sequence[Foe]:
        """The vehicles that come to a junction of the path or are on it."""
        here, ahead = self._now(), {junction.link[0] for junction in self._stretches[1]}
        raw, ego = here.drive.snapshot.raw, self._ego
        foes: list[Foe] = []
        for name in here.drive.near(ego, ROAD_SEEN_M):
            at = self._approach(name)
            if at is None or at[0][0] not in ahead:
                continue
            length = here.drive.simulation.fleet.sizes[name][0]
            foes.append(
                Foe(name, *at, length, raw[name][3], partial(here.drive.simulation.stood, name), self._letter(at[0]))
            )
        return foes

    def _approach(self, name: str) -> tuple[Link, float] | None:
        """Find the way over a junction that a vehicle is on or comes to next.

        Args:
            name: The id of the vehicle.

        Returns:
            The way, and the distance from the vehicle's front to its beginning [m]; None if there is none within
            ``ROAD_SEEN_M``. The distance is negative on the junction.
        """
        here = self._here
        x, y, _, _, on = here.drive.snapshot.raw[name]
        lane = here.map.lanes.get(on)
        if lane is None:
            return None
        if lane.internal:
            link = here.meetings.link_of.get(on)
            return None if link is None else (link, -float(along(here.meetings.line(link), x, y)) - 1e-3)
        edges, room = here.drive.simulation.ahead(name), lane.length - lane.station_at(x, y)
        while room < ROAD_SEEN_M:
            onward = here.map.onward(lane, edges, here.drive.kind(name))
            if not onward:
                return None
            if onward[0].link in here.meetings.ways:
                return onward[0].link, room
            lane = here.map.lanes[onward[0].to]
            room += lane.length
        return None


def _lit(line: Line) -> bool:
    """Return whether a light stands at the line, which it does at the beginning of the way over the junction."""
    return line.way.light[1] >= 0 and line.begin == 0.0
