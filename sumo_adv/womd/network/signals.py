"""Plan signals: the recorded phases, followed by a default for streams without a recorded green, in a repeated cycle.

A link is ruled by the first signal lane that begins on it. If a lane's state is unknown for a while, the last known
state holds. If the state is unknown throughout, the first of these applies:

- The lane follows a lane of the same edge and direction.
- The lane follows logged vehicles that drive off there. A vehicle that drives over a stop line has green.
- The lane is red until the default.

The same applies to approaches that go straight on across ruled ones and have no recorded signal. In the default, no two
streams that cross or merge are green together.

A witnessed green begins when the vehicle last stood or, if it did not stand, ``GREEN_BEFORE_PASSING_S`` before its
front passes the line. The green lasts until just after that. Short breaks between two vehicles are green too. Yellow
follows.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.geometry import wrap
from sumo_adv.womd.network.right_of_way import LinkPriorities
from sumo_adv.womd.network.roads import JunctionLink
from sumo_adv.womd.record import VEHICLE, Record

# Green before and after the front of a vehicle that did not stand passes the line.
GREEN_BEFORE_PASSING_S = 4.0
GREEN_AFTER_PASSING_S = 1.0
JOINED_GREEN_GAP_S = 5.0  # a break of at most this length is green too
MAX_STANDING_SPEED_AT_LIGHT_M_S = 1.0
MAX_LINK_OFFSET_M = 1.5  # maximum distance from a link's line
MAX_LINK_ANGLE_RAD = 0.5  # maximum angle between a vehicle and the link at the line
# A vehicle has taken a link if it follows the link for this length, or for this share of the link.
MIN_FOLLOWED_LINK_M = 12.0
MIN_FOLLOWED_LINK_SHARE = 0.6
LETTER_OF_SIGNAL_STATE = ("", "r", "y", "g", "r", "y", "g", "r", "o")  # by the dataset's number; "" means unknown
ENOUGH_GREEN_S = 5.0  # a stream with this much green in the record needs no default
DEFAULT_GREEN_S, DEFAULT_YELLOW_S, DEFAULT_CLEARANCE_S = 8.0, 3.0, 1.0  # durations in the default

Rulers = Mapping[int, int | None]  # link -> the lane of its signal; None if the record has none for it
Stream = tuple[str, str]  # edge and direction


@dataclass(frozen=True, slots=True)
class RecordTraffic:
    """All vehicles of a record. There are k vehicles and n steps.

    Attributes:
        fronts: The middles of their fronts, ``(k, n, 2)`` [m].
        centres: Their centres, ``(k, n, 2)`` [m].
        heading: Their headings, ``(k, n)`` [rad].
        speed: Their speeds, ``(k, n)`` [m/s].
        valid: Whether their states are known, ``(k, n)``.
        step: The length of a step [s].
    """

    fronts: Floats
    centres: Floats
    heading: Floats
    speed: Floats
    valid: Bools
    step: float


def logged_traffic(record: Record) -> RecordTraffic:
    """Return the vehicles of a record."""
    tracks = [t for t in record.tracks if t.kind == VEHICLE]
    shape = (len(tracks), len(record.time))
    x, y, heading, length, vx, vy = (
        np.array([getattr(t, name) for t in tracks], float).reshape(shape)
        for name in ("x", "y", "heading", "length", "vx", "vy")
    )
    centres = np.stack([x, y], axis=-1)
    fronts = centres + 0.5 * length[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    step = float(record.time[1] - record.time[0]) if len(record.time) > 1 else 0.1
    valid = np.array([t.valid for t in tracks], bool).reshape(shape)
    return RecordTraffic(fronts, centres, heading, np.hypot(vx, vy), valid, step)


def witnessed_letters(traffic: RecordTraffic, links: Sequence[JunctionLink]) -> list[str]:
    """Return the signal that logged vehicles imply.

    Args:
        traffic: The vehicles.
        links: Links that have one signal.

    Returns:
        A letter for each step (g, y or r); empty if no vehicle drove off on any of the links.
    """
    green = np.zeros(traffic.valid.shape[1], bool)
    for link in links:
        for vehicle, over in _drives(traffic, link):
            stood = np.flatnonzero(
                (traffic.speed[vehicle, :over] < MAX_STANDING_SPEED_AT_LIGHT_M_S) & traffic.valid[vehicle, :over]
            )
            begin = int(stood[-1]) if len(stood) else over - round(GREEN_BEFORE_PASSING_S / traffic.step)
            green[max(begin, 0) : over + round(GREEN_AFTER_PASSING_S / traffic.step)] = True
    if not green.any():
        return []
    on = np.flatnonzero(green)
    for a, b in pairwise(on):
        if b - a <= JOINED_GREEN_GAP_S / traffic.step:
            green[a:b] = True
    letters = np.where(green, "g", "r")
    for end in np.flatnonzero(green[:-1] & ~green[1:]) + 1:
        after = letters[end : end + round(DEFAULT_YELLOW_S / traffic.step)]
        after[after == "r"] = "y"
    return [str(letter) for letter in letters]


def _drives(traffic: RecordTraffic, link: JunctionLink) -> Iterator[tuple[int, int]]:
    """Yield vehicles that take a link, each with the step at which its front has passed the line."""
    from shapely import LineString, distance, line_locate_point, points

    line = LineString(link.shape)
    way = link.shape[min(2, len(link.shape) - 1)] - link.shape[0]
    way /= np.hypot(*way)
    off = traffic.fronts - link.shape[0]
    along, aside = off @ way, off @ np.array([-way[1], way[0]])
    straight = np.abs(wrap(traffic.heading - np.arctan2(way[1], way[0]))) < MAX_LINK_ANGLE_RAD
    over = (along[:, :-1] <= 0.0) & (along[:, 1:] > 0.0) & traffic.valid[:, :-1] & traffic.valid[:, 1:]
    over &= straight[:, 1:] & (np.abs(aside[:, 1:]) < MAX_LINK_OFFSET_M)
    for vehicle, step in np.argwhere(over):
        later = traffic.centres[vehicle, step + 1 :][traffic.valid[vehicle, step + 1 :]]
        at = line_locate_point(line, points(later))
        inside = (at > 0.0) & (at < line.length)
        near = distance(line, points(later)) < MAX_LINK_OFFSET_M
        if near[inside].all() and at.max() > min(MIN_FOLLOWED_LINK_M, MIN_FOLLOWED_LINK_SHARE * line.length):
            yield int(vehicle), int(step) + 1


@dataclass(frozen=True, slots=True)
class Program:
    """The signals of a junction.

    Attributes:
        index: The place of each link in the state.
        phases: The durations [s] and states of the phases.
    """

    index: Mapping[int, int]
    phases: tuple[tuple[float, str], ...]

    def element(self, name: str) -> ET.Element:
        """Return the program as SUMO's tlLogic."""
        made = ET.Element("tlLogic", id=name, type="static", programID="womd", offset="0.00")
        for duration, state in self.phases:
            ET.SubElement(made, "phase", duration=f"{duration:.2f}", state=state)
        return made


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """The signals of a network.

    Attributes:
        programs: The programs by junction.
        unknown: The number of signal lanes whose state is never known.
        witnessed: The number of streams whose signal follows from logged vehicles.
        assumed: The number of approaches with signals but without a recorded signal.
    """

    programs: dict[str, Program]
    unknown: int
    witnessed: int
    assumed: int


