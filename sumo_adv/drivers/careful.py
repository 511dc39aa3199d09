"""The careful and competent human driver of UN Regulation No. 157: one set of rules, driven and predicted.

The rules of the reference driver ``cc_human`` (``metrics/reference/cc_human.py``) say when a danger shows and how the
driver brakes. Until then, one of SUMO's drivers drives. The careful driver does not steer.

- ``CarefulEgo`` drives the ego. It is one driver that watches all vehicles in sight, in the frame of the engine's path.
- ``CarefulDrivers`` predicts it. These are N drivers that watch one adversary each, in the frame of the ego's
unattacked
  path. They leave out other vehicles, and what the driver saw before the attack. Yaw rates are relative to the path,
  which makes a difference on bends.

``watching.py`` describes how the driver looks at the traffic.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from sumo_adv.datatypes import DriverModel, Floats
from sumo_adv.drivers.protocol import Action, LaneSpeed, Observation
from sumo_adv.drivers.sumo_driven import FOLLOWING_MODELS, known_model, sumo_type
from sumo_adv.drivers.watching import (
    WatchedVehicles,
    Watcher,
    WatchingEgos,
    braked_speed,
    lane_half_width_of,
    path_of,
    view_of,
)
from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.reference.cc_human import CcHuman
from sumo_adv.metrics.reference.view import YAW_RATE_SPAN_S


class CarefulEgo:
    """The controller: the reference driver ``cc_human`` over one of SUMO's drivers."""

    name = "careful"
    reference = "cc_human"  # the reference driver that it is
    forkable = True
    needs_observation = True

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        """Read the parameters.

        Args:
            parameters: ``driver`` (krauss, idm or eidm; default idm) and the parameters of that model.

        Raises:
            UsageError: The driver is unknown, or a parameter is unknown or out of range.
        """
        own = dict(parameters or {})
        driver = own.pop("driver", "idm")
        if driver not in FOLLOWING_MODELS:
            known = ", ".join(FOLLOWING_MODELS)
            raise UsageError(f"The ego 'careful' has no driver {driver!r}; choose one of {known}.")
        self.sumo_type: Mapping[str, str] = sumo_type(driver, own)
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Forget all vehicles; the seed is not needed."""
        self._watcher: Watcher | None = None

    def model_of(self, numbers: DriverModel) -> DriverModel:
        """Return the model of ``CarefulDrivers``, with IDM's car following."""
        return known_model(self.name, numbers)

    @property
    def dangers(self) -> frozenset[str]:
        """The vehicles that are a danger now."""
        if self._watcher is None or not self._watcher.watched:
            return frozenset()
        driver = self._watcher.driver
        assert isinstance(driver, CcHuman)
        return frozenset(name for name, is_one in zip(self._watcher.watched, driver.danger[0], strict=True) if is_one)

    def act(self, observation: Observation) -> Action:
        """Brake if a danger has shown for long enough; otherwise return None."""
        if self._watcher is None:
            self._watcher = Watcher(CcHuman, observation.dt)
        target = self._watcher.speed(
            observation.ego, observation.others, path_of(observation), lane_half_width_of(observation),
            observation.sight,
        )  # fmt: skip
        return None if math.isinf(target) else LaneSpeed(None, target)


class CarefulDrivers:
    """N predicted drivers, each of which watches one adversary."""

    def __init__(
        self, ego: tuple[float, float], length: Floats, width: Floats, dt: float, lane_half_width: Floats
    ) -> None:  # fmt: skip
        """Start without any memory.

        Args:
            ego: The egos' length and width [m].
            length: The adversaries' lengths ``(N,)`` [m].
            width: The adversaries' widths ``(N,)`` [m].
            dt: Step [s].
            lane_half_width: Half the width of the egos' lanes ``(N,)`` [m].
        """
        self._lane_half_width = lane_half_width[:, None]
        self._ego, self._length, self._width, self._dt = ego, length[:, None], width[:, None], dt
        self._history = max(1, round(YAW_RATE_SPAN_S / dt))
        self._past: list[tuple[Floats, Floats, Floats]] = []  # offset, heading and speed of the last steps, each (N, 1)
        self._drivers = CcHuman((len(length), 1), dt)

    def bound(
        self, ego: tuple[Floats, Floats, Floats], adversary: tuple[Floats, Floats, Floats], speed: Floats
    ) -> Floats:
        """Look at one step. All arrays are ``(N,)``.

        Args:
            ego: The egos' stations [m], speeds [m/s] and accelerations [m/s2].
            adversary: Stations [m], offsets [m] and headings [rad] of the adversaries' box centres in the frame of the
                ego's path.
            speed: The adversaries' speeds [m/s].

        Returns:
            The speeds to which the drivers brake within this step [m/s]; inf if they do not brake.
        """
        station, offset, heading = (values[:, None] for values in adversary)
        v = speed[:, None]
        offset_before, _, v_before = self._past[-1] if self._past else (offset, heading, v)
        first_heading = self._past[0][1] if self._past else heading
        span = max(len(self._past), 1) * self._dt
        self._past = [*self._past, (offset, heading, v)][-self._history :]
        others = WatchedVehicles(
            station, offset, heading, v, (offset - offset_before) / self._dt, (v - v_before) / self._dt,
            wrap_below_pi(heading - first_heading) / span, self._length, self._width,
        )  # fmt: skip
        ego_station, ego_speed, ego_acceleration = (values[:, None] for values in ego)
        egos = WatchingEgos(ego_station, ego_speed, ego_acceleration, *self._ego)
        return braked_speed(self._drivers, egos, view_of(egos, others, self._lane_half_width), self._dt)
