"""The situation at a trigger: what planners, trajectories and predictions need to know of it, in arrays.

It is made once an encounter from the road, the states up to the trigger and an unattacked run forked there, and is
small enough to be sent between processes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Bools, DriverModel, Floats, Track, VehicleState
from sumo_adv.geometry import PATH_STEP_M, Frame, Path, same_layer, wrap
from sumo_adv.road_users import UNPROTECTED_SPEEDS_M_S, RoadUser, road_user

MIN_CROSSING_ANGLE_RAD = 0.35  # paths that meet at less merge
NO_ARRIVAL_S = 1e3  # an arrival that is never

Signal = tuple[str, float, str]
"""A traffic light ahead of a vehicle: id, distance from its front bumper [m], SUMO's state letter (r, y, g, G ...)."""


@dataclass(frozen=True, slots=True)
class PathConflict:
    """Where a way of the BV meets the path of the ego: stations of both [m], the BV's pose there, the angle [rad]."""

    kind: str  # crossing | merging
    movement: str  # straight | left | right | none
    bv_s: float
    ego_s: float
    x: float
    y: float
    heading: float
    angle: float


@dataclass(frozen=True, slots=True)
class ReferencePath:
    """One path that a BV may take, with its place relative to the ego's path at every sample.

    ego_s, ego_d, ego_h: station [m], offset [m] and relative heading [rad] in the ego path's frame, ``(n,)``.
    ``before_ego``: whether a vehicle on this path goes before an ego that has to give way, by SUMO's rules.
    ``bay``: station [m] at which a turning vehicle waits on the junction for others, which ignore it there; inf if
    there is none.
    """

    path: Path
    movement: str
    junction: float
    gives_way: bool
    ego_s: Floats
    ego_d: Floats
    ego_h: Floats
    conflict: PathConflict | None
    before_ego: bool = True
    bay: float = math.inf


def mirrored(movement: str, hand: float) -> str:
    """The movement in right-hand traffic that one of ``hand`` (``Frame.hand``) mirrors."""
    return {"left": "right", "right": "left"}.get(movement, movement) if hand < 0 else movement


def fastest_of(speed: float) -> float:
    """The highest speed [m/s] of a BV that has ``speed`` at the trigger: 40 % or 5 m/s more, whichever is more."""
    return max(1.4 * speed, speed + 5.0)


def top_speed(state: VehicleState) -> float:
    """The highest speed [m/s] that a BV goes for: of a vehicle by its speed at the trigger, else that of its kind."""
    return UNPROTECTED_SPEEDS_M_S.get(road_user(state)) or fastest_of(state.speed)


MEET_AHEAD = ("crossing", "merging")  # relations of vehicles that the ego can meet only where their paths meet


@dataclass(frozen=True, slots=True)
class Target:
    """A background vehicle that could be the adversary. Its ways begin where it is at the trigger."""

    state: VehicleState
    relation: str  # leader | follower | neighbour | oncoming | crossing | merging
    ways: tuple[ReferencePath, ...]
    station: float  # m along its ways, about 0
    offset: float  # m from its way
    turn: float  # rad, its heading against its way's
    sides: tuple[tuple[float, str], ...]  # lanes beside it: offset [m], "same" | "opposite"
    risk: float = 0.0
    unattacked: int | None = None  # the index of its path without an attack, None if that is unknown
    hidden: bool = False  # whether other boxes hide it from the ego
    hand: float = 1.0  # -1 in left-hand traffic

    @property
    def fastest(self) -> float:
        """The speed it goes for at most [m/s]."""
        return top_speed(self.state)

    def applies(self) -> tuple[str, ...]:
        """Words an intent's ``applies`` list is matched with; of a pedestrian or cyclist the kind, and whether it is
        hidden from the ego."""
        user = road_user(self.state)
        if user is not RoadUser.VEHICLE:
            return (str(user), f"{user}_hidden") if self.hidden else (str(user),)
        words = {self.relation} - set(MEET_AHEAD)  # these are said by the ways that do meet the ego's path
        for way in self.ways:
            if way.conflict is not None:
                movement = "straight" if way.movement in ("none", "u-turn") else mirrored(way.movement, self.hand)
                words.add("merging" if way.conflict.kind == "merging" else f"crossing_{movement}")
        return tuple(sorted(words))


