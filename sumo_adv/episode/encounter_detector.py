"""Says when an attack may begin, and which few background vehicles could carry it out, from the states up to now.

Every half second the vehicles near the ego are placed relative to its path: ahead, behind, beside, oncoming, crossing
or merging.  Vehicles that cannot meet the ego in time are dropped.  The others get a risk in [0, 1].  An encounter
begins when the highest risk is at least ``ON`` and the next look finds at least ``OFF``. In a recording each later
look tells which vehicles could begin an attack then, whatever their risk.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.config_odd import Odd
from sumo_adv.datatypes import Relation, VehicleState
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.encounter_place import place_of
from sumo_adv.episode.unprotected import crossing_risk, may_attack, unprotected_ways
from sumo_adv.geometry import Path, make_path, wrap
from sumo_adv.road_users import is_unprotected
from sumo_adv.simulation.network import RoadMap
from sumo_adv.situation import MEET_AHEAD, ReferencePath, relate

ON, OFF, LOOKS = 0.40, 0.30, 2
LOOK_EVERY = 0.5  # s
NEAR, ONCOMING_NEAR = 70.0, 320.0  # m
REACH = 330.0  # m of the ways ahead
SLOWEST_EGO = 4.0  # m/s: an ego that stands has no encounter
SLOWEST_SAME_WAY = 2.0  # m/s: of a vehicle that drives the ego's way
FASTEST_START = 3.0  # m/s2: acceleration of a BV that hurries to a conflict
LATEST = 0.2  # s: how much later than the ego a BV may arrive at a conflict
CONFLICT_TIMES = (1.5, 12.0)  # s from now until the ego is at the conflict
SAME_LANE = 1.2  # m
LEAST_WAY = 1.0  # m: a shorter log shows no path
BESIDE = 8.5  # m
BEHIND = 45.0  # m behind the ego, for vehicles on the ego's path
AHEAD, FAR_AHEAD = 60.0, 100.0  # m ahead of the ego, for such vehicles; the second if no other vehicle is ranked
CLASSES = frozenset(
    {"passenger", "private", "taxi", "delivery", "truck", "trailer", "bus", "coach", "evehicle", "custom1"}
)


@dataclass(frozen=True, slots=True)
class RankedVehicle:
    """A BV that could be the adversary: its relation to the ego, its risk in [0, 1], its ways on, its lane."""

    id: str
    relation: str
    risk: float
    ways: tuple[ReferencePath, ...]
    lane: str

    @property
    def meets_ahead(self) -> bool:
        """Whether it can meet the ego only where their paths cross or merge."""
        return self.relation in MEET_AHEAD


@dataclass(slots=True)
class _Seen:
    """What was there at some look: a path of the ego, an ego that moves, a vehicle near."""

    path: bool = False
    moved: bool = False
    near: bool = False
    outside: bool = False  # the ego or a vehicle near, of the ODD


class EncounterDetector:
    """Watches one ego. Call ``look`` every half second."""

    def __init__(
        self, road: RoadMap, shortlist: int, only: tuple[str, ...] = (), kinds: tuple[str, ...] = (), *,
        recorded: bool = False, odd: Odd | None = None,
    ) -> None:  # fmt: skip
        """shortlist: maximum number of ranked vehicles; only: the vehicles that may attack; kinds: the relations to the
        ego that they may have. Both are empty for all. odd: no encounter begins outside it."""
        self.road = road
        self.shortlist = shortlist
        self.only, self.kinds = only, kinds
        self.odd = odd
        self.best = 0.0
        self._looks, self._recorded = 0, recorded
        self._slowest = 0.0 if recorded else SLOWEST_EGO
        self._seen = _Seen()

    def look(self, drive: Drive) -> list[RankedVehicle] | None:
        """The ranking, highest risk first, if an encounter begins now; else None."""
        ranking = self.rank(drive)
        top = ranking[0].risk if ranking else 0.0
        self.best = max(self.best, top)
        if top >= ON or (self._looks and top >= OFF):
            self._looks += 1
        else:
            self._looks = 0
        return ranking if self._looks >= LOOKS else None

    def rank(self, drive: Drive) -> list[RankedVehicle]:
        """The vehicles that could attack, highest risk first. Empty if the ego is off the road or too slow; an ego of a
        recording may stand."""
        assert drive.ego is not None
        ego = drive.state(drive.ego)
        path = ego_path(self.road, drive)
        self._seen.path |= path is not None
        self._seen.moved |= ego.speed >= self._slowest
        if path is None or ego.speed < self._slowest:
            return []
        names = self._near(drive, ego)
        self._seen.near |= bool(names)
        placed = self._placed(drive, names, ego, path, AHEAD) or self._placed(drive, names, ego, path, FAR_AHEAD)
        if self.odd is not None and placed:
            placed = self._inside(self.odd, drive, placed)
        return sorted(placed, key=lambda c: (-c.risk, c.id))[: self.shortlist]

    def _inside(self, odd: Odd, drive: Drive, placed: list[RankedVehicle]) -> list[RankedVehicle]:
        """Those of the vehicles that the ODD lets attack here."""
        inside = odd.contains(place_of(self.road, drive))
        kept = [c for c in placed if inside and odd.has_relation(c.relation)]
        self._seen.outside |= len(kept) < len(placed)
        return kept

    @property
    def needed(self) -> str:
        """What was missing for an encounter, in words."""
        if self.best >= ON:
            return (
                f"a risk of {self.best:.2f} was seen, but it did not last until the next look, {LOOK_EVERY:g} s later"
            )
        return f"highest risk seen {self.best:.2f}, {ON:.2f} is needed"

    @property
    def outside(self) -> str:
        """A sentence, if the ODD kept vehicles from attacking; else empty."""
        return "The ODD kept vehicles from attacking." if self._seen.outside else ""

    @property
    def missing(self) -> str:
        """What kept the ego from an encounter, in a sentence."""
        if self.outside:
            return self.outside
        if not self._seen.path:
            return "The ego is on no road, or does not move in what is left of its log."
        if not self._seen.near:
            return f"No vehicle comes within {NEAR:.0f} m of the ego."
        if not self._seen.moved:
            return f"The ego is never faster than {self._slowest:g} m/s, and no vehicle can reach it where it stands."
        return "No vehicle near the ego can reach its path in time."

    def _placed(
        self, drive: Drive, names: Sequence[str], ego: VehicleState, path: Path, ahead: float
    ) -> list[RankedVehicle]:
        """The vehicles with a risk. ``ahead``: how far ahead of the ego a vehicle on its path may be [m]."""
        placed = [self._place(drive, name, ego, path, ahead) for name in names]
        return [c for c in placed if c is not None and c.risk > 0 and (not self.kinds or c.relation in self.kinds)]

    def _near(self, drive: Drive, ego: VehicleState) -> list[str]:
        names, obstacles = [], drive.obstacles
        c, s = math.cos(ego.heading), math.sin(ego.heading)
        for name in drive.snapshot.raw:
            if name == ego.id or (self.only and name not in self.only):
                continue
            small = may_attack(drive, name, self.only)
            if name in obstacles and not small:
                continue
            x, y, heading = drive.pose(name)
            dx, dy = x - ego.x, y - ego.y
            distance = math.hypot(dx, dy)
            ahead = c * dx + s * dy > 0
            far = ahead or abs(wrap(heading - ego.heading)) > 0.5
            if distance < (ONCOMING_NEAR if far else NEAR) and (
                small or drive.simulation.vehicle_class(name) in CLASSES
            ):
                names.append(name)
        return names

    def _place(self, drive: Drive, name: str, ego: VehicleState, path: Path, ahead: float) -> RankedVehicle | None:
        bv = drive.state(name)
        if is_unprotected(bv):
            ways = small_ways(self.road, drive, bv, path)
            return RankedVehicle(name, Relation.CROSSING, crossing_risk(ways, bv, ego), ways, bv.lane)
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
            risk = self._same_way_risk(relation, s, d, bv, ego) if -BEHIND < s < ahead else 0.0
        elif turned > 2.64 and 1.2 < self.road.hand * d < BESIDE and s > 0:
            sides = self.road.side_offsets(bv.lane, bv.x, bv.y, bv.heading)
            if any(kind == "opposite" for _, kind in sides):  # only a line separates the two
                relation, risk = "oncoming", _oncoming_risk(s, bv.speed + ego.speed)
        if relation in ("leader", "follower", "neighbour") and risk == 0.0:
            return None
        ways = bv_ways(self.road, drive, bv, path)
        if relation in ("", "oncoming"):
            meeting = [(w.conflict.kind, _conflict_risk(w, bv, ego)) for w in ways if w.conflict is not None]
            kind, best = max(meeting, key=lambda m: m[1], default=("", 0.0))
            if best > risk:
                relation, risk = (relation or kind), best
        return RankedVehicle(name, relation, risk, ways, bv.lane) if relation and ways else None

    def _same_way_risk(self, relation: str, s: float, d: float, bv: VehicleState, ego: VehicleState) -> float:
        """Risk of a vehicle that drives the ego's way. It is lower if the vehicle has no lane beside its own."""
        if bv.speed < SLOWEST_SAME_WAY and not self._recorded:
            return 0.0
        best_gap = {"leader": 12.0, "follower": -10.0, "neighbour": 3.0}[relation]
        closing = 0.5 * (bv.speed - ego.speed)
        risk = math.exp(-abs(s + closing * 2.0 - best_gap) / 35.0)
        if relation == "neighbour":
            return risk if abs(d) < 5.0 else 0.7 * risk
        same = [o for o, kind in self.road.side_offsets(bv.lane, bv.x, bv.y, bv.heading) if kind == "same"]
        return (0.8 if same else 0.42) * risk


