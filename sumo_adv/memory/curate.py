"""What a bank's evidence adds up to, and what a person may want to do about it: merge intents, retire planners.

Proposals only, nothing is changed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sumo_adv.memory.bank import MemoryBank

DUPLICATE_EPSILON_SHARE = 0.5  # of epsilon: two intents this near are proposed for merging
MIN_RETIRING_EVIDENCE_COUNT = 20  # pieces of evidence without one success: a planner is proposed for retiring


@dataclass(frozen=True, slots=True)
class MergeProposal:
    """``label`` could be merged into ``into`` (the older one): why, and how far apart they are."""

    label: str
    into: str
    distance: float
    reason: str


@dataclass(frozen=True, slots=True)
class PlannerCounts:
    """The evidence about one planner."""

    label: str
    mode: str
    hash: str
    origin: str
    retired: bool
    successes: int
    failures: int


def near_duplicates(bank: MemoryBank) -> list[MergeProposal]:
    """Active intents that may be one: a planner with the same text, or that can be tried from a common relation and lie
    within half of epsilon; nearest first."""
    places = {record.label: i for i, record in enumerate(bank.intents())}
    active = {stored.intent.label: stored for stored in bank.stored_intents() if stored.intent.status == "active"}
    texts: dict[str, list[str]] = {}
    proposals: dict[tuple[str, str], MergeProposal] = {}
    for label, stored in active.items():
        for planner in stored.planners:
            texts.setdefault(planner.hash, []).append(label)
        for neighbour, distance in bank.retrieve(label, stored.intent.description).nearest:
            common = set(stored.intent.applies) & set(active[neighbour].intent.applies)
            if neighbour != label and common and distance <= DUPLICATE_EPSILON_SHARE * bank.epsilon()[0]:
                into, later = sorted((label, neighbour), key=places.__getitem__)
                proposals[later, into] = MergeProposal(later, into, distance, "they say nearly the same")
    for labels in texts.values():
        for later in labels[1:]:
            proposals[later, labels[0]] = MergeProposal(later, labels[0], 0.0, "they have a planner with the same text")
    return sorted(proposals.values(), key=lambda proposal: (proposal.distance, proposal.label, proposal.into))


def statistics(bank: MemoryBank) -> dict[str, Any]:
    """Counts over the bank, and under ``by_label`` for each intent; ``attempts``: the sum over its evidence."""
    held = bank.stored_intents()
    by_label = {}
    for stored in held:
        successes = sum(e.success for e in stored.evidence)
        by_label[stored.intent.label] = {
            "planners": len(stored.planners), "evidence": len(stored.evidence), "successes": successes,
            "collisions": sum(e.collided for e in stored.evidence),
            "valid": sum(e.valid is True for e in stored.evidence),
            "attempts": sum(e.attempts for e in stored.evidence), "failures": len(stored.evidence) - successes,
        }  # fmt: skip
    return {
        "intents": len(held), "active": sum(stored.intent.status == "active" for stored in held),
        "planners": sum(len(stored.planners) for stored in held),
        "evidence": sum(len(stored.evidence) for stored in held), "by_label": by_label,
    }  # fmt: skip


def planner_counts(bank: MemoryBank) -> list[PlannerCounts]:
    """Successes and failures of every planner, retired ones too, in the order of ``MemoryBank.stored_intents``."""
    counts = []
    for stored in bank.stored_intents():
        results: Mapping[str, list[int]] = {planner.hash: [0, 0] for planner in stored.planners}
        for evidence in stored.evidence:
            results[evidence.planner_hash][0 if evidence.success else 1] += 1
        for planner in stored.planners:
            good, bad = results[planner.hash]
            retired = planner.hash in stored.retired or stored.intent.status == "retired"
            counts.append(
                PlannerCounts(stored.intent.label, planner.mode, planner.hash, planner.origin, retired, good, bad)
            )
    return counts


def hopeless(bank: MemoryBank, at_least: int = MIN_RETIRING_EVIDENCE_COUNT) -> list[PlannerCounts]:
    """Active planners that failed ``at_least`` times and never succeeded."""
    return [
        each for each in planner_counts(bank)
        if not each.retired and each.successes == 0 and each.failures >= at_least
    ]  # fmt: skip
