"""Composed intents in the memory bank: attacks of several adversaries, stored by reference to their parts.

A composition names the intent and the mode that each adversary carries out, the collider's first; planners stay with
their intents. It is kept under the settings of the bank (``COMPOSITION``), is found by its own label or description,
and is forgotten once ``FORGET`` attempts in a row have failed.
"""

from __future__ import annotations

from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.composition_record import COMPOSITION, Composition, composition_of
from sumo_adv.memory.records import canonical
from sumo_adv.memory.similarity import TextAndSlots


def compositions(bank: MemoryBank) -> list[Composition]:
    """The compositions of a bank by label; those that are forgotten are left out."""
    return [composition for composition in all_compositions(bank) if not composition.hopeless]


def all_compositions(bank: MemoryBank) -> list[Composition]:
    """The compositions of a bank by label, also those that are forgotten."""
    return [composition_of(value) for _, value in sorted(bank.settings(COMPOSITION).items())]


def retrieve_composition(bank: MemoryBank, label: str, description: str) -> Composition | None:
    """The composition of a bank that means the same by its own label or description; None if none is near enough."""
    candidates = compositions(bank)
    same = next((c for c in candidates if canonical(c.label) == canonical(label)), None)
    if same is not None or not candidates:
        return same
    similarity = TextAndSlots()
    similarity.fit([(c.label, c.description) for c in candidates])
    distances = similarity.distances(label, description)
    nearest = int(distances.argmin())
    return candidates[nearest] if distances[nearest] <= bank.epsilon()[0] else None
