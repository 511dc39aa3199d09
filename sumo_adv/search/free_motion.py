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

_SOURCE = '''\
# Free Motion, mode "free"
PARAMETERS = {
    "wait": (0.5, 0.0, 3.0, "s", "how long it goes on as before"),
    "meet": (3.5, 1.5, 6.5, "s", "how long after that it meets the ego"),
    "ahead": (2.0, -4.0, 7.0, "m", "how far ahead of the ego's centre its own is then"),
    "left": (0.0, -2.5, 2.5, "m", "how far to the left of it"),
    "pace": (0.5, 0.0, 1.2, "", "its speed then, as a share of the ego's and its own mean speed"),
    "swing": (0.0, -1.5, 1.5, "m", "how far beside its own way it goes first"),
}

import math


def endpoint(bv, ego, road, parameters, acc, horizon):
    left_over = parameters["wait"] + parameters["meet"] - bv["time"]
    if bv["time"] < parameters["wait"]:
        time = max(parameters["wait"] - bv["time"], 1.5)
        way = nearest(bv, road)
        return beside(way, bv["travelled"] + max(bv["speed"], 0.5) * time, parameters["swing"], bv["speed"], time)
    time = max(left_over, 0.8)
    for _ in range(3):
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


def nearest(bv, road):
    """The way that passes closest to where it is."""
    best = road["ways"][0]
    least = 1e9
    for way in road["ways"]:
        line = way["centreline"]
        i = int(clip(bv["travelled"] / 2.0, 0.0, len(line) - 1.0))
        d = (line[i][0] - bv["x"]) ** 2 + (line[i][1] - bv["y"]) ** 2
        if d < least - 0.5:
            least = d
            best = way
    return best


def beside(way, station, left, speed, time):
    """A point beside the way's centreline (one point every 2 m)."""
    line = way["centreline"]
    u = clip(station / 2.0, 0.0, len(line) - 1.001)
    i = int(u)
    w = u - i
    a = line[i]
    b = line[i + 1]
    heading = math.atan2(b[1] - a[1], b[0] - a[0])
    x, y = offset((a[0] + (b[0] - a[0]) * w, a[1] + (b[1] - a[1]) * w, heading), 0.0, left)
    return {"x": x, "y": y, "heading": heading, "speed": speed, "time": time}
'''

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