def _oncoming_risk(s: float, closing: float) -> float:
    """Risk of oncoming traffic: highest 3 to 5 s before the two meet."""
    time = s / max(closing, 0.1)
    return 0.9 * math.exp(-max(0.0, abs(time - 4.0) - 1.0) / 1.5) if 1.8 < time < 10.0 else 0.0


def _conflict_risk(way: ReferencePath, bv: VehicleState, ego: VehicleState) -> float:
    """Risk at a conflict point: high if both arrive at about the same time, 0 if the BV cannot arrive in time."""
    conflict = way.conflict
    assert conflict is not None
    if conflict.bv_s < 1.0 or conflict.ego_s < 1.0:
        return 0.0
    ego_time = conflict.ego_s / max(ego.speed, 1.0)
    v, a = max(bv.speed, 0.1), FASTEST_START
    earliest = (-v + math.sqrt(v * v + 2 * a * conflict.bv_s)) / a
    arrival = conflict.bv_s / max(bv.speed, 1.5)
    if not CONFLICT_TIMES[0] < ego_time < CONFLICT_TIMES[1] or earliest > ego_time + LATEST:
        return 0.0
    return 0.95 * math.exp(-max(0.0, abs(arrival - ego_time) - 0.5) / 4.0) * math.exp(-max(0.0, ego_time - 5.0) / 4.0)


