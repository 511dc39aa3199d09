"""What stands or moves in the world without SUMO knowing it: parked obstacles, pedestrians, cyclists, other objects.

A prop is a box with a pose at every time at which it is there.  It comes from a scenario (standing, or straight on at
one speed) or from a log.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from sumo_adv.geometry import Pose
from sumo_adv.simulation.tracks import LoggedTrack


@dataclass(frozen=True, slots=True)
class Prop:
    """A scenario's box: x, y centre [m] at ``start`` [s], heading [rad], speed [m/s]; it is gone after ``end`` [s]."""

    id: str
    x: float
    y: float
    heading: float
    speed: float
    length: float
    width: float
    start: float = 0.0
    end: float = math.inf
    kind: str = "other"  # pedestrian | cyclist | parked | other

    def pose(self, time: float) -> Pose | None:
        """Where it is at ``time`` [s]; None before it comes and after it left."""
        if not self.start - 1e-6 <= time <= self.end + 1e-6:
            return None
        gone = self.speed * (time - self.start)
        return Pose(
            self.x + gone * math.cos(self.heading), self.y + gone * math.sin(self.heading), self.heading, self.speed
        )


@dataclass(frozen=True, slots=True)
class Recorded:
    """An object of a log; its grid begins at ``begin`` [s] with steps of ``step`` [s]."""

    track: LoggedTrack
    begin: float
    step: float

    @property
    def id(self) -> str:
        """The log's name for it."""
        return self.track.id

    @property
    def length(self) -> float:
        """m."""
        return self.track.length

    @property
    def width(self) -> float:
        """m."""
        return self.track.width

    def pose(self, time: float) -> Pose | None:
        """Where the log has it at a time of its grid; None where it is not valid."""
        k, t = round((time - self.begin) / self.step), self.track
        if not 0 <= k < len(t.valid) or not t.valid[k]:
            return None
        return Pose(float(t.x[k]), float(t.y[k]), float(t.heading[k]), float(t.speed[k]))
