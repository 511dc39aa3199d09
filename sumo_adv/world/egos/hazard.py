"""When a hazard shows, from the ego's seat: an online approximation on observed states and their short history.

The rules are those of the verdicts (DESIGN.md). "Beside", "ahead" and "towards" are measured along the ego's path: its
lane and route where the engine tells them (``Observation.path``), else the arc that it is on (yaw rate over 0.5 s).

- same direction, beside the path: it has moved 0.375 m towards the path (UN R157's wandering zone) since it last kept
  its lateral place, will be in the way within 1.5 s, and is too near or too slow to be met by coasting through the
  reaction time and then braking gently;
- same direction, in the path: to stop behind it takes more than SUMO's own driver brakes (4.5 m/s2);
- oncoming: it has moved towards the path like that, its box is over the line (within 1.6 m of the path's centre), and
  the two meet within 3 s;
- crossing: it can no longer stop short of the path at 3 m/s2, and the two meet within 4 s;
- anything else: two-dimensional TTC below 3 s, and the two meet.

"Meet" is asked of the ego along its path and of the other on the arc that it is on. In the last two cases the ego must
also need at least 3 m/s2 to stop short: a driver who is about to yield anyway is not alarmed. A hazard lasts until it
is behind or out of the way.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from sumo_adv.datatypes import VehicleState
from sumo_adv.world.egos.path import EgoPath
from sumo_adv.world.egos.protocol import Observation

DRIFT = 0.375  # m, towards the ego (UN R157, lateral wandering zone)
DRIFT_RATE = 0.1  # m/s, slower sideways motion is lane keeping
REACTION = 1.15  # s, 0.4 to perceive + 0.75 to react
OWN_BRAKING = 4.5  # m/s2, what SUMO's driver does by itself behind a leader
GENTLE = 1.5  # m/s2, braking behind a cut-in that alarms nobody
STOPPING_SHORT = 3.0  # m/s2, what a crossing driver may brake to yield
ALARM_BRAKING = 3.0  # m/s2, ego needs that much to stop short
HALF_LANE = 1.6  # m, half of SUMO's default lane
CLOSE_HEADWAY = 0.5  # s, a gap below it is a hazard at any but a receding vehicle
HEADWAY = 2.0  # s, a vehicle further ahead, and not met within ``SIGHT``, is ordinary traffic
SOON = 1.5  # s, until a vehicle that moves over is in the way
SIGHT = 4.0  # s, no look further ahead
HISTORY = 0.5  # s, over which yaw rates are measured


@dataclass(frozen=True, slots=True)
class Relative:
    """A neighbour seen along the ego's path: distances in m between boxes (negative = overlap in that direction)."""

    ahead: bool  # its centre is ahead of the ego's
    heading: float  # rad, against the path's direction there
    gap: float  # m, along the path
    side_gap: float  # m, across the path
    near_edge: float  # m, from the path's centre line to its box
    speed: float  # m/s, along the path
    towards: float  # m/s, sideways towards the path, from its last two positions
    crossing: float  # m/s, the same from its heading and speed


@dataclass(slots=True)
class _Memory:
    """What the driver remembers of one vehicle."""

    poses: deque[tuple[float, float, float, float]] = field(default_factory=deque)  # time, x, y, heading
    drift: float = 0.0  # m, moved towards the ego's path since it last kept its place

    def see(self, time: float, state: VehicleState) -> None:
        self.poses.append((time, state.x, state.y, state.heading))
        while time - self.poses[0][0] > HISTORY + 1e-6:
            self.poses.popleft()

    def yaw_rate(self) -> float:
        """rad/s over the history."""
        (first, _, _, before), (last, _, _, now) = self.poses[0], self.poses[-1]
        return _wrap(now - before) / (last - first) if last > first else 0.0


class HazardWatch:
    """Watches the neighbours; ``update`` returns the ids of those that are a hazard now."""

    def __init__(self) -> None:
        self._seen: dict[str, _Memory] = {}
        self._hazards: set[str] = set()
        self._path = EgoPath(())
        self._points: object = None

    def update(self, observation: Observation) -> frozenset[str]:
        """Take in one observation (call it once a step, in order)."""
        ego, time = observation.ego, observation.time
        present = {ego.id} | {other.id for other in observation.others}
        self._seen = {key: memory for key, memory in self._seen.items() if key in present}
        me = self._seen.setdefault(ego.id, _Memory())
        me.see(time, ego)
        direction = ego.heading if observation.lane_heading is None else observation.lane_heading
        path = self._told_path(observation) or EgoPath.arc(ego, direction, me.yaw_rate())
        at, _, _ = path.locate(ego.x, ego.y)
        hazards = set()
        for other in observation.others:
            if other.id == ego.id:
                continue
            memory = self._seen.setdefault(other.id, _Memory())
            memory.see(time, other)
            if _far(ego, other) and other.id not in self._hazards:
                memory.drift = 0.0
                continue
            view = _relative(ego, path, at, other, memory)
            _follow_drift(memory, view.towards)
            if other.id in self._hazards:
                alarmed = not _over(ego, other, view)
            else:
                alarmed = _appears(ego, path, at, other, view, memory)
            if alarmed:
                hazards.add(other.id)
        self._hazards = hazards
        return frozenset(hazards)

    def _told_path(self, observation: Observation) -> EgoPath:
        """The engine's path; made anew only when it is another object."""
        if observation.path is not self._points:
            self._points, self._path = observation.path, EgoPath(observation.path or ())
        return self._path


