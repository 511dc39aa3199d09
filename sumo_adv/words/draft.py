"""The answer of a language model that writes a scenario. The schema is sent to the model, with names and docstrings.

Lengths are in m, times in s, speeds in km/h. No field is a path, a command or a program: an answer can only choose
among kinds of roads, names of edges and numbers within bounds.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from sumo_adv.asked import Asked
from sumo_adv.script import AppliesTo, Script

Edge = Annotated[str, Field(min_length=1, max_length=60)]
Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,29}$")]
Kmh = Annotated[float, Field(ge=0, le=160)]
RoadKind = Literal["shipped", "given", "straight", "ramp", "lane_drop", "t", "crossing", "roundabout"]
VehicleType = Literal["car", "van", "truck", "bus", "motorcycle", "bicycle"]
MAX_ACTORS = 12


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class LightsPhase(_Part):
    """A phase of the traffic lights. ego: of the ego's direction and the opposite one; others: of all that cross it."""

    shows: Literal["ego_green", "ego_yellow", "all_red", "others_green", "others_yellow"]
    seconds: float = Field(ge=1, le=3600)


class RoadDraft(_Part):
    """The road. name: of a shipped network. The numbers are of a generated one. lights: the phases of its traffic
    lights, over and over, the first of which begins lights_offset s after the start; none: the ego has green all the
    time."""

    kind: RoadKind
    name: str = Field(default="", max_length=60)
    lanes: int = Field(default=1, ge=1, le=4)
    lanes_back: int = Field(default=1, ge=0, le=3)
    speed_limit: float = Field(default=50, ge=10, le=160)
    minor_limit: float = Field(default=50, ge=5, le=100)
    length: float = Field(default=400, ge=100, le=3000)
    control: Literal["priority", "signals", "all_stop", "right_before_left"] = "priority"
    ends: Literal["left", "right"] = "right"
    sidewalk: bool = False
    bike_lane: bool = False
    lights: list[LightsPhase] = Field(default_factory=list, max_length=8)
    lights_offset: float = Field(default=0, ge=-120, le=120)


class MoveDraft(_Part):
    """A move of the EGO itself. at: m along its way from its front at the start; none for a turn, which is the first
    one of its route. seconds: of a stop. speed: from there on. attacked: the attack belongs to this move; one at most.
    """

    does: Literal["change_left", "change_right", "stop", "speed", "turn_left", "turn_right"]
    at: float | None = Field(default=None, ge=0, le=1500)
    seconds: float | None = Field(default=None, ge=0.5, le=30)
    speed: Annotated[float, Field(ge=5, le=160)] | None = None
    attacked: bool = False


class CrestDraft(_Part):
    """A stretch of the EGO's way, begin to end in m from its front at the start, from which it sees only so far."""

    begin: float = Field(ge=0, le=1500)
    end: float = Field(gt=0, le=1500)
    limit: float = Field(ge=10, le=120)


class EgoDraft(_Part):
    """The vehicle under test. route: first and last edge. lane: 0 is the rightmost one for it. position: m of its front
    on the first edge; leave it out where it is to meet somebody."""

    type: Literal["car", "van", "truck", "bus", "motorcycle"] = "car"
    route: list[Edge] = Field(min_length=2, max_length=2)
    lane: int = Field(default=0, ge=0, le=5)
    speed: Annotated[float, Field(ge=5, le=160)]
    position: float | None = Field(default=None, ge=5, le=3000)
    moves: list[MoveDraft] = Field(default_factory=list, max_length=4)
    crests: list[CrestDraft] = Field(default_factory=list, max_length=2)


class VehicleDraft(_Part):
    """A vehicle. Give gap (m from the ego's front to its front, along the same road; 0 is beside, negative is behind)
    or arrives (s after the ego at the place where their ways meet, negative: before; of an oncoming vehicle, where the
    two pass). stands: it does not move by itself; with gap, else at the end of its first edge."""

    id: Name
    type: VehicleType = "car"
    route: list[Edge] = Field(min_length=2, max_length=2)
    lane: int = Field(default=0, ge=0, le=5)
    speed: Kmh
    gap: float | None = Field(default=None, ge=-500, le=1500)
    arrives: float | None = Field(default=None, ge=-8, le=20)
    stands: bool = False


