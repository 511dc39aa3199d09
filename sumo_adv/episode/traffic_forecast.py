"""Predict traffic without an attack from the states up to now, for simulations that cannot be forked.

Each vehicle follows its route. If its route is unknown, it goes as straight on as the lanes allow, and off the road it
goes straight on. Its acceleration over the last second fades with a time constant of 1 s, or of 5 s if it is above
``GAINING_ACCELERATION_M_S2``. Then it keeps its speed, limited by its leader (Krauss's safe speed), by the speed limits
of the lanes ahead, and by red and yellow lights.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Floats, Track, VehicleState
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.ego_place import front_on, lane_on_route
from sumo_adv.episode.encounter_detector import WAY_AHEAD_M
from sumo_adv.episode.situation_builder import HISTORY_S
from sumo_adv.geometry import PATH_STEP_M, Path, make_path, same_layer, wrap
from sumo_adv.metrics.boxes import height_as
from sumo_adv.simulation.network import NetworkLane, RoadMap

FORECAST_RADIUS_M = 250.0  # m; vehicles within this distance of the ego are predicted
ACCELERATION_FADING_S = 1.0  # time constant of the present acceleration's decay
ACCELERATION_GAINING_S = 5.0  # its time constant above ``GAINING_ACCELERATION_M_S2``
GAINING_ACCELERATION_M_S2 = 1.0  # m/s2
CENTRING_S = 1.5  # s, time constant of the return to the lane's centre
FORECAST_BRAKING_M_S2 = 3.0  # m/s2, braking for what is ahead
FORECAST_TAU_S, FORECAST_MIN_GAP_M = 1.0, 2.0  # s and m; for the safe speed behind a leader
SAFE_SPEED_BRAKING_M_S2 = 4.5  # for the safe speed behind a leader
LEADER_OFFSET_M, LEADER_HEADING_RAD = 1.5, 0.6  # m, rad: maximum offset and turn of a leader from the follower's path
LEADER_SEARCH_M = 150.0  # maximum distance of a possible leader
POSSIBLE_LEADER_HEADING_RAD = 2.2  # maximum relative heading of a possible leader


@dataclass(frozen=True, slots=True)
class ForecastPath:
    """The predicted path of one vehicle.

    Attributes:
        state: The state of the vehicle now.
        path: The path.
        station: Where the vehicle is on the path now [m].
        offset: Its offset from the path now [m].
        cap: The highest speed at each sample of the path [m/s].
        lanes: The ids of the lanes.
        ends: The station at which each lane ends [m].
    """

    state: VehicleState
    path: Path
    station: float
    offset: float
    cap: Floats
    lanes: tuple[str, ...]
    ends: Floats


def traffic_forecast(road: RoadMap, drive: Drive, duration: float) -> dict[str, Track]:
    """Predict the traffic near the ego.

    Args:
        road: The network.
        drive: The simulation.
        duration: How far to predict [s].

    Returns:
        The tracks of the ego and of the vehicles within ``FORECAST_RADIUS_M``, by id. They begin ``HISTORY_S`` ago.
    """
    assert drive.ego is not None
    ego, dt = drive.state(drive.ego), drive.recording.step_length
    seen = [ego, *(drive.state(name) for name in drive.near(ego, FORECAST_RADIUS_M))]
    courses = [course(road, drive, state, duration) for state in seen]
    steps = round(HISTORY_S / dt) + 1
    recorded = {t.id: t for t in drive.tracks(start=max(0, len(drive.recording.snapshots) - steps))}
    gains = np.array([_acceleration(recorded[c.state.id]) for c in courses])
    travelled, speed = _advance(courses, gains, round(duration / dt), dt)
    return {c.state.id: _track(c, travelled[k], speed[k], recorded[c.state.id], dt) for k, c in enumerate(courses)}


def course(road: RoadMap, drive: Drive, state: VehicleState, duration: float) -> ForecastPath:
    """Find the path that a vehicle is going to take.

    Args:
        road: The network.
        drive: The simulation.
        state: The state of the vehicle.
        duration: How long it goes on [s].

    Returns:
        The path; straight on if the vehicle is off the road.
    """
    reach = min(WAY_AHEAD_M, max(60.0, (state.speed + 2.0) * duration))
    if state.lane not in road.lanes:
        c, s = math.cos(state.heading), math.sin(state.heading)
        path = make_path(np.array([[state.x, state.y, state.z], [state.x + reach * c, state.y + reach * s, state.z]]))
        return ForecastPath(state, path, 0.0, 0.0, np.full(len(path.x), math.inf), ("",), np.array([math.inf]))
    vclass = drive.kind(state.id)
    lane, front, route = _place(road, drive, state, vclass)
    begin = max(0.0, front - state.length / 2)
    way = road.ways(lane.id, begin, reach, route, vclass=vclass)[0]
    station, offset = way.path.project(state.x, state.y, near=0.0)
    ends = np.cumsum([road.lanes[n].length for n in way.lanes]) - begin
    limits = np.array([drive.simulation.lane_limit(name) for name in way.lanes])
    cap = _caps(limits, way.path, ends, state)
    lights = drive.simulation.signals(state.id)
    stop = min((road.metres_ahead(way.lanes, front, d) for _, d, s in lights if s in "rRyY"), default=math.inf)
    if stop < reach:
        cap = np.minimum(cap, _towards(way.path, np.where(_stations(way.path) > stop - 1.0, 0.0, 1e4)))
    return ForecastPath(state, way.path, station, offset, cap, way.lanes, ends)


def _place(road: RoadMap, drive: Drive, state: VehicleState, vclass: str) -> tuple[NetworkLane, float, tuple[str, ...]]:
    """Return a vehicle's lane on its route, the station of its front bumper there [m], and its edges from there on."""
    place = drive.place(road) if state.id == drive.ego else None
    if place is not None:
        return place.lane, place.front, place.route
    route = drive.simulation.ahead(state.id)
    lane = lane_on_route(road, state, route, vclass) or road.lanes[state.lane]
    return lane, front_on(lane, state, drive.simulation), route


