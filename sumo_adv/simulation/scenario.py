"""The scenario file: one encounter, or one place and its traffic, in TOML (``schema = 1``).

The classes below are its tables. ``docs/settings.md`` explains every key. Relative paths start from the scenario's
folder. Every time is simulation time, except ``warm_up``, which counts from the ego's insertion, and ``horizon``, a
duration. With ``tracks``, the log moves all vehicles until the warm-up is over. Then the ego and the BVs get their
drivers. The route of a recorded vehicle is the ``<route>`` of its id in the demand's files. Without one, the vehicle is
only replayed. This module opens no file but the scenario; ``inputs.py`` checks the files that it names.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self, TypeAlias

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, model_validator

from sumo_adv.asked import Asked, Attacker, RequestOrigin
from sumo_adv.datatypes import MAX_ADVERSARIES, Relation
from sumo_adv.ego_sensing import EgoSensing
from sumo_adv.ego_way import EgoMove, SightStretch
from sumo_adv.errors import UsageError
from sumo_adv.parsing import dotted, first_fault, read_toml
from sumo_adv.script import Script

SCENARIO_SCHEMA = 1
# Files of an imported or kept scenario.
SCENARIO_FILE, NETWORK_FILE = "scenario.toml", "network.net.xml"
TRACKS_FILE, ROUTES_FILE = "tracks.csv.gz", "routes.rou.xml"
DEFAULT_WARM_UP_S = 3.0  # counted from the ego's insertion
# Maximum length of a file's name and path; systems refuse to look for longer ones.
MAX_FILE_NAME_CHARACTERS = 200
MAX_PATH_CHARACTERS = 2000
MAX_MOVES = 20  # of the ego, and stretches of sight


def _from_scenario_folder(path: Path, info: ValidationInfo) -> Path:
    """Resolve ``path`` against the scenario's folder, which the validation context carries; absolute paths stay."""
    if any(len(part) > MAX_FILE_NAME_CHARACTERS for part in path.parts) or len(str(path)) > MAX_PATH_CHARACTERS:
        raise ValueError("the name of the file is too long")
    return Path(info.context["folder"], path) if info.context else path


Located = Annotated[Path, AfterValidator(_from_scenario_folder)]
Seconds = Annotated[float, Field(ge=0.0)]
Metres = Annotated[float, Field(gt=0.0)]
Name = Annotated[str, Field(min_length=1)]


class _Table(BaseModel):
    """A table of the file: frozen, no unknown keys, no infinities."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Demand(_Table):
    """The traffic: route files, or generated traffic of ``density`` [departures per minute over the whole network]."""

    files: tuple[Located, ...] = ()
    density: Annotated[float, Field(gt=0.0)] | None = None
    seed: Annotated[int, Field(ge=0)] | None = None
    begin: Seconds | None = None
    end: Seconds | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.files and self.density is not None:
            raise ValueError("give either files or density, not both")
        if self.begin is not None and self.end is not None and self.end <= self.begin:
            raise ValueError("end must be later than begin")
        return self


class Ego(_Table):
    """The vehicle under test: one of the demand (``id``) or one of its own (``route``, edges from first to last)."""

    id: Name | None = None
    route: tuple[Name, ...] = ()
    depart: Seconds | None = None
    lane: Annotated[int, Field(ge=0)] | Literal["best", "first", "free", "random"] | None = None
    position: float | Literal["base", "free", "last", "random"] | None = None
    speed: Seconds | Literal["desired", "max", "last", "avg"] | None = None
    controller: Name | None = None
    parameters: dict[str, bool | int | float | str] = Field(default_factory=dict)
    type: Name | None = None
    sensing: EgoSensing | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        placed = [key for key in ("depart", "lane", "position", "speed") if getattr(self, key) is not None]
        if self.id is not None and self.route:
            raise ValueError("give either id or route, not both")
        if placed and not self.route:
            raise ValueError(f"{placed[0]} needs a route")
        if self.route and self.depart is None:
            raise ValueError("a route needs a depart time")
        return self


class AttackWindow(_Table):
    """When to attack: ``trigger`` [s] or "auto" (looked for online, ``warm_up`` s after the ego's insertion at the
    earliest), and for how long (``horizon`` [s])."""

    warm_up: Seconds = DEFAULT_WARM_UP_S
    trigger: Seconds | Literal["auto"] = "auto"
    horizon: Annotated[float, Field(gt=0.0)] | None = None


class Adversary(_Table):
    """Which BVs may become the adversary, which others may support it, and what it may try; empty means no
    restriction."""

    candidates: tuple[Name, ...] = ()
    supports: tuple[Name, ...] = ()
    intents: tuple[Name, ...] = ()


Background: TypeAlias = Literal["log", "sumo"]
"""What drives recorded vehicles."""


class ObstacleBox(_Table):
    """A parked obstacle, pedestrian or cyclist: centre [m], heading [rad, counter-clockwise from +x], size [m]."""

    x: float
    y: float
    heading: float
    length: Metres
    width: Metres
    speed: Seconds = 0.0
    times: tuple[Seconds, Seconds] | None = None


class Signals(_Table):
    """Signal programs of the scenario's own (``files``, loaded as SUMO additionals) or recorded states (``log``)."""

    files: tuple[Located, ...] = ()
    log: Located | None = None


