"""From a trigger and an unattacked run to situations: one for every delay that may be tried."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import DriverModel, Floats, Track, VehicleState
from sumo_adv.episode.encounter import REACH, Candidate
from sumo_adv.episode.start_times import delays, spent
from sumo_adv.geometry import PATH_STEP, Frame, Path, along, make_path, wrap
from sumo_adv.metrics.case import closest
from sumo_adv.simulation.network import Connection, RoadMap, Way
from sumo_adv.situation import SHIFT_STEP, OnPath, Signal, Situation, Target, fastest_of, on_path, relate

OTHERS_NEAR = 90.0  # m: whose motion is kept, those who come so close to the unattacked ego
ANOTHER = 1.0  # m: a junction so much further on is another one
UNLIKE = 0.05  # m: less than this SUMO's places on lanes side by side are the same
FULL_LANE = 3.2  # m, where the ego's lane is unknown
ROAD_MARGIN = 150.0  # m around the unattacked ego's way within which the drivable area is known
FARTHEST_TIME = 20.0  # s at its fastest: so far no vehicle comes in an attempt and what is planned at its end
IN_SIGHT = 120.0  # m
HISTORY = 1.1  # s of everybody's past that a situation keeps (the paper's)


def build_situations(
    road: RoadMap,
    tracks: Mapping[str, Track],
    ego_id: str,
    candidates: Sequence[Candidate],
    time: float,
    *,
    settings: Settings,
    ego_model: DriverModel,
    route: tuple[str, ...],
    routes: Mapping[str, tuple[str, ...]],
    signals: Mapping[str, tuple[Signal, ...]],
    left: float = math.inf,
    reacting: bool = True,
) -> dict[float, Situation]:
    """A situation for every delay [s after ``time``] that may be tried; empty if the vehicles near leave at once.

    ``left``: steps from ``time`` on until the log is over; ``reacting``: whether the others have drivers."""

    def at(moments: Sequence[float]) -> dict[float, Situation]:
        found = {}
        for delay in moments:
            situation = build_situation(
                road, tracks, ego_id, candidates, time + delay, dt=settings.step_length, horizon=settings.horizon,
                ego_model=ego_model, route=route, routes=routes, signals=signals,
            )  # fmt: skip
            if situation is not None and settings.forecast == "constant":
                situation = _at_constant_velocity(situation)
            if situation is not None:
                found[delay] = replace(situation, left=left - settings.steps(delay), reacting=reacting)
        return found

    ahead = {name: track.between(time, math.inf) for name, track in tracks.items()}
    found, lateral = at(delays(candidates, ahead, ego_id, settings)), settings.limits.limits().lateral
    if all(spent(target, lateral) for situation in found.values() for target in situation.targets.values()):
        found = at(delays(candidates, ahead, ego_id, settings, both=True)) or found
    return found


def _at_constant_velocity(situation: Situation) -> Situation:
    """The situation with an ego that is expected to keep its speed, whatever happens."""
    speed = np.full_like(situation.profile_v, situation.ego.speed)
    stations = situation.profile_s[0] + situation.ego.speed * situation.dt * np.arange(len(speed))
    return replace(
        situation, profile_s=stations, profile_v=speed, profile_a=np.zeros_like(speed),
        ego_model=replace(situation.ego_model, kind="replay"),
    )  # fmt: skip


def area_of(ego: Track) -> tuple[float, float, float]:
    """A circle (x, y, radius) [m] around where the unattacked ego comes, with a margin."""
    x, y = float(ego.x.min() + ego.x.max()) / 2, float(ego.y.min() + ego.y.max()) / 2
    return x, y, float(np.hypot(ego.x - x, ego.y - y).max()) + ROAD_MARGIN


def state_at(track: Track, time: float) -> tuple[VehicleState, int] | None:
    """The state of a track at a time, and its index; None where it is not there."""
    i = int(np.argmin(np.abs(track.time - time)))
    if abs(track.time[i] - time) > 1e-3:
        return None
    state = VehicleState(
        track.id, float(track.x[i]), float(track.y[i]), float(track.heading[i]), float(track.speed[i]),
        float(track.acceleration[i]), track.length, track.width, track.lane[i],
    )  # fmt: skip
    return state, i


def path_of(track: Track, road: RoadMap, route: tuple[str, ...]) -> Path:
    """The path a track took, and on along its lanes for ``REACH`` metres."""
    points = np.column_stack([track.x, track.y])
    lane, last = track.lane[-1], points[-1]
    onward = None
    if lane in road.lanes:
        shape = road.lanes[lane].shape
        position = float(along(shape, last[0], last[1]))
        ways = road.ways(lane, position, REACH, route)
        onward = ways[0].path if ways else None
    if onward is not None:
        ahead = np.column_stack([onward.x, onward.y])[4:]  # 2 m on: no fold where the track is off the centre
        points = np.vstack([points, ahead])
    path = make_path(points)
    return path if path.length > REACH else path.extended(REACH - path.length)


def build_situation(
    road: RoadMap,
    tracks: Mapping[str, Track],
    ego_id: str,
    candidates: Sequence[Candidate],
    time: float,
    *,
    dt: float,
    horizon: float,
    ego_model: DriverModel,
    route: tuple[str, ...],
    routes: Mapping[str, tuple[str, ...]],
    signals: Mapping[str, tuple[Signal, ...]],
) -> Situation | None:
    """The situation at ``time`` of an unattacked run's tracks; None if the ego is gone by then or nobody is left."""
    ego_track = tracks[ego_id].between(time, math.inf)
    now = state_at(ego_track, time) if len(ego_track.time) > 1 else None
    if now is None:
        return None
    ego = now[0]
    path = path_of(ego_track, road, route)
    step = np.hypot(np.diff(ego_track.x), np.diff(ego_track.y))
    stations = np.concatenate([[0.0], np.cumsum(step)])
    onward = _onward(road, ego, route)
    first, rule = (None, "") if onward is None else (onward.first, onward.rule)
    junction, bay = (math.inf, math.inf) if onward is None else (onward.junction, onward.bay)
    targets = {}
    for candidate in candidates:
        target = _target(road, tracks.get(candidate.id), candidate, time, path, first, routes.get(candidate.id, ()))
        if target is not None:
            targets[candidate.id] = target
    if not targets:
        return None
    others = tuple(
        part for name, t in tracks.items() if name != ego_id and len((part := t.between(time, math.inf)).time) > 1
        and closest(ego_track, part, time) < OTHERS_NEAR
    )  # fmt: skip
    width = road.lanes[ego.lane].width if ego.lane in road.lanes else FULL_LANE
    sides = tuple((float(o), k) for o, k in road.side_offsets(ego.lane, ego.x, ego.y, ego.heading))
    near = {ego_id, *targets, *(t.id for t in others)}
    history = tuple(t.between(time - HISTORY, time) for name, t in tracks.items() if name in near)
    return Situation(
        time, dt, horizon, Frame(ego.x, ego.y, ego.heading), ego, path, stations, ego_track.speed,
        ego_track.acceleration, ego_model, targets, others, width,
        {name: lights for name, lights in signals.items() if name == ego_id or name in targets},
        tuple(sorted((t for t in history if len(t.time)), key=lambda t: t.id != ego_id)), sides,
        float(junction), rule, bay=float(bay), shifts=_shifts(road, ego.lane, path),
        ahead=_ahead(tracks, ego_track, path, stations, dt, width),
        later=tuple(s for s in _junctions(road, ego_track, path, stations) if s > junction + ANOTHER),
    )  # fmt: skip


