"""Build situations from the tracks of an unattacked run, one for each delay after the trigger that may be tried."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import DriverModel, Floats, Role, Track, VehicleState
from sumo_adv.drivers import model_of
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.ego_place import lane_on_route
from sumo_adv.episode.encounter_detector import WAY_AHEAD_M, RankedVehicle, continued
from sumo_adv.episode.surroundings import Sight
from sumo_adv.episode.unprotected import STANDING_SPEED_M_S, unprotected_ways, ways_back
from sumo_adv.geometry import PATH_STEP_M, Frame, Path, wrap
from sumo_adv.metrics.case import closest, smoothed
from sumo_adv.metrics.reference.sight import SightLimits
from sumo_adv.road_users import is_unprotected
from sumo_adv.simulation.network import Connection, PathAhead, RoadMap
from sumo_adv.simulation.permissions import CAR
from sumo_adv.situation import (
    Baseline,
    OnPath,
    RoadAhead,
    Signal,
    Situation,
    Target,
    Traffic,
    level_with,
    on_path,
    relate,
    top_speed,
)

# -- when attacks may begin -----------------------------------------------------------------------------------------

MAX_CONFLICT_TIME_S = 7.0  # from the start until the ego, or with ``both`` the first of the two, is at the conflict
MAX_START_SHIFT_S = 8.0  # added to the delays of the settings at most
AT_ONCE_DISTANCE_M = 3.0  # m; no vehicle can slow down much within this distance


def delays(
    ranking: Sequence[RankedVehicle], tracks: Mapping[str, Track], ego_id: str, settings: Settings,
    *, both: bool = False,
) -> list[float]:  # fmt: skip
    """Return when attacks may begin.

    The delays of the settings are shifted to later if the conflict is far away.

    Args:
        ranking: The vehicles that could attack.
        tracks: The unattacked motion from the trigger on, by id.
        ego_id: The id of the ego.
        settings: The settings of the run.
        both: Whether attacks also begin before the adversary is at the conflict. Otherwise only the ego's arrival
            counts.

    Returns:
        The delays after the trigger [s], each a whole number of steps.
    """
    soonest = min((_steps_to_conflict(c, tracks, ego_id, both) for c in ranking), default=0.0)
    shift = min(max(0.0, math.floor(soonest * settings.step_length - MAX_CONFLICT_TIME_S)), MAX_START_SHIFT_S)
    starts = (settings.steps(shift + delay) * settings.step_length for delay in settings.delays)
    return list(dict.fromkeys(round(start, 6) for start in starts))


def _steps_to_conflict(ranked: RankedVehicle, tracks: Mapping[str, Track], ego_id: str, both: bool) -> float:
    """Return the number of steps until the unattacked ego can meet a ranked vehicle; 0 if it can at once."""
    conflicts = [w.conflict for w in ranked.ways if w.conflict is not None]
    if not ranked.meets_ahead or not conflicts:
        return 0.0
    ego = _travelled(tracks[ego_id])
    steps = [np.searchsorted(ego, c.ego_s) for c in conflicts]
    if both and ranked.id in tracks:
        bv = _travelled(tracks[ranked.id])
        steps += [np.searchsorted(bv, c.bv_s) for c in conflicts]
    return float(min(steps))


def _travelled(track: Track) -> Floats:
    """Return the distance travelled since the track began, ``(n,)`` [m]."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(track.x), np.diff(track.y)))])


def spent(target: Target, lateral: float) -> bool:
    """Return whether no attack by a crossing or merging vehicle is feasible any more.

    This is so if none of its ways meets the ego's path any more, or if each of those that do bends too much for its
    speed within the next ``AT_ONCE_DISTANCE_M``.

    Args:
        target: The vehicle.
        lateral: The maximum lateral acceleration [m/s2].

    Returns:
        Whether no attack is feasible; False if the vehicle neither crosses nor merges.
    """
    if not target.meets_ahead:
        return False
    k, square = max(int(target.station / PATH_STEP_M), 0), target.state.speed**2
    meeting = [
        w.path.curvature[k : k + round(AT_ONCE_DISTANCE_M / PATH_STEP_M)] for w in target.ways if w.conflict is not None
    ]
    return not any(square * float(np.abs(bends).max(initial=0.0)) <= lateral for bends in meeting)


# -- situations -----------------------------------------------------------------------------------------------------