@dataclass(frozen=True, slots=True)
class OnPath:
    """A vehicle's unattacked motion in the ego path's frame by step from the trigger: station s, offset d of its centre
    [m], heading [rad], speed [m/s], each ``(n,)``, nan while it is not there, or on another layer; its length [m]."""

    id: str
    s: Floats
    d: Floats
    heading: Floats
    speed: Floats
    length: float


@dataclass(frozen=True, slots=True)
class Baseline:
    """The ego without an attack: its path, its driver's model, and by step of ``dt`` from the trigger on its station
    ``s`` [m], speed ``v`` [m/s] and acceleration ``a`` [m/s2], each ``(n,)``."""

    path: Path
    s: Floats
    v: Floats
    a: Floats
    model: DriverModel


@dataclass(frozen=True, slots=True)
class RoadAhead:
    """The road along the ego's path. Stations are those of the path [m], inf where there is none.

    sides: lanes beside the ego's lane: offset [m, left positive], "same" | "opposite". junction: station at which the
    next junction begins; later: stations of the junctions behind it. bay: station at which the ego waits on the next
    junction where it gives way (SUMO's internal junction). rule: SUMO's letter for the ego's right of way there
    (``Connection.state``), empty if there is no junction.
    """

    lane_width: float
    sides: tuple[tuple[float, str], ...] = ()
    junction: float = math.inf
    later: tuple[float, ...] = ()
    bay: float = math.inf
    rule: str = ""


@dataclass(frozen=True, slots=True)
class Traffic:
    """The vehicles near the ego.

    others: their motions without an attack from the trigger on. ahead: those that are ahead of the ego at some time, in
    its lane or beside it. history: all motions over the last second or so, the ego's first. signals: by vehicle (the
    ego and targets) the traffic lights ahead at the start of the encounter, nearest first. reacting: whether drivers
    move the others and brake for an adversary; False where a log moves them.
    """

    others: tuple[Track, ...] = ()
    ahead: tuple[OnPath, ...] = ()
    history: tuple[Track, ...] = ()
    signals: Mapping[str, tuple[Signal, ...]] = field(default_factory=dict)
    reacting: bool = True


@dataclass(frozen=True, slots=True)
class Situation:
    """The scene at one start time: the ego, the road ahead of it, the traffic near, and the possible adversaries.

    time: simulated time [s]; dt: step [s]; horizon: how far planners look ahead [s]. frame: the ego's pose, in which
    planners get positions. left: steps until a log that is played back is over, inf without one.
    """

    time: float
    dt: float
    horizon: float
    frame: Frame
    ego: VehicleState
    baseline: Baseline
    road: RoadAhead
    traffic: Traffic
    targets: Mapping[str, Target]
    left: float = math.inf

    def target_list(self) -> list[Target]:
        """Targets, most dangerous first."""
        return sorted(self.targets.values(), key=lambda t: (-t.risk, t.state.id))


def on_path(track: Track, time: float, dt: float, steps: int, path: Path) -> OnPath:
    """A track in the frame of the ego's ``path``, for ``steps`` steps from ``time``."""
    s, d, heading, speed = np.full((4, steps), math.nan)
    k = np.round((track.time - time) / dt).astype(np.intp)
    within = (k >= 0) & (k < steps) & level_with(track, path)
    x, y = track.x[within], track.y[within]
    i = _nearest(x, y, path)
    cos, sin = np.cos(path.heading[i]), np.sin(path.heading[i])
    dx, dy = x - path.x[i], y - path.y[i]
    s[k[within]], d[k[within]] = i * PATH_STEP_M + cos * dx + sin * dy, cos * dy - sin * dx
    heading[k[within]], speed[k[within]] = wrap(track.heading[within] - path.heading[i]), track.speed[within]
    return OnPath(track.id, s, d, heading, speed, track.length)


def level_with(track: Track, path: Path) -> Bools:
    """At which states ``(n,)`` a vehicle is on the layer of a path, where it is nearest to it."""
    if not np.ndim(track.z) and not np.ndim(path.z):
        return np.ones(len(track.time), bool)
    return np.asarray(same_layer(track.z, heights_along((path,), track.x, track.y)))


