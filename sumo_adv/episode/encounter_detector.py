"""Detect when an attack may begin, and which few background vehicles could carry it out, from the states up to now.

Every half second, the vehicles near the ego are placed relative to its path: ahead, behind, beside, oncoming, crossing
or merging. Vehicles that cannot meet the ego in time are dropped. The others get a risk in [0, 1]. An encounter begins
when the highest risk is at least ``RISK_ON`` and is still at least ``RISK_OFF`` at the next look. In a recording, each
later look ranks the vehicles that could begin an attack then, whatever their risk.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.config_odd import Odd
from sumo_adv.datatypes import Floats, Relation, VehicleState
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.ego_place import front_on, lane_on_route
from sumo_adv.episode.road_place import place_of
from sumo_adv.episode.unprotected import STANDING_SPEED_M_S, crossing_risk, may_attack, unprotected_ways
from sumo_adv.geometry import Path, make_path, same_layer, wrap
from sumo_adv.road_users import RoadUser, is_motorcycle, is_unprotected, road_user
from sumo_adv.simulation.network import PathAhead, RoadMap
from sumo_adv.simulation.permissions import MOTOR
from sumo_adv.situation import MEET_AHEAD, ReferencePath, relate

RISK_ON, RISK_OFF, LOOKS_ABOVE = 0.40, 0.30, 2  # risk of the first look, of the next ones, and number of looks
LOOK_INTERVAL_S = 0.5  # s
COOL_DOWN_S = 2.0  # s after an encounter that was passed over in which no other one begins
NEAR_DISTANCE_M, ONCOMING_DISTANCE_M = 70.0, 320.0  # m; the latter holds ahead and for other headings
WAY_AHEAD_M = 330.0  # m; length of the ways ahead
MIN_EGO_SPEED_M_S = 4.0  # m/s; a slower ego has no encounter, except in a recording
MIN_SAME_WAY_SPEED_M_S = 2.0  # m/s; a slower vehicle on the ego's way has no risk, except in a recording or if named
STANDING_AHEAD_S = 10.0  # s of the ego's driving; a named vehicle that stands on its path may be so far ahead
MAX_START_ACCELERATION_M_S2 = 3.0  # m/s2; acceleration of a BV that hurries to a conflict
MAX_LATER_ARRIVAL_S = 0.2  # s; how much later than the ego a BV may arrive at a conflict
CONFLICT_TIMES_S = (1.5, 12.0)  # s from now until the ego is at the conflict
SAME_LANE_OFFSET_M = 1.2  # m
MIN_LOGGED_WAY_M = 1.0  # m; a shorter log shows no path
BESIDE_OFFSET_M = 8.5  # m
ONCOMING_ANGLE_RAD = 2.64  # rad between the headings of the ego and of oncoming traffic, at least
BEHIND_DISTANCE_M = 45.0  # m behind the ego, for vehicles on the ego's path
AHEAD_DISTANCE_M = 60.0  # m ahead of the ego, for vehicles on its path
FAR_AHEAD_DISTANCE_M = 100.0  # m; the same if no vehicle is ranked otherwise


@dataclass(frozen=True, slots=True)
class RankedVehicle:
    """A BV that could be the adversary.

    Attributes:
        id: Its id.
        relation: Its relation to the ego.
        risk: Its risk in [0, 1].
        ways: The ways that it can take from here.
        lane: The id of its lane.
    """

    id: str
    relation: str
    risk: float
    ways: tuple[ReferencePath, ...]
    lane: str

    @property
    def meets_ahead(self) -> bool:
        """Whether it can meet the ego only where their paths cross or merge."""
        return self.relation in MEET_AHEAD or any(way.movement == "across" for way in self.ways)


class EncounterDetector:
    """Watches one ego. Call ``look`` every half second.

    Attributes:
        road: The map.
        shortlist: The maximum number of ranked vehicles.
        only: The vehicles that may attack.
        kinds: The relations that they may have.
        odd: The ODD.
        best: The highest risk at any look.
    """

    def __init__(
        self, road: RoadMap, shortlist: int, only: tuple[str, ...] = (), kinds: tuple[str, ...] = (), *,
        recorded: bool = False, odd: Odd | None = None,
    ) -> None:  # fmt: skip
        """Start before the first look.

        Args:
            road: The map.
            shortlist: The maximum number of ranked vehicles.
            only: The vehicles that may attack; empty allows all.
            kinds: The relations to the ego that they may have; empty allows all.
            recorded: Whether the ego and the traffic are recorded, so that they may be slow.
            odd: The ODD outside which no encounter begins; None allows all places.
        """
        self.road, self.shortlist, self.only, self.kinds, self.odd = road, shortlist, only, kinds, odd
        self.best, self._looks, self._recorded = 0.0, 0, recorded
        self._slowest = 0.0 if recorded else MIN_EGO_SPEED_M_S
        self._path = self._moved = self._near_one = False  # seen at some look: a path, a moving ego, a vehicle
        self._outside = False  # the ego or a vehicle near was outside the ODD at some look

    def look(self, drive: Drive) -> list[RankedVehicle] | None:
        """Look for an encounter that begins now.

        Args:
            drive: The simulation with the ego.

        Returns:
            The ranking, highest risk first, if an encounter begins now; otherwise None.
        """
        ranking = self.rank(drive)
        top = ranking[0].risk if ranking else 0.0
        self.best = max(self.best, top)
        self._looks = self._looks + 1 if top >= RISK_ON or (self._looks and top >= RISK_OFF) else 0
        return ranking if self._looks >= LOOKS_ABOVE else None

    def rank(self, drive: Drive) -> list[RankedVehicle]:
        """Return the vehicles that could attack.

        Args:
            drive: The simulation with the ego.

        Returns:
            At most ``shortlist`` vehicles, highest risk first. Empty if the ego is off the road or too slow; an ego of
            a recording may stand.
        """
        assert drive.ego is not None
        ego = drive.state(drive.ego)
        path = ego_path(self.road, drive)
        self._path |= path is not None
        self._moved |= ego.speed >= self._slowest
        if path is None or ego.speed < self._slowest:
            return []
        names = self._near(drive, ego)
        self._near_one |= bool(names)
        placed = self._placed(drive, names, ego, path, AHEAD_DISTANCE_M) or self._placed(
            drive, names, ego, path, FAR_AHEAD_DISTANCE_M
        )
        if self.odd is not None and placed:
            placed = self._inside(self.odd, drive, placed)
        return sorted(placed, key=lambda c: (-c.risk, c.id))[: self.shortlist]

    def _inside(self, odd: Odd, drive: Drive, placed: list[RankedVehicle]) -> list[RankedVehicle]:
        """Return the vehicles that the ODD lets attack here."""
        inside = odd.contains(place_of(self.road, drive))
        kept = [c for c in placed if inside and odd.has_relation(c.relation)]
        self._outside |= len(kept) < len(placed)
        return kept

    @property
    def needed(self) -> str:
        """What was missing for an encounter, in words."""
        if self.best >= RISK_ON:
            missed = f"it did not last until the next look, {LOOK_INTERVAL_S:g} s later"
            return f"a risk of {self.best:.2f} was seen, but {missed}"
        return f"highest risk seen {self.best:.2f}, {RISK_ON:.2f} is needed"

    @property
    def outside(self) -> str:
        """A sentence if the ODD kept vehicles from attacking; otherwise empty."""
        return "The ODD kept vehicles from attacking." if self._outside else ""

    @property
    def missing(self) -> str:
        """What kept the ego from an encounter, as a sentence."""
        if self.outside:
            return self.outside
        if not self._path:
            return "The ego is on no road, or does not move in the rest of its log."
        if not self._near_one:
            return f"No vehicle comes within {NEAR_DISTANCE_M:.0f} m of the ego."
        if not self._moved:
            return f"The ego is never faster than {self._slowest:g} m/s, and no vehicle can reach it where it stands."
        return "No vehicle near the ego can reach its path in time."

    def _placed(
        self, drive: Drive, names: Sequence[str], ego: VehicleState, path: Path, ahead: float
    ) -> list[RankedVehicle]:
        """Rank the vehicles with a risk; those on the ego's path may be ``ahead`` [m] of it at most."""
        placed = [self._place(drive, name, ego, path, ahead) for name in names]
        return [c for c in placed if c is not None and c.risk > 0 and (not self.kinds or c.relation in self.kinds)]

    def _near(self, drive: Drive, ego: VehicleState) -> list[str]:
        """Return the vehicles that are near enough, and of a kind that may attack."""
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
            if distance < (ONCOMING_DISTANCE_M if far else NEAR_DISTANCE_M) and (small or drive.kind(name) in MOTOR):
                names.append(name)
        return names

    def _place(self, drive: Drive, name: str, ego: VehicleState, path: Path, ahead: float) -> RankedVehicle | None:
        """Rank a vehicle by its relation to the ego's path; return None if it has no relation or no way."""
        bv = drive.state(name)
        if is_unprotected(bv):
            on_lane = bv.id not in drive.obstacles and bv.lane in self.road.lanes
            ways = unprotected_ways(bv, path, _ways(self.road, drive, bv) if on_lane else ())
            stands_to = Relation.ONCOMING if _rides_against(bv, ego, path) else Relation.CROSSING
            return RankedVehicle(name, stands_to, crossing_risk(ways, bv, ego), ways, bv.lane)
        if bv.lane not in self.road.lanes:
            return None
        s, d = path.project(bv.x, bv.y)
        level = bool(same_layer(bv.z, path.height(s)))
        turned = abs(wrap(bv.heading - float(path.at(np.asarray(s))[2])))
        place = drive.place(self.road)
        own_edge = place is not None and self.road.lanes[bv.lane].edge == place.lane.edge
        relation, risk = "", 0.0
        near = abs(d) < SAME_LANE_OFFSET_M
        if level and turned < 0.5 and (near or (own_edge and abs(d) < BESIDE_OFFSET_M)):
            in_line = near and not (is_motorcycle(bv) and _passes(bv, d, ego, path))
            relation = ("leader" if s > 0 else "follower") if in_line else "neighbour"
            if name in self.only and bv.speed < MIN_SAME_WAY_SPEED_M_S:
                ahead = max(ahead, STANDING_AHEAD_S * ego.speed)
            if -BEHIND_DISTANCE_M < s < ahead:
                risk = self._same_way_risk(relation, s, d, bv, ego, drive.kind(name))
        elif level and turned > ONCOMING_ANGLE_RAD and 1.2 < self.road.hand * d < BESIDE_OFFSET_M and s > 0:
            sides = self.road.side_offsets(bv.lane, bv.x, bv.y, bv.heading)
            if any(kind == "opposite" for _, kind in sides):  # only a line separates the two
                relation, risk = "oncoming", _oncoming_risk(s, bv.speed + ego.speed)
        if relation in ("leader", "follower", "neighbour") and risk == 0.0:
            return None
        onward = _ways(self.road, drive, bv)
        ways = tuple(relate(w.path, w.movement, w.junction, w.gives_way, path) for w in onward)
        if relation in ("", "oncoming"):
            meeting = [(w.conflict.kind, _conflict_risk(w, bv, ego)) for w in ways if w.conflict is not None]
            kind, best = max(meeting, key=lambda m: m[1], default=("", 0.0))
            if best > risk:
                relation, risk = (relation or kind), best
        return RankedVehicle(name, relation, risk, ways, bv.lane) if relation and ways else None

    def _same_way_risk(
        self, relation: str, s: float, d: float, bv: VehicleState, ego: VehicleState, vclass: str
    ) -> float:
        """Rate the risk of a vehicle that drives the ego's way.

        It is lower for a leader or follower that has no lane beside its own, and for a neighbour 5 m or more to the
        side of the ego's path.
        """
        if bv.speed < MIN_SAME_WAY_SPEED_M_S and not self._recorded and bv.id not in self.only:
            return 0.0
        best_gap = {"leader": 12.0, "follower": -10.0, "neighbour": 3.0}[relation]
        closing = 0.5 * (bv.speed - ego.speed)
        risk = math.exp(-abs(s + closing * 2.0 - best_gap) / 35.0)
        if relation == "neighbour":
            return risk if abs(d) < 5.0 else 0.7 * risk
        sides = self.road.side_offsets(bv.lane, bv.x, bv.y, bv.heading, vclass)
        same = [o for o, kind in sides if kind == "same"]
        return (0.8 if same else 0.42) * risk