def ruling_lanes(
    record: Record, links: Sequence[JunctionLink], foes: Collection[tuple[int, int]], stops: Collection[int]
) -> dict[int, int | None]:
    """Return the signal lane that rules each link.

    Args:
        record: The record.
        links: The links.
        foes: The pairs of links in each other's way.
        stops: WOMD lanes that begin at a stop sign.

    Returns:
        The signal lane by the number of the link. It is None for links of an approach that goes straight on across a
        ruled link and has neither a recorded signal nor a stop sign.
    """
    recorded = {state.lane for step in record.signals for state in step}
    ruling: dict[int, int | None] = {}
    for n, link in enumerate(links):
        lane = next((lane for lane in link.lanes if lane in recorded), None)
        if lane is not None:
            ruling[n] = lane
    crossing = {a for pair in foes for a, b in (pair, pair[::-1]) if a not in ruling and b in ruling}
    stopping = {link.source for link in links if any(lane in stops for lane in link.lanes)}
    assumed = {links[n].source for n in crossing if links[n].direction == "s"} - stopping
    ruling |= {n: None for n in crossing if links[n].source in assumed and links[n].direction != "r"}
    return ruling


def plan_signals(record: Record, links: Sequence[JunctionLink], rulers: Rulers, order: LinkPriorities) -> SignalPlan:
    """Return programs for all junctions with a ruled link.

    Args:
        record: The record.
        links: The links.
        rulers: The signal lane that rules each link (``ruling_lanes``).
        order: The right of way of the links.

    Returns:
        The programs, and counts for the report.
    """
    letters = _letters(record)
    place: dict[int | None, int] = {lane: n for n, lane in enumerate(letters)}
    programs: dict[str, Program] = {}
    witnessed = 0
    step = float(record.time[1] - record.time[0]) if len(record.time) > 1 else 0.1
    for junction in sorted({links[n].junction for n in rulers}):
        members = [n for n in rulers if links[n].junction == junction]
        members.sort(key=lambda n: (place.get(rulers[n], len(place)), n))
        of_link, streams = _known(record, links, members, rulers, letters)
        witnessed += streams
        rows = ["".join(of_link[n][k] for n in members) for k in range(len(record.signals))]
        phases = _run_lengths(rows, step)
        cycle = _with_changes(phases, _default(links, members, _needy(links, members, phases), order))
        greens = [(duration, _major(state, members, order)) for duration, state in cycle]
        programs[junction] = Program({n: k for k, n in enumerate(members)}, tuple(greens))
    assumed = len({links[n].source for n, lane in rulers.items() if lane is None})
    return SignalPlan(programs, sum(not any(states) for states in letters.values()), witnessed, assumed)


