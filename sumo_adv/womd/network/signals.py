"""Signals: phases as recorded, then a default for streams without a recorded green, over and over.

A link is ruled by the first signal lane that begins on it. Where a lane's state is unknown for a while, the last known
state holds; where it is unknown throughout, it does as a lane of the same edge and direction, else as logged vehicles
that drive off there tell (``witnesses.py``), else it is red until the default. So it is with approaches that go
straight on across ruled ones and of which the record tells no signal. In the default no two streams that cross or merge
are green together.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from sumo_adv.womd.network.right_of_way import RightOfWay
from sumo_adv.womd.network.roads import Link
from sumo_adv.womd.network.witnesses import logged_traffic, witnessed_letters
from sumo_adv.womd.record import Record

LETTERS = ("", "r", "y", "g", "r", "y", "g", "r", "o")  # by the dataset's number; "" = unknown
ENOUGH = 5.0  # s of green in the record after which the default need not serve a stream
GREEN, YELLOW, CLEARANCE = 8.0, 3.0, 1.0  # s of the default's phases

Rulers = Mapping[int, int | None]  # link -> the lane of its signal, None where the record has none for it
Stream = tuple[str, str]  # edge and direction


@dataclass(frozen=True, slots=True)
class Program:
    """The signals of a junction. index: link -> place in the state; phases: (duration [s], state)."""

    index: Mapping[int, int]
    phases: tuple[tuple[float, str], ...]
    recorded: int
    """How many of the phases, from the first, are as recorded."""

    def element(self, name: str) -> ET.Element:
        """As SUMO's tlLogic."""
        made = ET.Element("tlLogic", id=name, type="static", programID="womd", offset="0.00")
        for duration, state in self.phases:
            ET.SubElement(made, "phase", duration=f"{duration:.2f}", state=state)
        return made


@dataclass(frozen=True, slots=True)
class SignalPlan:
    """Programs by junction, and the report's counts: lanes with a signal, those that rule a link, those with a state
    that is never known, streams that logged vehicles tell of, streams that the default completes, approaches signalled
    without a recorded signal."""

    programs: dict[str, Program]
    recorded: frozenset[int]
    mapped: tuple[int, ...]
    unknown: tuple[int, ...]
    witnessed: int
    completed: int
    assumed: int


def ruling_lanes(
    record: Record, links: Sequence[Link], foes: Collection[tuple[int, int]], stops: Collection[int]
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


def plan_signals(record: Record, links: Sequence[Link], rulers: Rulers, order: RightOfWay) -> SignalPlan:
    """Programs for all junctions with a ruled link."""
    letters = _letters(record)
    place: dict[int | None, int] = {lane: n for n, lane in enumerate(letters)}
    programs: dict[str, Program] = {}
    completed = witnessed = 0
    step = float(record.time[1] - record.time[0]) if len(record.time) > 1 else 0.1
    for junction in sorted({links[n].junction for n in rulers}):
        members = [n for n in rulers if links[n].junction == junction]
        members.sort(key=lambda n: (place.get(rulers[n], len(place)), n))
        of_link, streams = _known(record, links, members, rulers, letters)
        witnessed += streams
        rows = ["".join(of_link[n][k] for n in members) for k in range(len(record.signals))]
        phases = _run_lengths(rows, step)
        needy = _needy(links, members, phases)
        completed += len(needy)
        default = _default(links, members, needy, order)
        cycle = _with_changes(phases, default)
        greens = [(duration, _major(state, members, order)) for duration, state in cycle]
        programs[junction] = Program({n: k for k, n in enumerate(members)}, tuple(greens), len(phases))
    unknown = tuple(lane for lane, states in letters.items() if not any(states))
    mapped = tuple(lane for lane in letters if lane in set(rulers.values()))
    assumed = len({links[n].source for n, lane in rulers.items() if lane is None})
    return SignalPlan(programs, frozenset(letters), mapped, unknown, witnessed, completed, assumed)


def _letters(record: Record) -> dict[int, list[str]]:
    """For each signal lane, in the recorded order, a letter a step; gaps are filled with the last known one."""
    letters: dict[int, list[str]] = {}
    for k, step in enumerate(record.signals):
        for state in step:
            states = letters.setdefault(state.lane, [""] * len(record.signals))
            states[k] = LETTERS[state.state] if 0 <= state.state < len(LETTERS) else ""
    for states in letters.values():
        last = next((letter for letter in states if letter), "")
        for k, letter in enumerate(states):
            last = letter or last
            states[k] = last
    return letters


def _known(
    record: Record, links: Sequence[Link], members: list[int], rulers: Rulers, letters: dict[int, list[str]]
) -> tuple[dict[int, list[str]], int]:
    """Each link's letters; where its own are never known those of a like link, else what logged vehicles tell, else
    red; and of how many streams vehicles told."""
    own = {n: letters.get(lane, []) if (lane := rulers[n]) is not None else [] for n in members}
    of_stream: dict[Stream, list[str]] = {}
    for n in members:
        if any(own[n]):
            of_stream.setdefault(_stream(links[n]), own[n])
    unseen: dict[Stream, list[Link]] = {}
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


def _stream(link: Link) -> Stream:
    return link.source, link.direction


def _run_lengths(rows: list[str], step: float) -> list[tuple[float, str]]:
    phases: list[tuple[float, str]] = []
    for row in rows:
        if phases and phases[-1][1] == row:
            phases[-1] = (phases[-1][0] + step, row)
        else:
            phases.append((step, row))
    return [(round(duration, 2), state) for duration, state in phases]


def _needy(links: Sequence[Link], members: list[int], phases: list[tuple[float, str]]) -> list[Stream]:
    """Streams with too little green in the record, in order."""
    green: dict[Stream, float] = {}
    for k, n in enumerate(members):
        seen = sum(duration for duration, state in phases if state[k] in "go")
        stream = _stream(links[n])
        green[stream] = min(green.get(stream, seen), seen)
    return [stream for stream, seen in green.items() if seen < ENOUGH]


def _default(
    links: Sequence[Link], members: list[int], needy: list[Stream], order: RightOfWay
) -> list[tuple[float, str]]:
    """Few green phases that serve every needy stream, each with all others that are in no other's way."""
    of_stream: dict[Stream, list[int]] = {}
    for n in members:
        of_stream.setdefault(_stream(links[n]), []).append(n)
    orders = [needy[k:] + needy[:k] for k in range(len(needy))]
    greens = min((_serve(waiting, of_stream, order) for waiting in orders), key=len, default=[])
    return [(GREEN, "".join("g" if n in green else "r" for n in members)) for green in greens]


def _serve(waiting: list[Stream], of_stream: Mapping[Stream, list[int]], order: RightOfWay) -> list[set[int]]:
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
    return [(YELLOW, yellow), (CLEARANCE, clear)]


def _major(state: str, members: list[int], order: RightOfWay) -> str:
    """Capital G for greens that yield to no other green of the phase."""
    green = {n for n, letter in zip(members, state, strict=True) if letter in "gyo"}
    return "".join(
        "G" if letter == "g" and not order.yields_to[n] & green else letter
        for n, letter in zip(members, state, strict=True)
    )
