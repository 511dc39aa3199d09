"""Which lanes of a record become road, and which of them follow one another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.womd.network.polyline import distinct, stations
from sumo_adv.womd.record import LANE_TYPES, LaneFeature, Record

BIKE = LANE_TYPES.index("bike")
MAX_GAP = 1.0  # m between a lane's end and the start of its exit
MIN_SCRAP = 1.0  # m, shorter lanes that nothing leads to or from are dropped
DEFAULT_SPEED = 11.176  # m/s (25 mph) where no limit is given anywhere near
BIKE_SPEED = 6.7  # m/s where a bike lane has no limit


@dataclass(frozen=True, slots=True)
class KeptLane:
    """A lane that becomes road. points ``(n, 3)`` without doubles; along: their stations ``(n,)`` [m]; index: for each
    point of the record its station ``(m,)``; speed m/s, never 0; exits and entries: kept lanes that touch."""

    feature: LaneFeature
    points: Floats
    along: Floats
    index: Floats
    speed: float
    entries: tuple[int, ...]
    exits: tuple[int, ...]

    @property
    def length(self) -> float:
        """Length in m."""
        return float(self.along[-1])

    @property
    def bike(self) -> bool:
        """Whether bicycles alone may use it."""
        return self.feature.kind == BIKE


@dataclass(frozen=True, slots=True)
class Kept:
    """The lanes kept, those dropped with the reason, links with ends too far apart, lanes of assumed speed."""

    lanes: dict[int, KeptLane]
    dropped: dict[int, str]
    gaps: list[tuple[int, int]]
    assumed_speeds: int


def keep(record: Record) -> Kept:
    """Sort the record's lanes into kept and dropped."""
    dropped: dict[int, str] = {}
    usable: dict[int, Floats] = {}
    for lane in record.lanes.values():
        points = distinct(lane.points) if len(lane.points) else lane.points
        if len(points) < 2:
            dropped[lane.id] = "one point" if len(points) else "no points"
        elif not np.isfinite(points).all():
            dropped[lane.id] = "not finite"
        else:
            usable[lane.id] = points
    links, gaps = _links(record, usable)
    linked = {lane for pair in links for lane in pair}
    for number, points in list(usable.items()):
        if number not in linked and stations(points)[-1] < MIN_SCRAP:
            dropped[number] = f"unconnected and under {MIN_SCRAP:g} m"
            del usable[number]
    speeds, assumed = _speeds(record, usable, links)
    lanes = {
        number: KeptLane(
            record.lanes[number], points, stations(points), stations(record.lanes[number].points),
            speeds[number], tuple(sorted(a for a, b in links if b == number)),
            tuple(sorted(b for a, b in links if a == number)),
        )
        for number, points in usable.items()
    }  # fmt: skip
    return Kept(lanes, dropped, gaps, assumed)


def _links(record: Record, usable: dict[int, Floats]) -> tuple[set[tuple[int, int]], list[tuple[int, int]]]:
    """Pairs (lane, exit) that touch, and those that do not."""
    pairs = {(a, b) for a in usable for b in record.lanes[a].exits}
    pairs |= {(a, b) for b in usable for a in record.lanes[b].entries}
    links, gaps = set(), []
    for a, b in sorted(pairs):
        if a not in usable or b not in usable or a == b:
            continue
        if np.hypot(*(usable[b][0] - usable[a][-1])[:2]) < MAX_GAP:
            links.add((a, b))
        else:
            gaps.append((a, b))
    return links, gaps


def _speeds(record: Record, usable: dict[int, Floats], links: set[tuple[int, int]]) -> tuple[dict[int, float], int]:
    """A speed for every lane: its limit, else that of the fastest lane it touches, else a default."""
    speeds = {n: record.lanes[n].speed_limit for n in usable if record.lanes[n].speed_limit > 0}
    without = [n for n in usable if n not in speeds]
    near: dict[int, list[int]] = {n: [] for n in without}
    for a, b in links:
        for own, neighbour in ((a, b), (b, a)):
            if own in near:
                near[own].append(neighbour)
    for n in without:
        limits = [record.lanes[m].speed_limit for m in near[n] if record.lanes[m].speed_limit > 0]
        speeds[n] = max(limits) if limits else BIKE_SPEED if record.lanes[n].kind == BIKE else DEFAULT_SPEED
    return speeds, len(without)
