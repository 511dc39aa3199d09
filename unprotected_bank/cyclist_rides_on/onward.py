# Cyclist Rides On, mode "onward"
# Rides straight on, so fast that it meets the ego where the ego's path crosses its way.
PARAMETERS = {
    "early": (0.3, -0.4, 1.6, "s", "how long before the ego's front it is in the middle of the ego's path"),
    "slowest": (2.5, 1.5, 4.0, "m/s", "how slowly it rides at least"),
    "fastest": (6.0, 4.5, 8.0, "m/s", "how fast it rides at most"),
}

import math


def endpoint(bv, ego, road, parameters, acc, horizon):
    index = choose(road)
    way = road["ways"][index]
    conflict = way["conflict"]
    if conflict is None:
        return along(way, bv["travelled"], road["start"]["speed"], 1.5)
    left_over = conflict["bv_distance"] - bv["travelled"]
    until = ego["arrivals"][index] - ego["length"] / 2 / max(ego["speed"], 3.0) - parameters["early"]
    wanted = left_over / clip(until, 0.4, 30.0)
    if left_over < 0.5:
        wanted = bv["speed"]
    return along(way, bv["travelled"], clip(wanted, parameters["slowest"], parameters["fastest"]), 1.5)


def choose(road):
    """The index of a way straight on that the ego's path crosses; 0 if there is none."""
    for i in range(len(road["ways"])):
        way = road["ways"][i]
        if way["movement"] != "across" and way["movement"] != "back" and way["conflict"] is not None:
            return i
    return 0


def along(way, travelled, speed, time):
    """Where it is on the way after ``time`` seconds at a speed."""
    line = way["centreline"]
    u = clip((travelled + speed * time) / 2.0, 0.0, len(line) - 1.001)
    i = int(u)
    a = line[i]
    b = line[i + 1]
    w = u - i
    heading = math.atan2(b[1] - a[1], b[0] - a[0])
    return {"x": a[0] + (b[0] - a[0]) * w, "y": a[1] + (b[1] - a[1]) * w, "heading": heading, "speed": speed, "time": time}
