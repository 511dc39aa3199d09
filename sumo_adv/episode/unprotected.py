"""Pedestrians and cyclists as adversaries: which of them may attack, their ways, and how dangerous they can be.

Their ways are not lanes. An ``along`` way goes straight on, or along the lane of a cyclist. An ``across`` way turns as
tightly as the pedestrian or cyclist can, and then goes straight over the ego's path. A pedestrian or cyclist that moves
has several ``across`` ways, whose turns begin one second after each other. A ``back`` way goes over the ego's path,
makes a half turn, and leads over the path again. Further ways back turn round in the ego's lane or before it. They are
for scripts, have no conflict, and come last.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sumo_adv.datatypes import VehicleState
from sumo_adv.episode.drive import Drive
from sumo_adv.geometry import PATH_STEP_M, Path, make_path, turned_back, wrap
from sumo_adv.road_users import UNPROTECTED_LIMITS, UNPROTECTED_SPEEDS_M_S, RoadUser, is_unprotected, road_user
from sumo_adv.simulation.network import PathAhead
from sumo_adv.simulation.permissions import CYCLES, ON_FOOT
from sumo_adv.situation import ReferencePath, relate

STANDING_SPEED_M_S = 0.3  # m/s; a slower pedestrian turns on the spot
TURN_DELAYS_S = (0.0, 1.0, 2.0, 3.0, 4.0)  # s until the turn
MIN_STRAIGHT_M = 1.0  # m before a turn; paths are smoothed over this length, and would begin turned otherwise
WAY_ACROSS_M = 30.0  # m; the length of a way after its turn
TURN_ACCELERATION_M_S2 = 2.5  # m/s2 of lateral acceleration in a turn; more than is usual and less than the limit
MIN_TURN_RADIUS_M = {RoadUser.PEDESTRIAN: 0.6, RoadUser.CYCLIST: 2.0}  # m
ARC_STEP_RAD = 0.1  # rad
TURNS_BACK_M = (0.5, 2.0, 3.5, 5.0)  # m past the middle of the ego's path
HALF_TURN_STEPS = {RoadUser.PEDESTRIAN: (1, -1, 2, -2), RoadUser.CYCLIST: (15, -15, 17, -17)}
"""Length of the half turn at each of ``TURNS_BACK_M``, in steps of a path, positive to the left.

