# $label, mode "tail"
# Drives through where it meets the ego's path, then slows down while it pulls over, and comes to a stand, or nearly,
# before it is quite out of the lane: its tail stays in the way of an ego that goes the same way.
PARAMETERS = {
    "pace": (6.0, 2.0, 11.0, "m/s", "speed until it slows down"),
    "past": (6.0, -4.0, 25.0, "m", "how far behind the place where they meet it slows down"),
    "braking": (2.0, 0.5, 4.0, "m/s2", "how hard"),
    "creep": (0.5, 0.0, 2.0, "m/s", "the speed it slows down to"),
    "turn": (0.0, -10.0, 10.0, "m", "how much later than it slows down it pulls over"),
    "drift": (4.5, 2.5, 7.0, "s", "duration of pulling over"),
    "aside": (2.0, 1.2, 2.8, "m", "how far off the middle of its lane it comes to stand"),
    "side": (1.0, -1.0, 1.0, "", "side it pulls over to: -1 right, 1 left"),
}

import math

MOVEMENT = "$movement"


def endpoint(bv, ego, road, parameters, acc, horizon):
    way = road["ways"][find_way(road)]
    meets = way["conflict"]["bv_distance"] if way["conflict"] is not None else 0.0
    gone = bv["travelled"] - meets - parameters["past"]
    left = 0.0
    time = 2.0
    if gone > parameters["turn"]:
        left = parameters["aside"] if parameters["side"] >= 0.0 else -parameters["aside"]
        time = bv["lateral_time"] if bv["lateral_time"] > 0.5 else parameters["drift"]
    distance, speed = advanced(gone, bv["speed"], time, parameters)
    return beside(way, bv["travelled"] + distance, left, speed, time)


def advanced(gone, speed, time, parameters):
    """The distance it covers within a time, and its speed then: at its pace, then slowing down evenly."""
    distance = 0.0
    left = time
    if gone < 0.0:
        span = min(left, -2.0 * gone / max(speed + parameters["pace"], 1.0))
        distance = (speed + parameters["pace"]) / 2 * span
        speed = parameters["pace"]
        left -= span
    slower = max(speed - parameters["braking"] * left, min(parameters["creep"], speed))
    span = min(left, (speed - slower) / parameters["braking"])
    distance += (speed + slower) / 2 * span + slower * (left - span)
    return distance, slower


def find_way(road):
    """The way that makes the movement of this planner and meets the ego's path; any that meets it otherwise."""
    best = 0
    for i, way in enumerate(road["ways"]):
        if way["conflict"] is not None:
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
