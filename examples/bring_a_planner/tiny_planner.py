"""A tiny planner that stands for a package from outside, with conventions of its own.

Its azimuths are degrees clockwise from north. It plans for the rear axle. The times of a plan count from the
moment at which it was made. It follows a route as the IDM follows a leader (Treiber, Hennecke and Helbing 2000).
"""

from dataclasses import dataclass

import numpy as np

STEP, HORIZON = 0.1, 3.0  # s
ACCELERATION, BRAKING, HEADWAY, GAP = 2.0, 3.0, 1.2, 2.5  # m/s2, m/s2, s, m
HARDEST, IN_BENDS, RETURN = 8.0, 2.5, 1.5  # m/s2, m/s2 sideways, s in which most of an offset is gone


@dataclass(frozen=True)
class State:
    """x, y [m] of the rear axle, azimuth [degrees], speed [m/s]."""

    x: float
    y: float
    azimuth: float
    speed: float


class Route:
    """A polyline (n, 2) [m] with stations along it."""

    def __init__(self, points: np.ndarray) -> None:
        self.points = points
        self.station = np.r_[0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T))]
        self.angle = np.unwrap(np.arctan2(*np.gradient(points, axis=0).T[::-1]))
        bend = np.abs(np.convolve(np.gradient(self.angle, self.station), np.full(7, 1 / 7), "same"))
        fastest = np.sqrt(IN_BENDS / np.maximum(bend, 1e-4))
        squares = fastest**2 + 2 * BRAKING / 2 * self.station  # braking gently for the bends to come
        self.fastest = np.sqrt(np.minimum.accumulate(squares[::-1])[::-1] - BRAKING * self.station)

    def locate(self, x: float, y: float) -> tuple[float, float]:
        """Station and offset to the left [m] of a point."""
        i = int(np.argmin(np.hypot(self.points[:, 0] - x, self.points[:, 1] - y)))
        dx, dy, c, s = x - self.points[i, 0], y - self.points[i, 1], np.cos(self.angle[i]), np.sin(self.angle[i])
        return self.station[i] + c * dx + s * dy, c * dy - s * dx

    def at(self, station: float, offset: float) -> tuple[float, float, float]:
        """x, y [m] and angle [rad from east]; straight on beyond both ends."""
        inside = min(max(station, 0.0), self.station[-1])
        x, y, angle = (np.interp(inside, self.station, q) for q in (*self.points.T, self.angle))
        c, s, beyond = np.cos(angle), np.sin(angle), station - inside
        return x + beyond * c - offset * s, y + beyond * s + offset * c, angle


def plan(state: State, route: Route, limit: float, leaders: list[tuple[float, float]]) -> list[State]:
    """States at 0, 0.1 .. 3 s from now; leaders: station of the rear [m, for our rear axle] and speed [m/s] of each."""
    (station, offset), speed, states = route.locate(state.x, state.y), state.speed, [state]
    for k in range(1, round(HORIZON / STEP) + 1):
        desired = max(min(limit, float(np.interp(station, route.station, route.fastest))), 0.1)
        pull = ACCELERATION * (1 - (speed / desired) ** 4)
        for rear, lead_speed in leaders:
            gap = max(rear + lead_speed * k * STEP - station, 0.1)
            room = GAP + max(
                speed * HEADWAY + speed * (speed - lead_speed) / (2 * (ACCELERATION * BRAKING) ** 0.5), 0.0
            )
            pull = min(pull, ACCELERATION * (1 - (speed / desired) ** 4 - (room / gap) ** 2))
        before, speed = speed, max(speed + max(pull, -HARDEST) * STEP, 0.0)
        station += (before + speed) / 2 * STEP
        offset -= offset * min((before + speed) / 2 * STEP / (RETURN * 10.0), 1.0)  # by the way: none at a standstill
        x, y, angle = route.at(station, offset)
        states.append(State(x, y, 90.0 - np.degrees(angle), speed))
    return states