def _rides_against(bv: VehicleState, ego: VehicleState, path: Path) -> bool:
    """Return whether a cyclist comes towards the ego, by its heading now or by that of its path beside the cyclist."""
    s, _ = path.project(bv.x, bv.y)
    headings = (ego.heading, float(path.at(np.asarray(s))[2]))
    against = any(abs(wrap(bv.heading - heading)) > ONCOMING_ANGLE_RAD for heading in headings)
    return s > 0 and against and bv.speed >= STANDING_SPEED_M_S and road_user(bv) is RoadUser.CYCLIST


def _passes(bv: VehicleState, d: float, ego: VehicleState, path: Path) -> bool:
    """Return whether a vehicle ``d`` [m] to the left of the ego's path has room to pass the ego as the ego drives."""
    return abs(d - path.project(ego.x, ego.y)[1]) > (bv.width + ego.width) / 2


def _oncoming_risk(s: float, closing: float) -> float:
    """Rate the risk of oncoming traffic; it is highest 3 to 5 s before the two meet."""
    time = s / max(closing, 0.1)
    return 0.9 * math.exp(-max(0.0, abs(time - 4.0) - 1.0) / 1.5) if 1.8 < time < 10.0 else 0.0


def _conflict_risk(way: ReferencePath, bv: VehicleState, ego: VehicleState) -> float:
    """Rate the risk at a conflict: high if both arrive at about the same time, 0 if the BV cannot arrive in time."""
    conflict = way.conflict
    assert conflict is not None
    if conflict.bv_s < 1.0 or conflict.ego_s < 1.0:
        return 0.0
    ego_time = conflict.ego_s / max(ego.speed, 1.0)
    v, a = max(bv.speed, 0.1), MAX_START_ACCELERATION_M_S2
    earliest = (-v + math.sqrt(v * v + 2 * a * conflict.bv_s)) / a
    arrival = conflict.bv_s / max(bv.speed, 1.5)
    if not CONFLICT_TIMES_S[0] < ego_time < CONFLICT_TIMES_S[1] or earliest > ego_time + MAX_LATER_ARRIVAL_S:
        return 0.0
    return 0.95 * math.exp(-max(0.0, abs(arrival - ego_time) - 0.5) / 4.0) * math.exp(-max(0.0, ego_time - 5.0) / 4.0)