def heights_along(paths: Sequence[Path], x: Floats, y: Floats) -> Floats | float:
    """The heights [m] at points ``(n,)`` of the path that is nearest to each; a number where all is flat."""
    if not any(np.ndim(path.z) for path in paths):
        return paths[0].z
    nearest, heights = np.full(len(x), np.inf), np.zeros(len(x))
    for path in paths:
        i = _nearest(x, y, path)
        away = np.hypot(path.x[i] - x, path.y[i] - y)
        heights = np.where(away < nearest, np.broadcast_to(path.z, path.x.shape)[i], heights)
        nearest = np.minimum(nearest, away)
    return heights


def relate(path: Path, movement: str, junction: float, gives_way: bool, ego_path: Path) -> ReferencePath:
    """Describe a way relative to the ego's path and find where they meet."""
    nearest = _nearest(path.x, path.y, ego_path)
    ex, ey, eh = ego_path.x[nearest], ego_path.y[nearest], ego_path.heading[nearest]
    along = np.cos(eh) * (path.x - ex) + np.sin(eh) * (path.y - ey)
    d = -np.sin(eh) * (path.x - ex) + np.cos(eh) * (path.y - ey)
    s = nearest * PATH_STEP_M + along
    h = wrap(path.heading - eh)
    return ReferencePath(path, movement, junction, gives_way, s, d, h, _conflict(path, movement, s, d, h, ego_path))


COARSE_STRIDE = 8  # samples of the ego's path between those that are looked at first
POINTS_PER_BLOCK = 64  # larger arrays would be new memory every time, which costs more than the sums


def _nearest(x: Floats, y: Floats, ego_path: Path) -> NDArray[np.intp]:
    """For each point the nearest sample of the ego's path: first every eighth, then those around the best."""
    px, py = ego_path.x[::COARSE_STRIDE], ego_path.y[::COARSE_STRIDE]
    around, last = np.arange(-COARSE_STRIDE, COARSE_STRIDE + 1), len(ego_path.x) - 1
    indices = np.empty(len(x), np.intp)
    for k in range(0, len(x), POINTS_PER_BLOCK):
        bx, by = x[k : k + POINTS_PER_BLOCK, None], y[k : k + POINTS_PER_BLOCK, None]
        first = ((bx - px) ** 2 + (by - py) ** 2).argmin(axis=1)
        near = np.minimum(np.maximum(first[:, None] * COARSE_STRIDE + around, 0), last)
        best = ((bx - ego_path.x[near]) ** 2 + (by - ego_path.y[near]) ** 2).argmin(axis=1)
        indices[k : k + POINTS_PER_BLOCK] = near[np.arange(len(near)), best]
    return indices


def _conflict(path: Path, movement: str, s: Floats, d: Floats, h: Floats, ego: Path) -> PathConflict | None:
    inside = (s > 1.0) & (s < ego.length - 1.0)
    if np.ndim(path.z) or np.ndim(ego.z):
        inside &= same_layer(path.z, ego.height(s))
    crossing = (d[:-1] * d[1:] <= 0) & (np.abs(d[:-1] - d[1:]) < 1.5) & (np.abs(h[:-1]) > MIN_CROSSING_ANGLE_RAD)
    crossing &= (np.abs(h[:-1]) < np.pi - MIN_CROSSING_ANGLE_RAD) & inside[:-1]
    apart = np.maximum.accumulate((np.abs(d) > 2.0) & (np.abs(h) < 2.6))
    merging = (np.abs(d) < 0.8) & (np.abs(h) < MIN_CROSSING_ANGLE_RAD) & inside & apart
    i_cross = int(np.argmax(crossing)) if crossing.any() else len(d)
    i_merge = int(np.argmax(merging)) if merging.any() else len(d)
    i = min(i_cross, i_merge)
    if i >= len(d):
        return None
    kind = "crossing" if i == i_cross else "merging"
    here = (float(values[i]) for values in (s, path.x, path.y, path.heading, h))
    return PathConflict(kind, movement, i * PATH_STEP_M, *here)