def _letters(record: Record) -> dict[int, list[str]]:
    """Return a letter for each step by signal lane, in recorded order; gaps are filled with the last known letter."""
    letters: dict[int, list[str]] = {}
    for k, step in enumerate(record.signals):
        for state in step:
            states = letters.setdefault(state.lane, [""] * len(record.signals))
            states[k] = LETTER_OF_SIGNAL_STATE[state.state] if 0 <= state.state < len(LETTER_OF_SIGNAL_STATE) else ""
    for states in letters.values():
        last = next((letter for letter in states if letter), "")
        for k, letter in enumerate(states):
            last = letter or last
            states[k] = last
    return letters


def _known(
    record: Record, links: Sequence[JunctionLink], members: list[int], rulers: Rulers, letters: dict[int, list[str]]
) -> tuple[dict[int, list[str]], int]:
    """Return the letters of each link, and the number of streams whose letters follow from logged vehicles.

    If a link's own letters are never known, those of a link of the same stream are used, otherwise those that logged
    vehicles imply, otherwise red.
    """
    own = {n: letters.get(lane, []) if (lane := rulers[n]) is not None else [] for n in members}
    of_stream: dict[Stream, list[str]] = {}
    for n in members:
        if any(own[n]):
            of_stream.setdefault(_stream(links[n]), own[n])
    unseen: dict[Stream, list[JunctionLink]] = {}
    for n in members:
        if _stream(links[n]) not in of_stream:
            unseen.setdefault(_stream(links[n]), []).append(links[n])
    traffic = logged_traffic(record) if unseen else None
    observed = {s: witnessed_letters(traffic, like) for s, like in unseen.items()} if traffic is not None else {}
    witnessed = {stream: told_by for stream, told_by in observed.items() if told_by}
    of_stream |= witnessed
    red = ["r"] * len(record.signals)
    of_link = {n: own[n] if any(own[n]) else of_stream.get(_stream(links[n]), red) for n in members}
    return of_link, len(witnessed)


