"""Lanes cut where they share their ground with others.

Lanes that split run over the same ground for their first metres, and lanes that merge for their last. As long as they
are within ``SAME_GROUND`` of one another they are one section here, so that it can be an edge and need not be junction.
The start of a lane that a signal or a stop sign holds is left alone: that is where vehicles wait.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.womd.network.lanes import KeptLane
from sumo_adv.womd.network.polyline import at, part, turned

SAME_GROUND = 0.1  # m from the straightest of the lanes that share their ground
STEP = 0.5  # m between the places compared
MOST = 12.0  # m that lanes share at most
MOST_PART = 0.4  # of a lane that is shared at either end
LEAST = 0.5  # m, less is not worth a section


@dataclass(frozen=True, slots=True)
class Use:
    """A lane from station ``start`` to ``end`` [m] runs over a section, from one end of it to the other."""

    lane: int
    start: float
    end: float


@dataclass(frozen=True, slots=True)
class Section:
    """Ground of one lane or of several. points ``(n, 3)``; entries, exits: keys of sections; speed m/s; turning: all
    its lanes interpolate."""

    points: Floats
    uses: tuple[Use, ...]
    entries: tuple[int, ...]
    exits: tuple[int, ...]
    speed: float
    bike: bool
    turning: bool


@dataclass(frozen=True, slots=True)
class _Shared:
    lanes: tuple[int, ...]  # the straightest first
    length: float


def make_sections(lanes: dict[int, KeptLane], held: Collection[int]) -> dict[int, Section]:
    """All sections by key; ``held``: lanes with a fixed start."""
    heads = _shared(lanes, held, at_end=False)
    tails = _shared(lanes, held, at_end=True)
    head_of = {lane: n for n, shared in enumerate(heads) for lane in shared.lanes}
    tail_of = {lane: n for n, shared in enumerate(tails) for lane in shared.lanes}
    body = {lane: n for n, lane in enumerate(lanes)}
    first = {lane: len(body) + head_of[lane] if lane in head_of else body[lane] for lane in lanes}
    base = len(body) + len(heads)
    last = {lane: base + tail_of[lane] if lane in tail_of else body[lane] for lane in lanes}
    sections: dict[int, Section] = {}
    for number, lane in lanes.items():
        start = heads[head_of[number]].length if number in head_of else 0.0
        end = lane.length - (tails[tail_of[number]].length if number in tail_of else 0.0)
        before = (first[number],) if number in head_of else tuple(sorted({last[e] for e in lane.entries}))
        after = (last[number],) if number in tail_of else tuple(sorted({first[e] for e in lane.exits}))
        points = part(lane.points, lane.along, start, end) if end - start < lane.length else lane.points
        sections[body[number]] = Section(
            points, (Use(number, start, end),), before, after, lane.speed, lane.bike, lane.feature.interpolating
        )
    for n, shared in enumerate(heads):
        lane = lanes[shared.lanes[0]]
        uses = tuple(Use(k, 0.0, shared.length) for k in shared.lanes)
        before = tuple(sorted({last[e] for e in lane.entries}))
        sections[len(body) + n] = _make(lanes, lane, uses, before, tuple(body[k] for k in shared.lanes))
    for n, shared in enumerate(tails):
        lane = lanes[shared.lanes[0]]
        uses = tuple(Use(k, lanes[k].length - shared.length, lanes[k].length) for k in shared.lanes)
        after = tuple(sorted({first[e] for e in lane.exits}))
        sections[base + n] = _make(lanes, lane, uses, tuple(body[k] for k in shared.lanes), after)
    return sections


def _make(
    lanes: dict[int, KeptLane], main: KeptLane, uses: tuple[Use, ...], entries: tuple[int, ...], exits: tuple[int, ...]
) -> Section:
    points = part(main.points, main.along, uses[0].start, uses[0].end)
    turning = all(lanes[use.lane].feature.interpolating for use in uses)
    return Section(points, uses, entries, exits, max(lanes[use.lane].speed for use in uses), False, turning)


def _shared(lanes: dict[int, KeptLane], held: Collection[int], *, at_end: bool) -> list[_Shared]:
    """Groups of lanes that share their last metres before, or their first after, the same one lane."""
    groups = []
    for number, lane in lanes.items():
        if at_end:
            group = [k for k in lane.entries if lanes[k].exits == (number,)]
        else:
            group = [k for k in lane.exits if lanes[k].entries == (number,)]
            if held and not set(group).isdisjoint(held):
                continue
        group = [k for k in group if not lanes[k].bike and k != number]
        if len(group) < 2:
            continue
        length = _common([lanes[k] for k in group], at_end=at_end)
        if length >= LEAST:
            group.sort(key=lambda k: (lanes[k].feature.interpolating, abs(turned(lanes[k].points)), k))
            groups.append(_Shared(tuple(group), length))
    return groups


def _common(group: Sequence[KeptLane], *, at_end: bool) -> float:
    """How far [m] all lanes are on the same ground, from their ends backward or their starts forward."""
    most = min(MOST, MOST_PART * min(lane.length for lane in group))
    distance = np.arange(0.0, most, STEP)
    if len(distance) < 2:
        return 0.0
    lines = [at(lane.points[:, :2], lane.along, lane.length - distance if at_end else distance) for lane in group]
    apart = np.max([np.hypot(*(line - lines[0]).T) for line in lines[1:]], axis=0) > SAME_GROUND
    high = np.max([lane.points[-1 if at_end else 0, 2] for lane in group])
    low = np.min([lane.points[-1 if at_end else 0, 2] for lane in group])
    if high - low > 1.0:
        return 0.0
    return float(distance[max(int(np.argmax(apart)) - 1, 0) if apart.any() else -1])
