"""Describe the situation at a trigger in arrays, for planners, trajectories and predictions.

It is made once per encounter from the road, the states up to the trigger, and an unattacked run forked there. It is
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

MIN_CROSSING_ANGLE_RAD = 0.35  # paths that meet at a smaller angle merge
NO_ARRIVAL_S = 1e3  # stands in for an arrival that never happens

Signal = tuple[str, float, str]
"""A traffic light ahead of a vehicle: id, distance from its front bumper [m], SUMO's state letter (r, y, g, G ...)."""


@dataclass(frozen=True, slots=True)
class PathConflict:
    """The place at which a way of a BV meets the path of the ego.

    Attributes:
        kind: ``crossing`` or ``merging``.
        movement: The movement of the BV: ``straight``, ``left``, ``right`` or ``none``.
        bv_s: The station on the BV's way [m].
        ego_s: The station on the ego's path [m].
        x: The x of the BV's way at the place [m].
        y: The y of the BV's way at the place [m].
        heading: The heading of the BV's way at the place [rad].
        angle: The heading relative to the ego's path [rad].
    """

    kind: str
    movement: str
    bv_s: float
    ego_s: float
    x: float
    y: float
    heading: float
    angle: float


@dataclass(frozen=True, slots=True)
class ReferencePath:
    """A path that a BV may take, with its position relative to the ego's path at every sample.

    Attributes:
        path: The path.
        movement: The movement at the junction.
        junction: The station at which the junction begins [m].
        gives_way: Whether a vehicle on this path has to give way.
        ego_s: Stations on the ego's path [m], ``(n,)``.
        ego_d: Offsets from the ego's path [m], ``(n,)``.
        ego_h: Headings relative to the ego's path [rad], ``(n,)``.
        conflict: Where the path meets the ego's path; None if it does not.
        before_ego: Whether, by SUMO's rules, a vehicle on this path goes before an ego that has to give way.
        bay: The station at which a turning vehicle waits on the junction for others, which ignore it there [m]; inf if
            there is none.
        turn: The stations at which a way that leads back begins and ends its half turn [m]; None for other ways. A way
            that leads back and has no conflict is for scripts only.
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
    turn: tuple[float, float] | None = None


def mirrored(movement: str, hand: float) -> str:
    """Return the movement in right-hand traffic that corresponds to a movement.

    Args:
        movement: The movement.
        hand: The ``Frame.hand`` of the traffic in which it is made.
    """
    return {"left": "right", "right": "left"}.get(movement, movement) if hand < 0 else movement


def fastest_of(speed: float) -> float:
    """Return the highest speed of a BV with ``speed`` at the trigger [m/s]: 40 % or 5 m/s more, whichever is more."""
    return max(1.4 * speed, speed + 5.0)


def top_speed(state: VehicleState) -> float:
    """Return the highest speed that a BV goes for [m/s].

    For a vehicle, it depends on the speed at the trigger; for a pedestrian or a cyclist, on the kind.
    """
    return UNPROTECTED_SPEEDS_M_S.get(road_user(state)) or fastest_of(state.speed)


MEET_AHEAD = ("crossing", "merging")  # relations of vehicles that the ego can meet only at a conflict of paths


@dataclass(frozen=True, slots=True)
class Target:
    """A background vehicle that could be the adversary. Its ways begin at its position at the trigger.

    Attributes:
        state: The state at the trigger.
        relation: ``leader``, ``follower``, ``neighbour``, ``oncoming``, ``crossing`` or ``merging``.
        ways: The paths that it may take.
        station: Its station on its ways [m], about 0.
        offset: Its offset from its way [m].
        turn: Its heading relative to its way [rad].
        sides: The offset [m] of each lane beside it, and whether the lane has the ``same`` or the ``opposite``
            direction.
        risk: How dangerous it is, from 0 to 1.
        unattacked: The index of its path without an attack; None if it is unknown.
        hidden: Whether other boxes hide it from the ego.
        hand: 1, or -1 in left-hand traffic.
    """

    state: VehicleState
    relation: str
    ways: tuple[ReferencePath, ...]
    station: float
    offset: float
    turn: float
    sides: tuple[tuple[float, str], ...]
    risk: float = 0.0
    unattacked: int | None = None
    hidden: bool = False
    hand: float = 1.0

    @property
    def meets_ahead(self) -> bool:
        """Whether the ego can meet it only at a conflict of paths, as it does all pedestrians and cyclists."""
        return self.relation in MEET_AHEAD or road_user(self.state) is not RoadUser.VEHICLE

    @property
    def fastest(self) -> float:
        """The highest speed that it goes for [m/s]."""
        return top_speed(self.state)

    def applies(self) -> tuple[str, ...]:
        """Return the words that an intent's ``applies`` list is matched with.

        For a pedestrian or a cyclist, they are the kind, whether it is hidden from the ego, and whether the ego's path
        crosses the way on which a cyclist rides.
        """
        user = road_user(self.state)
        if user is not RoadUser.VEHICLE:
            onward = any(w.movement not in ("across", "back") and w.conflict is not None for w in self.ways)
            more = ("straight",) * (onward and user is RoadUser.CYCLIST) + ("hidden",) * self.hidden
            return (str(user), *(f"{user}_{word}" for word in more))
        words = {self.relation} - set(MEET_AHEAD)  # added below for the ways that do meet the ego's path
        for way in self.ways:
            if way.conflict is not None:
                movement = "straight" if way.movement in ("none", "u-turn") else mirrored(way.movement, self.hand)
                words.add("merging" if way.conflict.kind == "merging" else f"crossing_{movement}")
        return tuple(sorted(words))


@dataclass(frozen=True, slots=True)
class OnPath:
    """A vehicle's unattacked motion in the frame of the ego's path, by step from the trigger.

    Arrays are ``(n,)``. They are nan while the vehicle is not in the simulation, or on another layer.

    Attributes:
        id: The id of the vehicle.
        s: The station of its centre [m].
        d: The offset of its centre [m].
        heading: The heading relative to the path [rad].
        speed: The speed [m/s].
        length: The length of the vehicle [m].
    """

    id: str
    s: Floats
    d: Floats
    heading: Floats
    speed: Floats
    length: float


@dataclass(frozen=True, slots=True)
class Baseline:
    """The ego without an attack, by step of ``dt`` from the trigger on. Arrays are ``(n,)``.

    Attributes:
        path: The ego's path.
        s: The stations [m].
        v: The speeds [m/s].
        a: The accelerations [m/s2].
        model: The model of the ego's driver.
    """

    path: Path
    s: Floats
    v: Floats
    a: Floats
    model: DriverModel


@dataclass(frozen=True, slots=True)
class RoadAhead:
    """The road along the ego's path. Stations are along that path [m], inf if there is no such place.

    Attributes:
        lane_width: The width of the ego's lane [m].
        sides: The offset [m, left positive] of each lane beside the ego's, and whether the lane has the ``same`` or the
            ``opposite`` direction.
        junction: The station at which the next junction begins.
        later: The stations at which the junctions behind it begin.
        bay: The station at which the ego waits on the next junction if it gives way (SUMO's internal junction).
        rule: SUMO's letter for the ego's right of way there (``Connection.state``); empty if there is no junction.
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

    Attributes:
        others: Their motions without an attack, from the trigger on.
        ahead: The vehicles that at some time are ahead of the ego, in its lane or beside it.
        history: All motions over the last second or so, the ego's first.
        signals: The traffic lights ahead of the ego and of each target at the start of the encounter, nearest first, by
            vehicle.
        reacting: Whether drivers move the others and brake for an adversary; False if a log moves them.
    """

    others: tuple[Track, ...] = ()
    ahead: tuple[OnPath, ...] = ()
    history: tuple[Track, ...] = ()
    signals: Mapping[str, tuple[Signal, ...]] = field(default_factory=dict)
    reacting: bool = True


@dataclass(frozen=True, slots=True)
class Situation:
    """The scene at one start time: the ego, the road ahead of it, the traffic nearby, and the possible adversaries.

    Attributes:
        time: The simulated time [s].
        dt: The step [s].
        horizon: How far planners look ahead [s].
        frame: The ego's pose as the frame of the positions that planners get.
        ego: The state of the ego.
        baseline: The ego's motion without an attack.
        road: The road ahead of the ego.
        traffic: The vehicles near the ego.
        targets: The possible adversaries, by id.
        left: The number of steps until the end of a replayed log; inf without a log.
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
        """List the targets, most dangerous first."""
        return sorted(self.targets.values(), key=lambda t: (-t.risk, t.state.id))


def on_path(track: Track, time: float, dt: float, steps: int, path: Path) -> OnPath:
    """Express a track in the frame of the ego's path.

    Args:
        track: The track.
        time: The time of the first step [s].
        dt: The step [s].
        steps: The number of steps.
        path: The ego's path.

    Returns:
        The motion along the path.
    """
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
    """Return at which states ``(n,)`` of a track the vehicle is on the layer of the path where it is nearest to it."""
    if not np.ndim(track.z) and not np.ndim(path.z):
        return np.ones(len(track.time), bool)
    return np.asarray(same_layer(track.z, heights_along((path,), track.x, track.y)))


def heights_along(paths: Sequence[Path], x: Floats, y: Floats) -> Floats | float:
    """Return the height of the nearest path at each point.

    Args:
        paths: The paths.
        x: The points' x [m], ``(n,)``.
        y: The points' y [m], ``(n,)``.

    Returns:
        Heights [m], ``(n,)``; a number if all paths are flat.
    """
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
    """Describe a way relative to the ego's path, and find where they meet.

    Args:
        path: The way.
        movement: Its movement at the junction.
        junction: The station at which the junction begins [m].
        gives_way: Whether a vehicle on the way has to give way.
        ego_path: The path of the ego.
    """
    nearest = _nearest(path.x, path.y, ego_path)
    ex, ey, eh = ego_path.x[nearest], ego_path.y[nearest], ego_path.heading[nearest]
    along = np.cos(eh) * (path.x - ex) + np.sin(eh) * (path.y - ey)
    d = -np.sin(eh) * (path.x - ex) + np.cos(eh) * (path.y - ey)
    s = nearest * PATH_STEP_M + along
    h = wrap(path.heading - eh)
    return ReferencePath(path, movement, junction, gives_way, s, d, h, _conflict(path, movement, s, d, h, ego_path))


COARSE_STRIDE = 8  # samples of the ego's path per sample of the coarse search
POINTS_PER_BLOCK = 64  # larger arrays would allocate new memory every time, which costs more than the sums


def _nearest(x: Floats, y: Floats, ego_path: Path) -> NDArray[np.intp]:
    """Find the nearest sample of the ego's path to each point: first every eighth one, then those around the best."""
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
    """Find the first place at which a way crosses or joins the ego's path."""
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
