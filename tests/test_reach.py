"""Whether a vehicle of a recording could reach the ego, in metres."""

from __future__ import annotations

from typing import Any

import numpy as np

from sumo_adv.datatypes import Role, Track
from sumo_adv.episode.encounter_builder import nearest_reach, why_nobody


def track(name: str, x: float, speed: float, length: float = 4.0, steps: int = 41) -> Track:
    """A vehicle that drives along x from 0 to 4 s."""
    time = np.arange(steps) * 0.1
    given: dict[str, Any] = {
        "time": time, "x": x + speed * time, "y": np.zeros(steps), "heading": np.zeros(steps),
        "speed": np.full(steps, speed), "acceleration": np.zeros(steps), "lane": [""] * steps,
    }  # fmt: skip
    return Track(id=name, role=Role.BACKGROUND, length=length, width=2.0, **given)


def test_a_vehicle_that_stands_behind_a_faster_ego_is_short() -> None:
    """From 0 to 5 m/s by 4 m/s2 takes 1.25 s and 3.125 m. The ego is 20 m ahead and drives off at 10 m/s, so the gap
    between the boxes, 16 m at first, grows from the beginning: at .1 s it is 16 + 1 - .02 = 16.98 m."""
    tracks = {t.id: t for t in (track("ego", 20.0, 10.0), track("stands", 0.0, 0.0))}
    reach = nearest_reach(tracks, "ego", 0.0, 4.0)
    assert reach is not None
    assert (reach.vehicle, round(reach.short, 2), round(reach.time, 1)) == ("stands", 16.98, 0.1)
    assert "'stands' comes nearest, and is 17.0 m short at 0.1 s" in why_nobody(tracks, "ego", 0.0, 4.0)


def test_one_that_can_catch_up_reaches_it_and_nobody_is_said_so() -> None:
    tracks = {t.id: t for t in (track("ego", 20.0, 0.0), track("fast", 0.0, 10.0))}
    reach = nearest_reach(tracks, "ego", 0.0, 4.0)
    assert reach is not None and reach.short < 0.0
    assert why_nobody({"ego": tracks["ego"]}, "ego", 0.0, 4.0) == "no other vehicle is there"
