"""Convert a record's lanes to strands.

First, the lanes that become road are chosen. They are cut where they share their ground. They are joined where only one
lane follows another, so that cuts need not lie at lane ends.

Lanes that split run over the same ground for their first metres, and lanes that merge for their last. As long as they
are within ``SHARED_GROUND_DISTANCE_M`` of each other, they are one section here. The section can then be an edge and
need not be part of a junction. The start of a lane that a signal or a stop sign holds is not changed, because vehicles
wait there.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.womd.lines import MAX_CONNECTION_GAP_M, at, distinct_points, line_stations, part, turned
from sumo_adv.womd.record import BIKE, LaneFeature, Record

MIN_LONE_LANE_LENGTH_M = 1.0  # shorter lanes without connections are dropped
DEFAULT_SPEED_LIMIT_M_S = 11.176  # (25 mph); for lanes without a limit of their own or on a lane that they touch
BIKE_LANE_SPEED_M_S = 6.7  # the same for bike lanes
# Maximum distance between the first lane of a group and the others that share its ground.
SHARED_GROUND_DISTANCE_M = 0.1
SHARED_GROUND_STEP_M = 0.5  # between the places that are compared
MAX_SHARED_LENGTH_M = 12.0  # maximum length that lanes share
MAX_SHARED_PART = 0.4  # maximum share of a lane that is shared at either end
MIN_SHARED_LENGTH_M = 0.5  # a shorter length gets no section of its own
SAME_SECTION_LIMIT_M_S = 0.5  # sections whose limits differ by less are one road


@dataclass(frozen=True, slots=True)
class KeptLane:
    """A lane that becomes road.

    Attributes:
        feature: The lane in the record.
        points: Its points without repeated ones, ``(n, 3)`` [m].
        along: The stations of these points, ``(n,)`` [m].
        index: The station of each point of the record, ``(m,)`` [m].
        speed: Its speed limit [m/s], never 0.
        entries: The kept lanes before that touch it.
        exits: The kept lanes after that touch it.
    """

    feature: LaneFeature
    points: Floats
    along: Floats
    index: Floats
    speed: float
    entries: tuple[int, ...]
    exits: tuple[int, ...]

    @property
    def length(self) -> float:
        """The length of the lane [m]."""
        return float(self.along[-1])

    @property
    def bike(self) -> bool:
        """Whether only bicycles may use the lane."""
        return self.feature.kind == BIKE


@dataclass(frozen=True, slots=True)
class Kept:
    """The lanes of a record, sorted.

    Attributes:
        lanes: The lanes that are kept, by id.
        dropped: The reason for each lane that is dropped, by id.
        gaps: Pairs of connected lanes whose ends are too far apart.
        assumed_speeds: The number of lanes with an assumed speed.
    """

    lanes: dict[int, KeptLane]
    dropped: dict[int, str]
    gaps: list[tuple[int, int]]
    assumed_speeds: int


def keep_lanes(record: Record) -> Kept:
    """Sort the record's lanes into kept and dropped ones."""
    dropped: dict[int, str] = {}
    usable: dict[int, Floats] = {}
    for lane in record.lanes.values():
        points = distinct_points(lane.points) if len(lane.points) else lane.points
        if len(points) < 2:
            dropped[lane.id] = "one point" if len(points) else "no points"
        elif not np.isfinite(points).all():
            dropped[lane.id] = "not finite"
        else:
            usable[lane.id] = points
    links, gaps = _links(record, usable)
    linked = {lane for pair in links for lane in pair}
    for number, points in list(usable.items()):
        if number not in linked and line_stations(points)[-1] < MIN_LONE_LANE_LENGTH_M:
            dropped[number] = f"unconnected and under {MIN_LONE_LANE_LENGTH_M:g} m"
            del usable[number]
    speeds, assumed = _speeds(record, usable, links)
    lanes = {
        number: KeptLane(
            record.lanes[number], points, line_stations(points), line_stations(record.lanes[number].points),
            speeds[number], tuple(sorted(a for a, b in links if b == number)),
            tuple(sorted(b for a, b in links if a == number)),
        )
        for number, points in usable.items()
    }  # fmt: skip
    return Kept(lanes, dropped, gaps, assumed)


def _links(record: Record, usable: dict[int, Floats]) -> tuple[set[tuple[int, int]], list[tuple[int, int]]]:
    """Return pairs (lane, exit) that touch, and pairs that do not."""
    pairs = {(a, b) for a in usable for b in record.lanes[a].exits}
    pairs |= {(a, b) for b in usable for a in record.lanes[b].entries}
    links, gaps = set(), []
    for a, b in sorted(pairs):
        if a not in usable or b not in usable or a == b:
            continue
        if np.hypot(*(usable[b][0] - usable[a][-1])[:2]) < MAX_CONNECTION_GAP_M:
            links.add((a, b))
        else:
            gaps.append((a, b))
    return links, gaps