def _junctions(road: RoadMap, ego: Track, path: Path, stations: Floats) -> list[float]:
    """Stations [m] of the ego's path at which the junctions begin that it drove onto."""
    inside = [lane in road.lanes and road.lanes[lane].internal for lane in ego.lane]
    onto = [k for k in range(1, len(inside)) if inside[k] and not inside[k - 1] and ego.lane[k - 1] in road.lanes]
    ends = [road.lanes[ego.lane[k - 1]].shape[-1] for k in onto]
    return [path.project(float(x), float(y), near=float(stations[k]))[0] for k, (x, y) in zip(onto, ends, strict=True)]


def _shifts(road: RoadMap, lane: str, path: Path) -> tuple[tuple[float, Floats], ...]:
    """``Situation.shifts``."""
    x, y, _ = path.at(np.arange(0.0, path.length, SHIFT_STEP))
    found = road.lane_shifts(lane, x, y)
    return tuple((o, m) for o, m in found if np.abs(m).max() > UNLIKE)


def _ahead(
    tracks: Mapping[str, Track], ego: Track, path: Path, stations: Floats, dt: float, lane: float
) -> tuple[OnPath, ...]:
    """Who is ahead of the unattacked ego within ``IN_SIGHT``, in its lane or in one beside it, at some time."""
    found = []
    for name, track in tracks.items():
        mine = track.between(float(ego.time[0]), math.inf)
        if name == ego.id or len(mine.time) < 2:
            continue
        one = on_path(mine, float(ego.time[0]), dt, len(stations), path)
        before = one.s - stations
        if ((before > 0.0) & (before < IN_SIGHT) & (np.abs(one.d) < 1.5 * lane)).any():  # nan is nowhere
            found.append(one)
    return tuple(found)


