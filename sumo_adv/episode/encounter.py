"""Is it time to attack, and which few background vehicles could do it: from the states up to now alone.

Every half second the vehicles near the ego are placed relative to its path (ahead, behind, beside, oncoming, on a way
that crosses or merges), those that cannot meet it in time fall away (arrival windows), and the rest get a risk in
[0, 1].  An encounter begins when the same scene stays above ``ON`` for two looks; below ``OFF`` it is forgotten.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import VehicleState
from sumo_adv.episode.drive import Drive
from sumo_adv.geometry import Path, make_path, wrap
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.simulation import heading_of
from sumo_adv.situation import MEET_AHEAD, ReferencePath, relate

ON, OFF, LOOKS = 0.40, 0.30, 2
LOOK_EVERY = 0.5  # s
NEAR, ONCOMING_NEAR = 70.0, 320.0  # m
REACH = 330.0  # m of ways ahead
SLOWEST_EGO = 4.0  # m/s: a standing ego is no encounter
ON_RECORDED, SLOWEST_RECORDED = 0.20, 1.0  # the few seconds of a recording are all there is: one look, less to see
FASTEST_START = 3.0  # m/s2: what a BV may accelerate by to be at a conflict in time
LATEST = 0.2  # s: how much later than the ego it may be there (ALGORITHM, lever 1)
CONFLICT_TIMES = (1.5, 12.0)  # s to the conflict
SAME_LANE = 1.2  # m
LEAST_WAY = 1.0  # m: a log that goes less far shows no way
BESIDE = 8.5  # m
BEHIND = 45.0  # m: how far behind who drives the ego's way may be,
AHEAD, FAR_AHEAD = 60.0, 100.0  # m: and how far ahead; the second where nobody else is found
CLASSES = frozenset(
    {"passenger", "private", "taxi", "delivery", "truck", "trailer", "bus", "coach", "evehicle", "custom1"}
)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A BV that could be the adversary: how it stands to the ego, its ways, how dangerous it could be in [0, 1]."""

    id: str
    relation: str
    risk: float
    ways: tuple[ReferencePath, ...]
    lane: str

    @property
    def meets_ahead(self) -> bool:
        """Whether the ego can meet it only where their ways do."""
        return self.relation in MEET_AHEAD


class EncounterDetector:
    """Watches one ego. ``look`` is called every half second and answers with the shortlist once it is time."""

    def __init__(self, road: RoadMap, shortlist: int, only: tuple[str, ...] = (), *, recorded: bool = False) -> None:
        self.road = road
        self.shortlist = shortlist
        self.only = only
        self.best = 0.0
        self._looks = 0
        self._on, self._needed = (ON_RECORDED, 1) if recorded else (ON, LOOKS)
        self._slowest = SLOWEST_RECORDED if recorded else SLOWEST_EGO

    def look(self, drive: Drive) -> list[Candidate] | None:
        """The shortlist, most dangerous first, if an encounter begins now; else None."""
        found = self.rank(drive)
        top = found[0].risk if found else 0.0
        self.best = max(self.best, top)
        if top >= self._on or (self._looks and top >= OFF):
            self._looks += 1
        else:
            self._looks = 0
        return found if self._looks >= self._needed else None

    def rank(self, drive: Drive) -> list[Candidate]:
        """Everybody who could, at most ``shortlist``; empty where the ego is off the road or stands."""
        assert drive.ego is not None
        ego = drive.state(drive.ego)
        path = ego_path(self.road, drive)
        if path is None or ego.speed < self._slowest:
            return []
        names = self._near(drive, ego)
        found = self._placed(drive, names, ego, path, AHEAD) or self._placed(drive, names, ego, path, FAR_AHEAD)
        return sorted(found, key=lambda c: (-c.risk, c.id))[: self.shortlist]

    def _placed(
        self, drive: Drive, names: Sequence[str], ego: VehicleState, path: Path, ahead: float
    ) -> list[Candidate]:
        """Those who could, of the same direction at most so far ahead [m]."""
        placed = [self._place(drive, name, ego, path, ahead) for name in names]
        return [c for c in placed if c is not None and c.risk > 0]

    def _near(self, drive: Drive, ego: VehicleState) -> list[str]:
        names, obstacles = [], drive.obstacles
        c, s = math.cos(ego.heading), math.sin(ego.heading)
        for name, raw in drive.snapshot.raw.items():
            if name == ego.id or name in obstacles or (self.only and name not in self.only):
                continue
            dx, dy = raw[0] - ego.x, raw[1] - ego.y
            distance = math.hypot(dx, dy)
            ahead = c * dx + s * dy > 0
            far = ahead or abs(wrap(heading_of(raw[2]) - ego.heading)) > 0.5
            if distance < (ONCOMING_NEAR if far else NEAR) and drive.simulation.vehicle_class(name) in CLASSES:
                names.append(name)
        return names

    def _place(self, drive: Drive, name: str, ego: VehicleState, path: Path, ahead: float) -> Candidate | None:
        bv = drive.state(name)
        if bv.lane not in self.road.lanes:
            return None
        s, d = path.project(bv.x, bv.y)
        turned = abs(wrap(bv.heading - float(path.at(np.asarray(s))[2])))
        own_edge = (
            self.road.lanes[bv.lane].edge == self.road.lanes[ego.lane].edge if ego.lane in self.road.lanes else False
        )
        relation, risk = "", 0.0
        if turned < 0.5 and (abs(d) < SAME_LANE or (own_edge and abs(d) < BESIDE)):
            relation = ("leader" if s > 0 else "follower") if abs(d) < SAME_LANE else "neighbour"
            risk = self._beside(relation, s, d, bv, ego) if -BEHIND < s < ahead else 0.0
        elif turned > 2.64 and 1.2 < d < BESIDE and s > 0:
            sides = self.road.side_offsets(bv.lane, bv.x, bv.y, bv.heading)
            if any(kind == "opposite" for _, kind in sides):  # nothing but a line between the two
                relation, risk = "oncoming", _oncoming(s, bv.speed + ego.speed)
        if relation in ("leader", "follower", "neighbour") and risk == 0.0:
            return None
        ways = bv_ways(self.road, drive, bv, path)
        if relation in ("", "oncoming"):
            meeting = [(w.conflict.kind, _meeting(w, bv, ego)) for w in ways if w.conflict is not None]
            kind, best = max(meeting, key=lambda m: m[1], default=("", 0.0))
            if best > risk:
                relation, risk = (relation or kind), best
        return Candidate(name, relation, risk, ways, bv.lane) if relation and ways else None

    def _beside(self, relation: str, s: float, d: float, bv: VehicleState, ego: VehicleState) -> float:
        """Risk of a vehicle that drives our way; less where no lane is free to come from."""
        if bv.speed < 2.0:
            return 0.0
        wanted = {"leader": 12.0, "follower": -10.0, "neighbour": 3.0}[relation]
        closing = 0.5 * (bv.speed - ego.speed)
        risk = math.exp(-abs(s + closing * 2.0 - wanted) / 35.0)
        if relation == "neighbour":
            return risk if abs(d) < 5.0 else 0.7 * risk
        same = [o for o, kind in self.road.side_offsets(bv.lane, bv.x, bv.y, bv.heading) if kind == "same"]
        return (0.8 if same else 0.42) * risk


