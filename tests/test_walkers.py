"""Pedestrians and cyclists who turn back, ride against the traffic, or only walk through a scene."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from situation_samples import EGO_PATH, situation

from sumo_adv.datatypes import Proposal, Role, Track, VehicleState
from sumo_adv.episode.attempt import PlannedAdversary
from sumo_adv.episode.memory_access import unprotected_library
from sumo_adv.episode.unprotected import unprotected_ways, ways_back
from sumo_adv.metrics.gates import kinematic_gates
from sumo_adv.planners.sessions import ask_trusted
from sumo_adv.road_users import UNPROTECTED_LIMITS, road_user
from sumo_adv.situation import Situation, Target

PERSON, BICYCLE = (0.5, 0.5), (1.8, 0.6)
NORTH = math.pi / 2


def walker(y: float, heading: float, speed: float, size: tuple[float, float] = PERSON) -> VehicleState:
    return VehicleState("walker", 60.0, y, heading, speed, 0.0, *size, "")


def scene(state: VehicleState, seconds: float = 12.0) -> Situation:
    """The ego comes from the origin at 10 m/s, along y = 0, and is at the walker's place after 6 s."""
    ways = unprotected_ways(state, EGO_PATH)
    target = Target(state, "crossing", (*ways, *ways_back(state, ways, EGO_PATH)), 0.0, 0.0, 0.0, ())
    given = situation([target])
    k = np.arange(round(seconds * 10) + 1.0)
    baseline = replace(given.baseline, s=1.0 * k, v=0.0 * k + 10.0, a=0.0 * k)
    return replace(given, baseline=baseline)


def walked(
    given: Situation, label: str, values: Mapping[str, float], seconds: float, *, ego_speed: float = 10.0
) -> Track:
    """What the walker does with a shipped planner while the ego drives on at one speed."""
    (planner,) = next(e.planners for e in unprotected_library() if e.label == label)
    proposal = Proposal("walker", label, planner, {**planner.defaults(), **values}, 0.0, 0.0)
    target = given.targets["walker"]
    limits = UNPROTECTED_LIMITS[road_user(target.state)]

    def none(_: object) -> str:
        return "the planner failed"

    control = PlannedAdversary(given, "walker", limits, ask_trusted(proposal, given, none))
    rows: list[tuple[float, ...]] = []
    for k in range(round(seconds * 10)):
        if k % 5 == 0:
            assert control.replan(0.1 * k, (0.1 * ego_speed * k, 0.0, ego_speed, 0.0)) is None
        there = control.advance()
        rows.append((0.1 * (k + 1), there.x, there.y, there.heading, there.speed, control.acceleration))
    time, x, y, heading, speed, acceleration = np.array(rows).T
    return Track("walker", Role.ADVERSARY, time, x, y, heading, speed, acceleration, *size_of(target))


def size_of(target: Target) -> tuple[float, float]:
    return target.state.length, target.state.width


def broken(track: Track) -> list[str]:
    """The gates on the motion itself that a walker breaks."""
    steps = kinematic_gates(track.boxes(), track.acceleration, track.time, UNPROTECTED_LIMITS[road_user(track)])
    return [gate for gate, bad in steps.items() if bad[1:].any()]
