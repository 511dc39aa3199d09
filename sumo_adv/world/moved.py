"""The speeds of vehicles that were moved: SUMO tells them a step late where one comes back on a lane from beside it."""

from __future__ import annotations

from sumo_adv.world.remote import RawState


class MovedSpeeds:
    """Of one simulation: ``ask`` before a step, ``next`` at the step, ``right`` with what SUMO says after it."""

    def __init__(self) -> None:
        self._asked: dict[str, float] = {}
        self._given: dict[str, float] = {}
        self._beside: set[str] = set()  # on no lane as they were last read, and before the step
        self._were: set[str] = set()

    def ask(self, vehicle: str, speed: float) -> None:
        """It is moved in the next step, at a speed [m/s]."""
        self._asked[vehicle] = speed

    def next(self) -> None:
        """A step is made."""
        self._given, self._asked = self._asked, {}
        self._were, self._beside = self._beside, set()

    def right(self, raw: dict[str, RawState]) -> None:
        """Put the speed asked for in the place of the one before, where SUMO did not take it over."""
        for vehicle, speed in self._given.items():
            state = raw.get(vehicle)
            if state is None:
                continue
            if not state[4]:
                self._beside.add(vehicle)
            elif vehicle in self._were:
                raw[vehicle] = (*state[:3], speed, state[4])
