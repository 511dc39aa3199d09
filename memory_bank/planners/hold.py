# $label, mode "hold"
# First hangs back as if it would give way, then rushes.
PARAMETERS = {
    "offset": (0.0, -0.9, 1.3, "s", "how much later than the ego's centre it is at the place where they meet"),
    "hold": (2.0, 0.8, 3.5, "s", "time it hangs back"),
    "slow": (0.5, 0.2, 0.8, "", "share of its speed it slows down to meanwhile"),
}

import math

MOVEMENT = "$movement"


def endpoint(bv, ego, road, parameters, acc, horizon):
    index = find_way(road)
    way = road["ways"][index]
    conflict = way["conflict"]
    left_over = conflict["bv_distance"] - bv["travelled"]
    if left_over <= 1.0:
        return along(way, bv["travelled"] + 1.5 * max(bv["speed"], 2.0), max(bv["speed"], 3.0), 1.5)
    arrival = ego["arrivals"][index]
    if arrival < 0.0:
        arrival = 0.0
    if arrival > 100.0:
        arrival = max(conflict["ego_distance"] / max(ego["speed"], 4.0), 4.0)
    if bv["time"] < parameters["hold"]:
        speed = road["start"]["speed"] * parameters["slow"]
        distance = min((bv["speed"] + speed) / 2 * 1.5, max(left_over - 6.0, 0.5))
        return along(way, bv["travelled"] + distance, speed, 1.5)
    time = clip(arrival + parameters["offset"], 0.6, 20.0)
    speed = clip(2.0 * left_over / time - bv["speed"], 0.5, road["fastest"])
    return {"x": conflict["x"], "y": conflict["y"], "heading": conflict["heading"], "speed": speed, "time": time}


def find_way(road):
    """The way that makes the movement of this planner and meets the ego's path; any that meets it otherwise."""
    best = 0
    for i, way in enumerate(road["ways"]):
        if way["conflict"] is not None:
            if way["movement"] == MOVEMENT:
                return i
            best = i
    return best


def along(way, station, speed, time):
    """A point on the way's centreline (one point every 2 m)."""
    line = way["centreline"]
    u = clip(station / 2.0, 0.0, len(line) - 1.001)
    i = int(u)
    w = u - i
    a = line[i]
    b = line[i + 1]
    heading = math.atan2(b[1] - a[1], b[0] - a[0])
    return {"x": a[0] + (b[0] - a[0]) * w, "y": a[1] + (b[1] - a[1]) * w, "heading": heading, "speed": speed, "time": time}
