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
    emergencyDecel: float = 9.0  # m/s2, the most it can brake
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
    """Parameters of SUMO's EIDM, which has those of IDM and more; its driver errors are off."""

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
"""Our name: SUMO's name for ``carFollowModel``, and the parameters with their defaults."""

POSITIVE = frozenset({"tau", "accel", "decel", "emergencyDecel", "speedFactor", "delta", "stepping", "tpreview"})


class DriverType(dict[str, str]):
    """vType attributes of a driver. defaults: those that nobody asked for, which a vehicle's own type goes before."""

    def __init__(self, attributes: Mapping[str, str], defaults: Collection[str] = ()) -> None:
        super().__init__(attributes)
        self.defaults = frozenset(defaults)


def sumo_type(model: str, parameters: Mapping[str, Any]) -> DriverType:
    """vType attributes of ``model`` with ``parameters`` laid over its defaults.

    Raises UsageError for an unknown parameter, or a value that is no number or out of range.
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
    """The attributes of a driver's vType that nobody asked for; none of those that a user's own driver has."""
    return attributes.defaults if isinstance(attributes, DriverType) else frozenset()


def _number(model: str, name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise UsageError(f"The ego {model!r} needs a finite number for {name!r}, not {value!r}.")
    if value < 0 or (value == 0 and name in POSITIVE):
        least = "above zero" if name in POSITIVE else "zero or more"
        raise UsageError(f"The ego {model!r} needs {name!r} to be {least}, not {value!r}.")
    return float(value)


def known_model(kind: str, numbers: DriverModel) -> DriverModel:
    """The model of a known driver that follows SUMO's lane rules, with the car-following numbers given."""
    return replace(numbers, kind=kind, known=True)


class SumoEgo:
    """SUMO drives the ego. The controller gets no observations and sends no commands, which makes it fast."""

    forkable = True
    needs_observation = False

    def __init__(self, model: str, parameters: Mapping[str, Any]) -> None:
        """``model``: a key of ``FOLLOWING_MODELS``. Raises UsageError as ``sumo_type`` does."""
        self.name = model
        self.sumo_type: Mapping[str, str] = sumo_type(model, parameters)

    def reset(self, seed: int) -> None:
        """Nothing to forget: SUMO's seed is the simulation's."""

    def act(self, observation: Observation) -> Action:
        """Never called."""
        return None

    def model_of(self, numbers: DriverModel) -> DriverModel:
        """Predicted by ``CarFollowing``; EIDM as IDM."""
        return known_model(self.name, numbers)


class ReplayEgo:
    """Plays back a track. Without a track, as in the unattacked run itself, SUMO's IDM drives with ``parameters``."""

    name = "replay"
    forkable = True
    needs_observation = True

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        """Raises UsageError for a parameter that IDM does not know."""
        self.sumo_type: Mapping[str, str] = sumo_type("idm", parameters or {})
        self._track: Track | None = None
        self._heading: Floats = np.empty(0)

    def load(self, track: Track) -> None:
        """Play ``track`` from now on. Raises UsageError if it is empty."""
        if track.time.size == 0:
            raise UsageError("The ego 'replay' was given an empty track; run the scenario unattacked first.")
        self._track, self._heading = track, np.unwrap(track.heading)

    def reset(self, seed: int) -> None:
        """A loaded track is kept."""

    def model_of(self, numbers: DriverModel) -> DriverModel:
        """Predicted by its unattacked motion."""
        return known_model(self.name, numbers)

    def act(self, observation: Observation) -> Action:
        """The pose at ``time + dt``, linear between samples, held before the first and after the last."""
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
