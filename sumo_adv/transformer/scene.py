"""Local scenes: the network's input for each vehicle, in the vehicle's own frame.

The origin is the vehicle's present position, and the x axis points along its heading. So the features do not change if
a whole scene is moved or rotated (the local regions of HiVT). Lengths are scaled to be near 1.

Citation: Zhou, Ye, Wang, Wu and Lu 2022, "HiVT: Hierarchical Vector Transformer for Multi-Agent Motion Prediction",
CVPR, pp. 8823-8833.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Bools, Floats, Ints, VehicleState
from sumo_adv.geometry import stations
from sumo_adv.simulation.network import RoadMap
from sumo_adv.situation import Signal, Situation

POSITION_STEP_S = 0.1  # time between positions
HISTORY_COUNT, FUTURE_COUNT = 11, 80  # positions: the last 1 s with the present one, and the next 8 s
TOKEN_COUNT = (HISTORY_COUNT - 1) // 2  # each token holds two displacements
MAX_AGENTS = 12  # vehicles of a scene
MAX_NEIGHBOURS = 8  # neighbours that a vehicle attends to
MAX_LANE_SEGMENTS = 40  # lane segments that a vehicle attends to
ROAD_SEGMENT_M, JUNCTION_SEGMENT_M = 12.0, 6.0  # length of a lane segment on roads and on junctions
DISTANCE_SCALE_M, SPEED_SCALE_M_S = 10.0, 10.0  # scales of the features
LENGTH_SCALE_M, WIDTH_SCALE_M, LIMIT_SCALE_M_S, LIGHT_DISTANCE_SCALE_M = 5.0, 2.0, 20.0, 50.0  # further scales
AHEAD_SPEED_SCALE_M_S = 6.0  # distances ahead are divided by 1 + speed / this to choose lanes
BEHIND_DISTANCE_FACTOR = 1.5  # distances behind a vehicle are multiplied by this to choose lanes
TURNED_PENALTY_M = 5.0  # added to the distance of a lane at right angles to the vehicle to choose lanes
MAX_LANE_DISTANCE_M = 250.0  # farther lanes are left out; a vehicle at 31 m/s covers this in 8 s


@dataclass(frozen=True, slots=True)
class Segments:
    """Segments of the centre lines of lanes.

    Attributes:
        ends: The start and end of each segment, x0, y0, x1, y1 [m], ``(n, 4)``.
        about: The properties of each segment, ``(n, 6)``. Five are 0 or 1: the lane is on a junction, turns left, turns
            right, gives way, has a traffic light. The last is the speed limit in units of ``LIMIT_SCALE_M_S``.
    """

    ends: Floats
    about: Floats


@dataclass(frozen=True, slots=True)
class SceneVehicles:
    """The vehicles of a scene at the present time.

    Attributes:
        past: The box centres [m] of the last ``HISTORY_COUNT`` steps, ``(n, HISTORY_COUNT, 2)``. The last one is the
            present. A position is nan if the vehicle was absent.
        heading: The headings [rad], ``(n,)``.
        speed: The speeds [m/s], ``(n,)``.
        size: The lengths and widths [m], ``(n, 2)``.
        light: The next traffic lights, ``(n, 5)``; see ``light_of``.
    """

    past: Floats
    heading: Floats
    speed: Floats
    size: Floats
    light: Floats


class Features(NamedTuple):
    """The network's input. Absent elements are zero.

    All arrays have the leading shape ``(AGENTS,)`` or ``(scenes, AGENTS)``, which the shapes below leave out.

    Attributes:
        own: Two displacements of the vehicle and whether they are known, ``(TOKENS, 5)``.
        state: The speed, the size and the traffic light, ``(8,)``.
        near: The position, two displacements and the size of each neighbour, ``(TOKENS, NEAR, 8)``.
        near_there: Whether the neighbour is present, ``(TOKENS, NEAR)``.
        lanes: The start, the vector and ``Segments.about`` of each lane segment, ``(LANES, 10)``.
        lanes_there: Whether the lane segment is present, ``(LANES,)``.
        pairs: The position and direction of every vehicle of the scene, ``(AGENTS, 4)``.
        there: Whether the vehicle is present, ``()``.
    """

    own: Any
    state: Any
    near: Any
    near_there: Any
    lanes: Any
    lanes_there: Any
    pairs: Any
    there: Any


def light_of(signals: Sequence[Signal] | None) -> tuple[float, ...]:
    """Describe the next traffic light ahead by five numbers.

    Args:
        signals: The traffic lights ahead; None if they are unknown.

    Returns:
        Whether the lights are known, whether the next one is red, yellow and green, and its scaled distance.
    """
    if signals is None:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    if not signals:
        return 1.0, 0.0, 0.0, 0.0, 0.0
    _, distance, letter = signals[0]
    shown = letter.lower()
    far = min(distance / LIGHT_DISTANCE_SCALE_M, 4.0)
    return 1.0, float(shown in "ru"), float(shown == "y"), float(shown == "g"), far


def agents_of(situation: Situation) -> tuple[list[str], SceneVehicles]:
    """Choose the vehicles of a scene: the ego, its possible adversaries, and the vehicles nearest to it, in this order.

    Returns:
        The ids and the states of at most ``MAX_AGENTS`` vehicles.
    """
    history = {track.id: track for track in situation.traffic.history}
    states = {s.id: s for s in (situation.ego, *(t.state for t in situation.target_list()))}
    for track in history.values():
        if track.id not in states and abs(track.time[-1] - situation.time) < POSITION_STEP_S / 2:
            x, y, h, v, a = (float(q[-1]) for q in (track.x, track.y, track.heading, track.speed, track.acceleration))
            states[track.id] = VehicleState(track.id, x, y, h, v, a, track.length, track.width, "")
    ego, first = situation.ego, 1 + len(situation.targets)
    others = sorted(list(states)[first:], key=lambda v: np.hypot(states[v].x - ego.x, states[v].y - ego.y))
    chosen = [states[name] for name in (*list(states)[:first], *others)][:MAX_AGENTS]
    past = np.full((len(chosen), HISTORY_COUNT, 2), np.nan)
    time = situation.time + POSITION_STEP_S * np.arange(1 - HISTORY_COUNT, 1)
    for i, state in enumerate(chosen):
        if (seen := history.get(state.id)) is not None:
            there = (time > seen.time[0] - POSITION_STEP_S / 2) & (time < seen.time[-1] + POSITION_STEP_S / 2)
            past[i, there, 0] = np.interp(time[there], seen.time, seen.x)
            past[i, there, 1] = np.interp(time[there], seen.time, seen.y)
        past[i, -1] = state.x, state.y
    signals = situation.traffic.signals
    return [state.id for state in chosen], SceneVehicles(
        past, np.array([s.heading for s in chosen]), np.array([s.speed for s in chosen]),
        np.array([(s.length, s.width) for s in chosen]), np.array([light_of(signals.get(s.id)) for s in chosen]),
    )  # fmt: skip


def segments_of(road: RoadMap) -> Segments:
    """Cut all passenger lanes of a network into segments."""
    turns: dict[str, tuple[str, bool, bool]] = {}
    for lane in road.lanes.values():
        for c in lane.connections:
            for via in c.via:
                turns[via] = c.movement, c.state not in "MOo", bool(c.light[0])
    pieces = []
    for lane in road.lanes.values():
        if lane.carriageway and len(lane.shape) > 1:
            movement, yields, light = turns.get(lane.id, ("", False, False))
            about = lane.internal, movement == "left", movement == "right", yields, light, lane.speed / LIMIT_SCALE_M_S
            pieces.append((lane.shape, JUNCTION_SEGMENT_M if lane.internal else ROAD_SEGMENT_M, about))
    return cut(pieces)


def cut(pieces: Iterable[tuple[Floats, float, Sequence[float]]]) -> Segments:
    """Cut polylines into segments.

    Args:
        pieces: For each polyline its points ``(n, 2)`` [m], the length of its segments [m] and its ``Segments.about``.
    """
    ends, about = [], []
    for shape, length, says in pieces:
        station = stations(*shape.T)
        at = np.linspace(0.0, station[-1], max(1, round(station[-1] / length)) + 1)
        points = np.column_stack([np.interp(at, station, shape[:, k]) for k in range(2)])
        ends += [np.concatenate(two) for two in pairwise(points)]
        about += [np.array(says, float)] * (len(at) - 1)
    return Segments(np.reshape(ends, (-1, 4)), np.reshape(about, (-1, 6)))


def scene_features(agents: SceneVehicles, segments: Segments) -> Features:
    """Compute the features of one scene of at most ``MAX_AGENTS`` vehicles."""
    n = len(agents.heading)
    turn = _turns(agents.heading)
    here = agents.past[:, -1]
    apart = (here[None, :, :] - here[:, None, :]) @ turn  # (n, n, 2): the second vehicle in the frame of the first
    far = np.hypot(*np.moveaxis(apart, 2, 0)) + np.where(np.eye(n, dtype=bool), np.inf, 0.0)
    chosen = np.argsort(far, axis=1, kind="stable")[:, : min(MAX_NEIGHBOURS, n - 1)]
    steps = np.diff(agents.past, axis=1).reshape(n, TOKEN_COUNT, 2, 2)  # displacements in the world
    known_steps = np.asarray(np.isfinite(steps).all(axis=(2, 3)))
    own = np.where(known_steps[..., None], (steps @ turn[:, None]).reshape(n, TOKEN_COUNT, 4), 0.0)
    near, near_there = _neighbours(agents, turn, chosen, steps, known_steps)
    lanes, lanes_there = _lanes(agents, turn, segments)
    between = agents.heading[None, :] - agents.heading[:, None]
    turned = [np.cos(between)[..., None], np.sin(between)[..., None]]
    pairs = np.concatenate([apart / (2 * DISTANCE_SCALE_M), *turned], axis=2)
    size = agents.size / (LENGTH_SCALE_M, WIDTH_SCALE_M)
    state = np.concatenate([agents.speed[:, None] / SPEED_SCALE_M_S, size, agents.light], axis=1)
    return Features(
        _filled(np.concatenate([own, known_steps[..., None]], axis=2), (MAX_AGENTS, TOKEN_COUNT, 5)),
        _filled(state, (MAX_AGENTS, 8)),
        _filled(near, (MAX_AGENTS, TOKEN_COUNT, MAX_NEIGHBOURS, 8)),
        _filled(near_there, (MAX_AGENTS, TOKEN_COUNT, MAX_NEIGHBOURS)),
        _filled(lanes, (MAX_AGENTS, MAX_LANE_SEGMENTS, 10)), _filled(lanes_there, (MAX_AGENTS, MAX_LANE_SEGMENTS)),
        _filled(pairs, (MAX_AGENTS, MAX_AGENTS, 4)), _filled(np.ones(n), (MAX_AGENTS,)),
    )  # fmt: skip


def to_world(points: Floats, agents: SceneVehicles) -> Floats:
    """Convert positions ``(n, ..., 2)`` from the vehicles' frames to the world."""
    n = len(agents.heading)
    flat = points.reshape(n, -1, 2) @ np.swapaxes(_turns(agents.heading), 1, 2)
    return np.asarray((flat + agents.past[:, -1][:, None]).reshape(points.shape))


