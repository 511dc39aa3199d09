"""Find where the ways over a junction meet, and decide whether the ego must wait at a line.

All drivers share one rule. The ego waits for lights, signs, and vehicles with the right of way. Such a vehicle counts
if it arrives where its way meets the ego's before the ego would be across, and if it has not left that place when the
ego is at its line. The margins and the expected acceleration are those of ``simulation/sumo_rules.py``, which copies
SUMO's own drivers. A reason to wait stays until the other vehicle is gone or has clearly slowed down. So the answer
does not flicker while the ego brakes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import along
from sumo_adv.simulation.network import Connection, RoadMap
from sumo_adv.simulation.sumo_rules import (
    FOE_ACCELERATION_M_S2,
    FOE_SPEED_M_S,
    HALTING_SPEED_M_S,
    MEETING_CLEARANCE_M,
    MINOR_TIME_GAP_S,
    travel_time,
)

# -- where ways meet ------------------------------------------------------------------------------------------------

Link = tuple[str, int]
"""A way over a junction: the junction's id and the index of the way, as in the network's ``request`` elements."""


@dataclass(frozen=True, slots=True)
class Meeting:
    """A place where a way over a junction meets another way.

    Distances are measured from the beginning of a way, which is its stop line.

    Attributes:
        other: The other way.
        lane: The id of the other way's lane at the place.
        at: The distance of the place along the first way [m].
        other_at: The distance of the place along the other way [m].
        x: The x of the place [m].
        y: The y of the place [m].
        joins: Whether both ways end in the same lane; otherwise they cross.
        yields: Whether signs make the first way give way to the other.
    """

    other: Link
    lane: str
    at: float
    other_at: float
    x: float
    y: float
    joins: bool
    yields: bool


class Meetings:
    """Finds the places where the ways of a network meet. Those on a way are worked out when first needed.

    Attributes:
        ways: The connection of each way.
        link_of: The way that each lane of a junction belongs to, by the lane's id.
    """

    def __init__(self, road: RoadMap) -> None:
        """Collect the ways.

        Args:
            road: The network.
        """
        self._road = road
        self.ways: dict[Link, Connection] = {}
        self.link_of: dict[str, Link] = {}  # by the id of a lane of the junction
        self._at: dict[str, list[Link]] = {}
        self._found: dict[Link, tuple[Meeting, ...]] = {}
        self._lines: dict[Link, Floats] = {}
        for lane in road.lanes.values():
            for connection in () if lane.internal else lane.connections:
                if connection.link[1] < 0 or connection.link in self.ways:
                    continue
                self.ways[connection.link] = connection
                self._at.setdefault(connection.link[0], []).append(connection.link)
                self.link_of.update(dict.fromkeys(connection.via, connection.link))

    def line(self, link: Link) -> Floats:
        """Return the centreline of a way over a junction.

        Args:
            link: The way.

        Returns:
            Its points ``(n, 2)`` [m].
        """
        if link not in self._lines:
            self._lines[link] = np.vstack([self._road.lanes[n].shape for n in self.ways[link].via])
        return self._lines[link]

    def of(self, link: Link) -> tuple[Meeting, ...]:
        """Return the places where other ways of the junction meet a way.

        Ways that begin at the same point part there, so they have no such place.

        Args:
            link: The way.

        Returns:
            The places, in the direction of the way.
        """
        if link not in self._found:
            others = (crossed for crossed in self._at.get(link[0], ()) if crossed != link)
            meetings = [m for crossed in others for m in self._between(link, crossed)]
            self._found[link] = tuple(sorted(meetings, key=lambda m: m.at))
        return self._found[link]

    def _between(self, mine: Link, other: Link) -> Iterator[Meeting]:
        """Find the first place where two ways meet, if they do."""
        from shapely import LineString, Point

        way, other_way = self.ways[mine], self.ways[other]
        a, b = self.line(mine), self.line(other)
        if np.hypot(*(a[0] - b[0])) < 0.1:
            return
        joins = way.to == other_way.to
        if joins:
            x, y = a[-1]
        else:
            shared = LineString(a).intersection(LineString(b))  # the ends of a shared stretch count
            points = [p for part in getattr(shared, "geoms", [shared]) for p in part.coords]
            if not points:
                return
            x, y = min(points, key=lambda p: float(along(a, *p)))
        at, other_at = float(along(a, x, y)), float(along(b, x, y))
        lane = min(other_way.via, key=lambda n: LineString(self._road.lanes[n].shape).distance(Point(x, y)))
        yield Meeting(other, lane, at, other_at, float(x), float(y), joins, other[1] in way.yields_to)


# -- who waits ------------------------------------------------------------------------------------------------------

# m/s2: a driver that can stop with this braking stops at a yellow light, and keeps ``MINOR_TIME_GAP_S`` when it yields
COMFORTABLE_BRAKING_M_S2 = 3.0
STOPPING_BRAKING_M_S2 = 4.5  # SUMO's ``decel``; a driver that cannot stop with it passes, unless it waits already
STOP_BEYOND_LINE_M = 0.5  # m; a driver that would stop at most this far beyond the line counts as able to stop
WAIT_RELAX_S = 1.0  # s on top of ``MINOR_TIME_GAP_S`` until a reason to wait goes away; as long as SUMO's own margin
LINE_PASSED_M = 0.5  # m; so far over a line the front bumper still stands at it (``simulation/sumo_rules.py``)
AT_STOP_SIGN_M = 3.0  # m before the line of a stop sign; a standstill counts within this distance
LETS_GO_AFTER_S = 3.0  # s; a vehicle that has stood this long lets the ego go, so that both do not wait


@dataclass(frozen=True, slots=True)
class Line:
    """A line on the ego's path at which it may have to wait.

    Attributes:
        link: The way over the junction.
        way: The connection of that way.
        room: The distance from the ego's front bumper to the line [m].
        begin: The distance from the beginning of the way to the line [m]; above zero if the ego waits on the junction.
        letter: SUMO's letter of the light or the sign.
        limit: The lowest speed limit on the way [m/s].
    """

    link: Link
    way: Connection
    room: float
    begin: float
    letter: str
    limit: float


@dataclass(frozen=True, slots=True)
class Foe:
    """Another vehicle that comes to a junction or is on it.

    Attributes:
        id: The id of the vehicle.
        link: Its way over the junction.
        to_line: The distance from its front bumper to the beginning of its way [m]; negative on the junction.
        length: Its length [m].
        speed: Its speed [m/s].
        stood: Returns for how long it has been standing [s].
        letter: SUMO's letter of its light now, or of its sign.
    """

    id: str
    link: Link
    to_line: float
    length: float
    speed: float
    stood: Callable[[], float]
    letter: str


LIGHT_COLOURS = {**dict.fromkeys("Ggs", "green"), **dict.fromkeys("yY", "yellow"), **dict.fromkeys("rRu", "red")}


def signal_of(letter: str, *, light: bool) -> str | None:
    """Return the colour of a light.

    Args:
        letter: SUMO's letter.
        light: Whether there is a light.

    Returns:
        ``green``, ``yellow`` or ``red``; None if there is no light or it is off.
    """
    return LIGHT_COLOURS.get(letter) if light else None


def sign_of(letter: str) -> str | None:
    """Return the sign that makes the ego give way while it may go.

    Args:
        letter: SUMO's letter of the light or the sign.

    Returns:
        ``stop`` or ``yield``; None if the ego does not have to give way.
    """
    if letter in {"s", "w"}:
        return "stop"
    return "yield" if letter in {"m", "g", "o", "="} else None


class RightOfWay:
    """Decides whether the ego must wait at a line.

    It remembers for which vehicles the ego waits, at which lines the ego has waited and may go, how long it has stood
    at which stop signs [s], and at which yellow lights it stops.
    """

    def __init__(self, meetings: Meetings) -> None:
        """Start without reasons to wait.

        Args:
            meetings: Finds where ways meet.
        """
        self._meetings = meetings
        self._waits: set[tuple[Link, str]] = set()
        self._stood: dict[Link, float] = {}
        self._let_go: set[Link] = set()
        self._yellow: set[Link] = set()

    def must_wait(self, line: Line, length: float, speed: float, stood: float, foes: Sequence[Foe]) -> bool:
        """Return whether the ego must not pass a line now.

        Args:
            line: The line.
            length: The ego's length [m].
            speed: The ego's speed [m/s].
            stood: For how long the ego has been standing [s].
            foes: The other vehicles that come to the junctions of the ego's path or are on them.
        """
        if line.room < -LINE_PASSED_M:
            self._forget(line.link)
            return False
        signal = signal_of(line.letter, light=line.way.light[1] >= 0 and line.begin == 0.0)
        if signal == "red":
            return True
        if signal == "yellow":
            if speed * speed <= 2 * COMFORTABLE_BRAKING_M_S2 * max(line.room, 0.0) or speed < HALTING_SPEED_M_S:
                self._yellow.add(line.link)
            return line.link in self._yellow
        self._yellow.discard(line.link)
        if sign_of(line.letter) == "stop":
            if speed < HALTING_SPEED_M_S and line.room <= AT_STOP_SIGN_M:
                self._stood[line.link] = max(stood, self._stood.get(line.link, 0.0))
            elif line.link not in self._stood:
                return True
        if sign_of(line.letter) is None:
            return False
        reasons = {(line.link, foe.id) for foe in foes if self._goes_first(line, length, speed, foe)}
        before = {reason for reason in self._waits if reason[0] == line.link}
        self._waits = self._waits - before | reasons
        if reasons:
            self._let_go.discard(line.link)
        elif before:
            self._let_go.add(line.link)
        return bool(reasons)

    def yields(self, line: Line, meeting: Meeting, letter: str) -> bool:
        """Return whether vehicles on another way go before the ego.

        Args:
            line: The line at which the ego would wait for them.
            meeting: The place where the other way meets the ego's.
            letter: SUMO's letter of the light or the sign on the other way.
        """
        return meeting.yields and sign_of(line.letter) is not None and letter not in "rRu"

    def _forget(self, link: Link) -> None:
        """Forget all that was remembered of a way."""
        self._waits = {reason for reason in self._waits if reason[0] != link}
        self._stood.pop(link, None)
        self._yellow.discard(link)
        self._let_go.discard(link)

    def _goes_first(self, line: Line, length: float, speed: float, foe: Foe) -> bool:
        """Return whether the ego has to wait for a vehicle; a vehicle on the junction counts even without priority."""
        entered = foe.to_line < 0.0
        if foe.letter in "rRuyY" and not entered:
            return False
        margin = MINOR_TIME_GAP_S
        if (line.link, foe.id) in self._waits:
            margin = MINOR_TIME_GAP_S + WAIT_RELAX_S
        elif line.room <= speed * speed / (2 * STOPPING_BRAKING_M_S2) - STOP_BEYOND_LINE_M:
            return False
        elif (
            line.link in self._let_go
            or line.room <= speed * speed / (2 * COMFORTABLE_BRAKING_M_S2) - STOP_BEYOND_LINE_M
        ):
            margin = 0.0
        for meeting in self._meetings.of(line.link):
            if meeting.other != foe.link or not (meeting.yields or entered) or meeting.at < line.begin:
                continue
            to_zone = foe.to_line + meeting.other_at - MEETING_CLEARANCE_M
            to_clear = foe.to_line + meeting.other_at + foe.length + MEETING_CLEARANCE_M
            if to_clear <= 0.0:
                continue
            if to_zone > 0.0 and foe.speed < HALTING_SPEED_M_S and foe.stood() >= LETS_GO_AFTER_S:
                continue
            if line.letter == "w" and not entered and foe.stood() <= self._stood[line.link]:
                continue
            to_meeting = line.room + meeting.at - line.begin
            at_line = _seconds(line.room, speed)
            across = _seconds(to_meeting + length + MEETING_CLEARANCE_M, speed, line.limit)
            gone = to_clear / max(foe.speed, HALTING_SPEED_M_S)
            if across + margin > _seconds(to_zone, foe.speed) and gone > at_line:
                return True
        return False


def _seconds(distance: float, speed: float, fastest: float = FOE_SPEED_M_S) -> float:
    """Return the time that a vehicle which accelerates as others expect needs for a distance [s]."""
    return float(travel_time(np.array([distance]), np.array([speed]), FOE_ACCELERATION_M_S2, fastest)[0])
