"""Local scenes: what the network sees of each vehicle, in the vehicle's own frame.

The origin is the vehicle's position now and the x axis its heading, so the features do not change where a scene is
moved or rotated as a whole (the local regions of HiVT). Lengths are scaled to be near 1.

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

STEP = 0.1  # s between positions
HISTORY, FUTURE = 11, 80  # positions: 1.1 s up to now (now included), the next 8 s
TOKENS = (HISTORY - 1) // 2  # of two displacements each
AGENTS = 12  # vehicles of a scene
NEAR = 8  # neighbours that a vehicle attends to
LANES = 40  # lane segments that a vehicle attends to
SEGMENT, INNER_SEGMENT = 12.0, 6.0  # m: length of a lane segment on roads and on junctions
METRES, SPEED = 10.0, 10.0  # m, m/s: scales of the features
LENGTH, WIDTH, LIMIT, LIGHT_DISTANCE = 5.0, 2.0, 20.0, 50.0  # m, m, m/s, m: the same
AHEAD_SPEED = 6.0  # m/s: distances ahead are divided by 1 + speed / this, where lanes are chosen
BEHIND = 1.5  # factor of distances behind a vehicle, where lanes are chosen
TURNED = 5.0  # m that are added for a lane at right angles to the vehicle, where lanes are chosen
OUT_OF_SIGHT = 250.0  # m: farther lanes are left out; 8 s at 31 m/s


@dataclass(frozen=True, slots=True)
class Segments:
    """Pieces of the centre lines of lanes.

    ends: start and end, x0, y0, x1, y1 [m], ``(n, 4)``; about: on a junction, turns left, turns right, gives way, has a
    traffic light (0 or 1 each), and the speed limit in ``LIMIT``, ``(n, 6)``.
    """

    ends: Floats
    about: Floats


@dataclass(frozen=True, slots=True)
class Agents:
    """The vehicles of a scene, now.

    past: box centres [m] of the last ``HISTORY`` steps, the last one now, ``(n, HISTORY, 2)``, nan where a vehicle was
    not there; heading [rad], speed [m/s] ``(n,)``; size: length, width [m] ``(n, 2)``; light: see ``light_of``,
    ``(n, 5)``.
    """

    past: Floats
    heading: Floats
    speed: Floats
    size: Floats
    light: Floats


class Features(NamedTuple):
    """The network's input: arrays with the leading shape ``(AGENTS,)`` or ``(scenes, AGENTS)``, zero where nothing is.

    own ``(TOKENS, 5)``: two displacements and whether they are known; state ``(8,)``: speed, size, light; near
    ``(TOKENS, NEAR, 8)``: position, two displacements and size of a neighbour; near_there ``(TOKENS, NEAR)``; lanes
    ``(LANES, 10)``: start, vector and ``Segments.about``; lanes_there ``(LANES,)``; pairs ``(AGENTS, 4)``: position and
    direction of every other vehicle; there ``()``: whether there is a vehicle.
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
    """The next traffic light ahead: known, red, yellow, green, distance in ``LIGHT_DISTANCE``; None: it is unknown."""
    if signals is None:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    if not signals:
        return 1.0, 0.0, 0.0, 0.0, 0.0
    _, distance, letter = signals[0]
    shown = letter.lower()
    return 1.0, float(shown in "ru"), float(shown == "y"), float(shown == "g"), min(distance / LIGHT_DISTANCE, 4.0)