def vehicles_of(kinds: Sequence[str]) -> str:
    """The vehicles that may attack, in words: ``oncoming or crossing vehicle``."""
    return f"{' or '.join(kinds)} vehicle".strip()


def ego_path(road: RoadMap, drive: Drive) -> Path | None:
    """The path of the ego's lanes along its route, or the path of its log; None off the road."""
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
    """The rest of the ego's log, continued along its route; None if the log is too short."""
    assert drive.ego is not None and drive.playback is not None
    points = drive.playback.ahead(drive.ego, drive.now)
    if len(points) < 2 or float(np.hypot(*np.diff(points, axis=0).T).sum()) < LEAST_WAY:
        return None
    path = make_path(points)
    last = road.lane_at(float(path.x[-1]), float(path.y[-1]), float(path.heading[-1]))
    ways = road.ways(*last, REACH, drive.route()) if last is not None else []
    if ways:
        onward = np.column_stack([ways[0].path.x, ways[0].path.y])
        path = make_path(np.vstack([points, onward[4:]]))  # 2 m on: no fold where the log is off the centre
    return path if path.length > REACH else path.extended(REACH - path.length)


def bv_ways(road: RoadMap, drive: Drive, bv: VehicleState, path: Path) -> tuple[ReferencePath, ...]:
    """All ways on of a vehicle, each related to the ego's path."""
    position = drive.simulation.lane_position(bv.id) - bv.length / 2
    return tuple(relate(w.path, w.movement, w.junction, w.gives_way, path) for w in road.ways(bv.lane, position, REACH))


def small_ways(road: RoadMap, drive: Drive, bv: VehicleState, path: Path) -> tuple[ReferencePath, ...]:
    """The ways of a pedestrian or cyclist, each related to the ego's path."""
    if bv.id in drive.obstacles or bv.lane not in road.lanes:
        return unprotected_ways(bv, path)
    return unprotected_ways(bv, path, road.ways(bv.lane, drive.simulation.lane_position(bv.id) - bv.length / 2, REACH))
