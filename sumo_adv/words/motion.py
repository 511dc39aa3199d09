"""What happened in an attempt, read from its tracks: the events of the adversary, and a description in words.

Positions are along the ego's path (station forward, offset to the left), from when the adversary was taken over until
the contact or the end. The adversary is *in the ego's way* while its box overlaps the strip that the ego's box covers
on its path.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sumo_adv.asked import Event
from sumo_adv.datatypes import Bools, Boxes, Floats, Track
from sumo_adv.geometry import Path, wrap
from sumo_adv.metrics.boxes import height_as, on_grid, row_of
from sumo_adv.metrics.reference.sight import SightLimits
from sumo_adv.metrics.reference.view import hidden
from sumo_adv.road_users import RoadUser, road_user

NEXT_PLACE_REACH_M = 30.0  # a vehicle's next place is searched within this distance along the path
PASSED_MARGIN_M = 1.0  # from centre to centre; farther away, a vehicle counts as behind or ahead
CROSSING_ANGLE_RAD = math.radians(35)  # minimum heading relative to the ego's path of a vehicle that crosses it
TURN_ANGLE_RAD = math.radians(45)  # minimum change of the adversary's heading in a turn
EGO_TURN_ANGLE_RAD = math.radians(30)  # minimum change of the ego's heading in a turn
ONCOMING_ANGLE_RAD = math.radians(120)  # minimum heading relative to the ego's path of an oncoming vehicle
MIN_SPEED_CHANGE_M_S = 2.0  # minimum change that counts as braking or speeding up
CHANGE_PAUSE_S = 0.5  # braking or speeding up has ended when the speed changes no further for this long
DESCRIBED_AS_STANDING_SPEED_M_S = 0.5
MIN_HIDDEN_S = 0.5  # minimum time that an adversary is out of sight
CONTACT_GAP_M = 0.5  # maximum gap to the ego's way at a contact, beyond what a vehicle moves to it in the last step
TURN_END_M = 15.0  # past the ego's farthest place; a turn that the ego has begun ends within this distance
IN_LINE_M = 0.5  # maximum offset of a vehicle that is on no side of the ego's way
MAX_BESIDE_OFFSET_M = 4.5  # maximum offset of a vehicle beside the ego
AFTER_APPROACH_S = 3.0  # how long after the nearest approach events count if nothing is hit
MAX_DESCRIBED_OTHERS = 4  # maximum number of other vehicles in the description, nearest first
DESCRIPTION_STEP_S = 1.0  # between the lines of the description


@dataclass(frozen=True, slots=True)
class Scene:
    """The tracks of an attempt from the take-over on.

    Attributes:
        ego: The ego's track.
        adversary: The adversary's track.
        others: The tracks of other vehicles.
        path: The ego's path without an attack.
        relation: The adversary's relation to the ego at the start of the encounter.
        hidden: Whether the adversary is hidden when the encounter begins.
        side: The side of the ego that is hit, where the tracks end; None without a contact.
        start: The start of the attack [s].
        light: When the adversary passes its stop line on red or yellow [s], and that event; None if it does not.
        sight: How far the ego sees along its way; None without a limit.
        until: The time up to which the motion is described at least [s after the take-over].
        hand: 1 in right-hand traffic, -1 in left-hand traffic.
    """

    ego: Track
    adversary: Track
    others: Sequence[Track]
    path: Path
    relation: str
    hidden: bool
    side: str | None
    start: float
    light: tuple[float, Event] | None = None
    sight: SightLimits | None = None
    until: float = 0.0
    hand: float = 1.0


@dataclass(frozen=True, slots=True)
class DescribedMotion:
    """What happened in an attempt.

    Attributes:
        relation: The adversary's relation to the ego at the start of the encounter.
        user: The adversary's kind of road user.
        events: The events with their times after the take-over [s], in order.
        side: The side of the ego that is hit; None without a contact.
        hidden: Whether other boxes hide the adversary from the ego at first, or for ``MIN_HIDDEN_S`` or more before it
            comes into the ego's way.
        beside: The sides of the ego on which another moving vehicle was.
        time: The time after the take-over [s], ``(n,)``.
        speed: The adversary's speed [m/s], ``(n,)``.
        length: The adversary's length [m].
        words: A description of everything, for a reader.
    """

    relation: str
    user: RoadUser
    events: tuple[tuple[float, Event], ...]
    side: str | None
    hidden: bool
    beside: frozenset[str]
    time: Floats
    speed: Floats
    length: float
    words: str


@dataclass(frozen=True, slots=True)
class PathTrack:
    """A track along a path. All arrays have the shape ``(n,)``.

    Attributes:
        s: The station of the centre [m].
        d: The offset of the centre, positive to the left [m].
        turn: The heading relative to the path [rad].
        half: Half of the extent across the path [m].
        reach: Half of the extent along the path [m].
    """

    s: Floats
    d: Floats
    turn: Floats
    half: Floats
    reach: Floats


@dataclass(frozen=True, slots=True)
class Course:
    """The common states of the ego and the adversary, from the take-over on.

    Attributes:
        time: The time after the take-over [s], ``(n,)``.
        ego: The ego's track.
        adversary: The adversary's track.
        ego_along: The ego along its path.
        along: The adversary along the ego's path.
        events: What the adversary does, with the times after the take-over [s], in order.
    """

    time: Floats
    ego: Track
    adversary: Track
    ego_along: PathTrack
    along: PathTrack
    events: tuple[tuple[float, Event], ...]


def follow(scene: Scene) -> Course | None:
    """Follow the ego and the adversary of a scene.

    Args:
        scene: The tracks of an attempt.

    Returns:
        Their common states; None if there are fewer than three.
    """
    time = np.intersect1d(np.round(scene.ego.time, 3), np.round(scene.adversary.time, 3))
    time = time[time >= scene.start - 1e-6]
    if len(time) < 3:
        return None
    time = time[: _end(scene, _at(scene.ego, time), _at(scene.adversary, time))]
    ego, bv = _at(scene.ego, time), _at(scene.adversary, time)
    a, b = _along(ego, scene.path), _along(bv, scene.path)
    events = tuple(sorted(_events(scene, time - time[0], ego, bv, a, b)))
    return Course(time - time[0], ego, bv, a, b, events)


def observe(scene: Scene) -> DescribedMotion | None:
    """Describe what happened in a scene.

    Args:
        scene: The tracks of an attempt.

    Returns:
        What happened; None if the ego and the adversary have fewer than three common states.
    """
    course = follow(scene)
    if course is None:
        return None
    ego, bv, a, b, events = course.ego, course.adversary, course.ego_along, course.along, course.events
    time = np.round(ego.time, 3)
    others = [_at(t, time) for t in scene.others if len(np.intersect1d(np.round(t.time, 3), time)) == len(time)]
    along = [(t, _along(t, scene.path)) for t in others]
    sides = (
        _beside(a, o) for t, o in along if t.speed.max() > DESCRIBED_AS_STANDING_SPEED_M_S
    )  # without parked vehicles
    beside = frozenset(side for side in sides if side is not None)
    user = road_user(scene.adversary)
    unseen = _hidden(scene, course)
    words = _words(scene, time - time[0], ego, bv, a, b, events, user, along, unseen)
    return DescribedMotion(
        scene.relation, user, events, scene.side, unseen is not None, beside, time - time[0], bv.speed, bv.length, words
    )  # fmt: skip


def heading_from_ego(ego: Track, adversary: Track, ego_along: PathTrack) -> float:
    """Return the adversary's first heading relative to the path at the ego's first place [rad].

    Use it if the ego turns: the path's nearest place to an oncoming vehicle may then be behind the turn.

    Args:
        ego: The ego's track.
        adversary: The adversary's track.
        ego_along: The ego along its path.
    """
    return float(wrap(adversary.heading[0] - (ego.heading[0] - ego_along.turn[0])))


def _end(scene: Scene, ego: Track, bv: Track) -> int:
    """Count the states to use: all up to a contact; otherwise until ``AFTER_APPROACH_S`` after the nearest approach."""
    if scene.side is not None:
        return len(ego.time)
    nearest = int(np.argmin(np.hypot(ego.x - bv.x, ego.y - bv.y)))
    last = max(ego.time[nearest] + AFTER_APPROACH_S, ego.time[0] + scene.until)
    return int(np.searchsorted(ego.time, last, side="right"))


def _hidden(scene: Scene, course: Course) -> tuple[float, float] | None:
    """Return when other boxes, standing or moving, hide the adversary from the ego's centre.

    Returns:
        Beginning and end [s after the take-over], at first or for ``MIN_HIDDEN_S`` or more before the adversary comes
        into the ego's way; None if it is in sight.
    """
    t = course.time
    away = np.zeros(len(t), bool)
    if scene.others:
        boxes = on_grid(scene.others, np.round(course.ego.time, 3))
        x, y, heading, speed = (v[None] for v in (boxes.x, boxes.y, boxes.heading, boxes.speed))
        height = height_as(boxes, lambda z: z[None])
        screens = Boxes(x, y, heading, speed, boxes.length[None], boxes.width[None], height)  # type: ignore[index]
        away = hidden(row_of(course.ego), row_of(course.adversary), screens)[0]
    if scene.sight is not None:
        away |= course.along.s - course.along.reach - course.ego_along.s > scene.sight.along(course.ego)
    in_way = min((time for time, event in course.events if event in INTO_THE_WAY), default=math.inf)
    begins = [k for k in np.flatnonzero(away).tolist() if (k == 0 or not away[k - 1]) and t[k] < in_way]
    for k in begins:
        later = np.flatnonzero(~away[k:])
        end = float(t[-1] if not len(later) else t[k + later[0]])
        if k == 0 or end - t[k] > MIN_HIDDEN_S - 1e-6:
            return float(t[k]), end
    return (0.0, 0.0) if scene.hidden else None


def _at(track: Track, time: Floats) -> Track:
    """Return the states of a track at these times."""
    return track.picked(np.flatnonzero(np.isin(np.round(track.time, 3), time)))


def _along(track: Track, path: Path) -> PathTrack:
    """Project a track onto a path."""
    places, near = [], None
    for x, y in zip(track.x.tolist(), track.y.tolist(), strict=True):
        station, offset = path.project(x, y, near=near, reach=NEXT_PLACE_REACH_M)
        near = station
        places.append((station, offset))
    s, d = np.array(places).T
    turn = wrap(track.heading - path.at(s)[2])
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    half = (track.length * sin + track.width * cos) / 2
    return PathTrack(s, d, turn, half, (track.length * cos + track.width * sin) / 2)


def _events(scene: Scene, t: Floats, ego: Track, bv: Track, a: PathTrack, b: PathTrack) -> list[tuple[float, Event]]:
    """Return what the adversary does, with times after the take-over [s]."""
    inside = np.abs(b.d) < b.half + ego.width / 2
    if scene.side is not None:  # the tracks end just before the boxes touch
        last_step = max(abs(float(b.d[-2])) - abs(float(b.d[-1])), 0.0)
        gap = abs(float(b.d[-1])) - float(b.half[-1]) - ego.width / 2
        inside[-1] |= gap < CONTACT_GAP_M + last_step  # otherwise, the ego has left its way and hits the adversary
    towards = _turns(scene.path, a) and abs(heading_from_ego(ego, bv, a)) >= ONCOMING_ANGLE_RAD
    found = [*_way_events(t, b, inside, scene.hand, towards), *_pass_events(t, a, b), *_speed_events(t, bv)]
    turned = np.unwrap(bv.heading) - bv.heading[0]
    for event, where in ((Event.TURNS_LEFT, turned >= TURN_ANGLE_RAD), (Event.TURNS_RIGHT, turned <= -TURN_ANGLE_RAD)):
        if (k := _first(where)) is not None:
            found.append((float(t[k]), event))
    if scene.light is not None:
        found.append((scene.light[0] - scene.start, scene.light[1]))
    return [(round(max(time, 0.0), 1), event) for time, event in found]


def _turns(path: Path, a: PathTrack) -> bool:
    """Return whether the ego's path turns as at a junction: within a short distance, so no curve of a road counts."""
    s = np.arange(float(a.s[0]), float(a.s.max()) + TURN_END_M, 1.0)
    change = path.at(np.minimum(s + NEXT_PLACE_REACH_M, s[-1]))[2] - path.at(s)[2]
    return bool((np.abs(change) >= EGO_TURN_ANGLE_RAD).any())