OTHERS_NEAR_M = 90.0  # m; a situation keeps the motion of vehicles that come this close to the unattacked ego
NEXT_JUNCTION_GAP_M = 1.0  # m; what begins this far beyond the start of a junction is another junction
UNKNOWN_LANE_WIDTH_M = 3.2  # m, if the ego's lane is unknown
FARTHEST_WAY_S = 20.0  # s at a BV's highest speed; covers an attempt and the plan made at its end
MIN_ATTACK_S = 1.5  # s from the start of an attack to the end of a recording
IN_SIGHT_M = 120.0  # m; a vehicle farther ahead does not count as ahead of the ego
HISTORY_S = 1.1  # s before the trigger; a situation keeps the states from then on (as the paper does)


@dataclass(frozen=True, slots=True)
class TriggerState:
    """What the simulation knows at the trigger, besides the states of the vehicles.

    Attributes:
        ego: The id of the ego.
        time: The time of the trigger [s].
        ego_model: How the ego's driver is predicted.
        route: The edges of the ego's whole route.
        routes: The edges of the routes of the ranked vehicles, by id.
        signals: The lights ahead of the ego and of the ranked vehicles, by id, with the distances to them [m].
        classes: SUMO's classes of the ego and of the ranked vehicles, by id.
        left: The number of steps until the log that is played back ends; inf without a log.
        follows_log: Whether a log moves background vehicles, so that they do not react to the adversary.
        sight: How far the ego sees along its way; None without a limit.
    """

    ego: str
    time: float
    ego_model: DriverModel
    route: tuple[str, ...]
    routes: Mapping[str, tuple[str, ...]]
    signals: Mapping[str, tuple[Signal, ...]]
    classes: Mapping[str, str]
    left: float = math.inf
    follows_log: bool = False
    sight: SightLimits | None = None


def trigger_state(road: RoadMap, drive: Drive, ranking: Sequence[RankedVehicle]) -> TriggerState:
    """Read the state of the simulation at the trigger, which is now.

    Args:
        road: The network.
        drive: The simulation.
        ranking: The vehicles that could attack. Vehicles of a recording that come later get no entries.

    Returns:
        The state.
    """
    assert drive.ego is not None
    simulation, left = drive.simulation, drive.left()
    model = model_of(drive.controller, simulation.model(drive.ego))
    here = drive.snapshot.raw.keys() - drive.obstacles  # in a recording a vehicle may come later
    driving = [c.id for c in ranking if c.id in here]
    return TriggerState(
        drive.ego, drive.now, model, drive.route(),
        {name: simulation.route(name)[0] for name in driving},
        {name: _signals(road, drive, name) for name in (drive.ego, *driving)},
        {name: drive.kind(name) for name in (drive.ego, *driving)},
        math.inf if left is None else left, drive.follows_log(), None if drive.way is None else drive.way.limits(drive),
    )  # fmt: skip


def _signals(road: RoadMap, drive: Drive, vehicle: str) -> tuple[Signal, ...]:
    """Return the traffic lights ahead of a vehicle, with the distance from its front bumper to each [m]."""
    state, lights = drive.state(vehicle), drive.simulation.signals(vehicle)
    lane = road.lanes.get(state.lane)
    if lane is None or not lights:
        return tuple(lights)
    station = lane.station_of(drive.simulation.lane_position(vehicle))
    edges = drive.simulation.ahead(vehicle)
    lanes = road.chain(lane.id, station, max(d for _, d, _ in lights), edges, drive.kind(vehicle))
    return tuple((name, road.metres_ahead(lanes, station, d), letter) for name, d, letter in lights)


def build_situations(
    road: RoadMap, tracks: Mapping[str, Track], trigger: TriggerState, ranking: Sequence[RankedVehicle],
    settings: Settings, delay: float | None = None,
) -> dict[float, Situation]:  # fmt: skip
    """Build the situations of an encounter.

    If no vehicle could attack any more at any of the usual delays, attacks begin earlier, before the adversary is at
    the conflict.

    Args:
        road: The network.
        tracks: The unattacked motion, by id.
        trigger: The state at the trigger.
        ranking: The vehicles that could attack.
        settings: The settings of the run.
        delay: The only delay to try [s]; None tries those of :func:`delays`.

    Returns:
        The situations by delay after the trigger [s]; empty if the ego or all ranked vehicles leave at once.
    """

    def at(moments: Sequence[float]) -> dict[float, Situation]:
        return _situations(road, tracks, trigger, dict.fromkeys(moments, ranking), settings)

    if delay is not None:
        return at([delay])
    ahead = {name: track.between(trigger.time, math.inf) for name, track in tracks.items()}
    lateral = settings.limits.limits().lateral
    situations = at(delays(ranking, ahead, trigger.ego, settings))
    if all(spent(target, lateral) for situation in situations.values() for target in situation.targets.values()):
        situations = at(delays(ranking, ahead, trigger.ego, settings, both=True)) or situations
    return situations


