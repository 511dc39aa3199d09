# Opposite Direction Intrusion, mode "straddle"
# Comes towards the ego with one side over the centre line and slows down there, as if it were about to turn off; swings
# across the ego's lane only when the ego is so near that it cannot stop any more.
PARAMETERS = {
    "early": (5.5, 3.5, 8.5, "s", "how long before they would meet it begins to move over"),
    "over": (0.8, 0.4, 1.1, "m", "how far over the centre line its side is at first"),
    "pace": (3.0, 0.0, 8.0, "m/s", "the speed it slows down to meanwhile"),
    "braking": (2.5, 1.0, 4.0, "m/s2", "how hard"),
    "go": (14.0, 5.0, 26.0, "m", "bumper gap at which it swings across"),
    "drift": (2.8, 2.2, 3.8, "s", "duration of either move"),
    "across": (0.9, -0.8, 1.8, "m", "how far short of the ego's lane centre it ends"),
    "stop": (2.0, 0.0, 5.0, "m/s2", "braking while it swings across"),
}

import math


def endpoint(bv, ego, road, parameters, acc, horizon):
    distance = bv["ahead"] - (bv["length"] + ego["length"]) / 2
    until = distance / max(bv["speed"] + ego["speed"], 1.0)
    side = 1.0 if road["left"] > 0 else -1.0
    astride = (road["lane_width"] + bv["width"]) / 2 - parameters["over"]
    begun = bv["target_left"] * side < (abs(road["left"]) + astride) / 2
    if distance <= parameters["go"]:
        left = side * min(parameters["across"], astride - 0.1)
        return towards(bv, ego, left, 0.0, parameters["stop"], parameters["drift"])
    if begun or until <= parameters["early"]:
        return towards(bv, ego, side * astride, parameters["pace"], parameters["braking"], parameters["drift"])
    return towards(bv, ego, bv["target_left"], bv["speed"], 0.0, parameters["drift"])


def towards(bv, ego, left, pace, braking, drift):
    """A place further on, towards the ego, where it has slowed down to its pace or is about to."""
    time = drift
    if abs(bv["target_left"] - left) < 0.1:
        time = max(bv["lateral_time"], 1.0)
    speed = max(bv["speed"] - braking * time, min(pace, bv["speed"]))
    span = (bv["speed"] - speed) / braking if braking > 0.0 else 0.0
    travelled = (bv["speed"] + speed) / 2 * span + speed * (time - span)
    pose = place(ego, bv["ahead"] - travelled)
    x, y = offset(pose, 0.0, left)
    return {"x": x, "y": y, "heading": wrap(pose[2] + math.pi), "speed": speed, "time": time}


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
