"""Egos that SUMO drives: its car-following models with all parameters written out.

Krauss: Krauss 1998; IDM: Treiber, Hennecke and Helbing 2000; EIDM: Salles, Kaufmann and Reuss 2020. All noise is off
(``sigma`` of Krauss, the three sigmas of EIDM) unless the vehicle's own type has it: see ``simulation/ego_types.py``.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from sumo_adv.datatypes import DriverModel, Floats, Track
from sumo_adv.drivers.protocol import Action, Observation, Pose
from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap


@dataclass(frozen=True, slots=True)
class FollowingParameters:
    """Parameters that all of SUMO's models here have, named as in SUMO's vType."""

    tau: float = 1.0  # s, time headway
    accel: float = 2.6  # m/s2
    decel: float = 4.5  # m/s2, comfortable braking
    emergencyDecel: float = 9.0  # m/s2, maximum braking
    minGap: float = 2.5  # m, at standstill
    speedFactor: float = 1.0  # -, times the speed limit
    speedDev: float = 0.0  # -, spread of the speed factor


@dataclass(frozen=True, slots=True)
class Krauss(FollowingParameters):
    """Parameters of SUMO's Krauss model."""

    sigma: float = 0.0  # -, dawdling (SUMO's own default is 0.5)


@dataclass(frozen=True, slots=True)
class Idm(FollowingParameters):
    """Parameters of SUMO's IDM."""

    delta: float = 4.0  # -, exponent of the free-road term
    stepping: float = 0.25  # s, inner integration step


@dataclass(frozen=True, slots=True)
class Eidm(Idm):
    """Parameters of SUMO's EIDM: those of IDM, and more. Its driver errors are off."""

    tpreview: float = 4.0  # s, look-ahead
    treaction: float = 0.5  # s, reaction time
    sigmaleader: float = 0.0  # -, error in the leader's speed (SUMO: 0.02)
    sigmagap: float = 0.0  # -, error in the gap (SUMO: 0.1)
    sigmaerror: float = 0.0  # -, driving error (SUMO: 0.04)


FOLLOWING_MODELS: Mapping[str, tuple[str, type[FollowingParameters]]] = {
    "krauss": ("Krauss", Krauss),
    "idm": ("IDM", Idm),
    "eidm": ("EIDM", Eidm),
}
"""For each of our names: SUMO's ``carFollowModel``, and the parameters with their defaults."""

POSITIVE = frozenset({"tau", "accel", "decel", "emergencyDecel", "speedFactor", "delta", "stepping", "tpreview"})


class DriverType(dict[str, str]):
    """vType attributes of a driver.

    Attributes:
        defaults: Names of the attributes that the user did not set. A vehicle's own type overrides them.
    """

    def __init__(self, attributes: Mapping[str, str], defaults: Collection[str] = ()) -> None:
        super().__init__(attributes)
        self.defaults = frozenset(defaults)


def sumo_type(model: str, parameters: Mapping[str, Any]) -> DriverType:
    """Write the vType attributes of a model.

    Args:
        model: A key of ``FOLLOWING_MODELS``.
        parameters: Replace the model's defaults.

    Returns:
        The attributes.

    Raises:
        UsageError: A parameter is unknown, or a value is no number or out of range.
    """
    sumo_name, settings = FOLLOWING_MODELS[model]
    values = {f.name: f.default for f in fields(settings)}
    for name, value in parameters.items():
        if name not in values:
            raise UsageError(f"The ego {model!r} has no parameter {name!r}; it knows {', '.join(values)}.")
        values[name] = _number(model, name, value)
    written = {"carFollowModel": sumo_name} | {name: f"{value:g}" for name, value in values.items()}
    return DriverType(written, values.keys() - parameters.keys())


def defaults_of(attributes: Mapping[str, str]) -> frozenset[str]:
    """Return the attributes of a driver's vType that the user did not set.

    A user's own driver has none: all of its attributes count as set.
    """
    return attributes.defaults if isinstance(attributes, DriverType) else frozenset()


def _number(model: str, name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise UsageError(f"The ego {model!r} needs a finite number for {name!r}, not {value!r}.")
    if value < 0 or (value == 0 and name in POSITIVE):
        least = "above zero" if name in POSITIVE else "zero or more"
        raise UsageError(f"The ego {model!r} needs {name!r} to be {least}, not {value!r}.")
    return float(value)


def known_model(kind: str, numbers: DriverModel) -> DriverModel:
    """Return the model of a known driver that follows SUMO's lane rules.

    Args:
        kind: The driver.
        numbers: Its car-following numbers.
    """
    return replace(numbers, kind=kind, known=True)


class SumoEgo:
    """SUMO drives the ego. The controller gets no observations and sends no commands, which makes it fast."""

    forkable = True
    needs_observation = False

    def __init__(self, model: str, parameters: Mapping[str, Any]) -> None:
        """Read the parameters.

        Args:
            model: A key of ``FOLLOWING_MODELS``.
            parameters: Replace the model's defaults.

        Raises:
            UsageError: A parameter is unknown, or a value is no number or out of range.
        """
        self.name = model
        self.sumo_type: Mapping[str, str] = sumo_type(model, parameters)

    def reset(self, seed: int) -> None:
        """Do nothing: SUMO's seed is that of the simulation."""

    def act(self, observation: Observation) -> Action:
        """Return None; this method is never called."""
        return None

    def model_of(self, numbers: DriverModel) -> DriverModel:
        """Return the model of ``CarFollowing``; EIDM is predicted as IDM."""
        return known_model(self.name, numbers)


class ReplayEgo:
    """Plays back a track. Without a track, as in the unattacked run, SUMO's IDM drives with ``parameters``."""

    name = "replay"
    forkable = True
    needs_observation = True

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        """Read the parameters of IDM.

        Raises:
            UsageError: IDM does not know a parameter, or a value is no number or out of range.
        """
        self.sumo_type: Mapping[str, str] = sumo_type("idm", parameters or {})
        self._track: Track | None = None
        self._heading: Floats = np.empty(0)

    def load(self, track: Track) -> None:
        """Play a track from now on.

        Raises:
            UsageError: The track is empty.
        """
        if track.time.size == 0:
            raise UsageError("The ego 'replay' was given an empty track; run the scenario unattacked first.")
        self._track, self._heading = track, np.unwrap(track.heading)

    def reset(self, seed: int) -> None:
        """Do nothing: a loaded track is kept."""

    def model_of(self, numbers: DriverModel) -> DriverModel:
        """Return the model that repeats the unattacked motion."""
        return known_model(self.name, numbers)

    def act(self, observation: Observation) -> Action:
        """Return the pose at ``time + dt``.

        The track is linear between samples. It holds its first pose before it begins, and its last pose with speed 0
        after it ends.
        """
        track = self._track
        if track is None:
            return None
        end = observation.time + observation.dt
        heading = float(np.interp(end, track.time, self._heading))
        return Pose(
            x=float(np.interp(end, track.time, track.x)),
            y=float(np.interp(end, track.time, track.y)),
            heading=wrap(heading),
            speed=float(np.interp(end, track.time, track.speed)) if end <= track.time[-1] else 0.0,
        )
