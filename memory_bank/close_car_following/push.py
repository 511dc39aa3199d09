# Close Car-following, mode "push"
# Drives behind the ego in its lane, closes up to a very small gap and stays there.
PARAMETERS = {
    "gap": (1.5, 0.5, 4.0, "m", "bumper gap it closes up to"),
    "speed": (0.3, 0.0, 2.0, "m/s", "speed by which it still closes at that gap"),
    "rate": (0.5, 0.2, 0.9, "1/s", "how fast the rest of the gap is closed"),
}


def endpoint(bv, ego, road, parameters, acc, horizon):
    time = 1.5
    pose = at(ego["path"], time)
    gap = -bv["ahead"] - (bv["length"] + ego["length"]) / 2
    left_over = max(parameters["gap"], gap - clip((gap - parameters["gap"]) * parameters["rate"] * time, -3.0, 8.0))
    x, y = offset(pose, -left_over - (bv["length"] + ego["length"]) / 2, 0.0)
    closing = clip((left_over - parameters["gap"]) * parameters["rate"], -2.0, 6.0) + parameters["speed"]
    return {"x": x, "y": y, "heading": pose[2], "speed": max(0.0, pose[3] + closing), "time": time}
