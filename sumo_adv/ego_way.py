"""Define what a scenario demands of the ego on its way: its own moves, and stretches on which it sees less far.

Places are metres that the front of the ego has come since its departure. ``episode/ego_way.py`` applies them.
"""

from __future__ import annotations

from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

TURNS = {"turn_left": "left", "turn_right": "right"}
"""The moves that the ego's route makes, with SUMO's words for them."""
CHANGES = {"change_left": "left", "change_right": "right"}


class _Table(BaseModel):
    """A table of the scenario: frozen, no unknown keys, no infinities."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class EgoMove(_Table):
    """A move of the ego. A turn names the first one of its route; it needs no place."""

    does: Literal["change_left", "change_right", "stop", "speed", "turn_left", "turn_right"]
    at: float | None = Field(default=None, ge=0)  # m
    time: float | None = Field(default=None, ge=0)  # s
    seconds: float | None = Field(default=None, gt=0, le=600)  # s, of a stop
    speed: float | None = Field(default=None, gt=0, le=70)  # m/s, from there on
    attacked: bool = False  # no encounter begins long before it

    @model_validator(mode="after")
    def _whole(self) -> Self:
        places = (self.at is not None) + (self.time is not None)
        if self.does in TURNS and places:
            raise ValueError(f"{self.does} has its place from the route: leave at and time out")
        if self.does not in TURNS and places != 1:
            raise ValueError(f"{self.does} needs either at or time")
        for key, owner in (("seconds", "stop"), ("speed", "speed")):
            if (getattr(self, key) is not None) != (self.does == owner):
                raise ValueError(f"{key} belongs to {owner}" if self.does != owner else f"{owner} needs {key}")
        return self

    @property
    def words(self) -> str:
        """The move and its place, for messages."""
        place = f" at {self.at:g} m" if self.at is not None else f" at {self.time:g} s" if self.time is not None else ""
        return f"{self.does}{place}"


class SightStretch(_Table):
    """A stretch of the ego's way from which it sees no farther than ``limit`` along the way, as before a crest [m]."""

    begin: float = Field(alias="from", ge=0)
    to: float = Field(gt=0)
    limit: float = Field(gt=0)

    @model_validator(mode="after")
    def _forward(self) -> Self:
        if self.to <= self.begin:
            raise ValueError("to must be greater than from")
        return self