def _way_events(t: Floats, b: PathTrack, inside: Bools, hand: float, towards: bool) -> list[tuple[float, Event]]:
    """Return when the adversary comes into the ego's way and leaves it.

    A vehicle that is in the way at first does not enter it. A vehicle that crosses and then, still in the way, turns
    into the ego's direction does enter it. With ``towards``, the ego turns, and the adversary comes towards its first
    place.
    """
    found = []
    left = across = False  # whether it came from the left; whether it is in the way and has not yet turned into it
    for k in range(1, len(t)):
        angle = abs(float(b.turn[k]))
        if inside[k] and not inside[k - 1]:
            left = bool(b.d[k] > 0)
            far = left == (hand > 0)  # from the side of oncoming traffic
            from_ahead = far and abs(float(b.turn[0])) >= ONCOMING_ANGLE_RAD
            if angle >= ONCOMING_ANGLE_RAD or from_ahead or (towards and angle >= CROSSING_ANGLE_RAD):
                found.append((float(t[k]), Event.COMES_OVER))
                continue
            across = True
            if angle >= CROSSING_ANGLE_RAD:
                found.append((float(t[k]), Event.CROSSES_FROM_LEFT if left else Event.CROSSES_FROM_RIGHT))
        elif inside[k - 1] and not inside[k]:
            across = False
            found.append((float(t[k]), Event.LEAVES))
        if across and angle < CROSSING_ANGLE_RAD:
            across = False
            found.append((float(t[k]), Event.ENTERS_FROM_LEFT if left else Event.ENTERS_FROM_RIGHT))
    return found


