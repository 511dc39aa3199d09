"""Compositions that a language model may propose: attacks by several adversaries, made of parts that it is told about.

The analyzer is asked for them only if more than one adversary is allowed. A part is a vehicle, its role, and an intent:
one of the library for the collider and further attackers, one of ``SUPPORT_INTENTS`` for a support.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from pydantic import BaseModel, Field

from sumo_adv.agents.scene_text import Aliases
from sumo_adv.datatypes import Duty, LibraryEntry
from sumo_adv.llm.prompts import MAX_PROMPT_TEXT_CHARACTERS, Prompts, sanitize
from sumo_adv.memory.records import Composition, Part, canonical
from sumo_adv.road_users import is_unprotected
from sumo_adv.search.support_intents import SUPPORT_INTENTS, can_do_duty
from sumo_adv.search.supports import ANY_FITTING, EXPERT_COMPOSITIONS, Cast
from sumo_adv.situation import Situation, Target

MAX_PROPOSED_COMPOSITIONS = 3  # maximum number of compositions in one answer
DUTY_DESCRIPTIONS = {
    Duty.BLOCK_LEFT: "takes the room into which EGO would swerve to the left",
    Duty.BLOCK_RIGHT: "takes the room into which EGO would swerve to the right",
    Duty.SLOW: "holds EGO up from ahead",
    Duty.HIDE: "keeps between EGO and a collider that crosses or merges",
    Duty.OPEN: "makes room into which the collider can go",
}
ATTACKING = (Duty.COLLIDER, Duty.ATTACK)

# The two classes below are sent to the model as a JSON schema, with their names and docstrings.


class Member(BaseModel):
    """What one vehicle does in a composition."""

    bv: str
    role: str = Field(max_length=40)
    label: str = Field(min_length=1, max_length=80)


class Team(BaseModel):
    """A composition as a model gives it."""

    label: str = Field(min_length=1, max_length=80)
    description: str = Field(default="", max_length=MAX_PROMPT_TEXT_CHARACTERS)
    parts: list[Member] = Field(max_length=6)
    reason: str = Field(default="", max_length=2000)


@dataclass(frozen=True, slots=True)
class Teamwork:
    """What an analyzer may compose.

    Attributes:
        most: The maximum number of adversaries.
        colliders: The ids of the vehicles that may be the collider; empty allows all.
        known: The compositions of the bank.
    """

    most: int
    colliders: tuple[str, ...] = ()
    known: tuple[Composition, ...] = ()

    @property
    def named(self) -> list[Composition]:
        """The compositions that a model is told about: the bank's, and those of the expert that the bank lacks."""
        labels = {canonical(c.label) for c in self.known}
        new = [c for c in EXPERT_COMPOSITIONS if canonical(c.label) not in labels]
        return [c for c in (*self.known, *new) if len(c.parts) <= self.most]

    def may_collide(self, name: str) -> bool:
        """Return whether a vehicle may be the collider.

        Args:
            name: The id of the vehicle.
        """
        return not self.colliders or name in self.colliders


def teams_words(
    prompts: Prompts, teamwork: Teamwork, situation: Situation, aliases: Aliases, library: Sequence[LibraryEntry]
) -> str:
    """Return the section of the analyzer's prompt on compositions.

    Args:
        prompts: The prompts.
        teamwork: What may be composed.
        situation: The situation.
        aliases: The aliases of its vehicles.
        library: The known intents.
    """
    roles = [
        f"- {duty}: {DUTY_DESCRIPTIONS[duty]}. Behaviours: "
        + "; ".join(f"{entry.label} ({entry.description})" for entry in SUPPORT_INTENTS[duty])
        for duty in DUTY_DESCRIPTIONS
    ]  # fmt: skip
    roles.append(f"- {Duty.ATTACK}: attacks EGO as the collider does. Behaviours: those of the library.")
    fitting = []
    for alias, name in aliases.bvs.items():
        target = situation.targets[name]
        collides = teamwork.may_collide(name) and not is_unprotected(target.state)
        collides = collides and any(_applies(target, entry) for entry in library)
        may = [
            *(map(str, ATTACKING) if collides else ()),
            *(f"{duty} ({entry.label})" for duty in DUTY_DESCRIPTIONS for entry in SUPPORT_INTENTS[duty]
              if can_do_duty(duty, entry, target)),
        ]  # fmt: skip
        fitting.append(f"{alias}: {', '.join(may) or 'nothing'}")
    named = [
        f"- {sanitize(c.label)}: {sanitize(c.description)} Parts: "
        + ", ".join(f"{part.duty} {sanitize(part.intent)}" for part in c.parts)
        for c in teamwork.named
    ]  # fmt: skip
    return prompts.piece(
        "teams", most=str(teamwork.most), proposed=str(MAX_PROPOSED_COMPOSITIONS), roles="\n".join(roles),
        fitting="\n".join(fitting), known="\n".join(named),
    )  # fmt: skip