The radii are 0.16 m and 0.32 m on foot, 2.39 m and 2.71 m by bicycle. No two ways back lie on each other, so that an
endpoint tells its way.
"""
EARLY_TURNS_M = (-3.0, -2.0, -1.0, 0.0)  # the same of scripts; turns in the ego's lane or before it
EARLY_TURNS_LESS_RAD = (0.06, 0.06, 0.12, 0.12)
"""By how much each of ``EARLY_TURNS_M`` is less than a half turn. They are as long as the first two half turns, and
this keeps their ways off one another."""
MAX_TURN_START_RAD = 0.02  # a half turn begins only where the way goes straight over the ego's path
MAX_HALF_TURN_SPEED_M_S = 0.45  # m/s, on foot; the motion may be a little faster, and stays below 0.5 m/s
PAST_START_M = 10.0  # m; how far a way back leads beyond where it began
MAX_PATH_DISTANCE_M = 25.0  # m of a way across to the conflict with the ego's path; a pedestrian needs 6 s for it
EGO_TIMES_S = (1.5, 8.0)  # s until the ego is where the two meet
START_DELAY_S = 0.5  # s that a pedestrian or cyclist needs to begin to move


def may_attack(drive: Drive, name: str, only: Sequence[str]) -> bool:
    """Return whether a vehicle or object is a pedestrian or cyclist that may be the adversary.

    Those of SUMO's traffic and the boxes of the scenario may attack. Objects of a log may attack only if ``only`` names
    them. A person may not attack if SUMO is shared: the person would have to be taken out, and another client may know
    the person.

    Args:
        drive: The simulation.
        name: The id of the vehicle or object.
        only: The ids of the vehicles that may attack.
    """
    is_object = name in drive.obstacles
    if drive.simulation.remote is not None and name in drive.simulation.fleet.persons:
        return False
    if not is_object and drive.simulation.vehicle_class(name) not in CYCLES | ON_FOOT:
        return False
    return is_unprotected(drive.state(name)) and (not is_object or name in only or drive.placed(name))


def unprotected_ways(state: VehicleState, ego_path: Path, lanes: Sequence[PathAhead] = ()) -> tuple[ReferencePath, ...]:
    """Return the ways that a pedestrian or cyclist can take.

    All ways begin where it is now.

    Args:
        state: The state of the pedestrian or cyclist.
        ego_path: The ego's path.
        lanes: The paths ahead along the lane of a cyclist; empty for one beside the road.

    Returns:
        The ways, ``along`` before ``across``. A pedestrian that stands has only ``across`` ways.
    """
    user, speed = road_user(state), state.speed
    stands = speed < STANDING_SPEED_M_S and user is RoadUser.PEDESTRIAN
    straight = (
        [0.0]
        if stands
        else [MIN_STRAIGHT_M + after * speed for after in (TURN_DELAYS_S if speed >= STANDING_SPEED_M_S else (0.0,))]
    )
    across = [_across(state, user, ego_path, after, turns=not stands) for after in straight]
    ways = [relate(_at(state, path), "across", math.inf, False, ego_path) for path in across]
    if stands:
        return tuple(ways)
    onward = [relate(_beside(w.path, state), w.movement, w.junction, w.gives_way, ego_path) for w in lanes]
    return (*(onward or [relate(_at(state, _straight_on(state)), "along", math.inf, False, ego_path)]), *ways)


def _at(state: VehicleState, path: Path) -> Path:
    """Put a path at the height of a pedestrian or cyclist, because it leads no further than over the road."""
    return replace(path, z=state.z)


def _beside(lane: Path, state: VehicleState) -> Path:
    """Move the path of a lane sideways to where a cyclist rides in it."""
    station, offset = lane.project(state.x, state.y, near=0.0)
    x, y, _ = lane.at(np.arange(station, lane.length, PATH_STEP_M), offset)
    return _at(state, make_path(np.column_stack([x, y])))


def _straight_on(state: VehicleState) -> Path:
    """Return the path straight on."""
    reach = np.array([0.0, WAY_ACROSS_M + max(TURN_DELAYS_S) * state.speed])
    return make_path(
        np.column_stack([state.x + reach * math.cos(state.heading), state.y + reach * math.sin(state.heading)])
    )


def _across(state: VehicleState, user: RoadUser, ego_path: Path, after: float, *, turns: bool) -> Path:
    """Return a path that goes straight on for ``after`` metres, turns, and goes straight over the ego's path."""
    c, s = math.cos(state.heading), math.sin(state.heading)
    x, y = state.x + after * c, state.y + after * s
    station, left = ego_path.project(x, y)
    ahead = float(ego_path.at(np.asarray(station))[2])
    heading = ahead + (-math.pi / 2 if left > 0 else math.pi / 2)
    points = [(state.x, state.y)] if after > 0 else []
    turn = wrap(heading - state.heading) if turns else 0.0
    radius = max(MIN_TURN_RADIUS_M[user], state.speed**2 / TURN_ACCELERATION_M_S2)
    sign = math.copysign(1.0, turn)
    for a in np.linspace(0.0, abs(turn), max(2, math.ceil(abs(turn) / ARC_STEP_RAD))):
        h = state.heading + sign * a
        points.append(
            (x + sign * radius * (math.sin(h) - s), y - sign * radius * (math.cos(h) - c))
            if turns else (x, y)
        )  # fmt: skip
    end = points[-1]
    points.append((end[0] + WAY_ACROSS_M * math.cos(heading), end[1] + WAY_ACROSS_M * math.sin(heading)))
    return make_path(points, tightest=UNPROTECTED_LIMITS[user].curvature, lateral=TURN_ACCELERATION_M_S2)


