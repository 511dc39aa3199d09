"""Pedestrians and cyclists as adversaries: which may attack, their ways, and how dangerous they can be.

Their ways are not lanes.  ``along``: straight on, or along the lane of a cyclist.  ``across``: a turn, as tight as the
kind can walk or ride it, and then straight over the ego's path.  A pedestrian or cyclist that moves has several such
ways; each begins some seconds later than the one before.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sumo_adv.datatypes import VehicleState
from sumo_adv.episode.drive import Drive
from sumo_adv.geometry import PATH_STEP_M, Path, make_path, wrap
from sumo_adv.road_users import UNPROTECTED_LIMITS, UNPROTECTED_SPEEDS_M_S, RoadUser, is_unprotected, road_user
from sumo_adv.simulation.network import PathAhead
from sumo_adv.simulation.permissions import CYCLES, ON_FOOT
from sumo_adv.situation import ReferencePath, relate

STANDING_SPEED_M_S = 0.3  # m/s, a slower pedestrian turns on the spot
TURN_DELAYS_S = (0.0, 1.0, 2.0, 3.0, 4.0)  # s of going on until the turn
MIN_STRAIGHT_M = 1.0  # m before a turn: paths are smoothed over as much, and would begin turned
WAY_ACROSS_M = 30.0  # m of a way after the turn
TURN_ACCELERATION_M_S2 = 2.5  # m/s2 sideways in a turn, more than people are used to and less than the limit
MIN_TURN_RADIUS_M = {RoadUser.PEDESTRIAN: 0.6, RoadUser.CYCLIST: 2.0}  # m
ARC_STEP_RAD = 0.1  # rad
MAX_PATH_DISTANCE_M = 25.0  # m from the ego's path; a pedestrian needs 6 s for it
EGO_TIMES_S = (1.5, 8.0)  # s until the ego is where the two meet
START_DELAY_S = 0.5  # s that a pedestrian or cyclist needs to begin to move


def may_attack(drive: Drive, name: str, only: Sequence[str]) -> bool:
    """Whether this is a pedestrian or cyclist that may be the adversary.

    Those of SUMO's traffic and the boxes of the scenario may; objects of a log only where ``only`` names them. A person
    may not where SUMO is shared: it would have to be taken out, and another client may know it.
    """
    is_object = name in drive.obstacles
    if drive.simulation.remote is not None and name in drive.simulation.fleet.persons:
        return False
    if not is_object and drive.simulation.vehicle_class(name) not in CYCLES | ON_FOOT:
        return False
    return is_unprotected(drive.state(name)) and (not is_object or name in only or drive.placed(name))


def unprotected_ways(state: VehicleState, ego_path: Path, lanes: Sequence[PathAhead] = ()) -> tuple[ReferencePath, ...]:
    """The ways of a pedestrian or cyclist. All of them begin at its place. lanes: the ways on of a cyclist along its
    lane; none for one beside the road."""
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
    """The path at the height of a pedestrian or cyclist: it leads no further than over the road."""
    return replace(path, z=state.z)


def _beside(lane: Path, state: VehicleState) -> Path:
    """The path of a lane, moved sideways to where a cyclist rides in it."""
    station, offset = lane.project(state.x, state.y, near=0.0)
    x, y, _ = lane.at(np.arange(station, lane.length, PATH_STEP_M), offset)
    return _at(state, make_path(np.column_stack([x, y])))


def _straight_on(state: VehicleState) -> Path:
    reach = np.array([0.0, WAY_ACROSS_M + max(TURN_DELAYS_S) * state.speed])
    return make_path(
        np.column_stack([state.x + reach * math.cos(state.heading), state.y + reach * math.sin(state.heading)])
    )


def _across(state: VehicleState, user: RoadUser, ego_path: Path, after: float, *, turns: bool) -> Path:
    """Straight on for ``after`` metres, a turn, and straight over the ego's path."""
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


def crossing_risk(ways: Sequence[ReferencePath], state: VehicleState, ego: VehicleState) -> float:
    """How dangerous a pedestrian or cyclist can be, in [0, 1]; 0 if it cannot be in the ego's way in time."""
    user = road_user(state)
    best = 0.0
    for way in ways:
        conflict = way.conflict
        if conflict is None or conflict.bv_s > MAX_PATH_DISTANCE_M:
            continue
        ego_time = conflict.ego_s / max(ego.speed, 1.0)
        earliest = START_DELAY_S + conflict.bv_s / UNPROTECTED_SPEEDS_M_S[user]
        if EGO_TIMES_S[0] < ego_time < EGO_TIMES_S[1] and earliest < ego_time:
            best = max(best, 0.95 * math.exp(-max(0.0, ego_time - 5.0) / 4.0))
    return best
