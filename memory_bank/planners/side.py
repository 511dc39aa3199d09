# $label, mode "side"
# Leads the adversary to a place beside or just ahead of the ego, then moves it sideways into the ego's lane.
# One that drives in the ego's own lane first leaves it to a free side and comes back from there.
# Times s, distances m, speeds m/s; "gap" is the adversary's front minus the ego's front when they meet.
PARAMETERS = {
    "gap": ($gap, "m", "adversary's front minus ego's front when they meet"),
    "speed": (0.0, -1.5, 1.5, "m/s", "speed relative to the ego when they meet"),
    "drift": (4.5, 2.5, 7.0, "s", "duration of the move into the ego's lane"),
    "gate": (1.2, 0.8, 2.0, "m", "how exact the place must be before the move begins"),
    "side": (1.0, -1.0, 1.0, "", "side to come from where it drives in the ego's lane: -1 right, 1 left"),
    "across": ($across, "m", "how far beyond the ego's lane centre it moves"),
    "brake": ($brake, "m/s2", "braking once it is in the ego's lane"),
}

import math


def base_lane(bv, road, parameters):
    """Lateral place relative to the ego's path from which the move begins."""
    start = road["left"]
    width = road["lane_width"]
    if abs(start) >= 1.6:
        return width if start > 0 else -width
    best = 0.0
    for side in road["sides"]:
        if side["kind"] == "same" and abs(side["offset"]) < 1.6 * width:
            if best == 0.0 or side["offset"] * parameters["side"] > 0:
                best = start + side["offset"]
    return best


def endpoint(bv, ego, road, parameters, acc, horizon):
    gap = parameters["gap"]
    relative_speed = parameters["speed"]
    base = base_lane(bv, road, parameters)
    final = -parameters["across"] if base > 0 else parameters["across"]
    half = (bv["length"] - ego["length"]) / 2
    place = bv["ahead"] + half
    closing = bv["speed_along"] - ego["speed"]
    moving_in = abs(bv["target_left"] - final) < 0.5 and base != 0.0
    apart = abs(bv["left"]) > 2.0
    if not moving_in and abs(bv["left"] - base) < 0.7:
        near = abs(place + 0.3 * parameters["drift"] * closing - gap) < parameters["gate"]
        if near and abs(place - gap) < 4.0:
            return beside(ego, gap - half, final, relative_speed, parameters["drift"])
    if moving_in and (bv["lateral_time"] > 0.0 or apart):
        return beside(ego, gap - half, final, relative_speed, max(bv["lateral_time"], 0.6))
    if moving_in:
        return brake_ahead(bv, ego, parameters, acc)
    goal = gap
    if not apart and place > 0:
        goal = max(gap, min(place, bv["length"] + 8.0))
    elif not apart:
        goal = min(gap, max(place, -ego["length"] - 6.0))
    time = 2.0
    if abs(bv["target_left"] - base) > 0.5:
        time = 3.5
    elif not apart:
        time = max(bv["lateral_time"], 2.0)
    rate = 0.45
    there = place + clip((goal - place) * (1.0 - math.exp(-rate * time)), -8.0 * time, 10.0 * time)
    speed = relative_speed + clip(rate * (goal - there), -8.0, 10.0)
    return beside(ego, there - half, base, speed, time)


def beside(ego, ahead, left, speed, time):
    """An endpoint at a place relative to where the ego will be."""
    pose = at(ego["path"], time)
    x, y = offset(pose, ahead, left)
    return {"x": x, "y": y, "heading": pose[2], "speed": max(0.0, pose[3] + speed), "time": time}


def brake_ahead(bv, ego, parameters, acc):
    """In the ego's lane: brake."""
    wanted = -acc if isinstance(acc, (int, float)) and acc < 0 else 0.0
    braking = max(parameters["brake"], wanted, 0.01)
    time = 1.5
    speed = max(0.0, bv["speed"] - braking * time)
    travelled = (bv["speed"] + speed) / 2 * time
    pose = place(ego, bv["ahead"] + travelled)
    x, y = offset(pose, 0.0, bv["target_left"])
    return {"x": x, "y": y, "heading": pose[2], "speed": speed, "time": time}


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