def recorded_situations(
    road: RoadMap, tracks: Mapping[str, Track], trigger: TriggerState,
    looks: Mapping[float, Sequence[RankedVehicle]], settings: Settings, delay: float | None = None,
) -> dict[float, Situation]:  # fmt: skip
    """Build the situations of an encounter in a recording.

    Args:
        road: The network.
        tracks: The unattacked motion, by id.
        trigger: The state at the trigger.
        looks: The vehicles that could attack, by seconds after the trigger.
        settings: The settings of the run.
        delay: The only delay to try [s], with the vehicles of the nearest look; None tries all looks.

    Returns:
        The situations by delay after the trigger [s], for looks with at least ``MIN_ATTACK_S`` until the recording
        ends.
    """
    if delay is not None:
        looks = {delay: looks[min(looks, key=lambda d: abs(d - delay))]}
    enough = {
        d: ranking for d, ranking in looks.items()
        if ranking and (trigger.left - settings.steps(d)) * settings.step_length >= MIN_ATTACK_S
    }  # fmt: skip
    return _situations(road, tracks, trigger, enough, settings)


def _situations(
    road: RoadMap, tracks: Mapping[str, Track], trigger: TriggerState,
    looks: Mapping[float, Sequence[RankedVehicle]], settings: Settings,
) -> dict[float, Situation]:  # fmt: skip
    """Build the situation after each delay [s], unless the ego or all of its ranked vehicles are gone then."""
    built = {d: build_situation(road, tracks, trigger, ranked, settings, d) for d, ranked in looks.items()}
    return {d: situation for d, situation in built.items() if situation is not None}


def build_situation(
    road: RoadMap, tracks: Mapping[str, Track], trigger: TriggerState, ranking: Sequence[RankedVehicle],
    settings: Settings, delay: float = 0.0,
) -> Situation | None:  # fmt: skip
    """Build the situation at one delay.

    Args:
        road: The network.
        tracks: The unattacked motion, by id.
        trigger: The state at the trigger.
        ranking: The vehicles that could attack.
        settings: The settings of the run.
        delay: The delay after the trigger [s].

    Returns:
        The situation; None if the ego or all ranked vehicles are gone by then.
    """
    time, ego_id, dt = trigger.time + delay, trigger.ego, settings.step_length
    vclass = trigger.classes[ego_id]
    ego_track = tracks[ego_id].between(time, math.inf)
    ego = state_at(ego_track, time) if len(ego_track.time) > 1 else None
    if ego is None:
        return None
    points = np.column_stack([ego_track.x, ego_track.y, *([ego_track.z] if np.ndim(ego_track.z) else [])])
    path = continued(points, _ways_on(road, state_at(ego_track, ego_track.time[-1]) or ego, trigger.route, vclass))
    stations = _travelled(ego_track)
    onward = way_ahead(road, ego, trigger.route, vclass)
    first, rule = (None, "") if onward is None else (onward.first, onward.rule)
    junction, bay = (math.inf, math.inf) if onward is None else (onward.junction, onward.bay)
    reach = math.inf if trigger.sight is None else float(trigger.sight.later(tracks[ego_id], time).along(ego_track)[0])
    targets = {}
    for ranked in ranking:
        track = tracks.get(ranked.id)
        if track is not None and trigger.follows_log:  # the attack begins without the noise of the log
            track = smoothed(track, time, settings.limits.limits())
        kind = trigger.classes.get(ranked.id, CAR)  # SUMO takes a vehicle that comes later in a recording for a car
        target = _target(road, track, ranked, time, path, first, trigger.routes.get(ranked.id, ()), kind)
        if target is not None:
            unseen = _is_hidden(target.state, ego, tracks, time) or not _in_reach(target.state, ego, path, reach)
            targets[ranked.id] = replace(target, hidden=unseen)
    if not targets:
        return None
    others = tuple(
        part for name, t in tracks.items() if name != ego_id and len((part := t.between(time, math.inf)).time) > 1
        and closest(ego_track, part, time) < OTHERS_NEAR_M and level_with(part, path).any()
    )  # fmt: skip
    lane = lane_on_route(road, ego, trigger.route, vclass)
    width = UNKNOWN_LANE_WIDTH_M if lane is None else lane.width
    sides = () if lane is None else road.side_offsets(lane.id, ego.x, ego.y, ego.heading, vclass)
    near = {ego_id, *targets, *(t.id for t in others)}
    history = tuple(t.between(time - HISTORY_S, time) for name, t in tracks.items() if name in near)
    later = tuple(s for s in _junctions(road, ego_track, path, stations) if s > junction + NEXT_JUNCTION_GAP_M)
    situation = Situation(
        time, dt, settings.horizon, Frame(ego.x, ego.y, ego.heading, road.hand), ego,
        Baseline(path, stations, ego_track.speed, ego_track.acceleration, trigger.ego_model),
        RoadAhead(width, tuple((float(o), k) for o, k in sides), float(junction), later, float(bay), rule),
        Traffic(
            others, _ahead(tracks, ego_track, path, stations, dt, width),
            tuple(sorted((t for t in history if len(t.time)), key=lambda t: t.id != ego_id)),
            {name: lights for name, lights in trigger.signals.items() if name == ego_id or name in targets},
            not trigger.follows_log,
        ),
        targets, trigger.left - settings.steps(delay),
    )  # fmt: skip
    return _at_constant_velocity(situation) if settings.forecast == "constant" else situation