def needed_braking(speed: float, gap: float, leader_speed: float, leader_acceleration: float) -> float:
    """Constant deceleration [m/s2] that just avoids running into a leader ``gap`` [m] ahead.

    The larger of c^2 / (2 gap) at a closing speed c, and, behind a braking leader, of stopping where it stops.
    """
    if gap <= 0.0:
        return math.inf if speed > 0.0 else 0.0
    needed = max(speed - leader_speed, 0.0) ** 2 / (2.0 * gap)
    if leader_acceleration < -0.5:
        standstill = max(leader_speed, 0.0) ** 2 / (-2.0 * leader_acceleration)
        needed = max(needed, speed**2 / (2.0 * (gap + standstill)))
    return needed


def _far(ego: VehicleState, other: VehicleState) -> bool:
    """Whether the two cannot meet within sight, however they turn."""
    return math.hypot(other.x - ego.x, other.y - ego.y) > 15.0 + SIGHT * (ego.speed + other.speed)


def _appears(ego: VehicleState, path: EgoPath, at: float, other: VehicleState, view: Relative, memory: _Memory) -> bool:
    """Whether a vehicle that was no hazard becomes one."""
    if not view.ahead or ego.speed < 0.1 or view.gap > SIGHT * (ego.speed + max(-view.speed, 0.0)):
        return False
    if abs(view.heading) < math.pi / 4:
        return _same_direction(ego, other, view, memory.drift)
    if other.speed < 0.1 or view.gap <= 0.0:
        return False
    if abs(view.heading) > 3 * math.pi / 4:
        over_the_line = view.near_edge < HALF_LANE and memory.drift >= DRIFT
        return over_the_line and _meet(ego, path, at, other, memory, horizon=3.0, margin=0.5)
    if needed_braking(ego.speed, view.gap, 0.0, 0.0) < ALARM_BRAKING:
        return False
    if view.side_gap > 0.0 and view.crossing > DRIFT_RATE:
        too_late = view.side_gap * other.speed / view.crossing < other.speed**2 / (2.0 * STOPPING_SHORT)
        return too_late and _meet(ego, path, at, other, memory, horizon=SIGHT, margin=1.0)
    return box_ttc(ego, other) < 3.0 and _meet(ego, path, at, other, memory, horizon=3.0, margin=0.0)


def _same_direction(ego: VehicleState, other: VehicleState, view: Relative, drift: float) -> bool:
    if drift < DRIFT:
        needed = needed_braking(ego.speed, view.gap, view.speed, other.acceleration)
        return view.side_gap <= 0.0 and needed > OWN_BRAKING
    entering = view.side_gap <= 0.0 or view.side_gap < SOON * view.towards
    return entering and _too_near(ego, other, view, reaction=REACTION, gentle=GENTLE)


def _too_near(ego: VehicleState, other: VehicleState, view: Relative, reaction: float, gentle: float) -> bool:
    """Whether coasting for ``reaction`` [s] and then braking by ``gentle`` [m/s2] does not do behind this vehicle."""
    closing = ego.speed - view.speed
    if view.gap < CLOSE_HEADWAY * ego.speed and closing > -1.0:
        return True
    if view.gap > max(SIGHT * closing, HEADWAY * ego.speed):
        return False
    left_over = view.gap - max(closing, 0.0) * reaction
    return needed_braking(ego.speed, left_over, view.speed, other.acceleration) > gentle


def _over(ego: VehicleState, other: VehicleState, view: Relative) -> bool:
    """Whether a hazard is past: behind, out of the way and not coming, or (same direction) harmless as a leader."""
    if not view.ahead:
        return True
    if view.side_gap > 0.0 and view.towards < DRIFT_RATE:
        return True
    if abs(view.heading) >= math.pi / 4:
        return False
    waits = ego.speed < 0.5 and view.gap < 2.5 and other.speed < 0.5
    return not waits and not _too_near(ego, other, view, reaction=0.0, gentle=0.5)


def _follow_drift(memory: _Memory, towards: float) -> None:
    if len(memory.poses) < 2 or abs(towards) < DRIFT_RATE:
        memory.drift = 0.0
    else:
        step = memory.poses[-1][0] - memory.poses[-2][0]
        memory.drift = max(0.0, memory.drift + towards * step)