def agents_of(situation: Situation) -> tuple[list[str], Agents]:
    """The ids and the states of the ego, its possible adversaries and the vehicles that are nearest to it, in this
    order, ``AGENTS`` at most."""
    history = {track.id: track for track in situation.traffic.history}
    states = {s.id: s for s in (situation.ego, *(t.state for t in situation.target_list()))}
    for track in history.values():
        if track.id not in states and abs(track.time[-1] - situation.time) < STEP / 2:
            x, y, h, v, a = (float(q[-1]) for q in (track.x, track.y, track.heading, track.speed, track.acceleration))
            states[track.id] = VehicleState(track.id, x, y, h, v, a, track.length, track.width, "")
    ego, first = situation.ego, 1 + len(situation.targets)
    others = sorted(list(states)[first:], key=lambda v: np.hypot(states[v].x - ego.x, states[v].y - ego.y))
    chosen = [states[name] for name in (*list(states)[:first], *others)][:AGENTS]
    past = np.full((len(chosen), HISTORY, 2), np.nan)
    time = situation.time + STEP * np.arange(1 - HISTORY, 1)
    for i, state in enumerate(chosen):
        if (seen := history.get(state.id)) is not None:
            there = (time > seen.time[0] - STEP / 2) & (time < seen.time[-1] + STEP / 2)
            past[i, there, 0] = np.interp(time[there], seen.time, seen.x)
            past[i, there, 1] = np.interp(time[there], seen.time, seen.y)
        past[i, -1] = state.x, state.y
    signals = situation.traffic.signals
    return [state.id for state in chosen], Agents(
        past, np.array([s.heading for s in chosen]), np.array([s.speed for s in chosen]),
        np.array([(s.length, s.width) for s in chosen]), np.array([light_of(signals.get(s.id)) for s in chosen]),
    )  # fmt: skip


def segments_of(road: RoadMap) -> Segments:
    """All passenger lanes of a network, in pieces."""
    turns: dict[str, tuple[str, bool, bool]] = {}
    for lane in road.lanes.values():
        for c in lane.connections:
            for via in c.via:
                turns[via] = c.movement, c.state not in "MOo", bool(c.light[0])
    pieces = []
    for lane in road.lanes.values():
        if lane.carriageway and len(lane.shape) > 1:
            movement, yields, light = turns.get(lane.id, ("", False, False))
            about = lane.internal, movement == "left", movement == "right", yields, light, lane.speed / LIMIT
            pieces.append((lane.shape, INNER_SEGMENT if lane.internal else SEGMENT, about))
    return cut(pieces)


def cut(pieces: Iterable[tuple[Floats, float, Sequence[float]]]) -> Segments:
    """Segments of polylines ``(n, 2)`` [m], each with the length of its segments [m] and its ``Segments.about``."""
    ends, about = [], []
    for shape, length, says in pieces:
        station = stations(*shape.T)
        at = np.linspace(0.0, station[-1], max(1, round(station[-1] / length)) + 1)
        points = np.column_stack([np.interp(at, station, shape[:, k]) for k in range(2)])
        ends += [np.concatenate(two) for two in pairwise(points)]
        about += [np.array(says, float)] * (len(at) - 1)
    return Segments(np.reshape(ends, (-1, 4)), np.reshape(about, (-1, 6)))


def features(agents: Agents, segments: Segments) -> Features:
    """The features of one scene of at most ``AGENTS`` vehicles."""
    n = len(agents.heading)
    turn = _turns(agents.heading)
    here = agents.past[:, -1]
    apart = (here[None, :, :] - here[:, None, :]) @ turn  # (n, n, 2): of the second in the frame of the first
    far = np.hypot(*np.moveaxis(apart, 2, 0)) + np.where(np.eye(n, dtype=bool), np.inf, 0.0)
    chosen = np.argsort(far, axis=1, kind="stable")[:, : min(NEAR, n - 1)]
    steps = np.diff(agents.past, axis=1).reshape(n, TOKENS, 2, 2)  # displacements in the world
    known_steps = np.asarray(np.isfinite(steps).all(axis=(2, 3)))
    own = np.where(known_steps[..., None], (steps @ turn[:, None]).reshape(n, TOKENS, 4), 0.0)
    near, near_there = _neighbours(agents, turn, chosen, steps, known_steps)
    lanes, lanes_there = _lanes(agents, turn, segments)
    between = agents.heading[None, :] - agents.heading[:, None]
    pairs = np.concatenate([apart / (2 * METRES), np.cos(between)[..., None], np.sin(between)[..., None]], axis=2)
    size = agents.size / (LENGTH, WIDTH)
    state = np.concatenate([agents.speed[:, None] / SPEED, size, agents.light], axis=1)
    return Features(
        _filled(np.concatenate([own, known_steps[..., None]], axis=2), (AGENTS, TOKENS, 5)),
        _filled(state, (AGENTS, 8)),
        _filled(near, (AGENTS, TOKENS, NEAR, 8)), _filled(near_there, (AGENTS, TOKENS, NEAR)),
        _filled(lanes, (AGENTS, LANES, 10)), _filled(lanes_there, (AGENTS, LANES)),
        _filled(pairs, (AGENTS, AGENTS, 4)), _filled(np.ones(n), (AGENTS,)),
    )  # fmt: skip


