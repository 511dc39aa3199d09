"""What a planner observes and what it answers: observation, road, forecast of the ego's motion, endpoint.

The ego's profile is its motion in the baseline run. The forecast assumes that an ego near its profile follows it,
shifted by its present distance from the profile. It assumes that any other ego keeps its acceleration for a moment and
then its speed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sumo_adv.datatypes import Endpoint, Floats, Proposal, acceleration_at
from sumo_adv.planners.session import Call
from sumo_adv.simulation.sumo_rules import SituationBatch
from sumo_adv.situation import NO_ARRIVAL_S, Situation, mirrored

PlannerObservation = tuple[dict[str, Any], dict[str, Any]]
"""The dictionaries ``bv`` and ``ego`` of a planner's call, in the frame of the ego at the trigger."""


@dataclass(frozen=True, slots=True)
class Answer:
    """A planner's answer, in the world frame.

    Attributes:
        endpoint: The endpoint.
        trajectory: The planner's own trajectory, ``(n, 4)``: x, y [m], heading [rad] and speed [m/s] for each step from
            now on, without the present state. None means that the built-in f_traj is used.
        remark: Why the planner's own trajectory was refused, or empty.
        notes: What the planner notes for its next call, by keys that begin with ``note_``.
    """

    endpoint: Endpoint
    trajectory: Floats | None = None
    remark: str = ""
    notes: Mapping[str, float] = field(default_factory=dict)


AskOne = Callable[[PlannerObservation], Answer | str]
"""A function that returns a planner's answer, or a sentence that says why there is none."""


def call_of(proposal: Proposal, road: str, observation: PlannerObservation, horizon: float) -> Call:
    """Make the call of a proposal's planner.

    Args:
        proposal: The candidate.
        road: The key of the candidate's road in the session.
        observation: What the planner observes.
        horizon: The planning horizon [s].
    """
    acceleration = acceleration_at(proposal.acceleration, observation[0]["time"])
    return road, *observation, proposal.parameters, acceleration, horizon


def local_endpoint(situation: Situation, end: Endpoint) -> dict[str, float]:
    """Convert an endpoint to the frame of the ego at the trigger, as planners return it."""
    x, y, h = situation.frame.to_local(end.x, end.y, end.heading)
    return {"x": x, "y": y, "heading": h, "speed": end.speed, "time": end.time}


def remembered(situation: Situation, answer: Answer) -> dict[str, float]:
    """Return what a planner sees of its answer at its next call: the endpoint and the notes.

    Args:
        situation: The situation of the encounter.
        answer: The answer.
    """
    return {**local_endpoint(situation, answer.endpoint), **answer.notes}


def world_endpoint(situation: Situation, end: Mapping[str, float]) -> Endpoint:
    """Convert an endpoint in the frame of the ego at the trigger to the world frame."""
    x, y, h = situation.frame.to_world(end["x"], end["y"], end["heading"])
    return Endpoint(x, y, h, end["speed"], end["time"])


# -- the road -------------------------------------------------------------------------------------------------------


def planner_road(situation: Situation, name: str) -> dict[str, Any]:
    """Make the ``road`` dictionary of the BV ``name``; ``prompts/planner.md`` describes its keys."""
    target = situation.targets[name]
    frame, hand = situation.frame, situation.frame.hand
    x, y, h = frame.to_local(target.state.x, target.state.y, target.state.heading)
    ways: list[dict[str, Any]] = []
    turns: list[dict[str, Any]] = []
    for way in target.ways:
        entry: dict[str, Any] = {
            "movement": mirrored(way.movement, hand), "junction": min(way.junction, NO_ARRIVAL_S), "conflict": None,
            "centreline": _points(situation, way.path),
        }  # fmt: skip
        if way.turn is not None:
            entry["turn"] = list(way.turn)
        if way.conflict is not None:
            c = way.conflict
            cx, cy, ch = frame.to_local(c.x, c.y, c.heading)
            entry["conflict"] = {
                "kind": c.kind, "x": cx, "y": cy, "heading": ch, "bv_distance": c.bv_s, "ego_distance": c.ego_s,
                "angle": hand * c.angle,
            }  # fmt: skip
        (turns if way.turn is not None and way.conflict is None else ways).append(entry)
    more = {"turns": turns} if turns else {}  # of scripts: the last ones of the target's ways
    return {
        **more,
        "relation": target.relation, "left": hand * float(target.ways[0].ego_d[0] + target.offset),
        "lane_width": situation.road.lane_width, "ways": ways,
        "sides": [{"offset": hand * o, "kind": k} for o, k in target.sides],
        "start": {"x": x, "y": y, "heading": h, "speed": target.state.speed},
        "ego_centreline": _points(situation, situation.baseline.path), "fastest": target.fastest,
        "signals": {"bv": _signals(situation, name), "ego": _signals(situation, situation.ego.id)},
    }  # fmt: skip


