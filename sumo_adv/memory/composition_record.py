"""A composed intent: an attack of several adversaries by reference to the intents and modes of its parts, and as plain
data for the bank's settings and files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sumo_adv.datatypes import MOST_ADVERSARIES, Duty
from sumo_adv.errors import BankError
from sumo_adv.memory.records import canonical

COMPOSITION = "composition."  # keys of the bank's settings begin with it
FORGET = 20  # attempts that failed in a row
MOST_ATTEMPTS = 2**53  # bound of the counts: JSON and TOML keep whole numbers up to it


@dataclass(frozen=True, slots=True)
class Part:
    """What one adversary does: its duty, and the intent and the planner's mode by which it does it."""

    duty: Duty
    intent: str
    mode: str


@dataclass(frozen=True, slots=True)
class Composition:
    """A composed intent. ``parts``: the collider's first. ``succeeded``: attempts so far; ``failed``: since the last
    success.

    Raises BankError for an empty label or description, and for parts that are no collider with supports.
    """

    label: str
    description: str
    parts: tuple[Part, ...]
    succeeded: int = 0
    failed: int = 0

    def __post_init__(self) -> None:
        if not canonical(self.label) or not self.description.strip():
            raise BankError(f"The composition {self.label!r} needs a label and a description.")
        colliders = [part.duty is Duty.COLLIDER for part in self.parts]
        if not 2 <= len(colliders) <= MOST_ADVERSARIES or colliders != [True] + [False] * (len(colliders) - 1):
            raise BankError(
                f"The composition {self.label!r} must have 2 to {MOST_ADVERSARIES} parts: a collider, then supports."
            )

    @property
    def key(self) -> str:
        """The key under which the bank's settings have it."""
        return f"{COMPOSITION}{canonical(self.label)}"

    @property
    def hopeless(self) -> bool:
        """Whether many attempts in a row have failed."""
        return self.failed >= FORGET


def plain_composition(composition: Composition) -> dict[str, Any]:
    """A composition as the bank's settings and files have it."""
    parts = [{"role": str(p.duty), "intent": p.intent, "mode": p.mode} for p in composition.parts]
    return {
        "label": composition.label, "description": composition.description, "parts": parts,
        "succeeded": composition.succeeded, "failed": composition.failed,
    }  # fmt: skip


def composition_of(value: Any) -> Composition:
    """What ``plain_composition`` made. Raises ValueError or BankError, with what is wrong, for anything else."""
    table = _table(value, {"label": str, "description": str, "parts": list, "succeeded": int, "failed": int})
    rows = [_table(each, {"role": str, "intent": str, "mode": str}) for each in table["parts"]]
    if any(each["role"] not in list(Duty) for each in rows):
        raise ValueError(f"the role of a part of a composition must be one of {', '.join(Duty)}")
    if not 0 <= min(table["succeeded"], table["failed"]) <= max(table["succeeded"], table["failed"]) < MOST_ATTEMPTS:
        raise ValueError("the counts of a composition must be whole numbers of 0 or more")
    parts = tuple(Part(Duty(each["role"]), each["intent"], each["mode"]) for each in rows)
    return Composition(table["label"], table["description"], parts, table["succeeded"], table["failed"])


def _table(value: Any, kinds: Mapping[str, type]) -> Mapping[str, Any]:
    """The value, if it is a table with exactly these keys and kinds of values."""
    if not isinstance(value, Mapping) or value.keys() != kinds.keys():
        raise ValueError(f"a table of a composition must hold {', '.join(kinds)} and nothing else")
    wrong = [key for key, kind in kinds.items() if not isinstance(value[key], kind) or isinstance(value[key], bool)]
    if wrong:
        raise ValueError(f"the value of {wrong[0]} in a composition is of another kind")
    return value


def counted(known: Composition | None, composition: Composition, attempts: Sequence[bool]) -> Composition | None:
    """The composition after attempts, True for each success; ``known``: as it was before. None if it is unknown and
    none succeeded, since only a success adds one."""
    if known is None and not any(attempts):
        return None
    after = known or replace(composition, succeeded=0, failed=0)
    for succeeded in attempts:
        after = replace(after, succeeded=after.succeeded + succeeded, failed=0 if succeeded else after.failed + 1)
    return after


def renamed(composition: Composition, label: str, into: str, modes: Mapping[str, str]) -> Composition:
    """The composition after the intent ``label`` was merged into another one; ``modes``: its modes' new names."""
    parts = tuple(
        replace(p, intent=into, mode=modes.get(p.mode, p.mode)) if canonical(p.intent) == canonical(label) else p
        for p in composition.parts
    )
    return replace(composition, parts=parts)
