"""Another vehicle as a driver sees it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

from sumo_adv.datatypes import VehicleState


class Senses(Protocol):
    """What tells more of a vehicle, by its id, in one step."""

    def kind(self, vehicle: str) -> str: ...

    def yaw_rate(self, vehicle: str) -> float: ...

    def indicator(self, vehicle: str) -> str | None: ...

    def brake_light(self, vehicle: str) -> bool: ...

    def visible(self, vehicle: str) -> bool: ...


@dataclass(frozen=True)
class Vehicle(VehicleState):
    """Another vehicle. In a run the attributes below are worked out when they are first read.

    Without ``senses`` (in tests of your own) they have the values of a visible passenger car that goes straight on.
    """

    senses: Senses | None = field(default=None, repr=False, compare=False)

    @cached_property
    def kind(self) -> str:
        """SUMO's vehicle class (``passenger``, ``truck``, ``bus``, ``bicycle``, ``pedestrian`` ...); ``obstacle`` for
        an object that SUMO does not know."""
        return "passenger" if self.senses is None else self.senses.kind(self.id)

    @cached_property
    def yaw_rate(self) -> float:
        """Change of its heading in the last step [rad/s], left positive."""
        return 0.0 if self.senses is None else self.senses.yaw_rate(self.id)

    @cached_property
    def indicator(self) -> str | None:
        """``left`` or ``right`` while it indicates one, else None."""
        return None if self.senses is None else self.senses.indicator(self.id)

    @cached_property
    def brake_light(self) -> bool:
        """Whether its brake lights are on."""
        return False if self.senses is None else self.senses.brake_light(self.id)

    @cached_property
    def visible(self) -> bool:
        """Whether a line from the ego's centre to its centre or one of its corners passes through no other vehicle."""
        return True if self.senses is None else self.senses.visible(self.id)
