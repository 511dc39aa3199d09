"""Signals: phases as recorded, then a default for streams without a recorded green, over and over.

A link is ruled by the first signal lane that begins on it. Where a lane's state is unknown for a while, the last known
state holds; where it is unknown throughout, it does as a lane of the same edge and direction, else as logged vehicles
that drive off there tell (one that drives over a stop line has green), else it is red until the default. So it is with
approaches that go straight on across ruled ones and of which the record tells no signal. In the default no two streams
that cross or merge are green together.

A witnessed green lasts from when the vehicle last stood (if it did not, from ``GREEN_BEFORE_PASSING_S`` before) until
just after its front is over the line; short breaks between two vehicles are green too. Yellow follows."""

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

# s of green before and after a vehicle that did not stand drives over the line
GREEN_BEFORE_PASSING_S = 4.0
GREEN_AFTER_PASSING_S = 1.0
JOINED_GREEN_GAP_S = 5.0  # of a break that is green too
MAX_STANDING_SPEED_AT_LIGHT_M_S = 1.0
MAX_LINK_OFFSET_M = 1.5  # from a link's line at most
MAX_LINK_ANGLE_RAD = 0.5  # between a vehicle and the link at the line
# m, or that share of it, that a vehicle must follow a link to have taken it
MIN_FOLLOWED_LINK_M = 12.0
MIN_FOLLOWED_LINK_SHARE = 0.6
LETTER_OF_SIGNAL_STATE = ("", "r", "y", "g", "r", "y", "g", "r", "o")  # by the dataset's number; "" = unknown
ENOUGH_GREEN_S = 5.0  # of green in the record after which the default need not serve a stream
DEFAULT_GREEN_S, DEFAULT_YELLOW_S, DEFAULT_CLEARANCE_S = 8.0, 3.0, 1.0  # s of the default's phases

Rulers = Mapping[int, int | None]  # link -> the lane of its signal, None where the record has none for it
Stream = tuple[str, str]  # edge and direction


@dataclass(frozen=True, slots=True)
class RecordTraffic:
    """All vehicles of a record: fronts, centres ``(k, n, 2)`` m; heading rad, speed m/s, valid ``(k, n)``; step s."""

    fronts: Floats
    centres: Floats
    heading: Floats
    speed: Floats
    valid: Bools
    step: float


def logged_traffic(record: Record) -> RecordTraffic:
    """The record's vehicles."""
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
    """A letter a step (g, y or r) for links that have one signal; empty if no vehicle drove off on any of them."""
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
    """Vehicles that take a link, each with the step at which its front is over the line."""
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
    """The signals of a junction. index: link -> place in the state; phases: (duration [s], state)."""

    index: Mapping[int, int]
    phases: tuple[tuple[float, str], ...]

    def element(self, name: str) -> ET.Element:
        """As SUMO's tlLogic."""
        made = ET.Element("tlLogic", id=name, type="static", programID="womd", offset="0.00")
        for duration, state in self.phases:
            ET.SubElement(made, "phase", duration=f"{duration:.2f}", state=state)
        return made


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """Programs by junction, and the report's counts: signal lanes with a state that is never known, streams that logged
    vehicles tell of, approaches signalled without a recorded signal."""

    programs: dict[str, Program]
    unknown: int
    witnessed: int
    assumed: int


def ruling_lanes(
    record: Record, links: Sequence[JunctionLink], foes: Collection[tuple[int, int]], stops: Collection[int]
) -> dict[int, int | None]:
    """Link number -> the signal lane that rules it; None for links of an approach without a recorded signal or a stop
    sign that goes straight on across a ruled one."""
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
    """Programs for all junctions with a ruled link."""
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
    """For each signal lane, in the recorded order, a letter a step; gaps are filled with the last known one."""
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
    """Each link's letters; where its own are never known those of a like link, else what logged vehicles tell, else
    red; and of how many streams vehicles told."""
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
    return link.source, link.direction


def _run_lengths(rows: list[str], step: float) -> list[tuple[float, str]]:
    phases: list[tuple[float, str]] = []
    for row in rows:
        if phases and phases[-1][1] == row:
            phases[-1] = (phases[-1][0] + step, row)
        else:
            phases.append((step, row))
    return [(round(duration, 2), state) for duration, state in phases]


def _needy(links: Sequence[JunctionLink], members: list[int], phases: list[tuple[float, str]]) -> list[Stream]:
    """Streams with too little green in the record, in order."""
    green: dict[Stream, float] = {}
    for k, n in enumerate(members):
        seen = sum(duration for duration, state in phases if state[k] in "go")
        stream = _stream(links[n])
        green[stream] = min(green.get(stream, seen), seen)
    return [stream for stream, seen in green.items() if seen < ENOUGH_GREEN_S]


def _default(
    links: Sequence[JunctionLink], members: list[int], needy: list[Stream], order: LinkPriorities
) -> list[tuple[float, str]]:
    """Few green phases that serve every needy stream, each with all others that are in no other's way."""
    of_stream: dict[Stream, list[int]] = {}
    for n in members:
        of_stream.setdefault(_stream(links[n]), []).append(n)
    orders = [needy[k:] + needy[:k] for k in range(len(needy))]
    greens = min((_serve(waiting, of_stream, order) for waiting in orders), key=len, default=[])
    return [(DEFAULT_GREEN_S, "".join("g" if n in green else "r" for n in members)) for green in greens]


def _serve(waiting: list[Stream], of_stream: Mapping[Stream, list[int]], order: LinkPriorities) -> list[set[int]]:
    """The links that are green together, a set a phase: the first stream that waits with all that fit."""
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
    """Record and default one after the other, with yellow and a clearance wherever a green ends, also at the turn."""
    cycle = list(phases)
    for phase in default:
        cycle += _change(cycle[-1][1], phase[1])
        cycle.append(phase)
    if len(cycle) > 1:
        cycle += _change(cycle[-1][1], cycle[0][1])
    return cycle


def _change(before: str, after: str) -> list[tuple[float, str]]:
    ends = [b in "gy" and a == "r" for b, a in zip(before, after, strict=True)]
    if not any(ends):
        return []
    both = list(zip(before, after, ends, strict=True))
    yellow = "".join("y" if end else "g" if b == a == "g" else b if b == "o" else "r" for b, a, end in both)
    clear = "".join("g" if b == a == "g" else b if b == "o" else "r" for b, a, end in both)
    return [(DEFAULT_YELLOW_S, yellow), (DEFAULT_CLEARANCE_S, clear)]


def _major(state: str, members: list[int], order: LinkPriorities) -> str:
    """Capital G for greens that yield to no other green of the phase."""
    green = {n for n, letter in zip(members, state, strict=True) if letter in "gyo"}
    return "".join(
        "G" if letter == "g" and not order.yields_to[n] & green else letter
        for n, letter in zip(members, state, strict=True)
    )
