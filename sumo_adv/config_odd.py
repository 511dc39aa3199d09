"""Define the operational design domain (ODD) of a campaign. Encounters outside it are not attacked.

    roads = ["urban", "junction"]            # motorway | rural | urban | junction
    relations = ["oncoming", "crossing"]     # leader | follower | neighbour | oncoming | crossing | merging
    speed = [0.0, 14.0]                      # m/s, of the ego when the attack may begin
    vehicles_near = [1, 12]                  # vehicles within 70 m of the ego at that time

A missing key restricts nothing. Both ends of a range belong to it.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, NonNegativeFloat, NonNegativeInt, ValidationError

from sumo_adv.datatypes import Relation, RoadClass, RoadPlace
from sumo_adv.errors import UsageError
from sumo_adv.parsing import first_fault, read_toml


def _ascending(given: tuple[float, float]) -> tuple[float, float]:
    if given[0] > given[1]:
        raise ValueError("write the lower end of the range first")
    return given


Speeds = Annotated[tuple[NonNegativeFloat, NonNegativeFloat], AfterValidator(_ascending)]  # m/s
Counts = Annotated[tuple[NonNegativeInt, NonNegativeInt], AfterValidator(_ascending)]


class Odd(BaseModel):
    """Limits of the encounters that may be attacked."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    roads: tuple[RoadClass, ...] = ()
    relations: tuple[Relation, ...] = ()
    speed: Speeds | None = None
    vehicles_near: Counts | None = None

    def contains(self, place: RoadPlace) -> bool:
        """Return whether an attack may begin at a place.

        A place off the network is inside only if the ODD has no ``roads``.
        """
        on_road = not self.roads or place.road in self.roads
        low, high = self.speed or (0.0, math.inf)
        fewest, most = self.vehicles_near or (0, math.inf)
        return on_road and low <= place.speed <= high and fewest <= place.vehicles_near <= most

    def has_relation(self, relation: str) -> bool:
        """Return whether a vehicle with this relation to the ego may attack."""
        return not self.relations or relation in self.relations


def read_odd(path: Path) -> Odd:
    """Read an ODD from a TOML file.

    Raises:
        UsageError: The file is missing, is not TOML, or has a bad key or value.
    """
    try:
        return Odd.model_validate(read_toml(path, "The ODD"))
    except ValidationError as error:
        raise UsageError(f"The ODD {path} {first_fault(error, Odd.model_fields)}") from error