def _onward(road: RoadMap, ego: VehicleState, route: tuple[str, ...]) -> Way | None:
    """The ego's way on; None where it is on no lane."""
    if ego.lane not in road.lanes:
        return None
    ways = road.ways(ego.lane, float(along(road.lanes[ego.lane].shape, ego.x, ego.y)), REACH, route)
    return ways[0] if ways else None


def _goes_first(other: Connection | None, ego: Connection | None) -> bool:
    """Whether the other has the right of way before the ego; where they meet at another junction nobody knows."""
    if other is None or ego is None or other.link[0] != ego.link[0]:
        return True
    return other.link[1] in ego.yields_to


def _target(
    road: RoadMap, track: Track | None, candidate: Candidate, time: float, path: Path, ego: Connection | None,
    route: tuple[str, ...],
) -> Target | None:  # fmt: skip
    """``ego``: how the ego goes on at its junction; ``route``: the vehicle's own edges, as far as they are known."""
    found = state_at(track, time) if track is not None else None
    if found is None or track is None or found[0].lane not in road.lanes:
        return None
    bv, _ = found
    position = float(along(road.lanes[bv.lane].shape, bv.x, bv.y))
    on = road.ways(bv.lane, position, REACH, farthest=FARTHEST_TIME * fastest_of(bv.speed))
    ways = [
        replace(
            relate(w.path, w.movement, w.junction, w.gives_way, path),
            before_ego=_goes_first(w.first, ego),
            bay=w.bay,
        )
        for w in on
    ]
    if not ways:
        return None
    station, offset = ways[0].path.project(bv.x, bv.y, near=0.0)
    heading = ways[0].path.heading[min(max(int(station / PATH_STEP), 0), len(ways[0].path.x) - 1)]
    turn = wrap(bv.heading - float(heading))
    sides = tuple((float(o), k) for o, k in road.side_offsets(bv.lane, bv.x, bv.y, bv.heading))
    unattacked = _along(on, road, bv.lane, route)
    return Target(bv, candidate.relation, tuple(ways), station, offset, turn, sides, candidate.risk, unattacked)


def _along(ways: Sequence[Way], road: RoadMap, lane: str, route: tuple[str, ...]) -> int | None:
    """Which of the ways the route goes, None where nobody knows."""
    edge = road.lanes[lane].edge
    onward = route[route.index(edge) + 1 :][:1] if edge in route else route
    goes = (k for k, w in enumerate(ways) if w.first is not None and road.lanes[w.first.to].edge in onward)
    return next(goes, None)