def _at_constant_velocity(situation: Situation) -> Situation:
    """Predict an ego that keeps its speed and does not react."""
    speed = np.full_like(situation.baseline.v, situation.ego.speed)
    stations = situation.baseline.s[0] + situation.ego.speed * situation.dt * np.arange(len(speed))
    baseline = situation.baseline
    model = replace(baseline.model, kind="replay")
    return replace(situation, baseline=Baseline(baseline.path, stations, speed, np.zeros_like(speed), model))


def state_at(track: Track, time: float) -> VehicleState | None:
    """Return the state of a track at a time.

    Args:
        track: The track.
        time: The time [s].

    Returns:
        The state; None if the track has no state then.
    """
    i = int(np.argmin(np.abs(track.time - time)))
    if abs(track.time[i] - time) > 1e-3:
        return None
    return VehicleState(
        track.id, float(track.x[i]), float(track.y[i]), float(track.heading[i]), float(track.speed[i]),
        float(track.acceleration[i]), track.length, track.width, track.lane[i],
        float(track.z[i]) if isinstance(track.z, np.ndarray) else track.z,
    )  # fmt: skip


def _ways_on(road: RoadMap, vehicle: VehicleState, route: tuple[str, ...], vclass: str) -> list[PathAhead]:
    """Return the paths that a vehicle can take along its route (``RoadMap.ways``); none if it is off all lanes."""
    lane = lane_on_route(road, vehicle, route, vclass)
    if lane is None:
        return []
    return road.ways(lane.id, lane.station_at(vehicle.x, vehicle.y), WAY_AHEAD_M, route, vclass=vclass)


def _junctions(road: RoadMap, ego: Track, path: Path, stations: Floats) -> list[float]:
    """Return the stations on the ego's path at which the junctions begin that it drives onto [m]."""
    inside = [lane in road.lanes and road.lanes[lane].internal for lane in ego.lane]
    onto = [k for k in range(1, len(inside)) if inside[k] and not inside[k - 1] and ego.lane[k - 1] in road.lanes]
    ends = [road.lanes[ego.lane[k - 1]].shape[-1] for k in onto]
    return [path.project(float(x), float(y), near=float(stations[k]))[0] for k, (x, y) in zip(onto, ends, strict=True)]


def _ahead(
    tracks: Mapping[str, Track], ego: Track, path: Path, stations: Floats, dt: float, lane: float
) -> tuple[OnPath, ...]:
    """Find vehicles that are ahead of the unattacked ego at some time, within ``IN_SIGHT_M`` and 1.5 lane widths."""
    ahead = []
    for name, track in tracks.items():
        unattacked = track.between(float(ego.time[0]), math.inf)
        if name == ego.id or len(unattacked.time) < 2:
            continue
        motion = on_path(unattacked, float(ego.time[0]), dt, len(stations), path)
        before = motion.s - stations
        if ((before > 0.0) & (before < IN_SIGHT_M) & (np.abs(motion.d) < 1.5 * lane)).any():  # false for nan
            ahead.append(motion)
    return tuple(ahead)


