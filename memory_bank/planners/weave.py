# $label, mode "weave"
# Two stretches of even acceleration and two moves sideways, each to a lane or a little off its middle; it does not
# wait for the ego, so it is the prediction that finds numbers with which they meet.
PARAMETERS = {
    "pull": (-1.5, -4.0, 2.0, "m/s2", "mean acceleration at first"),
    "until": (3.0, 1.5, 6.0, "s", "when that ends"),
    "then": (0.0, -4.0, 2.0, "m/s2", "mean acceleration after it"),
    "span": (3.0, 1.5, 6.0, "s", "how long that lasts; the speed is kept from then on"),
    "begin": (1.0, 0.0, 5.0, "s", "when the first move sideways begins"),
    "lane": (0.0, -1.5, 1.5, "", "where to: above 0.5 the lane on the left, below -0.5 the one on the right, else its own"),
    "stray": (1.2, -1.3, 1.3, "m", "how far off the middle of that lane, to the left"),
    "again": (4.0, 2.0, 6.0, "s", "how much later the second move begins"),
    "lane_2": (0.0, -1.5, 1.5, "", "where the second move goes to"),
    "stray_2": (0.6, -1.3, 1.3, "m", "how far off the middle of that lane"),
    "drift": (4.0, 2.5, 6.5, "s", "duration of a move sideways"),
}

import math

MOVEMENT = "$movement"


def endpoint(bv, ego, road, parameters, acc, horizon):
    way = road["ways"][find_way(road)]
    now = bv["time"]
    wanted, since = sideways(now, road, parameters)
    time = max(parameters["drift"] - since, 1.5)
    start = road["start"]["speed"]
    speed = speed_at(now + time, start, parameters)
    middle = speed_at(now + time / 2, start, parameters)
    distance = (bv["speed"] + 4.0 * middle + speed) / 6.0 * time
    return beside(way, bv["travelled"] + distance, wanted, speed, time)


def sideways(now, road, parameters):
    """The offset from its way that it wants to have, and for how long it has wanted that."""
    since = now - parameters["begin"]
    if since < 0.0:
        return 0.0, parameters["drift"]
    if since < parameters["again"]:
        return lane(road, parameters["lane"]) + parameters["stray"], since
    return lane(road, parameters["lane_2"]) + parameters["stray_2"], since - parameters["again"]


def lane(road, which):
    """The offset of the middle of a lane beside its own, 0 for its own and where there is none."""
    for side in road["sides"]:
        if which > 0.5 and side["offset"] > 0.0:
            return side["offset"]
        if which < -0.5 and side["offset"] < 0.0:
            return side["offset"]
    return 0.0


def speed_at(time, start, parameters):
    """Two stretches of even acceleration, then an even speed."""
    first = min(time, parameters["until"])
    second = clip(time - parameters["until"], 0.0, parameters["span"])
    slower = max(start + parameters["pull"] * first, 0.0)
    return max(slower + parameters["then"] * second, 0.0)


def find_way(road):
    """The way that makes the movement of this planner and meets the ego's path; any that meets it otherwise."""
    best = 0
    for i, way in enumerate(road["ways"]):
        if way["conflict"] is not None and MOVEMENT != "none":
            if way["movement"] == MOVEMENT:
                return i
            best = i
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
