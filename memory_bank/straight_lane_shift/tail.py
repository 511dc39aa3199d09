# Straight Lane Shift, mode "tail"
# Slows down ahead of the ego while it pulls out of its lane, and comes to a stand, or nearly, before it is quite out:
# its tail stays in the way of an ego that takes the lane for free.
PARAMETERS = {
    "wait": (0.5, 0.0, 3.0, "s", "time before it slows down"),
    "braking": (2.0, 1.0, 4.0, "m/s2", "how hard it slows down"),
    "creep": (0.5, 0.0, 2.0, "m/s", "the speed it slows down to"),
    "turn": (1.5, 0.0, 5.0, "s", "time before it pulls out"),
    "drift": (5.0, 2.5, 8.0, "s", "duration of pulling out"),
    "aside": (2.2, 1.7, 2.8, "m", "how far off the middle of its lane it comes to stand"),
    "side": (1.0, -1.0, 1.0, "", "side it pulls out to where both are free: -1 right, 1 left"),
}

import math


def endpoint(bv, ego, road, parameters, acc, horizon):
    now = bv["time"]
    since = now - parameters["turn"]
    left = side_of(road, parameters) * parameters["aside"] if since >= 0.0 else 0.0
    time = max(parameters["drift"] - max(since, 0.0), 1.5)
    speed = speed_at(now + time, road, parameters)
    middle = speed_at(now + time / 2, road, parameters)
    distance = (bv["speed"] + 4.0 * middle + speed) / 6.0 * time
    return beside(road["ways"][0], bv["travelled"] + distance, left, speed, time)


def side_of(road, parameters):
    """1 to the left, -1 to the right: where there is a lane, of two the wanted one."""
    wanted = 1.0 if parameters["side"] >= 0.0 else -1.0
    for side in road["sides"]:
        if side["offset"] * wanted > 0.0:
            return wanted
    return -wanted if road["sides"] else wanted


def speed_at(time, road, parameters):
    """It keeps its speed, then slows down evenly."""
    slower = road["start"]["speed"] - parameters["braking"] * max(time - parameters["wait"], 0.0)
    return max(slower, min(parameters["creep"], road["start"]["speed"]))


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