def _oncoming(s: float, closing: float) -> float:
    """Risk of oncoming traffic: best 3 to 5 s before the two meet."""
    time = s / max(closing, 0.1)
    return 0.9 * math.exp(-max(0.0, abs(time - 4.0) - 1.0) / 1.5) if 1.8 < time < 10.0 else 0.0


def _meeting(way: ReferencePath, bv: VehicleState, ego: VehicleState) -> float:
    """Risk at a conflict point: both can be there at about the same time, the BV at the latest 0.2 s after the ego."""
    conflict = way.conflict
    assert conflict is not None
    if conflict.bv_s < 1.0 or conflict.ego_s < 1.0:
        return 0.0
    ego_time = conflict.ego_s / max(ego.speed, 1.0)
    v, a = max(bv.speed, 0.1), FASTEST_START
    earliest = (-v + math.sqrt(v * v + 2 * a * conflict.bv_s)) / a
    now = conflict.bv_s / max(bv.speed, 1.5)
    if not CONFLICT_TIMES[0] < ego_time < CONFLICT_TIMES[1] or earliest > ego_time + LATEST:
        return 0.0
    return 0.95 * math.exp(-max(0.0, abs(now - ego_time) - 0.5) / 4.0) * math.exp(-max(0.0, ego_time - 5.0) / 4.0)


def ego_path(road: RoadMap, drive: Drive) -> Path | None:
    """The path of the ego's lanes ahead along its route, or the one that a log moves it along; None off the road."""
    assert drive.ego is not None
    ego = drive.state(drive.ego)
    if drive.replayed():
        return logged_path(road, drive)
    if ego.lane not in road.lanes:
        return None
    edges, at = drive.simulation.route(drive.ego)
    position = drive.simulation.lane_position(drive.ego) - ego.length / 2
    ways = road.ways(ego.lane, position, REACH, edges[max(at, 0) :])
    return ways[0].path if ways else None


def logged_path(road: RoadMap, drive: Drive) -> Path | None:
    """Where a log takes the ego, and on along its route; None where that is no way at all."""
    assert drive.ego is not None and drive.playback is not None
    points = drive.playback.ahead(drive.ego, drive.now)
    if len(points) < 2 or float(np.hypot(*np.diff(points, axis=0).T).sum()) < LEAST_WAY:
        return None
    path = make_path(points)
    found = road.lane_at(float(path.x[-1]), float(path.y[-1]), float(path.heading[-1]))
    ways = road.ways(*found, REACH, drive.route()) if found is not None else []
    if ways:
        onward = np.column_stack([ways[0].path.x, ways[0].path.y])
        path = make_path(np.vstack([points, onward[4:]]))  # 2 m on: no fold where the log is off the centre
    return path if path.length > REACH else path.extended(REACH - path.length)


def bv_ways(road: RoadMap, drive: Drive, bv: VehicleState, path: Path) -> tuple[ReferencePath, ...]:
    """All ways on of a vehicle, each related to the ego's path."""
    position = drive.simulation.lane_position(bv.id) - bv.length / 2
    return tuple(relate(w.path, w.movement, w.junction, w.gives_way, path) for w in road.ways(bv.lane, position, REACH))
