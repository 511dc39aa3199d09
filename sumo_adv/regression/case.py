"""One kept attack: the folder of a case, read and checked. ``docs/regression.md`` describes case.toml.

SUITE/networks/NAME.net.xml    networks that do not come with the program, once each
SUITE/CASE/scenario.toml       road, traffic, ego and trigger: an input of ``sumo-adv run`` like any other
SUITE/CASE/planner.py          the adversary's planner; it runs only in the sandbox, unless it is a shipped one
SUITE/CASE/planner_2.py, _3    those of supports, in the order of case.toml
SUITE/CASE/case.toml           the attack and what is expected of the ego
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from sumo_adv.config import MAX_ATTACK_DELAY_S, load_settings
from sumo_adv.datatypes import MAX_ADVERSARIES, MAX_WAIT_S, Duty, Level, Proposal, acceleration_of
from sumo_adv.errors import SandboxError, UsageError
from sumo_adv.files import refuse_links
from sumo_adv.parsing import first_fault, read_toml
from sumo_adv.planners.text import make_planner
from sumo_adv.regression.at_trigger import AtTrigger
from sumo_adv.simulation.inputs import RunInput, load_input
from sumo_adv.simulation.scenario import SCENARIO_FILE
from sumo_adv.simulation.sumo_options import refuse

CASE_SCHEMA = 1
CASE_FILE, PLANNER_FILE, NETWORKS_FOLDER = "case.toml", "planner.py", "networks"
HASH_DIGITS = 12
SHAPING = (
    "seed", "step_length", "history", "duration", "replan", "delays", "forecast", "ttc", "limits", "sumo_options",
)  # fmt: skip
"""The settings that shape the run of one given attack.

