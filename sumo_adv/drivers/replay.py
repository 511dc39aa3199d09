"""The ego that repeats its motion of the unattacked run, whatever the adversary does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sumo_adv.datatypes import DriverModel, Floats, Track
from sumo_adv.drivers.protocol import Action, Observation, Pose
from sumo_adv.drivers.sumo_driven import known_model, sumo_type
from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap


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
