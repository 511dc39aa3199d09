# $label, mode "commit"
# Waits well short of the junction, where the ego does not count it as waiting, and rushes once the ego has set off.
PARAMETERS = {
    "short": (16.0, 9.0, 26.0, "m", "how far short of the conflict point it waits"),
    "near": (16.0, 8.0, 25.0, "m", "the ego's distance to the conflict point within which setting off counts"),
    "urge": (3.4, 2.0, 3.9, "m/s2", "how hard it accelerates then"),
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
    stop = left_over - parameters["short"]
    gone = bv["last"] is not None and bv["last"]["speed"] > 0.0
    gap = math.sqrt((ego["x"] - conflict["x"]) ** 2 + (ego["y"] - conflict["y"]) ** 2)
    sets_off = gap < parameters["near"] and ego["speed"] > 0.4 and ego["acceleration"] > 0.2
    if not gone and not sets_off and stop > -2.0:
        time = clip(2.0 * max(stop, 0.3) / max(bv["speed"], 0.5), 1.0, 15.0)
        return along(way, bv["travelled"] + max(stop, 0.0), 0.0, time)
    urge = parameters["urge"]
    time = (math.sqrt(bv["speed"] ** 2 + 2.0 * urge * left_over) - bv["speed"]) / urge
    speed = min(bv["speed"] + urge * time, road["fastest"])
    return {"x": conflict["x"], "y": conflict["y"], "heading": conflict["heading"], "speed": speed, "time": max(time, 0.6)}


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