class WalkerDraft(_Part):
    """A pedestrian or cyclist. at: m along the ego's way from its front at the start of the scene. offset: m from the
    middle of the ego's lane, left positive. straight_on: at counts straight on where the ego's way turns. heading:
    across (over the ego's way), along (as the ego goes) or against (towards the ego). speed: 0 for one who stands;
    others go straight on from the start, until the attack begins, or all the time if they are no adversary."""

    id: Name
    kind: Literal["pedestrian", "cyclist"] = "pedestrian"
    at: float = Field(ge=5, le=1500)
    offset: float = Field(ge=-20, le=20)
    straight_on: bool = False
    heading: Literal["across", "along", "against"] = "across"
    speed: Annotated[float, Field(ge=0, le=28)] = 0.0


class ParkedDraft(_Part):
    """A parked vehicle, which never moves; at and offset as of a walker, of its middle."""

    type: VehicleType = "car"
    at: float = Field(ge=0, le=1500)
    offset: float = Field(ge=-20, le=20)


class NovelDraft(_Part):
    """A behaviour that no known intent has, for which a planner is written. description: all that the adversary does,
    in its order, with the conditions. applies: from where it begins."""

    label: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9 '-]{2,59}$")
    description: str = Field(min_length=20, max_length=500)
    applies: list[AppliesTo] = Field(min_length=1, max_length=4)


class OtherAttackerDraft(_Part):
    """Another one that acts in the same attempt. adversary: its id. script: what it does, if no intent can be it.
    intents: known ones or the novel one, empty for any if there is no script. attacks: false for one that only plays
    its part, so that touching it is no success. asked: of it, without level and within."""

    adversary: Name
    script: Script | None = None
    intents: list[str] = Field(default_factory=list, max_length=4)
    attacks: bool = True
    asked: Asked

    @property
    def labels(self) -> list[str]:
        """The intents to try, the script first; empty for any."""
        return self.intents if self.script is None else [self.script.label, *self.intents]


class AttackDraft(_Part):
    """The attack. adversary, supports: ids of vehicles or walkers. intents: known ones, empty for any. script: what the
    adversary does, if none of them can be it; novel: if no script can say it either. others: that attack together with
    the adversary; the level and within of asked are of all."""

    adversary: Name
    script: Script | None = None
    novel: NovelDraft | None = None
    intents: list[str] = Field(default_factory=list, max_length=4)
    supports: list[Name] = Field(default_factory=list, max_length=2)
    others: list[OtherAttackerDraft] = Field(default_factory=list, max_length=2)
    asked: Asked

    @property
    def attackers(self) -> list[str]:
        """The ids of all that act, the adversary's first."""
        return [self.adversary, *(other.adversary for other in self.others)]

    @property
    def scripts(self) -> dict[str, Script]:
        """The scripts, by the id of the one that plays it."""
        own = [(self.adversary, self.script), *((other.adversary, other.script) for other in self.others)]
        return {name: script for name, script in own if script is not None}

    @property
    def labels(self) -> list[str]:
        """The intents to try, the script and the novel one first; empty for any."""
        own = [part.label for part in (self.script, self.novel) if part is not None]
        return own + self.intents


class SceneDraft(_Part):
    """A whole scenario."""

    road: RoadDraft
    ego: EgoDraft
    vehicles: list[VehicleDraft] = Field(default_factory=list, max_length=MAX_ACTORS)
    walkers: list[WalkerDraft] = Field(default_factory=list, max_length=4)
    parked: list[ParkedDraft] = Field(default_factory=list, max_length=8)
    attack: AttackDraft


class Draft(_Part):
    """The whole answer: either a scene, or cannot: one sentence on why there is none."""

    understood: str = Field(max_length=600)
    left_out: str = Field(default="", max_length=400)
    cannot: str = Field(default="", max_length=400)
    scene: SceneDraft | None = None