def to_local(points: Floats, agents: SceneVehicles) -> Floats:
    """Convert positions ``(n, k, 2)`` from the world to the vehicles' frames."""
    return np.asarray((points - agents.past[:, -1][:, None]) @ _turns(agents.heading))


def _turns(heading: Floats) -> Floats:
    """Return matrices ``(n, 2, 2)`` that rotate row vectors of the world into the vehicles' frames."""
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)


def _neighbours(
    agents: SceneVehicles, turn: Floats, chosen: Ints, steps: Floats, known_steps: Bools
) -> tuple[Floats, Floats]:
    """Compute ``Features.near`` and ``near_there`` of the neighbours ``chosen``, ``(n, k)``.

    Positions are those at the end of each token.
    """
    at = agents.past[:, 2::2]  # (n, TOKEN_COUNT, 2)
    position = (at[chosen] - at[:, None]) @ turn[:, None]  # (n, k, TOKEN_COUNT, 2)
    moved = (steps[chosen] @ turn[:, None, None]).reshape(*chosen.shape, TOKEN_COUNT, 4)
    scaled = agents.size / (LENGTH_SCALE_M, WIDTH_SCALE_M)
    size = np.broadcast_to(scaled[chosen][:, :, None], (*chosen.shape, TOKEN_COUNT, 2))
    there = known_steps[chosen] & known_steps[:, None]
    columns = np.where(there[..., None], np.concatenate([position / DISTANCE_SCALE_M, moved, size], axis=3), 0.0)
    return np.swapaxes(columns, 1, 2), np.swapaxes(there, 1, 2).astype(float)