def team_fault(
    team: Team, teamwork: Teamwork, situation: Situation, aliases: Aliases, library: Sequence[LibraryEntry]
) -> str | None:
    """Return the fault of a composition as a sentence for the model.

    Args:
        team: The composition.
        teamwork: What may be composed.
        situation: The situation.
        aliases: The aliases of its vehicles.
        library: The known intents.

    Returns:
        The fault; None for a usable composition.
    """
    label = sanitize(team.label)
    labels = {canonical(c.label) for c in teamwork.named}
    if canonical(label) not in labels and len(team.description.split()) < 5:
        return f"The new composition '{label}' needs a description of one or two sentences."
    if not 2 <= len(team.parts) <= teamwork.most:
        return f"The composition '{label}' has {len(team.parts)} parts; it must have 2 to {teamwork.most}."
    if [member.role == Duty.COLLIDER for member in team.parts] != [True] + [False] * (len(team.parts) - 1):
        return f"The first part of the composition '{label}' must be the collider, and the others must be supports."
    if len({member.bv for member in team.parts}) < len(team.parts):
        return f"A vehicle has two parts in the composition '{label}'."
    return next((f for m in team.parts if (f := _member_fault(m, teamwork, situation, aliases, library))), None)


def casts_of(teams: Iterable[Team], aliases: Aliases, library: Sequence[LibraryEntry]) -> tuple[Cast, ...]:
    """Return the compositions of a model's answers, with their vehicles.

    Args:
        teams: The usable compositions.
        aliases: The aliases of the vehicles.
        library: The known intents.

    Returns:
        The compositions; only the first one of each label.
    """
    casts: dict[str, Cast] = {}
    for team in teams:
        parts = tuple(Part(Duty(m.role), _entry(m, library).label, ANY_FITTING) for m in team.parts)
        label = sanitize(team.label)
        same = next((c.description for c in EXPERT_COMPOSITIONS if canonical(c.label) == canonical(label)), "")
        composition = Composition(label, sanitize(team.description) or same or label, parts)
        casts.setdefault(canonical(label), Cast(composition, tuple(aliases.bvs[m.bv] for m in team.parts)))
    return tuple(casts.values())


def _member_fault(
    member: Member, teamwork: Teamwork, situation: Situation, aliases: Aliases, library: Sequence[LibraryEntry]
) -> str | None:
    """Return the fault of a part; None if it is usable."""
    bv, role = sanitize(member.bv), sanitize(member.role)
    if member.bv not in aliases.bvs:
        return f"There is no vehicle '{bv}' that may take part; there are {', '.join(aliases.bvs)}."
    if member.role not in (*ATTACKING, *DUTY_DESCRIPTIONS):
        return f"There is no role '{role}'; choose {', '.join((*ATTACKING, *DUTY_DESCRIPTIONS))}."
    duty, name = Duty(member.role), aliases.bvs[member.bv]
    entries = {e.label.lower(): e for e in (library if duty in ATTACKING else SUPPORT_INTENTS[duty])}
    entry, target = entries.get(member.label.lower()), situation.targets[name]
    if entry is None:
        choices = ", ".join(e.label for e in entries.values())
        return f"'{sanitize(member.label)}' is no behaviour of the role {role}; choose {choices}."
    if duty not in ATTACKING:
        return None if can_do_duty(duty, entry, target) else f"{bv} cannot carry out '{entry.label}' from where it is."
    if not teamwork.may_collide(name):
        return f"{bv} may not be the collider or attack, only support."
    if is_unprotected(target.state):  # all adversaries of a candidate have the same limits
        return f"{bv} is a pedestrian or cyclist, and only vehicles have supports: choose another collider."
    return None if _applies(target, entry) else f"'{entry.label}' does not apply to {bv} from where it is."


def _entry(member: Member, library: Sequence[LibraryEntry]) -> LibraryEntry:
    """Return the intent of a part."""
    entries = library if member.role in ATTACKING else SUPPORT_INTENTS[Duty(member.role)]
    return next(e for e in entries if e.label.lower() == member.label.lower())


def _applies(target: Target, entry: LibraryEntry) -> bool:
    """Return whether an intent applies to a vehicle."""
    return bool(set(target.applies()) & set(entry.applies))
