# Cyclist Swerve, mode "swerve"
# Rides on at its own pace, the ego's way or against it, until the ego is about to pass, and then swings out into the
# ego's path.
PARAMETERS = {
    "before": (1.5, 0.6, 4.0, "s", "how long before the ego's front reaches its rear wheel it swings out"),
    "swing": (1.8, 1.0, 4.0, "s", "how long that takes"),
    "across": (0.0, -0.9, 0.9, "m", "where it ends, to the left of the ego's path"),
    "slower": (0.0, 0.0, 2.5, "m/s", "how much slower than before it then rides"),
}


def endpoint(bv, ego, road, parameters, acc, horizon):
    gap = bv["ahead"] - (bv["length"] + ego["length"]) / 2
    closing = max(ego["speed"] - bv["speed_along"], 0.1)
    began = bv["last"] is not None and abs(bv["target_left"] - parameters["across"]) < 0.5
    own = road["start"]["speed"]
    if not began and gap / closing > parameters["before"]:
        return ahead(bv, bv["target_left"] - bv["left"], own, 2.0)
    time = max(bv["lateral_time"], 0.8) if began else parameters["swing"]
    return ahead(bv, parameters["across"] - bv["left"], max(own - parameters["slower"], 1.0), time)


def ahead(bv, left, speed, time):
    """Further on by what it rides in the time, the ego's way or against it, and to the left of the ego's path."""
    way = 1.0 if abs(bv["relative_heading"]) < 1.5708 else -1.0
    heading = bv["road_heading"] if way > 0.0 else wrap(bv["road_heading"] + 3.141593)
    x, y = offset((bv["x"], bv["y"], heading), (bv["speed"] + speed) / 2 * time, way * left)
    return {"x": x, "y": y, "heading": heading, "speed": speed, "time": time}
