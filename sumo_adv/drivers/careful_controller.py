"""The careful and competent human driver of UN Regulation No. 157, on top of one of SUMO's drivers.

SUMO drives (car following, lane keeping, junctions) until a danger shows.  When that is, and how the driver brakes, are
the rules of the reference driver ``cc_human`` (``metrics/reference/cc_human.py``), on all vehicles that it sees.  It
does not steer.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sumo_adv.datatypes import Boxes, Floats, VehicleState
from sumo_adv.drivers.protocol import Action, LaneSpeed, Observation
from sumo_adv.drivers.sumo_driven import MODELS, sumo_type
from sumo_adv.errors import UsageError
from sumo_adv.metrics.boxes import wrap
from sumo_adv.metrics.paths import EgoPaths
from sumo_adv.metrics.reference.cc_human import CcHuman
from sumo_adv.metrics.reference.view import HISTORY, View

HALF_LANE = 1.6  # m, half of SUMO's default lane
SIGHT = 5.0  # s of both speeds within which a vehicle is watched
LEAST_SIGHT = 20.0  # m
SPACING = 2.0  # m between the points of a path
AHEAD = 150.0  # m, how far the path goes on straight where the engine does not tell it
Seen = tuple[float, float, float]  # x, y [m], heading [rad]


class CarefulEgo:
    """SUMO's driver with the reactions of UN R157. State: the vehicles it watches, their past, its decisions."""

    name = "careful"
    forkable = True
    needs_observation = True

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        """``parameters``: ``driver`` (krauss, idm or eidm; default idm) and that model's own. Raises UsageError."""
        own = dict(parameters or {})
        driver = own.pop("driver", "idm")
        if driver not in MODELS:
            raise UsageError(f"The ego 'careful' has no driver {driver!r}; choose one of {', '.join(MODELS)}.")
        self.sumo_type: Mapping[str, str] = sumo_type(driver, own)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """At ease, nobody seen yet; the seed is not needed."""
        self._driver: CcHuman | None = None
        self._watched: list[str] = []
        self._seen: dict[str, deque[Seen]] = {}

    @property
    def dangers(self) -> frozenset[str]:
        """The vehicles that are a danger now."""
        if self._driver is None or not self._watched:
            return frozenset()
        return frozenset(name for name, danger in zip(self._watched, self._driver.danger[0], strict=True) if danger)

    def act(self, observation: Observation) -> Action:
        """Brake if a danger has shown for long enough; else None."""
        ego, dt = observation.ego, observation.dt
        others = [o for o in observation.others if o.id != ego.id and _in_sight(ego, o)]
        if self._driver is None:
            self._driver = CcHuman((1, 0), dt)
        before = {name: k for k, name in enumerate(self._watched)}
        self._driver.watch(np.array([before.get(o.id, -1) for o in others], dtype=np.intp))
        self._watched = [o.id for o in others]
        self._remember([ego, *others], dt)
        view = self._view(observation, others)
        asked = float(self._driver.step(view)[0])
        return None if np.isnan(asked) else LaneSpeed(None, max(0.0, ego.speed + asked * dt))

    def _remember(self, states: Sequence[VehicleState], dt: float) -> None:
        names = {state.id for state in states}
        self._seen = {name: poses for name, poses in self._seen.items() if name in names}
        for state in states:
            poses = self._seen.setdefault(state.id, deque(maxlen=max(1, round(HISTORY / dt)) + 1))
            poses.append((state.x, state.y, state.heading))

    def _view(self, observation: Observation, others: Sequence[VehicleState]) -> View:
        ego, dt = observation.ego, observation.dt
        path = _path(observation)
        now = np.array([(o.x, o.y, o.heading, o.speed, o.acceleration, o.length, o.width) for o in others])
        x, y, heading, speed, acceleration, length, width = now.reshape(-1, 7).T[:, None, :]
        was = (
            np.array([self._seen[o.id][max(len(self._seen[o.id]) - 2, 0)] for o in others]).reshape(-1, 3).T[:, None, :]
        )
        first = np.array([self._seen[o.id][0][2] for o in others])[None, :]
        span = np.array([max(len(self._seen[o.id]) - 1, 1) * dt for o in others])[None, :]
        here, left, direction = path.locate(x, y)
        at, _, _ = path.locate(np.array([[ego.x]]), np.array([[ego.y]]))
        turn = wrap(heading - direction)
        cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
        along, across = (cos * length + sin * width) / 2, (sin * length + cos * width) / 2
        sideways = ((y - was[1]) * np.cos(direction) - (x - was[0]) * np.sin(direction)) / dt
        side = np.where(left >= 0, 1.0, -1.0)
        away, near_edge = here - at, np.abs(left) - across
        return View(
            away > 0, away, left, turn, np.abs(away) - along - ego.length / 2, near_edge - ego.width / 2, near_edge,
            speed, speed * np.cos(turn), -side * sideways, -side * speed * np.sin(turn), acceleration,
            wrap(heading - first) / span, length, width, np.array([[ego.speed]]), np.array([[ego.acceleration]]),
            ego.length, ego.width, HALF_LANE,
        )  # fmt: skip


def _in_sight(ego: VehicleState, other: VehicleState) -> bool:
    """Whether the two can meet soon, however they turn."""
    reach = LEAST_SIGHT + SIGHT * (ego.speed + other.speed)
    return abs(other.x - ego.x) < reach and abs(other.y - ego.y) < reach


def _path(observation: Observation) -> EgoPaths:
    """The engine's path of the ego, else straight ahead."""
    ego = observation.ego
    points: Floats
    if observation.path is not None and len(observation.path) > 1:
        points = np.asarray(observation.path, dtype=np.float64).T
    else:
        heading = ego.heading if observation.lane_heading is None else observation.lane_heading
        ahead = np.array([0.0, AHEAD])
        points = np.stack([ego.x + ahead * np.cos(heading), ego.y + ahead * np.sin(heading)])
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=1)))])
    stations = np.linspace(0.0, length[-1], max(2, round(length[-1] / SPACING) + 1))
    points = np.stack([np.interp(stations, length, v) for v in points])
    dx, dy = np.diff(points[0]), np.diff(points[1])
    headings = np.arctan2(np.append(dy, dy[-1]), np.append(dx, dx[-1]))
    return EgoPaths(
        Boxes(points[0][None], points[1][None], headings[None], 0.0 * headings[None], ego.length, ego.width)
    )