def _stations(path: Path) -> Floats:
    """Return the stations of a path's samples [m]."""
    return np.asarray(PATH_STEP_M * np.arange(len(path.x)), float)


def _caps(limits: Floats, path: Path, ends: Floats, state: VehicleState) -> Floats:
    """Return the highest speed at each sample, from the limits of the lanes [m/s].

    A vehicle that is faster than the limit now exceeds later limits by the same factor.
    """
    over = max(1.0, state.speed / max(float(limits[0]), 0.1))
    place = np.minimum(np.searchsorted(ends, _stations(path)), len(limits) - 1)
    return _towards(path, (over * limits[place]) ** 2)


def _towards(path: Path, square: Floats) -> Floats:
    """Return the speeds from which comfortable braking reaches the squared speeds ahead."""
    gained = 2 * FORECAST_BRAKING_M_S2 * _stations(path)
    least = np.minimum.accumulate((square + gained)[::-1])[::-1]
    return np.asarray(np.sqrt(np.maximum(least - gained, 0.0)))


def _acceleration(recorded: Track) -> float:
    """Return the mean acceleration over the recorded track [m/s2].

    The acceleration of a single step is mostly a driver's noise (sigma).
    """
    since = recorded.time[-1] - recorded.time[0]
    return 0.0 if since <= 0 else float(recorded.speed[-1] - recorded.speed[0]) / float(since)


def _advance(courses: Sequence[ForecastPath], a: Floats, steps: int, dt: float) -> tuple[Floats, Floats]:
    """Predict the motions along the paths.

    Args:
        courses: The paths of ``n`` vehicles.
        a: Their present accelerations, ``(n,)`` [m/s2].
        steps: The number of steps.
        dt: The step length [s].

    Returns:
        The distances travelled [m] and the speeds [m/s], each ``(n, steps + 1)``.
    """
    n = len(courses)
    leader, gap = _leaders(courses)
    follows = leader >= 0
    v = np.array([c.state.speed for c in courses])
    cap = np.full((n, max(len(c.cap) for c in courses)), math.inf)
    for k, c in enumerate(courses):
        cap[k, : len(c.cap)] = c.cap
    start = np.array([c.station for c in courses])
    rows, travelled, speed = np.arange(n), np.zeros((n, steps + 1)), np.empty((n, steps + 1))
    speed[:, 0] = v
    went, fade = (
        np.zeros(n),
        np.exp(-dt / np.where(a > GAINING_ACCELERATION_M_S2, ACCELERATION_GAINING_S, ACCELERATION_FADING_S)),
    )
    for k in range(1, steps + 1):
        room = np.maximum(gap + np.where(follows, went[leader], 0.0) - went, 0.0)
        ahead = np.where(follows, v[leader], 0.0)
        safe = -SAFE_SPEED_BRAKING_M_S2 * FORECAST_TAU_S + np.sqrt(
            (SAFE_SPEED_BRAKING_M_S2 * FORECAST_TAU_S) ** 2 + ahead**2 + 2 * SAFE_SPEED_BRAKING_M_S2 * room
        )
        place = np.minimum(((start + went) / PATH_STEP_M).astype(np.intp), cap.shape[1] - 1)
        wish = np.minimum(v + a * dt, np.where(follows, safe, math.inf))
        v = np.clip(np.minimum(wish, cap[rows, place]), np.maximum(v - 2 * SAFE_SPEED_BRAKING_M_S2 * dt, 0.0), 60.0)
        a, went = a * fade, went + v * dt
        travelled[:, k], speed[:, k] = went, v
    return travelled, speed