def _pass_events(t: Floats, a: PathTrack, b: PathTrack) -> list[tuple[float, Event]]:
    """Return when the adversary first gets from behind the ego's centre to ahead of it in the ego's direction."""
    ahead = b.s - a.s
    behind = _first((ahead <= -PASSED_MARGIN_M) & (np.abs(b.turn) < CROSSING_ANGLE_RAD))
    k = None if behind is None else _first((np.arange(len(t)) > behind) & (ahead >= PASSED_MARGIN_M))
    if k is None or abs(b.d[k]) < 1.0:
        return []
    return [(float(t[k]), Event.PASSES_LEFT if b.d[k] > 0 else Event.PASSES_RIGHT)]


def _speed_events(t: Floats, bv: Track) -> list[tuple[float, Event]]:
    """Return each phase of braking or speeding up that changes the speed enough, and each standstill and start."""
    found: list[tuple[float, Event]] = []
    low = high = float(bv.speed[0])
    since_low = since_high = float(t[0])
    last = None
    for time, speed in zip(t.tolist(), bv.speed.tolist(), strict=True):
        if speed <= low:
            low, since_low = speed, time
        if speed >= high:
            high, since_high = speed, time
        if speed <= high - MIN_SPEED_CHANGE_M_S and last is not Event.BRAKES:
            found.append((since_high, last := Event.BRAKES))
            low, since_low = speed, time
        elif speed >= low + MIN_SPEED_CHANGE_M_S and last is not Event.SPEEDS_UP:
            found.append((since_low, last := Event.SPEEDS_UP))
            high, since_high = speed, time
        if last is Event.BRAKES:
            high, since_high = low, since_low
        elif last is Event.SPEEDS_UP:
            low, since_low = high, since_high
    standing = bv.speed < DESCRIBED_AS_STANDING_SPEED_M_S
    for k in range(1, len(t)):
        if standing[k] != standing[k - 1]:
            found.append((float(t[k]), Event.STOPS if standing[k] else Event.STARTS))
    return found


