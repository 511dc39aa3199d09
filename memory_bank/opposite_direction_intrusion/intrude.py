# Opposite Direction Intrusion, mode "intrude"
# Comes towards the ego in the opposing lane and crosses over into the ego's lane shortly before they meet.
PARAMETERS = {
    "early": (0.8, -0.5, 3.0, "s", "how long before they meet the move is complete"),
    "drift": (3.2, 2.2, 5.5, "s", "duration of the move across the centre line"),
    "across": (0.0, -0.8, 3.2, "m", "how far beyond the ego's lane centre it moves"),
    "speed": (1.0, 0.6, 1.3, "", "its speed as a multiple of the one it came with"),
}

import math


def endpoint(bv, ego, road, parameters, acc, horizon):
    distance = bv["ahead"] - (bv["length"] + ego["length"]) / 2
    until = distance / max(bv["speed"] + ego["speed"], 1.0)
    final = -parameters["across"] if road["left"] > 0 else parameters["across"]
    moving = abs(bv["target_left"] - final) < 0.5
    time = 2.0
    left = bv["target_left"]
    if moving:
        left = final
        time = max(bv["lateral_time"], 1.0)
    elif until <= parameters["early"] + parameters["drift"]:
        left = final
        time = parameters["drift"]
    wish = road["start"]["speed"] * parameters["speed"]
    if isinstance(acc, (int, float)):
        wish = wish + clip(acc, -3.0, 2.0) * min(bv["time"], 2.0)
    speed = bv["speed"] + clip(wish - bv["speed"], -2.0 * time, 2.0 * time)
    travelled = (bv["speed"] + speed) / 2 * time
    pose = place(ego, bv["ahead"] - travelled)
    x, y = offset(pose, 0.0, left)
    return {"x": x, "y": y, "heading": wrap(pose[2] + math.pi), "speed": max(speed, 0.5), "time": time}


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