def ways_back(state: VehicleState, ways: Sequence[ReferencePath], ego_path: Path) -> tuple[ReferencePath, ...]:
    """Return ways that go over the ego's path, turn back, and cross it again. That second place is their conflict.

    Args:
        state: The state of a pedestrian or cyclist.
        ways: Its ways that do not turn back. The first of them that crosses the ego's path is followed until the turn.
        ego_path: The ego's path.

    Returns:
        A way for each of ``TURNS_BACK_M`` with movement ``back``, and for each of ``EARLY_TURNS_M`` that is ahead one
        without a conflict; empty if no way crosses the ego's path.
    """
    user, onto = road_user(state), next((w for w in ways if w.conflict and w.conflict.kind == "crossing"), None)
    if onto is None or onto.conflict is None:
        return ()
    at = round(onto.conflict.bv_s / PATH_STEP_M)  # the last sample before the middle of the ego's path
    middle, made = onto.conflict.bv_s + abs(float(onto.ego_d[at])), []
    for beyond, steps in zip(TURNS_BACK_M, HALF_TURN_STEPS[user], strict=True):
        begins = round((middle + beyond) / PATH_STEP_M)
        ends = begins + abs(steps)
        way = _way_back(onto.path, begins, steps, user, ego_path)
        last = relate(_from(way.path, ends), "back", math.inf, False, ego_path).conflict
        if last is not None:
            last = replace(last, bv_s=last.bv_s + ends * PATH_STEP_M)
            made.append(replace(way, conflict=last))
    if len(made) < len(TURNS_BACK_M):
        return tuple(made)
    ahead = onto.path.heading
    for k, (beyond, less) in enumerate(zip(EARLY_TURNS_M, EARLY_TURNS_LESS_RAD, strict=True)):
        begins = round((middle + beyond) / PATH_STEP_M)
        if begins > 0 and abs(wrap(float(ahead[begins] - ahead[at]))) < MAX_TURN_START_RAD:
            made.append(_way_back(onto.path, begins, HALF_TURN_STEPS[user][k % 2], user, ego_path, less))
    return tuple(made)


def _way_back(
    onto: Path, begins: int, steps: int, user: RoadUser, ego_path: Path, less: float = 0.0
) -> ReferencePath:  # fmt: skip
    """Return a way that turns back at a sample of a path, without its conflict."""
    radius = abs(steps) * PATH_STEP_M / math.pi
    fastest = math.sqrt(TURN_ACCELERATION_M_S2 * radius)
    if user is RoadUser.PEDESTRIAN:
        fastest = min(fastest, MAX_HALF_TURN_SPEED_M_S)
    begin, end = begins * PATH_STEP_M, (begins + abs(steps)) * PATH_STEP_M
    path = turned_back(onto, begin, steps, begin + PAST_START_M, fastest, less)
    return replace(relate(path, "back", math.inf, False, ego_path), conflict=None, turn=(begin, end))


def _from(path: Path, first: int) -> Path:
    """Return the part of a path from a sample on."""
    here = slice(first, None)
    return Path(path.x[here], path.y[here], path.heading[here], path.curvature[here], path.speed[here], path.z)


def crossing_risk(ways: Sequence[ReferencePath], state: VehicleState, ego: VehicleState) -> float:
    """Rate how dangerous a pedestrian or cyclist can be.

    Args:
        ways: The ways that the pedestrian or cyclist can take.
        state: The state of the pedestrian or cyclist.
        ego: The state of the ego.

    Returns:
        The risk in [0, 1]; 0 if it cannot be in the ego's way in time.
    """
    user = road_user(state)
    best = 0.0
    for way in ways:
        conflict = way.conflict
        if conflict is None or (way.movement == "across" and conflict.bv_s > MAX_PATH_DISTANCE_M):
            continue
        ego_time = conflict.ego_s / max(ego.speed, 1.0)
        earliest = START_DELAY_S + conflict.bv_s / UNPROTECTED_SPEEDS_M_S[user]
        if EGO_TIMES_S[0] < ego_time < EGO_TIMES_S[1] and earliest < ego_time:
            best = max(best, 0.95 * math.exp(-max(0.0, ego_time - 5.0) / 4.0))
    return best