def change_after(time: Floats, speed: Floats, after: float, event: Event) -> float | None:
    """Return when a vehicle begins to brake or to speed up by ``MIN_SPEED_CHANGE_M_S`` or more.

    A change that began before ``after`` and continues counts from ``after`` on.

    Args:
        time: The times [s], ``(n,)``.
        speed: The speeds [m/s], ``(n,)``.
        after: The earliest time [s].
        event: ``Event.BRAKES`` or ``Event.SPEEDS_UP``.

    Returns:
        The time [s]; None if the vehicle does not.
    """
    sign = -1.0 if event is Event.BRAKES else 1.0
    keep = time >= after
    if not keep.any():
        return None
    t, gained = time[keep], sign * speed[keep]
    since = np.minimum.accumulate(gained)
    k = _first(gained >= since + MIN_SPEED_CHANGE_M_S)
    return None if k is None else float(t[int(np.flatnonzero(gained[: k + 1] == since[k])[-1])])


def end_of_change(time: Floats, speed: Floats, begun: float, event: Event) -> float:
    """Return when the braking or speeding up that ``change_after`` found has ended.

    Args:
        time: The times [s], ``(n,)``.
        speed: The speeds [m/s], ``(n,)``.
        begun: When it began [s], as ``change_after`` returns it.
        event: ``Event.BRAKES`` or ``Event.SPEEDS_UP``.

    Returns:
        The time [s] after which the speed changes no further for ``CHANGE_PAUSE_S``.
    """
    sign = -1.0 if event is Event.BRAKES else 1.0
    keep = time >= begun
    t, gained = time[keep], sign * speed[keep]
    late = np.searchsorted(t, t + CHANGE_PAUSE_S + 1e-6)
    first = _first(gained >= gained[0] + MIN_SPEED_CHANGE_M_S) or 0
    ends = (k for k in range(first, len(t)) if (gained[k : late[k]] <= gained[k] + 1e-6).all())
    return float(t[next(ends)])  # the last state, at the latest


