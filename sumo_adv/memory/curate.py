"""Summarise a bank's evidence, and propose what a person may want to do: merge intents, retire planners.

The functions only propose; they change nothing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sumo_adv.memory.bank import MemoryBank

DUPLICATE_EPSILON_SHARE = 0.5  # of epsilon; two intents at most this far apart are proposed for merging
MIN_RETIRING_EVIDENCE_COUNT = 20  # a planner with this many failures and no success is proposed for retiring


@dataclass(frozen=True, slots=True)
class MergeProposal:
    """A proposal to merge an intent into an older one.

    Attributes:
        label: The label of the intent to merge.
        into: The label of the older intent.
        distance: The distance between the two [-].
        reason: Why they may be one intent.
    """

    label: str
    into: str
    distance: float
    reason: str


@dataclass(frozen=True, slots=True)
class PlannerCounts:
    """The evidence about one planner.

    Attributes:
        label: The label of its intent.
        mode: Its mode.
        hash: The hash of its text.
        origin: Where it came from.
        retired: Whether the planner or its intent is retired.
        successes: The number of pieces of evidence with a success.
        failures: The number of the other pieces.
    """

    label: str
    mode: str
    hash: str
    origin: str
    retired: bool
    successes: int
    failures: int


def near_duplicates(bank: MemoryBank) -> list[MergeProposal]:
    """Find active intents that may be one, nearest first.

    Two intents may be one if they have a planner with the same text, or if they have a relation in common and lie
    within half of epsilon.

    Args:
        bank: The bank to examine.
    """
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
                proposals[later, into] = MergeProposal(later, into, distance, "their descriptions are nearly the same")
    for labels in texts.values():
        for later in labels[1:]:
            proposals[later, labels[0]] = MergeProposal(later, labels[0], 0.0, "they have a planner with the same text")
    return sorted(proposals.values(), key=lambda proposal: (proposal.distance, proposal.label, proposal.into))


def statistics(bank: MemoryBank) -> dict[str, Any]:
    """Count the content of a bank, in total and, under ``by_label``, for each intent.

    Args:
        bank: The bank to examine.

    Returns:
        The counts. ``attempts`` is the sum over an intent's evidence.
    """
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
    """Count successes and failures of every planner, including retired ones, in the order of ``stored_intents``.

    Args:
        bank: The bank to examine.
    """
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
    """Return active planners that failed often and never succeeded.

    Args:
        bank: The bank to examine.
        at_least: The minimum number of failures.
    """
    return [
        each for each in planner_counts(bank)
        if not each.retired and each.successes == 0 and each.failures >= at_least
    ]  # fmt: skip
