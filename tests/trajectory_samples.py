"""Planners that define ``trajectory`` themselves, as source text."""

from __future__ import annotations

from sumo_adv.datatypes import Planner
from sumo_adv.planners.text import make_planner

LANE_CHANGE = '''
PARAMETERS = {
    "lateral": (2.0, 0.5, 40.0, "m/s2", "lateral acceleration of the move at most"),
    "slower": (0.0, 0.0, 60.0, "m/s", "how much slower than now it goes at the end"),
    "beyond": (0.0, -20.0, 20.0, "m", "how far beyond the ego's lane centre it moves"),
}

from math import atan2, sqrt


def endpoint(bv, ego, road, parameters, acc, horizon):
    """In the ego's lane (y = beyond), after a cubic whose largest second derivative is 6 d / T^2."""
    left = bv["y"] - parameters["beyond"]
    time = max(1.0, sqrt(6.0 * abs(left) / parameters["lateral"]))
    speed = max(0.0, bv["speed"] - parameters["slower"])
    return {
        "x": bv["x"] + (bv["speed"] + speed) / 2.0 * time, "y": parameters["beyond"], "heading": 0.0, "speed": speed,
        "time": time,
    }


def trajectory(bv, endpoint, road, dt):
    """Hermite cubics in x and y from the present pose and speed to the endpoint's."""
    time = endpoint["time"]
    vx, vy = offset((0.0, 0.0, bv["heading"]), bv["speed"], 0.0)
    wx, wy = offset((0.0, 0.0, endpoint["heading"]), endpoint["speed"], 0.0)
    states = []
    for k in range(1, int(time / dt) + 1):
        u = k * dt / time
        x, dx = hermite(bv["x"], vx * time, endpoint["x"], wx * time, u)
        y, dy = hermite(bv["y"], vy * time, endpoint["y"], wy * time, u)
        states.append((x, y, atan2(dy, dx), sqrt(dx * dx + dy * dy) / time))
    return states


def hermite(a, da, b, db, u):
    """Value and slope in u of the cubic from a to b with the slopes da and db."""
    c = 3.0 * (b - a) - 2.0 * da - db
    d = 2.0 * (a - b) + da + db
    return a + u * (da + u * (c + u * d)), da + u * (2.0 * c + 3.0 * u * d)
'''


def lane_change(trajectory: str | None = None) -> Planner:
    """A cut-in on cubics; ``trajectory``: the body of another trajectory(), or '' for none."""
    text = LANE_CHANGE
    if trajectory is not None:
        head, rest = text.split("def trajectory(", 1)
        body = (
            f"def trajectory(bv, endpoint, road, dt):\n    {trajectory}\n\n\ndef hermite("
            if trajectory
            else "def hermite("
        )
        text = head + body + rest.split("def hermite(", 1)[1]
    return make_planner("Cubic Cut-in", "cubic", text, "person")