def _leaders(courses: Sequence[ForecastPath]) -> tuple[np.ndarray, Floats]:
    """Return the index of the next vehicle ahead on each vehicle's path (-1: none), and the gap to it [m]."""
    x, y, h, z = (np.array([getattr(c.state, k) for c in courses]) for k in ("x", "y", "heading", "z"))
    half = np.array([c.state.length / 2 for c in courses])
    leader, room = np.full(len(courses), -1), np.full(len(courses), math.inf)
    for k, c in enumerate(courses):
        forth = np.cos(c.state.heading) * (x - c.state.x) + np.sin(c.state.heading) * (y - c.state.y)
        near = (forth > -5.0) & (np.hypot(x - c.state.x, y - c.state.y) < LEADER_SEARCH_M)
        for j in np.flatnonzero(near & (np.abs(wrap(h - c.state.heading)) < POSSIBLE_LEADER_HEADING_RAD)):
            s, d = c.path.project(float(x[j]), float(y[j]))
            free = s - c.station - half[k] - half[j] - FORECAST_MIN_GAP_M
            turned = abs(wrap(h[j] - c.path.heading[min(int(max(s, 0.0) / PATH_STEP_M), len(c.path.x) - 1)]))
            level = same_layer(z[j], c.path.height(s))
            if (
                j != k
                and s > c.station
                and abs(d) < LEADER_OFFSET_M
                and turned < LEADER_HEADING_RAD
                and free < room[k]
                and level
            ):
                leader[k], room[k] = j, free
    return leader, room


def _track(c: ForecastPath, travelled: Floats, speed: Floats, recorded: Track, dt: float) -> Track:
    """Continue a recorded track with the predicted motion."""
    after = dt * np.arange(1, len(travelled))
    s = c.station + travelled[1:]
    x, y, heading = c.path.at(s, c.offset * np.exp(-after / CENTRING_S))
    lanes = np.minimum(np.searchsorted(c.ends, s), len(c.lanes) - 1)

    def both(name: str, foreseen: Floats) -> Floats:
        return np.concatenate([getattr(recorded, name), foreseen])

    return Track(
        recorded.id, recorded.role, both("time", recorded.time[-1] + after), both("x", x), both("y", y),
        both("heading", wrap(heading)), both("speed", speed[1:]), both("acceleration", np.diff(speed) / dt),
        recorded.length, recorded.width, (*recorded.lane, *(c.lanes[i] for i in lanes)),
        height_as(recorded, lambda z: np.concatenate([z, np.broadcast_to(c.path.height(s), s.shape)])),
    )  # fmt: skip


def apart(tracks: Mapping[str, Track], state: VehicleState, time: float) -> tuple[float, float]:
    """Compare a vehicle with its prediction.

    Args:
        tracks: The predicted tracks by id.
        state: The state of the vehicle.
        time: The time of the state [s].

    Returns:
        The difference in position [m] and speed [m/s]; inf without a prediction for this time.
    """
    track = tracks.get(state.id)
    if track is None or time > track.time[-1] + 1e-3:
        return math.inf, math.inf
    i = int(np.argmin(np.abs(track.time - time)))
    return math.hypot(track.x[i] - state.x, track.y[i] - state.y), abs(float(track.speed[i]) - state.speed)
