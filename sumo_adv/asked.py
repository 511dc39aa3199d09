"""Describe the attack that was requested, so that a run can tell whether an attempt fits.

The description is the table ``[asked]`` of a scenario file that ``sumo-adv write`` made, or a language model's reading
of the words of ``sumo-adv run --ask``. ``words/fit.py`` compares it with the motion of an attempt.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from sumo_adv.datatypes import Relation
from sumo_adv.road_users import RoadUser

MAX_REQUEST_CHARACTERS = 6000  # longest request or report
NEAR_MISS_TTC_S = (0.2, 1.5)  # minimum TTC of a requested near miss
Side = Literal["front", "rear", "left", "right"]


class Event(StrEnum):
    """What an adversary does, as its track shows. ``words/motion.py`` has the rules."""

    PASSES_LEFT = "passes_left"
    PASSES_RIGHT = "passes_right"
    ENTERS_FROM_LEFT = "enters_from_left"
    ENTERS_FROM_RIGHT = "enters_from_right"
    CROSSES_FROM_LEFT = "crosses_from_left"
    CROSSES_FROM_RIGHT = "crosses_from_right"
    COMES_OVER = "comes_over"
    LEAVES = "leaves"
    TURNS_LEFT = "turns_left"
    TURNS_RIGHT = "turns_right"
    SPEEDS_UP = "speeds_up"
    BRAKES = "brakes"
    STOPS = "stops"
    STARTS = "starts"
    RUNS_RED = "runs_red"
    RUNS_YELLOW = "runs_yellow"


MEANINGS = {
    Event.PASSES_LEFT: "it comes from behind the ego and gets ahead of it on the ego's left",
    Event.PASSES_RIGHT: "the same on the ego's right",
    Event.ENTERS_FROM_LEFT: "going the ego's way, it comes from the ego's left into the way of the ego",
    Event.ENTERS_FROM_RIGHT: "the same from the right (also from a ramp or a road that joins)",
    Event.CROSSES_FROM_LEFT: "it comes from the left across the way of the ego (from a side road, or on foot)",
    Event.CROSSES_FROM_RIGHT: "the same from the right",
    Event.COMES_OVER: "an oncoming vehicle comes into the way of the ego, straight on or turning left",
    Event.LEAVES: "it goes out of the way of the ego again",
    Event.TURNS_LEFT: "it turns left by 45 degrees or more",
    Event.TURNS_RIGHT: "it turns right by 45 degrees or more",
    Event.SPEEDS_UP: "it gains 2 m/s or more",
    Event.BRAKES: "it loses 2 m/s or more",
    Event.STOPS: "it comes to a standstill",
    Event.STARTS: "it moves off from a standstill",
    Event.RUNS_RED: "it enters a junction while its light is red",
    Event.RUNS_YELLOW: "it enters a junction while its light is yellow",
}
"""The meaning of each event, for people and models."""


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Asked(_Table):
    """What must be true of an attack; what is not given may be anything.

    relation: how the adversary stands to the ego when the encounter begins. user: its kind. events: what it does, in
    this order; others may come between. side: of the ego that is hit. hidden: other vehicles, standing or moving, or
    obstacles hide it from the ego at first or for half a second before it comes into the ego's way. beside: another
    vehicle is beside the ego on that side at some time. least_length: of the adversary [m]. most_speed_first: it is no
    faster than this at first [m/s]. most_braking: it brakes no harder than this [m/s2]. within: all events that are
    asked of several attackers end within this time [s]. level: which the attack must reach.
    """

    relation: Relation | None = None
    user: RoadUser | None = None
    events: Annotated[tuple[Event, ...], Field(max_length=6)] = ()
    side: Side | None = None
    hidden: bool = False
    beside: Literal["left", "right"] | None = None
    least_length: Annotated[float, Field(gt=0, le=30)] | None = None
    most_speed_first: Annotated[float, Field(ge=0, le=60)] | None = None
    most_braking: Annotated[float, Field(gt=0, le=12)] | None = None
    within: Annotated[float, Field(gt=0, le=20)] | None = None
    level: Literal["near_miss", "critical", "collision", "valid", "strict", "serious"] | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """The settings for the requested level; empty if no level is requested."""
        if self.level is None:
            return {}
        return {"ttc": NEAR_MISS_TTC_S, "until": "critical"} if self.level == "near_miss" else {"until": self.level}


class Attacker(_Table):
    """One of several vehicles that attack together. id: of the vehicle. intents: which it may try; empty allows all.
    attacks: false for one that only plays its part, so that touching it is no success. asked: what must be true of it.
    """

    id: Annotated[str, Field(min_length=1)]
    intents: tuple[Annotated[str, Field(min_length=1)], ...] = ()
    attacks: bool = True
    asked: Asked = Asked()


class RequestOrigin(_Table):
    """Where a scenario comes from: the words, the model that made a scenario of them, and the date (YYYY-MM-DD)."""

    words: Annotated[str, Field(min_length=1, max_length=MAX_REQUEST_CHARACTERS)]
    model: str
    date: str