def _lanes(agents: SceneVehicles, turn: Floats, segments: Segments) -> tuple[Floats, Floats]:
    """Compute ``Features.lanes`` and ``lanes_there`` of the segments that count as nearest."""
    here = agents.past[:, -1]
    start = (segments.ends[None, :, :2] - here[:, None]) @ turn  # (n, segments, 2)
    along = (segments.ends[None, :, 2:] - segments.ends[None, :, :2]) @ turn
    x, y = np.moveaxis(start + along / 2, 2, 0)
    length = np.maximum(np.hypot(along[..., 0], along[..., 1]), 1e-6)
    stretch = 1.0 + agents.speed[:, None] / AHEAD_SPEED_SCALE_M_S
    far = np.hypot(np.where(x > 0.0, x / stretch, -BEHIND_DISTANCE_FACTOR * x), y)
    far += TURNED_PENALTY_M * (1.0 - along[..., 0] / length)
    nearest = np.argsort(far, axis=1, kind="stable")[:, :MAX_LANE_SEGMENTS]
    rows = np.arange(len(here))[:, None]
    says = np.broadcast_to(segments.about, (len(here), *segments.about.shape))[rows, nearest]
    there = np.hypot(x, y)[rows, nearest] < MAX_LANE_DISTANCE_M
    pieces = [line[rows, nearest] / DISTANCE_SCALE_M for line in (start, along)]
    columns = np.concatenate([*pieces, says], axis=2)
    return np.where(there[..., None], columns, 0.0), there.astype(float)


def _filled(values: Floats, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Pad an array with zeros to a shape."""
    whole = np.zeros(shape, np.float32)
    whole[tuple(slice(k) for k in values.shape)] = values
    return whole
