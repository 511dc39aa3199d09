# Straight Lane Shift, mode "nudge"
# Leads the adversary to a place beside or just ahead of the ego, comes over to the edge of the ego's lane and drives on
# there, as one who wants to be let in; then it moves in, let in or not.
# One that drives in the ego's own lane first leaves it to a free side and comes back from there.
# Times s, distances m, speeds m/s; "gap" is the adversary's front minus the ego's front when they meet.
PARAMETERS = {
    "gap": (1.0, -2.5, 5.0, "m", "adversary's front minus ego's front when they meet"),
    "speed": (0.0, -1.0, 1.0, "m/s", "speed relative to the ego when they meet"),
    "edge": (0.3, 0.0, 0.9, "m", "how far its side is from the ego's side while it drives at the edge"),
    "drift": (3.5, 2.5, 5.0, "s", "duration of the move to the edge"),
    "early": (0.2, 0.0, 1.0, "s", "how long before that is complete it moves in"),
    "swing": (2.8, 2.0, 4.5, "s", "duration of the move in"),
    "gate": (2.0, 1.0, 3.5, "m", "how exact the place must be before it comes over"),
    "side": (1.0, -1.0, 1.0, "", "side to come from where it drives in the ego's lane: -1 right, 1 left"),
    "across": (0.0, -0.6, 1.2, "m", "how far short of the ego's lane centre it ends"),
    "brake": (3.0, 0.0, 7.0, "m/s2", "braking once it moves in"),
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
    base = base_lane(bv, road, parameters)
    side = 1.0 if base > 0 else -1.0
    edge = side * ((bv["width"] + ego["width"]) / 2 + parameters["edge"])
    final = side * parameters["across"]
    half = (bv["length"] - ego["length"]) / 2
    place = bv["ahead"] + half
    meet = parameters["gap"] - half
    wanted = bv["target_left"]
    stage = "base"
    if base != 0.0 and bv["last"] is not None:
        stage = nearest(wanted, base, edge, final)
    if stage == "in" and bv["lateral_time"] <= 0.5 * parameters["swing"]:
        return brake_ahead(bv, ego, parameters, acc)
    if stage == "in":
        return beside(ego, meet, final, parameters["speed"], bv["lateral_time"])
    if stage == "edge" and bv["lateral_time"] <= parameters["early"]:
        return beside(ego, meet, final, parameters["speed"], parameters["swing"])
    if stage == "edge":
        return beside(ego, meet, wanted, parameters["speed"], max(bv["lateral_time"], 0.8))
    apart = abs(bv["left"]) > 2.0
    if abs(bv["left"] - base) < 0.7 and base != 0.0:
        closing = bv["speed_along"] - ego["speed"]
        near = abs(place + 0.3 * parameters["drift"] * closing - parameters["gap"]) < parameters["gate"]
        if near and abs(place - parameters["gap"]) < 4.0:
            return beside(ego, meet, edge, parameters["speed"], parameters["drift"])
    goal = parameters["gap"]
    if not apart and place > 0:
        goal = max(goal, min(place, bv["length"] + 8.0))
    elif not apart:
        goal = min(goal, max(place, -ego["length"] - 6.0))
    time = 2.0
    if abs(wanted - base) > 0.5:
        time = 3.5
    elif not apart:
        time = max(bv["lateral_time"], 2.0)
    rate = 0.45
    there = place + clip((goal - place) * (1.0 - math.exp(-rate * time)), -8.0 * time, 10.0 * time)
    speed = parameters["speed"] + clip(rate * (goal - there), -8.0, 10.0)
    return beside(ego, there - half, base, speed, time)


def nearest(wanted, base, edge, final):
    """Which of the three places it is on its way to, or at."""
    if abs(wanted - final) < abs(wanted - edge):
        return "in"
    return "edge" if abs(wanted - edge) < abs(wanted - base) else "base"


def beside(ego, ahead, left, speed, time):
    """An endpoint at a place relative to where the ego will be."""
    pose = at(ego["path"], time)
    x, y = offset(pose, ahead, left)
    return {"x": x, "y": y, "heading": pose[2], "speed": max(0.0, pose[3] + speed), "time": time}


def brake_ahead(bv, ego, parameters, acc):
    """It moves in: it goes on to where it is going and brakes."""
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
