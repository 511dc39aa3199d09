"""Drive the ego with a CommonRoad planner, which is asked for a plan every few steps."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sumo_adv.commonroad.scene import HORIZON_S, STEP_S, Scene, Scenes, constant_velocity
from sumo_adv.datatypes import Floats, VehicleState
from sumo_adv.drivers import Action, Observation, PlannedPose, Steer
from sumo_adv.drivers.lattice_frame import RoadFrame
from sumo_adv.drivers.protocol import MAX_BRAKING_M_S2, Points
from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap

MAX_AWAY_M = 0.5  # if the ego is farther from its place in the plan, it plans again at once
PATH_AHEAD_M = 250.0  # length of the reference path: 5 s at 50 m/s
MAX_LATERAL_M_S2 = 4.0  # lateral acceleration of an ego that brakes without a plan
TIME_TOLERANCE_S = 1e-6


@dataclass(frozen=True, slots=True)
class Followed:
    """A plan that the ego follows.

    Attributes:
        times: The simulation times of its states [s], ``(n,)``.
        states: x, y [m], heading [rad, unwrapped] and speed [m/s] of the box centre, ``(n, 4)``.
    """

    times: Floats
    states: Floats

    def at(self, time: float) -> Floats | None:
        """Return x, y, heading and speed at a time [s], or None after the end."""
        if time > self.times[-1] + TIME_TOLERANCE_S:
            return None
        return np.array([np.interp(time, self.times, column) for column in self.states.T])

    def rest(self, time: float) -> Points:
        """Return the places from a time [s] on, for pages and exports."""
        left = self.states[self.times > time - TIME_TOLERANCE_S, :2].tolist()
        return [(x, y) for x, y in left]


class PlannerEgo(ABC):
    """The ego that a CommonRoad planner drives. Subclass it, write ``plan``, and name it with ``--ego module:Class``.

    If the observation has no path, or the route leaves the network, SUMO drives. If there is no plan, the ego brakes
    fully along its path, and calls ``plan`` again in the next step.

    Attributes:
        replan_every: The number of simulation steps from one plan to the next.
        horizon: How long the other road users are predicted [s].
        time_step: CommonRoad's time step [s]. The run's step may differ, because states of the plan are interpolated.
        path_ahead: The minimum length of the reference path ahead of the ego [m], if the route is long enough.
        shut_lines: Whether a static obstacle stands behind the next line while the ego must wait there.
        notes: Numbers by name that ``plan`` may set, shown with the answers.
    """

    replan_every = 5
    horizon = HORIZON_S
    time_step = STEP_S
    path_ahead = PATH_AHEAD_M
    shut_lines = True
    notes: Mapping[str, float] = {}

    @abstractmethod
    def plan(self, scene: Scene) -> Sequence[Any] | None:
        """Plan from now on.

        Args:
            scene: Scenario, planning problem with the initial state, and reference path.

        Returns:
            States with ``time_step`` (0 is now), ``position`` (the centre of the box), ``orientation`` and
            ``velocity``; None or nothing if there is no plan.
        """

    def predict(self, vehicle: VehicleState, times: Floats) -> Floats:
        """Predict where another road user will be: straight on at its speed. Override this to predict otherwise.

        Args:
            vehicle: The road user's observed state.
            times: The times from now on ``(n,)`` [s].

        Returns:
            x, y [m] and heading [rad], ``(n, 3)``.
        """
        return constant_velocity(vehicle, times)

    def reset(self, seed: int) -> None:
        """Forget everything, because a run begins. A subclass with its own ``reset`` must call this method."""
        self._scenes = Scenes(self.predict, horizon=self.horizon, step=self.time_step, shut_lines=self.shut_lines)
        self._followed: Followed | None = None
        self._steps = 0  # since the last plan
        self._before: tuple[float, float] | None = None  # time [s] and heading [rad] of the last step
        self.notes = {}

    def act(self, seen: Observation) -> Action:
        """Return the ego's place in the plan after this step.

        Args:
            seen: The observation.

        Returns:
            The action. It is None, so that SUMO drives, if there is no path or the route leaves the network.
        """
        yaw_rate = self._yaw_rate(seen)
        if seen.path is None or seen.road is None or seen.road.leaves:
            self._followed = None
            return None
        if self._is_due(seen):
            states = self.plan(self._scenes(seen, yaw_rate))
            self._followed = self._read(states, seen) if states is not None and len(states) else None
            self._steps = 0
        self._steps += 1
        after = None if self._followed is None else self._followed.at(seen.time + seen.dt)
        if self._followed is None or after is None:
            wheel = RoadFrame(seen.path).wheel(seen.ego, MAX_LATERAL_M_S2)
            return Steer(-MAX_BRAKING_M_S2, wheel, notes=self.notes)
        x, y, heading, speed = after.tolist()
        return PlannedPose(x, y, wrap(heading), max(speed, 0.0), self._followed.rest(seen.time), self.notes)

    def _is_due(self, seen: Observation) -> bool:
        """Return whether to plan now.

        The ego plans if it has no plan, ``replan_every`` steps after the last plan, at the plan's end, and if it is
        more than ``MAX_AWAY_M`` from its place in the plan.
        """
        if self._followed is None or self._steps >= self.replan_every:
            return True
        now, after = self._followed.at(seen.time), self._followed.at(seen.time + seen.dt)
        return now is None or after is None or math.dist(now[:2], (seen.ego.x, seen.ego.y)) > MAX_AWAY_M

    def _yaw_rate(self, seen: Observation) -> float:
        """Return the rate at which the ego's heading changed over the last step [rad/s]."""
        before, self._before = self._before, (seen.time, seen.ego.heading)
        if before is None or before[0] >= seen.time:
            return 0.0
        return wrap(seen.ego.heading - before[1]) / (seen.time - before[0])

    def _read(self, states: Sequence[Any], seen: Observation) -> Followed:
        """Read states of CommonRoad as a plan that begins at the ego's present place.

        Raises:
            UsageError: A state lacks a field, or the time steps do not increase.
        """
        try:
            rows = [(s.time_step, *s.position, s.orientation, s.velocity) for s in states if s.time_step > 0]
            table = np.array(rows, float).reshape(len(rows), 5)
        except (AttributeError, TypeError, ValueError) as error:
            raise UsageError(
                f"plan returned states that cannot be driven ({error}): each needs time_step, position (x, y), "
                "orientation and velocity, as numbers."
            ) from error
        if not len(table) or not np.isfinite(table).all() or (np.diff(table[:, 0]) <= 0).any():
            raise UsageError("plan returned states whose time_step does not grow from 1 on, or that are not finite.")
        ego = seen.ego
        table = np.vstack([(0.0, ego.x, ego.y, ego.heading, ego.speed), table])
        table[:, 3] = np.unwrap(table[:, 3])
        return Followed(seen.time + self.time_step * table[:, 0], table[:, 1:])