class Label(_Table):
    """The intents held to be the most dangerous here. source: people's annotation, or an oracle's simulations.

    relation, level: of an attack with one of the intents and this number of ``adversaries``. All shipped scenarios have
    them; a run until this level finds such an attack in at most 400 attempts.
    """

    intents: Annotated[tuple[Name, ...], Field(min_length=1)]
    source: Literal["annotated", "oracle"] = "annotated"
    relation: Relation | None = None
    level: Literal["critical", "collision", "valid", "strict", "serious"] | None = None
    adversaries: Annotated[int, Field(ge=1, le=MAX_ADVERSARIES)] = 1


class Scenario(_Table):
    """A whole scenario file; paths are already counted from its folder."""

    schema_version: Literal[1] = Field(alias="schema")
    network: Located
    tracks: Located | None = None
    background: Background | None = None
    additional: tuple[Located, ...] = ()
    demand: Demand = Demand()
    ego: Ego = Ego()
    window: AttackWindow = AttackWindow()
    adversary: Adversary = Adversary()
    signals: Signals = Signals()
    label: Label | None = None
    parked: tuple[ObstacleBox, ...] = ()
    pedestrians: tuple[ObstacleBox, ...] = ()
    cyclists: tuple[ObstacleBox, ...] = ()
    scripts: tuple[Script, ...] = ()
    moves: Annotated[tuple[EgoMove, ...], Field(max_length=MAX_MOVES)] = ()
    sight: Annotated[tuple[SightStretch, ...], Field(max_length=MAX_MOVES)] = ()
    written: RequestOrigin | None = None
    asked: Asked | None = None
    attackers: tuple[Attacker, ...] = ()

    @model_validator(mode="after")
    def _few_attackers(self) -> Self:
        ids = [attacker.id for attacker in self.attackers]
        if not ids:
            return self
        if self.adversary.candidates or self.adversary.intents:
            raise ValueError("give either attackers, or candidates and intents of the adversary, not both")
        if len(ids) == 1:
            raise ValueError("attackers are two or more; a single one is the candidate of the adversary")
        if not any(attacker.attacks for attacker in self.attackers):
            raise ValueError("one of the attackers must attack, and all of them have attacks = false")
        if len({*ids, *self.adversary.supports}) < len(ids) + len(self.adversary.supports):
            raise ValueError("attackers and supports must all be different vehicles")
        if len(ids) + len(self.adversary.supports) > MAX_ADVERSARIES:
            raise ValueError(f"attackers and supports together are at most {MAX_ADVERSARIES}")
        return self

    @model_validator(mode="after")
    def _asked_of_all(self) -> Self:
        if any(each.asked.level is not None or each.asked.within is not None for each in self.attackers):
            raise ValueError("level and within hold for all attackers: give them in [asked], not in [attackers.asked]")
        if self.asked is not None and self.asked.within is not None and not self.attackers:
            raise ValueError("within in [asked] bounds the time between attackers: leave it out, or give attackers")
        return self

    @model_validator(mode="after")
    def _of_an_ego(self) -> Self:
        given = "moves" if self.moves else "sight" if self.sight else ""
        if given and self.ego.id is None and not self.ego.route:
            raise ValueError(f"{given} needs an ego with an id or a route")
        if given and self.tracks is not None:
            raise ValueError(f"{given} needs traffic that SUMO drives, not tracks")
        if sum(move.attacked for move in self.moves) > 1:
            raise ValueError("only one of the moves can be attacked")
        return self


def load_scenario(path: Path) -> Scenario:
    """Read a scenario from a TOML file.

    Args:
        path: The file.

    Returns:
        The scenario.

    Raises:
        UsageError: The file cannot be read, or has unknown keys or bad values. The message is one sentence with file
            and key.
    """
    table = read_toml(path, "The scenario")
    try:
        return Scenario.model_validate(table, context={"folder": path.parent})
    except ValidationError as error:
        raise UsageError(f"The scenario {path} {_fault(error)}") from error


def _fault(error: ValidationError) -> str:
    """Return the first fault of the file, as the end of a sentence that begins with its name."""
    detail = error.errors()[0]
    key = dotted(detail["loc"])
    if detail["type"] == "extra_forbidden":
        return f"has an unknown key '{key}'; {_known_keys(detail['loc'])}"
    if key == "schema" and detail["type"] != "missing":
        return f"has schema = {repr(detail['input'])[:200]}; this program reads schema = {SCENARIO_SCHEMA}."
    return first_fault(error)


def _known_keys(location: tuple[int | str, ...]) -> str:
    """Return the known keys beside the unknown one at ``location``."""
    tables: dict[str, type[BaseModel]] = {
        "demand": Demand, "ego": Ego, "window": AttackWindow, "adversary": Adversary, "signals": Signals,
        "label": Label, "parked": ObstacleBox, "pedestrians": ObstacleBox, "cyclists": ObstacleBox,
        "scripts": Script, "written": RequestOrigin, "asked": Asked, "moves": EgoMove, "sight": SightStretch,
        "attackers": Attacker,
    }  # fmt: skip
    table = tables.get(str(location[0]), Scenario) if len(location) > 1 else Scenario
    names = [info.alias or name for name, info in table.model_fields.items()]
    return f"known keys there are {', '.join(names)}."
