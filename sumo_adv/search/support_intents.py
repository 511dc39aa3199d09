"""The intents of supports: what another vehicle can do so that a collider succeeds, each with its planner.

They are not part of the memory bank, because a support alone is no attack. A composition of the bank refers to them by
label and mode, as it refers to intents of the bank.
"""

from __future__ import annotations

from collections.abc import Mapping
from string import Template

from sumo_adv.datatypes import Duty, LibraryEntry
from sumo_adv.planners.text import make_planner
from sumo_adv.road_users import is_unprotected
from sumo_adv.search.intents import EXPERT
from sumo_adv.situation import Target

ALONG_RELATIONS = ("neighbour", "leader", "follower")  # relations of vehicles that drive along the ego's path
MIN_LANE_OFFSET_M = 1.6  # from the ego's path; vehicles at least this far away are in a lane beside it

_PLACE = '''

def place(ego, distance):
    """The pose on the ego's predicted path that lies ``distance`` metres from the ego, straight on past its end."""
    path = ego["path"]
    left = distance
    for i in range(len(path) - 1):
        a = path[i]
        b = path[i + 1]
        step = math.sqrt((b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2)
        if step > 0.05 and left <= step:
            w = left / step
            return (a[1] + (b[1] - a[1]) * w, a[2] + (b[2] - a[2]) * w, a[3] + wrap(b[3] - a[3]) * w)
        left -= step
    end = path[len(path) - 1]
    x, y = offset((end[1], end[2], end[3]), left, 0.0)
    return (x, y, end[3])
'''

_KEEP = Template("""\
# $label, mode "beside"
# Gets to a place beside the ego and keeps it. One that drives in the ego's lane first moves to the lane beside it.
PARAMETERS = {
    "ahead": ($ahead, "m", "its centre ahead of the ego's"),
    "rate": (0.5, 0.3, 0.9, "1/s", "how fast it gets there"),
    "side": ($side, "", "the lane that it moves to from the ego's: 1 left, -1 right"),
}

import math


def endpoint(bv, ego, road, parameters, acc, horizon):
    lane = road["left"]
    if abs(lane) < 1.6:
        lane = parameters["side"] * road["lane_width"]
    rate = parameters["rate"]
    time = 2.0
    goal = parameters["ahead"]
    if abs(bv["target_left"] - lane) > 0.5:
        time = 3.5
    elif abs(bv["left"] - lane) > 0.3:
        time = max(bv["lateral_time"], 2.0)
    if abs(bv["left"] - lane) > 1.0:
        goal = bv["ahead"]
    there = bv["ahead"] + clip((goal - bv["ahead"]) * (1.0 - math.exp(-rate * time)), -6.0 * time, 6.0 * time)
    pose = at(ego["path"], time)
    x, y = offset(pose, there, lane)
    speed = max(0.0, pose[3] + clip(rate * (goal - there), -6.0, 6.0))
    return {"x": x, "y": y, "heading": pose[2], "speed": speed, "time": time}
""")

_PACE = Template(
    """\
# $label, mode "pace"
# Keeps its lane and, after a wait, changes its speed and keeps the new one.
PARAMETERS = {
    "wait": (0.0, 0.0, 3.0, "s", "time before it changes its speed"),
    "change": ($change, "m/s", "how much faster it becomes than it was at the takeover; negative: slower"),
    "rate": (2.0, 1.0, 3.5, "m/s2", "acceleration or braking for that"),
}

import math


def endpoint(bv, ego, road, parameters, acc, horizon):
    time = 1.5
    speed = road["start"]["speed"]
    if bv["time"] >= parameters["wait"]:
        speed = max(0.0, speed + parameters["change"])
    step = parameters["rate"] * time
    speed = clip(speed, max(0.0, bv["speed"] - step), bv["speed"] + step)
    pose = place(ego, bv["ahead"] + (bv["speed"] + speed) / 2 * time)
    x, y = offset(pose, 0.0, road["left"])
    return {"x": x, "y": y, "heading": pose[2], "speed": speed, "time": time}
"""
    + _PLACE
)

