"""Free motions: to a place near where the ego will be, at a time and a speed of the vehicle's own, whatever its lane.

They are offered in recordings, where vehicles stand as no intent of the library expects. An attempt of one is named
afterwards by what it came to (``named``). It is no part of the memory bank until a success adds it to an intent.
"""

from __future__ import annotations

from dataclasses import replace

from sumo_adv.datatypes import LibraryEntry, Proposal, Verdict
from sumo_adv.planners.source import make_planner
from sumo_adv.search.composed_intents import NAME, NEW_INTENTS
from sumo_adv.situation import Target

_SOURCE = """\
# Free Motion, mode "free"
PARAMETERS = {
    "meet": (4.0, 1.5, 7.5, "s", "how long after its start it meets the ego"),
    "ahead": (2.0, -4.0, 7.0, "m", "how far ahead of the ego's centre its own is then"),
    "left": (0.0, -2.5, 2.5, "m", "how far to the left of it"),
    "pace": (0.5, 0.0, 1.2, "", "its speed then, as a share of the ego's and its own mean speed"),
}

import math


def endpoint(bv, ego, road, parameters, acc, horizon):
    time = max(parameters["meet"] - bv["time"], 0.8)
    for _ in range(3):  # later where it cannot be there in time
        pose = at(ego["path"], time)
        x, y = offset(pose, parameters["ahead"], parameters["left"])
        dx = x - bv["x"]
        dy = y - bv["y"]
        time = max(time, 1.2 * math.sqrt(dx * dx + dy * dy) / max(road["fastest"], 1.0))
    heading = bv["heading"]
    if dx * dx + dy * dy > 25.0:
        heading = math.atan2(dy, dx)
    if bv["ahead"] * bv["ahead"] + bv["left"] * bv["left"] < 900.0 and abs(wrap(pose[2] - heading)) < 0.5:
        heading = pose[2]
    mean = 0.5 * (pose[3] + road["start"]["speed"])
    speed = clip(parameters["pace"] * mean, 0.0, road["fastest"])
    return {"x": x, "y": y, "heading": heading, "speed": speed, "time": time}
"""

LABEL = "Free Motion"
VEHICLES = (
    "leader", "follower", "neighbour", "oncoming", "crossing_left", "crossing_straight", "crossing_right", "merging",
)  # fmt: skip
FREE = LibraryEntry(
    LABEL,
    "The vehicle leaves its way and goes to where the ego will be, at a time and a speed of its own.",
    VEHICLES,
    (make_planner(LABEL, "free", _SOURCE, NAME),),
    "generated",
)

_SIDES = {
    ("leader", "front"): "Emergency Braking",
    ("neighbour", "front"): "Aggressive Cut-in",
    ("neighbour", "left"): "Straight Lane Shift",
    ("neighbour", "right"): "Straight Lane Shift",
    ("neighbour", "rear"): "Close Car-following",
    ("follower", "rear"): "Close Car-following",
}  # by relation and the side of the ego that is hit
_WORDS = {
    "oncoming": "Opposite Direction Intrusion",
    "crossing_straight": "Intersection Rush-through Go-straight",
    "crossing_left": "Intersection Rush-through Turn Left",
    **{word: label for word, (label, _, _) in NEW_INTENTS.items()},
}


def named(p: Proposal, target: Target, verdict: Verdict) -> Proposal:
    """A free motion that collided, with the label of the intent that it carried out; it keeps its own where none fits.

    Of a vehicle that crosses or merges it is the intent of its way that meets the ego's path soonest.
    """
    if p.label != LABEL or not verdict.collided:
        return p
    label = _SIDES.get((target.relation, verdict.contact_side or ""))
    if label is None:
        label = next((_WORDS[word] for word in _by_conflict(target) if word in _WORDS), None)
    return p if label is None else replace(p, label=label, planner=replace(p.planner, label=label))


def _by_conflict(target: Target) -> list[str]:
    """What ``applies`` says, of the way that meets the ego's path soonest alone where the vehicle's ways do."""
    meeting = [w for w in target.ways if w.conflict is not None]
    if target.relation == "oncoming" or not meeting:
        return list(target.applies())
    soonest = min(meeting, key=lambda w: w.conflict.bv_s if w.conflict is not None else 0.0)
    return list(replace(target, ways=(soonest,)).applies())