def _beside(a: PathTrack, o: PathTrack) -> str | None:
    """Return the side of the ego on which a vehicle first was beside it; None if it never was."""
    near = (np.abs(o.s - a.s) < o.reach + a.reach) & (np.abs(o.d) > 1.5) & (np.abs(o.d) < MAX_BESIDE_OFFSET_M)
    k = _first(near & (np.abs(o.turn) < CROSSING_ANGLE_RAD))
    return None if k is None else ("left" if o.d[k] > 0 else "right")


def _first(where: Bools) -> int | None:
    """Return the first index that is true; None if there is none."""
    return int(np.argmax(where)) if where.any() else None


INTO_THE_WAY = frozenset(
    {
        Event.ENTERS_FROM_LEFT, Event.ENTERS_FROM_RIGHT, Event.CROSSES_FROM_LEFT, Event.CROSSES_FROM_RIGHT,
        Event.COMES_OVER,
    }
)  # fmt: skip
"""The events with which an adversary comes into the ego's way."""
EVENT_PHRASES = {
    Event.PASSES_LEFT: "A has come from behind and is now ahead of EGO, on its left",
    Event.PASSES_RIGHT: "A has come from behind and is now ahead of EGO, on its right",
    Event.ENTERS_FROM_LEFT: "A comes from the left into EGO's way, going the same way",
    Event.ENTERS_FROM_RIGHT: "A comes from the right into EGO's way, going the same way",
    Event.CROSSES_FROM_LEFT: "A comes from the left across EGO's way",
    Event.CROSSES_FROM_RIGHT: "A comes from the right across EGO's way",
    Event.COMES_OVER: "A, which came towards EGO, comes into EGO's way",
    Event.LEAVES: "A goes out of EGO's way",
    Event.TURNS_LEFT: "A has turned left by 45 degrees",
    Event.TURNS_RIGHT: "A has turned right by 45 degrees",
    Event.SPEEDS_UP: "A begins to speed up",
    Event.BRAKES: "A begins to brake",
    Event.STOPS: "A stands",
    Event.STARTS: "A moves off",
    Event.RUNS_RED: "A enters the junction on red",
    Event.RUNS_YELLOW: "A enters the junction on yellow",
}


def words_of(motions: Sequence[DescribedMotion]) -> str:
    """Describe the motions of one or several attackers: A, B and C, in the given order.

    Args:
        motions: The motions of the attackers in the same attempt.
    """
    if len(motions) == 1:
        return motions[0].words
    names = "ABC"[: len(motions)]
    texts = [re.sub(r"\bA\b", name, motion.words) for name, motion in zip(names, motions, strict=True)]
    return "\n\n".join([f"{len(motions)} road users act: {', '.join(names)}. Each has its own facts.", *texts])


def _words(
    scene: Scene, t: Floats, ego: Track, bv: Track, a: PathTrack, b: PathTrack, events: Sequence[tuple[float, Event]],
    user: RoadUser, others: Sequence[tuple[Track, PathTrack]], unseen: tuple[float, float] | None,
) -> str:  # fmt: skip
    """Describe the motion in numbers and plain facts, without names from files; a reader sees nothing else."""
    lines = [
        f"EGO is {ego.length:.1f} m long and {_route(scene, ego, a)}. A is a {user}, {bv.length:.1f} m long and "
        f"{bv.width:.1f} m wide; at first it is {_where(scene, a, b)}.",
        *_lane_changes(ego, t, scene.hand),
        *([] if unseen is None else [_unseen(unseen)]),
        *_others(a, others),
    ]
    marks = sorted({*np.arange(0.0, float(t[-1]) - DESCRIPTION_STEP_S / 4, DESCRIPTION_STEP_S).tolist(), float(t[-1])})
    before = -DESCRIPTION_STEP_S
    for mark in marks:
        k = int(np.argmin(np.abs(t - mark)))
        lines += [f"{time:.1f} s: {EVENT_PHRASES[event]}." for time, event in events if before < time <= mark + 0.05]
        before = mark + 0.05
        ahead, left = float(b.s[k] - a.s[k]), float(b.d[k])
        lines.append(
            f"{t[k]:.1f} s: EGO {ego.speed[k]:.1f} m/s; A {bv.speed[k]:.1f} m/s, {abs(ahead):.1f} m "
            f"{'ahead of' if ahead >= 0 else 'behind'} EGO along EGO's way, {abs(left):.1f} m to the "
            f"{'left' if left > 0 else 'right'} of that way, heading {math.degrees(float(b.turn[k])):.0f} deg to it."
        )
    end = "They do not touch." if scene.side is None else f"They collide: EGO is hit at its {scene.side}."
    return "\n".join([*lines, end])


