"""Strands: lanes strung together where nothing but the next lane follows, so that cuts need not lie at lane ends."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.womd.network.lanes import KeptLane
from sumo_adv.womd.network.polyline import stations

SAME_SPEED = 0.5  # m/s, lanes whose limits differ by less are one road


@dataclass(frozen=True, slots=True)
class Strand:
    """Lanes one after the other. points ``(n, 3)``, along ``(n,)`` [m]; lanes: id and station of its start, in order;
    exits, entries: numbers of strands; turning: every lane interpolates, as in a junction."""

    number: int
    points: Floats
    along: Floats
    lanes: tuple[tuple[int, float], ...]
    speed: float
    bike: bool
    turning: bool
    entries: tuple[int, ...]
    exits: tuple[int, ...]

    @property
    def length(self) -> float:
        """Length in m."""
        return float(self.along[-1])

    def lane_at(self, station: float) -> int:
        """The WOMD lane at a station."""
        found = self.lanes[0][0]
        for lane, start in self.lanes:
            if start <= station:
                found = lane
        return found

    def lanes_between(self, start: float, end: float) -> list[int]:
        """The WOMD lanes that have a part between two stations, in order."""
        ends = [*(begin for _, begin in self.lanes[1:]), self.length]
        return [lane for (lane, begin), stop in zip(self.lanes, ends, strict=True) if begin < end and stop > start]


@dataclass(frozen=True, slots=True)
class Strands:
    """All strands, and for each lane its strand and where on it the lane begins."""

    all: tuple[Strand, ...]
    of_lane: dict[int, tuple[int, float]]


def make_strands(lanes: dict[int, KeptLane]) -> Strands:
    """String the lanes together."""
    follows = {}
    for number, lane in lanes.items():
        if len(lane.exits) == 1:
            after = lanes[lane.exits[0]]
            alike = after.bike == lane.bike and abs(after.speed - lane.speed) < SAME_SPEED
            if after.entries == (number,) and alike:
                follows[number] = after.feature.id
    chains = _chains(sorted(lanes), follows)
    first = {chain[0]: k for k, chain in enumerate(chains)}
    last = {chain[-1]: k for k, chain in enumerate(chains)}
    made: list[Strand] = []
    of_lane: dict[int, tuple[int, float]] = {}
    for k, chain in enumerate(chains):
        line, placed = _string([lanes[number].points for number in chain])
        for number, start in zip(chain, placed, strict=True):
            of_lane[number] = (k, start)
        head, tail = lanes[chain[0]], lanes[chain[-1]]
        made.append(
            Strand(
                k, line, stations(line), tuple(zip(chain, placed, strict=True)), head.speed, head.bike,
                all(lanes[number].feature.interpolating for number in chain),
                tuple(last[n] for n in head.entries), tuple(first[n] for n in tail.exits),
            )
        )  # fmt: skip
    return Strands(tuple(made), of_lane)


def _string(parts: list[Floats]) -> tuple[Floats, list[float]]:
    """One line through lanes that follow one another, and the station where each begins."""
    placed = [0.0]
    for before, after in pairwise(parts):
        placed.append(placed[-1] + float(stations(before)[-1]) + float(np.hypot(*(after[0] - before[-1])[:2])))
    line = np.vstack(parts)
    step = np.hypot(*np.diff(line[:, :2], axis=0).T)
    return line[np.concatenate([[True], step > 1e-9])], placed


def _chains(numbers: list[int], follows: dict[int, int]) -> list[list[int]]:
    """Chains along ``follows``; a ring is opened at its smallest number."""
    behind = set(follows.values())
    chains: list[list[int]] = []
    seen: set[int] = set()
    for number in [n for n in numbers if n not in behind] + numbers:
        if number in seen:
            continue
        chain = [number]
        seen.add(number)
        while (after := follows.get(chain[-1])) is not None and after not in seen:
            chain.append(after)
            seen.add(after)
        chains.append(chain)
    return chains
