"""Strands: sections strung together where nothing but the next one follows, so that cuts need not lie at lane ends."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.womd.network.lanes import KeptLane
from sumo_adv.womd.network.polyline import stations
from sumo_adv.womd.network.sections import Section, make_sections

SAME_SPEED = 0.5  # m/s, sections with limits that differ by less are one road


@dataclass(frozen=True, slots=True)
class Run:
    """Lane ``lane`` from its station lane_start to lane_end lies on a strand from start to end [m]."""

    lane: int
    lane_start: float
    lane_end: float
    start: float
    end: float


@dataclass(frozen=True, slots=True)
class Strand:
    """Lanes one after the other. points ``(n, 3)``, along ``(n,)`` [m]; runs: the lanes on it in order; exits, entries:
    numbers of strands; turning: every lane interpolates, as in a junction."""

    number: int
    points: Floats
    along: Floats
    runs: tuple[Run, ...]
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
        return next((run.lane for run in self.runs if station < run.end - 1e-6), self.runs[-1].lane)

    def begin_between(self, start: float, end: float) -> list[int]:
        """The WOMD lanes that begin between two stations, in order."""
        return [run.lane for run in self.runs if run.lane_start == 0.0 and start - 1e-6 <= run.start < end]


@dataclass(frozen=True, slots=True)
class Strands:
    """All strands; for each lane its runs in order, each with its strand."""

    all: tuple[Strand, ...]
    of_lane: dict[int, tuple[tuple[int, Run], ...]]

    def start_of(self, lane: int) -> tuple[int, float]:
        """Strand and station where a lane begins."""
        strand, run = self.of_lane[lane][0]
        return strand, run.start


def make_strands(lanes: dict[int, KeptLane], held: Collection[int]) -> Strands:
    """String the lanes together; ``held``: lanes that begin at a signal or a stop sign."""
    sections = make_sections(lanes, held)
    chains = _chains(sorted(sections), _follows(sections))
    first = {chain[0]: k for k, chain in enumerate(chains)}
    last = {chain[-1]: k for k, chain in enumerate(chains)}
    made: list[Strand] = []
    runs_of: dict[int, list[tuple[int, Run]]] = {}
    for k, chain in enumerate(chains):
        line, placed = _string([sections[key].points for key in chain])
        runs = []
        for key, (start, end) in zip(chain, placed, strict=True):
            for use in sections[key].uses:
                runs.append(Run(use.lane, use.start, use.end, start, end))
                runs_of.setdefault(use.lane, []).append((k, runs[-1]))
        head, tail = sections[chain[0]], sections[chain[-1]]
        made.append(
            Strand(
                k, line, stations(line), tuple(runs), head.speed, head.bike, all(sections[n].turning for n in chain),
                tuple(last[n] for n in head.entries), tuple(first[n] for n in tail.exits),
            )
        )  # fmt: skip
    of_lane = {lane: tuple(sorted(lane_runs, key=lambda f: f[1].lane_start)) for lane, lane_runs in runs_of.items()}
    return Strands(tuple(made), of_lane)


def _follows(sections: dict[int, Section]) -> dict[int, int]:
    """Section -> its successor, where there is no other and both are alike."""
    successors = {}
    for key, section in sections.items():
        if len(section.exits) == 1 and section.exits[0] != key:
            after = sections[section.exits[0]]
            alike = after.bike == section.bike and abs(after.speed - section.speed) < SAME_SPEED
            if after.entries == (key,) and alike:
                successors[key] = section.exits[0]
    return successors


def _string(parts: list[Floats]) -> tuple[Floats, list[tuple[float, float]]]:
    """One line through parts that follow one another, and the stations where each begins and ends."""
    placed = [(0.0, float(stations(parts[0])[-1]))]
    for before, after in pairwise(parts):
        start = placed[-1][1] + float(np.hypot(*(after[0] - before[-1])[:2]))
        placed.append((start, start + float(stations(after)[-1])))
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