def _speeds(record: Record, usable: dict[int, Floats], links: set[tuple[int, int]]) -> tuple[dict[int, float], int]:
    """Return a speed for every lane [m/s], and the number of lanes without a limit.

    The speed is the lane's limit, otherwise the highest limit of the lanes that it touches, otherwise a default.
    """
    speeds = {n: record.lanes[n].speed_limit for n in usable if record.lanes[n].speed_limit > 0}
    without = [n for n in usable if n not in speeds]
    near: dict[int, list[float]] = {n: [] for n in without}
    for a, b in links:
        for own, neighbour in ((a, b), (b, a)):
            if own in near:
                near[own].append(record.lanes[neighbour].speed_limit)
    for n in without:
        default = BIKE_LANE_SPEED_M_S if record.lanes[n].kind == BIKE else DEFAULT_SPEED_LIMIT_M_S
        speeds[n] = max((limit for limit in near[n] if limit > 0), default=default)
    return speeds, len(without)


@dataclass(frozen=True, slots=True)
class Use:
    """A lane that runs over a section, from one end of the section to the other.

    Attributes:
        lane: The id of the lane.
        start: The station on the lane at the section's start [m].
        end: The station on the lane at the section's end [m].
    """

    lane: int
    start: float
    end: float


@dataclass(frozen=True, slots=True)
class Section:
    """Ground of one lane or of several.

    Attributes:
        points: Its centre line, ``(n, 3)`` [m].
        uses: The lanes on it.
        entries: The keys of the sections before.
        exits: The keys of the sections after.
        speed: Its speed limit [m/s].
        bike: Whether only bicycles may use it.
        turning: Whether all its lanes interpolate.
    """

    points: Floats
    uses: tuple[Use, ...]
    entries: tuple[int, ...]
    exits: tuple[int, ...]
    speed: float
    bike: bool
    turning: bool


def _make_sections(lanes: dict[int, KeptLane], held: Collection[int]) -> dict[int, Section]:
    """Return all sections by key; ``held`` are the lanes with a fixed start."""
    heads, tails = (_shared(lanes, held, at_end=at_end) for at_end in (False, True))
    body = {lane: n for n, lane in enumerate(lanes)}
    first, last = dict(body), dict(body)  # the sections at a lane's beginning and end
    begins, ends = dict.fromkeys(lanes, 0.0), {number: lane.length for number, lane in lanes.items()}
    for key, (group, length) in enumerate(heads, len(body)):
        first |= dict.fromkeys(group, key)
        begins |= dict.fromkeys(group, length)
    for key, (group, length) in enumerate(tails, len(body) + len(heads)):
        last |= dict.fromkeys(group, key)
        ends |= {number: lanes[number].length - length for number in group}
    before = {number: tuple(sorted({last[e] for e in lane.entries})) for number, lane in lanes.items()}
    after = {number: tuple(sorted({first[e] for e in lane.exits})) for number, lane in lanes.items()}
    sections: dict[int, Section] = {}
    for number, lane in lanes.items():
        start, end, key = begins[number], ends[number], body[number]
        points = part(lane.points, lane.along, start, end) if end - start < lane.length else lane.points
        sections[key] = Section(
            points, (Use(number, start, end),), before[number] if first[number] == key else (first[number],),
            after[number] if last[number] == key else (last[number],), lane.speed, lane.bike,
            lane.feature.interpolating,
        )  # fmt: skip
    for group, length in heads:
        uses = tuple(Use(k, 0.0, length) for k in group)
        sections[first[group[0]]] = _common_section(lanes, uses, before[group[0]], tuple(body[k] for k in group))
    for group, _ in tails:
        uses = tuple(Use(k, ends[k], lanes[k].length) for k in group)
        sections[last[group[0]]] = _common_section(lanes, uses, tuple(body[k] for k in group), after[group[0]])
    return sections


def _common_section(
    lanes: dict[int, KeptLane], uses: tuple[Use, ...], entries: tuple[int, ...], exits: tuple[int, ...]
) -> Section:
    """Return a section that several lanes share, with the centre line of the first."""
    main = lanes[uses[0].lane]
    points = part(main.points, main.along, uses[0].start, uses[0].end)
    turning = all(lanes[use.lane].feature.interpolating for use in uses)
    return Section(points, uses, entries, exits, max(lanes[use.lane].speed for use in uses), False, turning)


def _shared(lanes: dict[int, KeptLane], held: Collection[int], *, at_end: bool) -> list[tuple[list[int], float]]:
    """Return groups of lanes that share ground before or after one lane, and for how long.

    The lanes of a group, the straightest first, share their last metres before the lane (``at_end``) or their first
    metres after it.
    """
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
        if length >= MIN_SHARED_LENGTH_M:
            group.sort(key=lambda k: (lanes[k].feature.interpolating, abs(turned(lanes[k].points)), k))
            groups.append((group, length))
    return groups