def _lane_changes(ego: Track, t: Floats, hand: float) -> list[str]:
    """Say when the ego comes into another lane of its road."""
    lines = []
    for k, (before, after) in enumerate(pairwise(ego.lane), start=1):
        (old, _, was), (new, _, now) = before.rpartition("_"), after.rpartition("_")
        if before != after and old == new and not new.startswith(":"):
            inwards = int(now) > int(was)  # SUMO counts lanes from the right, in left-hand traffic from the left
            side = "left" if inwards == (hand > 0) else "right"
            lines.append(f"EGO changes to the lane on its {side}; it is over the line at {t[k]:.1f} s.")
    return lines


def _unseen(between: tuple[float, float]) -> str:
    """Say when the adversary is hidden."""
    begin, end = between
    if begin == 0.0:
        return "A is hidden from EGO at first by something between them."
    return f"From {begin:.1f} s to {end:.1f} s A is hidden from EGO by something between them."


def _route(scene: Scene, ego: Track, a: PathTrack) -> str:
    """Say what the ego did, and what it would have done next if nothing had happened."""
    turned = float(wrap(ego.heading[-1] - ego.heading[0]))
    if abs(turned) >= EGO_TURN_ANGLE_RAD:
        return "turns left" if turned > 0 else "turns right"
    ahead = scene.path.at(a.s[-1] + np.arange(0.0, NEXT_PLACE_REACH_M, 2.0))[2]
    turns = wrap(ahead - ego.heading[0])
    bend = float(turns[np.argmax(np.abs(turns))])
    if abs(bend) < EGO_TURN_ANGLE_RAD:
        return "goes straight on"
    return f"is about to turn {'left' if bend > 0 else 'right'}"


def _others(a: PathTrack, others: Sequence[tuple[Track, PathTrack]]) -> list[str]:
    """Say where the nearest other vehicles are at first and in the end."""
    near = sorted(others, key=lambda each: float(np.hypot(each[1].s - a.s, each[1].d).min()))[:MAX_DESCRIBED_OTHERS]
    return [
        f"Another {road_user(track)}, {track.length:.1f} m long: at first {_placed(a, o, track, 0)}; "
        f"in the end {_placed(a, o, track, -1)}."
        for track, o in near
    ]


def _placed(a: PathTrack, o: PathTrack, track: Track, k: int) -> str:
    """Say where another vehicle is in one state."""
    ahead, left = float(o.s[k] - a.s[k]), float(o.d[k])
    side = "in EGO's lane" if abs(left) < 1.0 else f"{abs(left):.1f} m to the {'left' if left > 0 else 'right'}"
    place = f"{abs(ahead):.0f} m {'ahead of' if ahead >= 0 else 'behind'} EGO, {side}"
    if track.speed[k] < DESCRIBED_AS_STANDING_SPEED_M_S:
        return f"{place}, standing"
    return f"{place}, {track.speed[k]:.0f} m/s, heading {math.degrees(float(o.turn[k])):.0f} deg"


def _where(scene: Scene, a: PathTrack, b: PathTrack) -> str:
    """Say where the adversary is at first."""
    words = {
        "leader": "ahead of EGO in its lane", "follower": "behind EGO in its lane",
        "neighbour": "in a lane beside EGO, going the same way", "oncoming": "coming towards EGO",
        "crossing": "on a way that crosses EGO's", "merging": "on a way that joins EGO's",
    }  # fmt: skip
    side = "left" if b.d[0] > 0 else "right"
    if road_user(scene.adversary) is not RoadUser.VEHICLE:
        oncoming = ", coming towards EGO" if scene.relation == "oncoming" else ""
        return f"{b.s[0] - a.s[0]:.0f} m ahead, beside EGO's way, on its {side}{oncoming}"
    in_line = scene.relation in ("leader", "follower") and abs(float(b.d[0])) < IN_LINE_M
    return words.get(scene.relation, scene.relation) + ("" if in_line else f", on its {side}")
