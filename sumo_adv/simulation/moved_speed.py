"""The speeds of vehicles that the program moved: as asked for, because SUMO's answer is wrong in some steps.

Measured with SUMO 1.28: a vehicle that comes back on a lane from beside it has its speed a step late, and a vehicle
that enters a junction's internal lane can have speed 0 for one step.  Its position is exact in both cases, so the speed
that the position was computed with is the true one.
"""

from __future__ import annotations

from sumo_adv.simulation.remote import RawState


class MovedSpeeds:
    """Of one simulation: ``ask`` before a step, ``next`` at the step, ``correct`` what SUMO says after it."""

    def __init__(self) -> None:
        self._asked: dict[str, float] = {}
        self._given: dict[str, float] = {}

    def ask(self, vehicle: str, speed: float) -> None:
        """It is moved in the next step, at a speed [m/s]."""
        self._asked[vehicle] = speed

    def next(self) -> None:
        """A step is made."""
        self._given, self._asked = self._asked, {}

    def correct(self, raw: dict[str, RawState]) -> None:
        """Give each vehicle that was moved in this step the speed that was asked for."""
        for vehicle, speed in self._given.items():
            state = raw.get(vehicle)
            if state is not None:
                raw[vehicle] = (*state[:3], speed, state[4])