_PASS = Template(
    """\
# $label, mode "pass"
# Comes towards the ego on its own lane, so fast that it is beside the ego at a given time.
PARAMETERS = {
    "when": (4.0, 1.5, 9.0, "s", "time after the takeover at which it passes the ego"),
}

import math


def endpoint(bv, ego, road, parameters, acc, horizon):
    time = 2.0
    speed = bv["speed"]
    left = parameters["when"] - bv["time"]
    if left > 1.0:
        usual = road["start"]["speed"]
        speed = clip(bv["ahead"] / left - ego["speed"], 0.6 * usual, min(1.3 * usual, road["fastest"]))
        speed = clip(speed, bv["speed"] - 3.0 * time, bv["speed"] + 2.0 * time)
    pose = place(ego, bv["ahead"] - (bv["speed"] + speed) / 2 * time)
    x, y = offset(pose, 0.0, road["left"])
    return {"x": x, "y": y, "heading": wrap(pose[2] + math.pi), "speed": speed, "time": time}
"""
    + _PLACE
)


def _entry(
    label: str, description: str, applies: tuple[str, ...], mode: str, template: Template, **numbers: str
) -> LibraryEntry:
    """Return an intent of a support with the planner that the template gives."""
    text = template.substitute(label=label, **numbers)
    return LibraryEntry(label, description, applies, (make_planner(label, mode, text, EXPERT),))


_BLOCK = "The vehicle keeps beside the ego on its {} side and takes the room into which the ego would swerve."
_MEET = "An oncoming vehicle passes the ego just when the ego would swerve to the {}, and leaves no room for it."

SUPPORT_INTENTS: Mapping[Duty, tuple[LibraryEntry, ...]] = {
    Duty.BLOCK_LEFT: (
        _entry(
            "Escape Block Left", _BLOCK.format("left"), ALONG_RELATIONS, "beside", _KEEP, ahead="0.0, -5.0, 7.0",
            side="1.0, 1.0, 1.0",
        ),
        _entry("Oncoming Block Left", _MEET.format("left"), ("oncoming",), "pass", _PASS),
    ),
    Duty.BLOCK_RIGHT: (
        _entry(
            "Escape Block Right", _BLOCK.format("right"), ALONG_RELATIONS, "beside", _KEEP, ahead="0.0, -5.0, 7.0",
            side="-1.0, -1.0, -1.0",
        ),
    ),
    Duty.SLOW: (
        _entry(
            "Slow Leader", "The vehicle ahead of the ego in its lane becomes slower and holds the ego up.", ("leader",),
            "pace", _PACE, change="-5.0, -14.0, -1.0",
        ),
    ),
    Duty.HIDE: (
        _entry(
            "View Screen", "The vehicle keeps ahead of the ego beside its lane and hides another one from it.",
            ("neighbour",), "beside", _KEEP, ahead="9.0, 5.0, 20.0", side="1.0, -1.0, 1.0",
        ),
    ),
    Duty.OPEN: (
        _entry(
            "Gap Opening", "The vehicle changes its speed and opens a gap into which another one can go.",
            ALONG_RELATIONS, "pace", _PACE, change="-4.0, -10.0, 6.0",
        ),
    ),
}  # fmt: skip
"""The intents of supports, by duty."""


def can_do_duty(duty: Duty, entry: LibraryEntry, target: Target) -> bool:
    """Return whether a vehicle can do a duty from its current position.

    Pedestrians and cyclists have no duties.

    Args:
        duty: The duty of a support.
        entry: The intent by which the vehicle would do it.
        target: The vehicle.
    """
    if target.relation not in entry.applies or not target.ways or is_unprotected(target.state):
        return False
    left = float(target.ways[0].ego_d[0] + target.offset)
    if duty not in (Duty.BLOCK_LEFT, Duty.BLOCK_RIGHT):
        return True
    side = 1.0 if duty is Duty.BLOCK_LEFT else -1.0
    if abs(left) >= MIN_LANE_OFFSET_M:
        return left * side > 0.0
    return any(kind == "same" and offset * side > 0.0 for offset, kind in target.sides)