def _common(group: Sequence[KeptLane], *, at_end: bool) -> float:
    """Return how far all lanes are on the same ground [m], from their ends backward or their starts forward."""
    most = min(MAX_SHARED_LENGTH_M, MAX_SHARED_PART * min(lane.length for lane in group))
    distance = np.arange(0.0, most, SHARED_GROUND_STEP_M)
    if len(distance) < 2:
        return 0.0
    lines = [at(lane.points[:, :2], lane.along, lane.length - distance if at_end else distance) for lane in group]
    apart = np.max([np.hypot(*(line - lines[0]).T) for line in lines[1:]], axis=0) > SHARED_GROUND_DISTANCE_M
    high = np.max([lane.points[-1 if at_end else 0, 2] for lane in group])
    low = np.min([lane.points[-1 if at_end else 0, 2] for lane in group])
    if high - low > 1.0:
        return 0.0
    return float(distance[max(int(np.argmax(apart)) - 1, 0) if apart.any() else -1])


@dataclass(frozen=True, slots=True)
class LaneRun:
    """A part of a lane on a strand.

    Attributes:
        lane: The id of the lane.
        lane_start: The station on the lane at which the part begins [m].
        lane_end: The station on the lane at which it ends [m].
        start: The station on the strand at which it begins [m].
        end: The station on the strand at which it ends [m].
    """

    lane: int
    lane_start: float
    lane_end: float
    start: float
    end: float


@dataclass(frozen=True, slots=True)
class Strand:
    """Successive lanes as one line.

    Attributes:
        number: The number of the strand.
        points: Its centre line, ``(n, 3)`` [m].
        along: The stations of its points, ``(n,)`` [m].
        runs: The lanes on it, in order.
        speed: Its speed limit [m/s].
        bike: Whether only bicycles may use it.
        turning: Whether every lane on it interpolates, as in a junction.
        entries: The numbers of the strands before.
        exits: The numbers of the strands after.
    """

    number: int
    points: Floats
    along: Floats
    runs: tuple[LaneRun, ...]
    speed: float
    bike: bool
    turning: bool
    entries: tuple[int, ...]
    exits: tuple[int, ...]

    @property
    def length(self) -> float:
        """The length of the strand [m]."""
        return float(self.along[-1])

    def lane_at(self, station: float) -> int:
        """Return the id of the WOMD lane at a station [m]."""
        return next((run.lane for run in self.runs if station < run.end - 1e-6), self.runs[-1].lane)


@dataclass(frozen=True, slots=True)
class Strands:
    """All strands of a record.

    Attributes:
        all: The strands by number.
        of_lane: For each lane, its runs in order, each with the number of its strand.
    """

    all: tuple[Strand, ...]
    of_lane: dict[int, tuple[tuple[int, LaneRun], ...]]


def make_strands(lanes: dict[int, KeptLane], held: Collection[int]) -> Strands:
    """Join lanes to strands.

    Args:
        lanes: The lanes by id.
        held: The lanes that begin at a signal or a stop sign.

    Returns:
        The strands.
    """
    sections = _make_sections(lanes, held)
    chains = _chains(sorted(sections), _follows(sections))
    first = {chain[0]: k for k, chain in enumerate(chains)}
    last = {chain[-1]: k for k, chain in enumerate(chains)}
    made: list[Strand] = []
    runs_of: dict[int, list[tuple[int, LaneRun]]] = {}
    for k, chain in enumerate(chains):
        line, placed = _string([sections[key].points for key in chain])
        runs = []
        for key, (start, end) in zip(chain, placed, strict=True):
            for use in sections[key].uses:
                runs.append(LaneRun(use.lane, use.start, use.end, start, end))
                runs_of.setdefault(use.lane, []).append((k, runs[-1]))
        head, tail = sections[chain[0]], sections[chain[-1]]
        made.append(
            Strand(
                k, line, line_stations(line), tuple(runs), head.speed, head.bike,
                all(sections[n].turning for n in chain),
                tuple(last[n] for n in head.entries), tuple(first[n] for n in tail.exits),
            )
        )  # fmt: skip
    of_lane = {lane: tuple(sorted(lane_runs, key=lambda f: f[1].lane_start)) for lane, lane_runs in runs_of.items()}
    return Strands(tuple(made), of_lane)


def _follows(sections: dict[int, Section]) -> dict[int, int]:
    """Return the successor of each section that has only one and is like it."""
    successors = {}
    for key, section in sections.items():
        if len(section.exits) == 1 and section.exits[0] != key:
            after = sections[section.exits[0]]
            alike = after.bike == section.bike and abs(after.speed - section.speed) < SAME_SECTION_LIMIT_M_S
            if after.entries == (key,) and alike:
                successors[key] = section.exits[0]
    return successors


def _string(parts: list[Floats]) -> tuple[Floats, list[tuple[float, float]]]:
    """Return one line through successive parts, and the stations where each begins and ends [m]."""
    placed = [(0.0, float(line_stations(parts[0])[-1]))]
    for before, after in pairwise(parts):
        start = placed[-1][1] + float(np.hypot(*(after[0] - before[-1])[:2]))
        placed.append((start, start + float(line_stations(after)[-1])))
    line = np.vstack(parts)
    step = np.hypot(*np.diff(line[:, :2], axis=0).T)
    return line[np.concatenate([[True], step > 1e-9])], placed


def _chains(numbers: list[int], follows: dict[int, int]) -> list[list[int]]:
    """Return chains along ``follows``; a ring is opened at its smallest number."""
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