def _signals(situation: Situation, vehicle: str) -> list[dict[str, Any]]:
    return [{"id": i, "distance": d, "state": s} for i, d, s in situation.traffic.signals.get(vehicle, ())]


def _points(situation: Situation, path: Any) -> list[list[float]]:
    """Sample the first 200 m of a path as [x, y] every 2 m, in the ego's frame."""
    step = slice(0, 400, 4)
    x, y, _ = situation.frame.to_local(path.x[step], path.y[step], path.heading[step])
    return [[round(a, 2), round(b, 2)] for a, b in zip(x.tolist(), y.tolist(), strict=True)]


# -- the forecast of the ego ----------------------------------------------------------------------------------------

ON_PROFILE_DISTANCE_M, ON_PROFILE_SPEED_M_S = 1.0, 0.6  # an ego nearer than this still follows its profile
HELD_ACCELERATION_S = 0.5  # a disturbed ego keeps its acceleration for this time, then its speed
PATH_TIMES_S = np.arange(0.0, 9.0)  # times of the predicted path in a planner's observation
ARRIVAL_TIMES_S = np.arange(0.0, 16.1, 0.5)


def expected_stations(
    scenes: SituationBatch, now: float, s: Floats, v: Floats, a: Floats, look: Floats
) -> tuple[Floats, Floats]:
    """Forecast the stations and speeds of egos.

    Args:
        scenes: The situations of the egos.
        now: The time since the trigger [s].
        s: The present stations [m], ``(n,)``.
        v: The present speeds [m/s], ``(n,)``.
        a: The present accelerations [m/s2], ``(n,)``.
        look: The times from now [s], ``(k,)``.

    Returns:
        Stations [m] and speeds [m/s], each ``(n, k)``.
    """
    (ps, pv), (fs, fv) = scenes.profile_now(now), scenes.profile(now + look)
    held = np.minimum(look, HELD_ACCELERATION_S)
    speed = np.maximum(v[:, None] + a[:, None] * held, 0.0)
    free = s[:, None] + (v[:, None] + speed) / 2 * held + speed * (look - held)
    on = ((np.abs(s - ps) < ON_PROFILE_DISTANCE_M) & (np.abs(v - pv) < ON_PROFILE_SPEED_M_S))[:, None]
    return np.where(on, fs + (s - ps)[:, None], free), np.where(on, fv, speed)


def arrivals(scenes: SituationBatch, now: float, s: Floats, v: Floats, a: Floats, conflict_s: Floats) -> Floats:
    """Forecast how long egos need to reach given stations.

    Args:
        scenes: The situations of the egos.
        now: The time since the trigger [s].
        s: The present stations [m], ``(n,)``.
        v: The present speeds [m/s], ``(n,)``.
        a: The present accelerations [m/s2], ``(n,)``.
        conflict_s: The stations to reach [m], ``(n, k)``.

    Returns:
        Times [s], ``(n, k)``. A time is negative after the ego has passed the station, and ``NO_ARRIVAL_S`` if the ego
        does not reach it within the forecast.
    """
    times = np.full(conflict_s.shape, NO_ARRIVAL_S)
    if not np.isfinite(conflict_s).any():
        return times
    way, _ = expected_stations(scenes, now, s, v, a, ARRIVAL_TIMES_S)
    rows = np.arange(len(s))
    for k, at in enumerate(conflict_s.T):
        reached = way >= at[:, None]
        i = np.clip(np.argmax(reached, axis=1), 1, len(ARRIVAL_TIMES_S) - 1)
        before, after = way[rows, i - 1], way[rows, i]
        w = np.clip((at - before) / np.maximum(after - before, 1e-6), 0.0, 1.0)
        time = ARRIVAL_TIMES_S[i - 1] + w * (ARRIVAL_TIMES_S[i] - ARRIVAL_TIMES_S[i - 1])
        left = at - s
        times[:, k] = np.where(left <= 0, left / np.maximum(v, 3.0), np.where(reached[:, -1], time, NO_ARRIVAL_S))
    return times
