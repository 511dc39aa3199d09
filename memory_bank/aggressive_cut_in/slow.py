# Aggressive Cut-in, mode "slow"
# Drives ahead of the ego in the next lane, slows down there, comes to the edge of the ego's lane, and pulls in when the
# ego has nearly caught up, like a vehicle that leaves a queue.
# A vehicle in the ego's own lane first leaves it to a free side and comes back from there.
# Times s, distances m, speeds m/s; "reach" is the time until the ego's front would be at its rear.
PARAMETERS = {
    "ahead": (26.0, 12.0, 50.0, "m", "how far its rear is ahead of the ego's front when it slows down"),
    "slower": (8.0, 4.0, 14.0, "m/s", "how much slower than the ego it becomes"),
    "braking": (3.0, 1.5, 4.5, "m/s2", "how hard it slows down"),
    "edge": (0.6, 0.2, 1.0, "m", "how far its side is from the ego's side while it waits at the edge"),
    "reach": (7.0, 4.0, 12.0, "s", "the time at which it comes to the edge of the ego's lane"),
    "drift": (2.2, 1.5, 3.5, "s", "duration of the move to the edge"),
    "gap": (2.5, 0.5, 6.0, "m", "from the ego's front to its rear when it is about to overlap the ego's width"),
    "swing": (1.8, 1.4, 3.0, "s", "duration of the move in, longer or shorter to be in time"),
    "side": (1.0, -1.0, 1.0, "", "side to come from where it drives in the ego's lane: -1 right, 1 left"),
    "across": (0.4, -0.4, 1.2, "m", "how far short of the ego's lane centre it ends"),
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
    rear = bv["ahead"] - (bv["length"] + ego["length"]) / 2
    closing = ego["speed"] - bv["speed_along"]
    reach = rear / closing if closing > 0.5 else 99.0
    slow = max(0.0, ego["speed"] - parameters["slower"])
    stage = "base"
    if base != 0.0 and bv["last"] is not None:
        stage = nearest(bv["target_left"], base, edge, final)
    if stage == "in":
        return forward(bv, ego, final, slow, parameters["braking"], max(bv["lateral_time"], 0.6))
    fast = ego["speed"] + clip(0.45 * (parameters["ahead"] + 2.0 - rear), 1.0, 8.0)
    if stage == "edge" and rear < 0.0:
        return forward(bv, ego, base, fast, 3.0, parameters["drift"])
    if stage == "edge":
        share = (abs(bv["left"]) - (bv["width"] + ego["width"]) / 2) / max(abs(bv["left"] - final), 0.1)
        until = (rear - parameters["gap"]) / closing if closing > 0.5 else 99.0
        due = part_of_move(share)
        if until <= due * parameters["swing"] + 0.3:
            duration = clip(until / due, 0.8 * parameters["swing"], 1.5 * parameters["swing"])
            return forward(bv, ego, final, slow, parameters["braking"], duration)
        return forward(bv, ego, edge, slow, parameters["braking"], max(bv["lateral_time"], 0.6))
    if base != 0.0 and abs(bv["left"] - base) < 0.7 and reach <= parameters["reach"]:
        return forward(bv, ego, edge, slow, parameters["braking"], parameters["drift"])
    time = 2.0
    if abs(bv["target_left"] - base) > 0.5:
        time = 3.5
    elif abs(bv["left"] - base) > 0.7:
        time = max(bv["lateral_time"], 2.0)
    if rear >= parameters["ahead"] or (closing > 0.5 and rear > 0.0):
        return forward(bv, ego, base, slow, parameters["braking"], time)
    return forward(bv, ego, base, fast, 3.0, time)


def part_of_move(share):
    """The part of a move's time in which it makes a share of its way: 10 u^3 - 15 u^4 + 6 u^5 = share."""
    low = 0.05
    high = 1.0
    for i in range(12):
        u = (low + high) / 2
        if u * u * u * (10.0 + u * (6.0 * u - 15.0)) < share:
            low = u
        else:
            high = u
    return (low + high) / 2


def nearest(wanted, base, edge, final):
    """Which of the three places it is on its way to, or at."""
    if abs(wanted - final) < abs(wanted - edge):
        return "in"
    return "edge" if abs(wanted - edge) < abs(wanted - base) else "base"


def forward(bv, ego, left, wanted, rate, time):
    """An endpoint ahead: it goes for a speed at a rate."""
    change = clip(wanted - bv["speed"], -rate * time, rate * time)
    span = abs(change) / rate
    speed = bv["speed"] + change
    travelled = (bv["speed"] + speed) / 2 * span + speed * (time - span)
    pose = place(ego, bv["ahead"] + travelled)
    x, y = offset(pose, 0.0, left)
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
