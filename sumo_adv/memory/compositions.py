"""Composed intents in the memory bank: attacks of several adversaries, stored by reference to their parts.

A composition names the intent and the mode that each adversary carries out, the collider's first; planners stay with
their intents. It is kept under the settings of the bank (``COMPOSITION``), is found by its own label or description,
and is forgotten once ``FORGET`` attempts in a row have failed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.composition_record import COMPOSITION, Composition, composition_of, plain_composition
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


def record_composition(bank: MemoryBank, composition: Composition, attempts: Sequence[bool]) -> bool:
    """Count attempts with a composition, True for each success; whether the bank knows it now.

    An unknown composition is added by a success only, as an intent is.
    """
    written = bank.settings(composition.key).get(composition.key)
    if written is None and not any(attempts):
        return False
    after = replace(composition, succeeded=0, failed=0) if written is None else composition_of(written)
    for succeeded in attempts:
        more, failed = (1, 0) if succeeded else (0, after.failed + 1)
        after = replace(after, succeeded=after.succeeded + more, failed=failed)
    bank.keep(composition.key, plain_composition(after))
    return True
