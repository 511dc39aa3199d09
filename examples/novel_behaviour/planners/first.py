# Blind-Side High-Speed Merge, mode "swing"
# Speeds up along the inner turning lane, comes out of the ego's blind side, and merges ahead of it after the bend.
PARAMETERS = {
    "lead": (7.0, 3.0, 12.0, "m", "how far its front is ahead of the ego's front when it merges"),
    "drift": (3.0, 2.0, 5.0, "s", "duration of the merge"),
}


def endpoint(bv, ego, road, parameters, acc, horizon):
    place = bv["ahead"] + (bv["length"] - ego["length"]) / 2
    merging = abs(bv["target_left"]) < 0.5
    time = 1.5
    left = road["left"]
    if merging or place >= parameters["lead"]:
        left = 0.0
        time = max(bv["lateral_time"], 0.6) if merging else parameters["drift"]
    speed = clip(ego["speed"] + 0.6 * (parameters["lead"] - place), 2.0, road["fastest"])
    travelled = (bv["speed"] + speed) / 2 * time
    x, y, heading = ahead_of(ego, bv["ahead"] + travelled, left)
    return {"x": x, "y": y, "heading": heading, "speed": speed, "time": time}


def ahead_of(ego, distance, left):
    """The place that lies ``distance`` metres on along the ego's predicted path, ``left`` metres to its left."""
    path = ego["path"]
    rest = distance
    for i in range(len(path) - 1):
        a = path[i]
        b = path[i + 1]
        step = ((b[1] - a[1]) ** 2 + (b[2] - a[2]) ** 2) ** 0.5
        if step > 0.05 and rest <= step:
            w = rest / step
            pose = (a[1] + (b[1] - a[1]) * w, a[2] + (b[2] - a[2]) * w, wrap(a[3] + wrap(b[3] - a[3]) * w))
            x, y = offset(pose, 0.0, left)
            return (x, y, pose[2])
        rest -= step
    end = (path[-1][1], path[-1][2], path[-1][3])
    x, y = offset(end, rest, left)
    return (x, y, end[2])
