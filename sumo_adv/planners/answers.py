"""A planner's observation and its answer, and the frames of its endpoints."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from sumo_adv.datatypes import Endpoint, Floats, Proposal, acceleration_at
from sumo_adv.planners.session import Call
from sumo_adv.situation import Situation

PlannerObservation = tuple[dict[str, Any], dict[str, Any]]
"""The dictionaries ``bv`` and ``ego`` of a planner's call, in the frame of the ego at the trigger."""


@dataclass(frozen=True, slots=True)
class Answer:
    """A planner's answer, in the world.

    ``trajectory``: (n, 4) states x, y, heading, speed, one for each step from now on, without the present one. None
    means the built-in f_traj. ``remark``: why the planner's own trajectory was refused.
    """

    endpoint: Endpoint
    trajectory: Floats | None = None
    remark: str = ""


AskOne = Callable[[PlannerObservation], Answer | str]
"""Returns a planner's answer, or a sentence why there is none."""


def call_of(proposal: Proposal, road: str, observation: PlannerObservation, horizon: float) -> Call:
    """The call of a proposal's planner; ``road``: the key of its road in the session."""
    acceleration = acceleration_at(proposal.acceleration, observation[0]["time"])
    return road, *observation, proposal.parameters, acceleration, horizon


def local_endpoint(situation: Situation, end: Endpoint) -> dict[str, float]:
    """An endpoint in the frame of the ego at the trigger, as planners give it."""
    x, y, h = situation.frame.to_local(end.x, end.y, end.heading)
    return {"x": x, "y": y, "heading": h, "speed": end.speed, "time": end.time}


def world_endpoint(situation: Situation, end: Mapping[str, float]) -> Endpoint:
    """A planner's endpoint in the world."""
    x, y, h = situation.frame.to_world(end["x"], end["y"], end["heading"])
    return Endpoint(x, y, h, end["speed"], end["time"])