def to_world(points: Floats, agents: Agents) -> Floats:
    """Positions ``(n, ..., 2)`` in the vehicles' frames as positions in the world."""
    n = len(agents.heading)
    flat = points.reshape(n, -1, 2) @ np.swapaxes(_turns(agents.heading), 1, 2)
    return np.asarray((flat + agents.past[:, -1][:, None]).reshape(points.shape))


def to_local(points: Floats, agents: Agents) -> Floats:
    """Positions ``(n, k, 2)`` in the world as positions in the vehicles' frames."""
    return np.asarray((points - agents.past[:, -1][:, None]) @ _turns(agents.heading))


def _turns(heading: Floats) -> Floats:
    """Matrices ``(n, 2, 2)`` that take vectors (rows) of the world into the vehicles' frames."""
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([np.stack([c, -s], axis=1), np.stack([s, c], axis=1)], axis=1)


def _neighbours(agents: Agents, turn: Floats, chosen: Ints, steps: Floats, known_steps: Bools) -> tuple[Floats, Floats]:
    """``Features.near`` and ``near_there`` of the neighbours ``chosen`` ``(n, k)``.

    Positions are those at the end of each token.
    """
    at = agents.past[:, 2::2]  # (n, TOKENS, 2)
    position = (at[chosen] - at[:, None]) @ turn[:, None]  # (n, k, TOKENS, 2)
    moved = (steps[chosen] @ turn[:, None, None]).reshape(*chosen.shape, TOKENS, 4)
    size = np.broadcast_to((agents.size / (LENGTH, WIDTH))[chosen][:, :, None], (*chosen.shape, TOKENS, 2))
    there = known_steps[chosen] & known_steps[:, None]
    columns = np.where(there[..., None], np.concatenate([position / METRES, moved, size], axis=3), 0.0)
    return np.swapaxes(columns, 1, 2), np.swapaxes(there, 1, 2).astype(float)


def _lanes(agents: Agents, turn: Floats, segments: Segments) -> tuple[Floats, Floats]:
    """``Features.lanes`` and ``lanes_there``: the segments that count as nearest."""
    here = agents.past[:, -1]
    start = (segments.ends[None, :, :2] - here[:, None]) @ turn  # (n, segments, 2)
    along = (segments.ends[None, :, 2:] - segments.ends[None, :, :2]) @ turn
    x, y = np.moveaxis(start + along / 2, 2, 0)
    length = np.maximum(np.hypot(along[..., 0], along[..., 1]), 1e-6)
    stretch = 1.0 + agents.speed[:, None] / AHEAD_SPEED
    far = np.hypot(np.where(x > 0.0, x / stretch, -BEHIND * x), y) + TURNED * (1.0 - along[..., 0] / length)
    nearest = np.argsort(far, axis=1, kind="stable")[:, :LANES]
    rows = np.arange(len(here))[:, None]
    says = np.broadcast_to(segments.about, (len(here), *segments.about.shape))[rows, nearest]
    there = np.hypot(x, y)[rows, nearest] < OUT_OF_SIGHT
    columns = np.concatenate([start[rows, nearest] / METRES, along[rows, nearest] / METRES, says], axis=2)
    return np.where(there[..., None], columns, 0.0), there.astype(float)


def _filled(values: Floats, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """The array with zeros behind it, in ``shape``."""
    whole = np.zeros(shape, np.float32)
    whole[tuple(slice(k) for k in values.shape)] = values
    return whole