def vehicles_of(kinds: Sequence[str]) -> str:
    """Name the vehicles that may attack, such as ``oncoming or crossing vehicle``.

    Args:
        kinds: The relations to the ego that they may have.
    """
    return f"{' or '.join(kinds)} vehicle".strip()


def ego_path(road: RoadMap, drive: Drive) -> Path | None:
    """Return the ego's path ahead.

    Args:
        road: The map.
        drive: The simulation with the ego.

    Returns:
        The path of the lanes along the ego's route, or of its log if the log moves it. None if the ego is off the road,
        or if its log is too short.
    """
    assert drive.ego is not None
    ego = drive.state(drive.ego)
    if drive.replayed():
        return logged_path(road, drive)
    place = drive.place(road)
    if place is None:
        return None
    ways = road.ways(
        place.lane.id,
        place.front - ego.length / 2,
        WAY_AHEAD_M,
        place.route,
        vclass=drive.kind(ego.id),
        closed=drive.closed,
    )
    return ways[0].path if ways else None


def _ways(road: RoadMap, drive: Drive, vehicle: VehicleState) -> list[PathAhead]:
    """Return all ways of a vehicle along its lane or, if it overtakes on the opposite lane, along its own."""
    vclass = drive.kind(vehicle.id)
    lane = lane_on_route(road, vehicle, (), vclass)
    if lane is None:
        return []
    return road.ways(
        lane.id, front_on(lane, vehicle, drive.simulation) - vehicle.length / 2, WAY_AHEAD_M, vclass=vclass
    )


