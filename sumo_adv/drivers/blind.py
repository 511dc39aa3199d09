"""A driver that sees no other vehicle: a baseline for drivers that look around.

It follows its route at the speed limit, slower in bends, and stops at lines at which it must wait (lights and right of
way). It never reacts to a vehicle, so every collision that a reference driver avoids can be had with it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from sumo_adv.datatypes import DriverModel, VehicleState
from sumo_adv.drivers.lattice_frame import LINE_HOLDING_M_S2, RoadFrame
from sumo_adv.drivers.protocol import Action, Observation, Road, Steer, Wishes
from sumo_adv.drivers.sumo_driven import Idm, known_model, sumo_type

MIN_LINE_BRAKING_M_S2 = 2.0  # it begins to brake for a line when the line requires this
MAX_BEND_LATERAL_M_S2 = 4.0  # the maximum that it steers with
BEND_TIMES_S = np.arange(0.0, 4.1, 0.25)  # times ahead at which bends are looked at


class BlindEgo:
    """The controller. Its state is the frame of the last path."""

    name = "blind"
    forkable = True
    needs_observation = True
    wishes = Wishes(needs_road=True)

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        """Read the parameters.

        Args:
            parameters: Those of IDM. Only those of the free road have an effect.

        Raises:
            UsageError: A parameter is unknown or out of range.
        """
        self.sumo_type: Mapping[str, str] = sumo_type("idm", parameters or {})
        self._idm = Idm(**{name: float(value) for name, value in self.sumo_type.items() if name != "carFollowModel"})
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Forget the path; the seed is not needed."""
        self._points: Sequence[tuple[float, float]] | None = None
        self._frame: RoadFrame | None = None

    def model_of(self, numbers: DriverModel) -> DriverModel:
        """Return the model that repeats the unattacked motion."""
        return known_model("replay", numbers)

    def act(self, observation: Observation) -> Action:
        """Return pedals and wheel for the step.

        Returns:
            None (SUMO drives) without a path, and when the route leaves the network.
        """
        ego, road = observation.ego, observation.road
        if observation.path is not None and observation.path is not self._points:
            self._points, self._frame = observation.path, RoadFrame(observation.path)
        if self._frame is None or road is None or road.leaves:
            return None
        station = self._frame.locate(ego)[0]
        bends = self._frame.bend(station + ego.length / 2 + max(ego.speed, 0.1) * BEND_TIMES_S)[1]
        desired_speed = max(min(road.limit, float(np.min(bends))), 0.1)
        free = self._idm.accel * (1.0 - (ego.speed / desired_speed) ** self._idm.delta)
        pedal = min(max(free, -self._idm.decel), _stopping(road, ego) if road.must_wait else math.inf)
        return Steer(pedal, self._frame.wheel(ego, MAX_BEND_LATERAL_M_S2))


def _stopping(road: Road, ego: VehicleState) -> float:
    """Return the acceleration [m/s2] with which the ego stops at the next line; inf while the line is still far."""
    room = road.stop_lines[0].ahead - ego.length / 2 - 0.5  # m before the line
    if room < 1.0:
        return LINE_HOLDING_M_S2
    needed = ego.speed**2 / (2 * room)
    return -needed if needed > MIN_LINE_BRAKING_M_S2 else math.inf