def way_ahead(road: RoadMap, ego: VehicleState, route: tuple[str, ...], vclass: str = CAR) -> PathAhead | None:
    """Return the path ahead of an ego.

    Args:
        road: The network.
        ego: The state of the ego.
        route: The edges of its route.
        vclass: SUMO's class of the ego.

    Returns:
        The path; None if the ego is on no lane.
    """
    ways = _ways_on(road, ego, route, vclass)
    return ways[0] if ways else None


def goes_first(other: Connection | None, ego: Connection | None) -> bool:
    """Return whether another vehicle has the right of way over the ego.

    Args:
        other: The other vehicle's next connection.
        ego: The ego's next connection.

    Returns:
        Whether it has; True if they pass different junctions, or if one of them passes none.
    """
    if other is None or ego is None or other.link[0] != ego.link[0]:
        return True
    return other.link[1] in ego.yields_to


def _target(
    road: RoadMap, track: Track | None, ranked: RankedVehicle, time: float, path: Path, ego: Connection | None,
    route: tuple[str, ...], vclass: str,
) -> Target | None:  # fmt: skip
    """Describe a vehicle that could attack; None if it is gone by then or has no way.

    Args:
        road: The network.
        track: Its unattacked motion.
        ranked: Its place in the ranking.
        time: The time of the situation [s].
        path: The ego's path.
        ego: The ego's connection at its junction.
        route: The edges of the vehicle's route; empty if unknown.
        vclass: SUMO's class of the vehicle.
    """
    bv = state_at(track, time) if track is not None else None
    if bv is None:
        return None
    placed = track is not None and track.role is Role.OBSTACLE  # a box of the scenario keeps to no lane
    lane = None if placed else lane_on_route(road, bv, (), vclass)
    begin = 0.0 if lane is None else lane.station_at(bv.x, bv.y)
    farthest = FARTHEST_WAY_S * top_speed(bv)
    onward = [] if lane is None else road.ways(lane.id, begin, WAY_AHEAD_M, farthest=farthest, vclass=vclass)
    if is_unprotected(bv):
        small = unprotected_ways(bv, path, onward)
        turn = 0.0 if bv.speed < STANDING_SPEED_M_S else wrap(bv.heading - float(small[0].path.heading[0]))
        small = (*small, *ways_back(bv, small, path))
        return Target(bv, ranked.relation, small, 0.0, 0.0, turn, (), ranked.risk, hand=road.hand)
    related = [relate(w.path, w.movement, w.junction, w.gives_way, path) for w in onward]
    ways = [replace(r, before_ego=goes_first(w.first, ego), bay=w.bay) for r, w in zip(related, onward, strict=True)]
    if lane is None or not ways:
        return None
    station, offset = ways[0].path.project(bv.x, bv.y, near=0.0)
    heading = ways[0].path.heading[min(max(int(station / PATH_STEP_M), 0), len(ways[0].path.x) - 1)]
    turn = wrap(bv.heading - float(heading))
    sides = tuple((float(o), k) for o, k in road.side_offsets(lane.id, bv.x, bv.y, bv.heading, vclass))
    unattacked = _along(onward, road, lane.id, route)
    return Target(
        bv, ranked.relation, tuple(ways), station, offset, turn, sides, ranked.risk, unattacked, hand=road.hand
    )


def _is_hidden(bv: VehicleState, ego: VehicleState, tracks: Mapping[str, Track], time: float) -> bool:
    """Return whether other boxes, standing or moving, hide a road user from the ego at a time [s]."""
    there = (state_at(t, time) for name, t in tracks.items() if name not in (bv.id, ego.id) and len(t.time))
    return not Sight().visible((ego.x, ego.y), [bv, *(state for state in there if state is not None)], ego.z)[0]


def _in_reach(bv: VehicleState, ego: VehicleState, path: Path, reach: float) -> bool:
    """Return whether a road user is within the ego's limit of sight along its path [m]."""
    stations = (path.project(each.x, each.y)[0] for each in (bv, ego))
    return next(stations) - bv.length / 2 - next(stations) <= reach


def _along(ways: Sequence[PathAhead], road: RoadMap, lane: str, route: tuple[str, ...]) -> int | None:
    """Return the index of the way that the route follows; None if it is unknown."""
    edge = road.lanes[lane].edge
    onward = route[route.index(edge) + 1 :][:1] if edge in route else route
    goes = (k for k, w in enumerate(ways) if w.first is not None and road.lanes[w.first.to].edge in onward)
    return next(goes, None)