def logged_path(road: RoadMap, drive: Drive) -> Path | None:
    """Return the rest of the ego's log, continued along its route.

    Args:
        road: The map.
        drive: The simulation with the ego.

    Returns:
        The path; None if the log is too short.
    """
    assert drive.ego is not None and drive.playback is not None
    points = drive.playback.ahead(drive.ego, drive.now)
    if road.heights is not None:
        points = road.heights.along(points, drive.state(drive.ego).z)
    if len(points) < 2 or float(np.hypot(*np.diff(points[:, :2], axis=0).T).sum()) < MIN_LOGGED_WAY_M:
        return None
    path = make_path(points)
    vclass, z = drive.kind(drive.ego), float(path.height(path.length))
    last = road.lane_at(float(path.x[-1]), float(path.y[-1]), float(path.heading[-1]), vclass, z)
    return continued(points, road.ways(*last, WAY_AHEAD_M, drive.route(), vclass=vclass) if last is not None else ())


def continued(points: Floats, ways: Sequence[PathAhead]) -> Path:
    """Return the path through points, continued along the first of the ways.

    Args:
        points: The points, ``(n, 2)``, or ``(n, 3)`` with heights [m].
        ways: The ways that begin at the last point; without any, the path goes straight on.

    Returns:
        The path, at least ``WAY_AHEAD_M`` long.
    """
    if ways:
        way = ways[0].path
        onward = np.column_stack([way.x, way.y, np.broadcast_to(way.z, way.x.shape)])[:, : points.shape[1]]
        points = np.vstack([points, onward[4:]])  # from 2 m on, so that no fold arises if the points are off the centre
    path = make_path(points)
    return path if path.length > WAY_AHEAD_M else path.extended(WAY_AHEAD_M - path.length)
