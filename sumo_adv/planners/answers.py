"""What a planner answers, and the frames its endpoints are in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sumo_adv.datatypes import Endpoint, Floats
from sumo_adv.situation import Situation

Told = tuple[dict[str, Any], dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Answer:
    """What a planner answers, in the world: ``trajectory`` (n, 4: x, y, heading, speed, a step apart, the first a step
    from now) or None where the built-in f_traj is to be used; ``remark``: why a trajectory was refused."""

    endpoint: Endpoint
    trajectory: Floats | None = None
    remark: str = ""


def local_endpoint(situation: Situation, end: Endpoint) -> dict[str, float]:
    """An endpoint as the planner gave it, in the frame of the ego at the trigger."""
    x, y, h = situation.frame.to_local(end.x, end.y, end.heading)
    return {"x": x, "y": y, "heading": h, "speed": end.speed, "time": end.time}


def world_endpoint(situation: Situation, end: Mapping[str, float]) -> Endpoint:
    """A planner's answer in the world."""
    x, y, h = situation.frame.to_world(end["x"], end["y"], end["heading"])
    return Endpoint(x, y, h, end["speed"], end["time"])