def _relative(ego: VehicleState, path: EgoPath, at: float, other: VehicleState, memory: _Memory) -> Relative:
    there, left, direction = path.locate(other.x, other.y)
    heading = _wrap(other.heading - direction)
    along = 0.5 * (abs(math.cos(heading)) * other.length + abs(math.sin(heading)) * other.width)
    across = 0.5 * (abs(math.sin(heading)) * other.length + abs(math.cos(heading)) * other.width)
    sideways = 0.0
    if len(memory.poses) > 1:
        (before, x0, y0, _), (now, x1, y1, _) = memory.poses[-2], memory.poses[-1]
        sideways = ((y1 - y0) * math.cos(direction) - (x1 - x0) * math.sin(direction)) / max(now - before, 1e-3)
    return Relative(
        ahead=there > at,
        heading=heading,
        gap=there - at - along - ego.length / 2,
        side_gap=abs(left) - across - ego.width / 2,
        near_edge=abs(left) - across,
        speed=other.speed * math.cos(heading),
        towards=-math.copysign(1.0, left) * sideways,
        crossing=-math.copysign(1.0, left) * other.speed * math.sin(heading),
    )


def box_ttc(a: VehicleState, b: VehicleState) -> float:
    """Time [s] until two boxes touch at constant velocity and heading; 0 = they touch, ``inf`` = never.

    Separating axes: on each box's two axes the projections overlap during one interval of time; the boxes touch when
    all four do.
    """
    vx = b.speed * math.cos(b.heading) - a.speed * math.cos(a.heading)
    vy = b.speed * math.sin(b.heading) - a.speed * math.sin(a.heading)
    start, end = 0.0, math.inf
    for axis_x, axis_y, reach in _axes(a, b):
        distance = (b.x - a.x) * axis_x + (b.y - a.y) * axis_y
        rate = vx * axis_x + vy * axis_y
        if abs(rate) < 1e-9:
            if abs(distance) > reach:
                return math.inf
            continue
        enter, leave = sorted(((-reach - distance) / rate, (reach - distance) / rate))
        start, end = max(start, enter), min(end, leave)
    return start if start <= end else math.inf


def _axes(a: VehicleState, b: VehicleState) -> list[tuple[float, float, float]]:
    """Four axes (unit vectors) with the sum of both boxes' half extents [m] on each."""
    turn = b.heading - a.heading
    cos, sin = abs(math.cos(turn)), abs(math.sin(turn))
    axes = []
    for mine, its in ((a, b), (b, a)):
        x, y = math.cos(mine.heading), math.sin(mine.heading)
        axes.append((x, y, 0.5 * (mine.length + cos * its.length + sin * its.width)))
        axes.append((-y, x, 0.5 * (mine.width + sin * its.length + cos * its.width)))
    return axes


def _meet(
    ego: VehicleState, path: EgoPath, at: float, other: VehicleState, memory: _Memory, horizon: float, margin: float
) -> bool:
    """Whether the boxes, one grown by ``margin`` [m], overlap within ``horizon`` [s].

    Sampled every 0.1 s; the ego goes along its path and keeps its braking if it brakes already, the other keeps speed
    and turn.
    """
    braking = -ego.acceleration if ego.acceleration < -0.5 else 0.0
    until = ego.speed / braking if braking > 0.0 else math.inf
    size = (other.length + 2 * margin, other.width + 2 * margin)
    for step in range(round(horizon / 0.1) + 1):
        moving = min(0.1 * step, until)
        mine = path.pose(at + ego.speed * moving - 0.5 * braking * moving**2)
        if _overlap(mine, (ego.length, ego.width), _arc(other, memory.yaw_rate(), 0.1 * step), size):
            return True
    return False


def _arc(state: VehicleState, yaw_rate: float, time: float) -> tuple[float, float, float]:
    """x, y, heading after ``time`` [s] at constant speed and yaw rate [rad/s]."""
    travelled, turned = state.speed * time, yaw_rate * time
    chord = travelled if abs(turned) < 1e-9 else travelled * math.sin(turned / 2) / (turned / 2)
    direction = state.heading + turned / 2
    return state.x + chord * math.cos(direction), state.y + chord * math.sin(direction), state.heading + turned


def _overlap(
    a: tuple[float, float, float],
    a_size: tuple[float, float],
    b: tuple[float, float, float],
    b_size: tuple[float, float],
) -> bool:
    dx, dy = b[0] - a[0], b[1] - a[1]
    turn = b[2] - a[2]
    cos, sin = abs(math.cos(turn)), abs(math.sin(turn))
    for pose, (length, width), (far_length, far_width) in ((a, a_size, b_size), (b, b_size, a_size)):
        x, y = math.cos(pose[2]), math.sin(pose[2])
        if abs(dx * x + dy * y) > 0.5 * (length + cos * far_length + sin * far_width):
            return False
        if abs(dy * x - dx * y) > 0.5 * (width + sin * far_length + cos * far_width):
            return False
    return True


def _wrap(angle: float) -> float:
    """``angle`` [rad] in (-pi, pi]."""
    return math.pi - (math.pi - angle) % math.tau