def _stream(link: JunctionLink) -> Stream:
    """Return the stream of a link."""
    return link.source, link.direction


def _run_lengths(rows: list[str], step: float) -> list[tuple[float, str]]:
    """Merge equal states of successive steps into phases."""
    phases: list[tuple[float, str]] = []
    for row in rows:
        if phases and phases[-1][1] == row:
            phases[-1] = (phases[-1][0] + step, row)
        else:
            phases.append((step, row))
    return [(round(duration, 2), state) for duration, state in phases]


def _needy(links: Sequence[JunctionLink], members: list[int], phases: list[tuple[float, str]]) -> list[Stream]:
    """Return the streams with too little green in the record, in order."""
    green: dict[Stream, float] = {}
    for k, n in enumerate(members):
        seen = sum(duration for duration, state in phases if state[k] in "go")
        stream = _stream(links[n])
        green[stream] = min(green.get(stream, seen), seen)
    return [stream for stream, seen in green.items() if seen < ENOUGH_GREEN_S]


def _default(
    links: Sequence[JunctionLink], members: list[int], needy: list[Stream], order: LinkPriorities
) -> list[tuple[float, str]]:
    """Return few green phases that serve every needy stream, each with all other streams that fit."""
    of_stream: dict[Stream, list[int]] = {}
    for n in members:
        of_stream.setdefault(_stream(links[n]), []).append(n)
    orders = [needy[k:] + needy[:k] for k in range(len(needy))]
    greens = min((_serve(waiting, of_stream, order) for waiting in orders), key=len, default=[])
    return [(DEFAULT_GREEN_S, "".join("g" if n in green else "r" for n in members)) for green in greens]


def _serve(waiting: list[Stream], of_stream: Mapping[Stream, list[int]], order: LinkPriorities) -> list[set[int]]:
    """Return the links that are green together in each phase: the first waiting stream, with all streams that fit."""
    phases = []
    while waiting:
        green: set[int] = set()
        served = []
        for stream in [*waiting, *(s for s in of_stream if s not in waiting)]:
            if not any(order.foes[n] & green for n in of_stream[stream]):
                green |= set(of_stream[stream])
                served.append(stream)
        waiting = [stream for stream in waiting if stream not in served]
        phases.append(green)
    return phases


def _with_changes(phases: list[tuple[float, str]], default: list[tuple[float, str]]) -> list[tuple[float, str]]:
    """Join record and default, with yellow and clearance wherever a green ends, including at the end of the cycle."""
    cycle = list(phases)
    for phase in default:
        cycle += _change(cycle[-1][1], phase[1])
        cycle.append(phase)
    if len(cycle) > 1:
        cycle += _change(cycle[-1][1], cycle[0][1])
    return cycle


def _change(before: str, after: str) -> list[tuple[float, str]]:
    """Return the yellow and clearance between two states; nothing if no green ends."""
    ends = [b in "gy" and a == "r" for b, a in zip(before, after, strict=True)]
    if not any(ends):
        return []
    both = list(zip(before, after, ends, strict=True))
    yellow = "".join("y" if end else "g" if b == a == "g" else b if b == "o" else "r" for b, a, end in both)
    clear = "".join("g" if b == a == "g" else b if b == "o" else "r" for b, a, end in both)
    return [(DEFAULT_YELLOW_S, yellow), (DEFAULT_CLEARANCE_S, clear)]


def _major(state: str, members: list[int], order: LinkPriorities) -> str:
    """Replace greens that yield to no other green of the phase by capital G."""
    green = {n for n, letter in zip(members, state, strict=True) if letter in "gyo"}
    return "".join(
        "G" if letter == "g" and not order.yields_to[n] & green else letter
        for n, letter in zip(members, state, strict=True)
    )
