"""Composed intents in the memory bank: attacks of several adversaries, stored by reference to their parts.

A composition names the intent and the mode that each adversary carries out, the collider's first; planners stay with
their intents. It is kept under the settings of the bank (``COMPOSITION``), is found by its own label or description,
and is forgotten once ``FORGET`` attempts in a row have failed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sumo_adv.datatypes import MOST_ADVERSARIES, Duty
from sumo_adv.errors import BankError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import canonical
from sumo_adv.memory.similarity import TextAndSlots

COMPOSITION = "composition."  # keys of the bank's settings begin with it
FORGET = 20  # attempts that failed in a row


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
    def hopeless(self) -> bool:
        """Whether many attempts in a row have failed."""
        return self.failed >= FORGET


def compositions(bank: MemoryBank) -> list[Composition]:
    """The compositions of a bank by label; those that are forgotten and those that cannot be read are left out."""
    found = [_read(value) for _, value in sorted(bank.settings(COMPOSITION).items())]
    return [composition for composition in found if composition is not None and not composition.hopeless]


def retrieve_composition(bank: MemoryBank, label: str, description: str) -> Composition | None:
    """The composition of a bank that means the same by its own label or description; None if none is near enough."""
    known = compositions(bank)
    same = next((c for c in known if canonical(c.label) == canonical(label)), None)
    if same is not None or not known:
        return same
    similarity = TextAndSlots()
    similarity.fit([(c.label, c.description) for c in known])
    distances = similarity.distances(label, description)
    nearest = int(distances.argmin())
    return known[nearest] if distances[nearest] <= bank.epsilon()[0] else None


def record_composition(bank: MemoryBank, composition: Composition, attempts: Sequence[bool]) -> bool:
    """Count attempts with a composition, True for each success; whether the bank knows it now.

    An unknown composition is added by a success only, as an intent is.
    """
    key = f"{COMPOSITION}{canonical(composition.label)}"
    known = _read(bank.settings(key).get(key))
    if known is None and not any(attempts):
        return False
    after = known or replace(composition, succeeded=0, failed=0)
    for succeeded in attempts:
        more, failed = (1, 0) if succeeded else (0, after.failed + 1)
        after = replace(after, succeeded=after.succeeded + more, failed=failed)
    parts = [{"role": str(p.duty), "intent": p.intent, "mode": p.mode} for p in after.parts]
    bank.keep(key, {
        "label": after.label, "description": after.description, "parts": parts, "succeeded": after.succeeded,
        "failed": after.failed,
    })  # fmt: skip
    return True


def _read(value: Any) -> Composition | None:
    if not isinstance(value, Mapping):
        return None
    try:
        parts = tuple(Part(Duty(p["role"]), str(p["intent"]), str(p["mode"])) for p in value["parts"])
        counts = int(value["succeeded"]), int(value["failed"])
        return Composition(str(value["label"]), str(value["description"]), parts, *counts)
    except (BankError, KeyError, TypeError, ValueError):
        return None