A case may set only these; the horizon is part of its scenario.
"""
Avoided = Literal["critical", "collision", "valid", "strict", "serious"]


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Expectation(_Table):
    """Expectations of the ego; all that are given must hold. ``min_ttc`` [s]."""

    avoid: Avoided | None = None
    min_ttc: Annotated[float, Field(ge=0.0)] | None = None
    no_worse: bool = False

    @model_validator(mode="after")
    def _something(self) -> Expectation:
        if self.avoid is None and self.min_ttc is None and not self.no_worse:
            raise ValueError("give avoid, min_ttc or no_worse = true")
        return self

    @property
    def level(self) -> Level | None:
        return None if self.avoid is None else Level[self.avoid.upper()]

    @property
    def of_near_misses(self) -> bool:
        """Whether an attempt without a contact can break it."""
        return self.min_ttc is not None or self.level is Level.CRITICAL


class _Member(_Table):
    adversary: str
    relation: str
    intent: str
    mode: str
    origin: str
    acceleration: Any
    wait: Annotated[float, Field(ge=0.0, le=MAX_WAIT_S)] = 0.0
    parameters: dict[str, float] = Field(default_factory=dict)


class _Support(_Member):
    role: Duty

    @model_validator(mode="after")
    def _no_collider(self) -> _Support:
        if self.role is Duty.COLLIDER:
            raise ValueError("a support is not a collider")
        return self


class _Attack(_Member):
    delay: Annotated[float, Field(ge=0.0, le=MAX_ATTACK_DELAY_S)]
    ego_driven_from: float | None = None
    ego_before: tuple[tuple[str, float, float], ...] = ()
    network: str
    composition: str = ""
    supports: Annotated[tuple[_Support, ...], Field(max_length=MAX_ADVERSARIES - 1)] = ()

    @model_validator(mode="after")
    def _each_once(self) -> _Attack:
        if len({m.adversary for m in (self, *self.supports)}) <= len(self.supports):
            raise ValueError("each adversary must be another vehicle")
        return self


class _Found(BaseModel):
    model_config = ConfigDict(extra="allow", frozen=True, allow_inf_nan=False)

    level: str = "none"
    situation: AtTrigger | None = None

    @field_validator("level")
    @classmethod
    def _known(cls, level: str) -> str:
        if level.upper() not in Level.__members__:
            raise ValueError(f"it is one of {', '.join(map(str, Level))}")
        return level


class _File(_Table):
    schema_version: Literal[1] = Field(alias="schema")
    expect: Expectation = Expectation(avoid="collision")
    attack: _Attack
    settings: dict[str, Any] = Field(default_factory=dict)
    found: _Found = _Found()


@dataclass(frozen=True, slots=True)
class KeptCase:
    """A kept attack.

    Attributes:
        name: The name of the case.
        folder: Its folder.
        run_input: Its scenario.
        proposal: The attack.
        relations: The relation of each adversary to the ego at the trigger, by id.
        expect: What is expected of the ego.
        ego_driven_from: The earliest time at which the ego's driver takes over [s]; None means as soon as the ego
            exists.
        ego_before: The vehicles that the driver drives before the ego, each with the times at which it takes over and
            releases the vehicle [s].
        settings: The settings that shape the run, as data.
        level: The level that the attack reached when it was kept.
        situation: The ego and the adversary when the attack began; None in cases of earlier versions.
        notes: What has changed since the case was kept.
    """

    name: str
    folder: Path
    run_input: RunInput
    proposal: Proposal
    relations: Mapping[str, str]
    expect: Expectation
    ego_driven_from: float | None = None
    ego_before: tuple[tuple[str, float, float], ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    level: Level = Level.NONE
    situation: AtTrigger | None = None
    notes: tuple[str, ...] = ()


def read_suite(folder: Path) -> list[KeptCase]:
    """Read the cases of a suite, by name.

    Args:
        folder: The folder of a suite, or of a single case.

    Raises:
        UsageError: There is no such folder, there are no cases, one of them is damaged, or one lies in another.
    """
    if not folder.exists():
        raise UsageError(f"There is no folder {folder}.")
    refuse_links(folder)
    files = sorted(folder.glob(f"*/{CASE_FILE}")) if folder.is_dir() else []
    if (folder / CASE_FILE).is_file():
        if files:  # otherwise they would be skipped silently
            raise UsageError(f"{folder} is a case and holds the case {files[0].parent.name}: move one of them.")
        return [read_case(folder)]
    if not files:
        raise UsageError(f"{folder} holds no case: give a folder that sumo-adv keep has made.")
    return [read_case(file.parent) for file in files]


def read_case(folder: Path) -> KeptCase:
    """Read and check the case in a folder.

    Args:
        folder: The folder of the case.

    Raises:
        UsageError: A file is missing, is damaged, or does not fit the others.
    """
    file = folder / CASE_FILE
    name = folder.name if folder.name not in ("", "..") else folder.resolve().name  # its place in the suite
    given = _parsed(file)
    run_input = load_input(folder / SCENARIO_FILE)
    attack = given.attack
    if run_input.trigger == "auto" or run_input.candidates != (attack.adversary,):
        raise UsageError(
            f"The scenario of the case {folder} needs a trigger [s], and as its only candidate '{attack.adversary}'."
        )
    if run_input.ego is None:
        raise UsageError(f"The scenario of the case {folder} names no ego: give it an id or a route.")
    helpers = tuple(support.adversary for support in attack.supports)
    if set(run_input.supports) != set(helpers):
        raise UsageError(f"The scenario of the case {folder} and its {CASE_FILE} must name the same supports.")
    strange = sorted(given.settings.keys() - set(SHAPING))
    if strange:
        raise UsageError(f"{file} sets '{strange[0]}', which a case does not; it may set {', '.join(SHAPING)}.")
    refuse(load_settings(None, **given.settings).sumo_options)
    members = (attack, *attack.supports)
    proposal, *supports = [_proposal(file, planner_file(k), m, attack.delay) for k, m in enumerate(members)]
    proposal = replace(proposal, supports=tuple(supports), composition=attack.composition)
    relations = {m.adversary: m.relation for m in members}
    changed = hash_of(run_input.network) != attack.network
    note = f"{name}: the network {run_input.network.name} is not the one that the case was kept with."
    return KeptCase(
        name, folder, run_input, proposal, relations, given.expect, attack.ego_driven_from,
        attack.ego_before, given.settings, Level[given.found.level.upper()], given.found.situation,
        (note,) if changed else (),
    )  # fmt: skip


def planner_file(member: int) -> str:
    """Return the file of an adversary's planner.

    Args:
        member: The place of the adversary in the attack; 0 is the collider.
    """
    return PLANNER_FILE if member == 0 else f"planner_{member + 1}.py"


def _proposal(file: Path, planner: str, member: _Member, delay: float) -> Proposal:
    """Return what one adversary of a case does; raise UsageError if its planner or parameters cannot be used."""
    try:
        acceleration, text = acceleration_of(member.acceleration), (file.parent / planner).read_text(encoding="utf-8")
        made = make_planner(member.intent, member.mode, text, member.origin)
    except (OSError, ValueError, SandboxError) as error:
        raise UsageError(f"The planner of the case {file.parent} cannot be used ({error}).") from error
    numbers = {**made.defaults(), **member.parameters}
    unknown = sorted(numbers.keys() - made.defaults().keys())
    if unknown:
        raise UsageError(f"{file} has the parameter '{unknown[0]}', which the planner does not have.")
    return Proposal(
        member.adversary, member.intent, made, numbers, acceleration, delay, by="kept",
        duty=member.role if isinstance(member, _Support) else Duty.COLLIDER, wait=member.wait,
    )  # fmt: skip


def hash_of(file: Path) -> str:
    """Return the first ``HASH_DIGITS`` digits of the SHA-256 of a file.

    Args:
        file: The path of the file.
    """
    return hashlib.sha256(file.read_bytes()).hexdigest()[:HASH_DIGITS]


def _parsed(file: Path) -> _File:
    """Parse a case.toml; raise UsageError if it is wrong."""
    try:
        return _File.model_validate(read_toml(file, "The case"))
    except ValidationError as error:
        raise UsageError(f"The case {file} {first_fault(error)}") from error
