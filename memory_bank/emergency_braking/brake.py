# Emergency Braking, mode "brake"
# Drives ahead in the ego's lane and brakes hard after a wait, to a standstill.
PARAMETERS = {
    "wait": (0.0, 0.0, 3.0, "s", "time before it brakes"),
    "braking": (7.5, 4.0, 8.0, "m/s2", "how hard it brakes"),
    "gap": (8.0, 3.0, 25.0, "m", "bumper gap it first lets the ego come up to"),
}

import math


def endpoint(bv, ego, road, parameters, acc, horizon):
    wanted = -acc if isinstance(acc, (int, float)) and acc < 0 else 0.0
    braking = max(parameters["braking"], wanted)
    gap = bv["ahead"] - (bv["length"] + ego["length"]) / 2
    braking_now = bv["last"] is not None and bv["last"]["speed"] == 0.0
    ready = bv["time"] >= parameters["wait"] and gap <= parameters["gap"] + 1.0
    if braking_now or ready or bv["time"] > horizon - 2.0:
        time = max(bv["speed"] / braking, 0.8)
        return ahead_in_lane(bv, ego, bv["speed"] * time / 2, 0.0, time)
    time = 1.5
    speed = max(ego["speed"] - clip((gap - parameters["gap"]) * 0.4, 0.0, 4.0), 0.5)
    return ahead_in_lane(bv, ego, (bv["speed"] + speed) / 2 * time, speed, time)


def ahead_in_lane(bv, ego, distance, speed, time):
    pose = place(ego, bv["ahead"] + distance)
    return {"x": pose[0], "y": pose[1], "heading": pose[2], "speed": speed, "time": time}


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
