"""What the memory bank learns from the attempts of an encounter, and what that changes for the next run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sumo_adv import __version__
from sumo_adv.agents.agents import Agents
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, LibraryEntry
from sumo_adv.episode.memory_access import read_library, signature
from sumo_adv.episode.order import rank
from sumo_adv.episode.prepared_encounter import PreparedEncounter
from sumo_adv.episode.run import EncounterRecord
from sumo_adv.errors import BankError
from sumo_adv.goal import Goal
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import Composition, IntentRecord, Part, SceneSignature, evidence_of
from sumo_adv.search.intents import EXPERT, composed
from sumo_adv.search.sampling import templates_of
from sumo_adv.search.supports import Cast, description_of


@dataclass(frozen=True, slots=True)
class Learnt:
    """Whether the bank has learnt a success, and a sentence if it could not be written."""

    success: bool = False
    note: str = ""


def learn(
    record: EncounterRecord, bank: MemoryBank, entries: Sequence[LibraryEntry], settings: Settings, network: str,
    driver: str,
) -> Learnt:  # fmt: skip
    """Write what the attempts of an encounter showed to the bank: a piece of evidence for each planner that was tried.

    A critical and feasible attempt that is no rear-end adds its planner, and a generated intent, to the bank. A failed
    one is recorded only if the bank has its planner.

    Args:
        record: The encounter with its attempts.
        bank: The bank. If it cannot be written, nothing is raised.
        entries: The library that the attempts came from.
        settings: The run's settings.
        network: The name of the run's input.
        driver: The name of the ego's driver.
    """
    if settings.learn == "off":
        return Learnt()
    success = False
    by_planner: dict[str, list[Attempt]] = {}
    by_composition: dict[str, list[Attempt]] = {}  # those of several adversaries say nothing of a planner alone
    for attempt in record.attempts:
        p = attempt.proposal
        if attempt.ending not in ("ego_lost", "crashed"):  # else it was not driven to its end, and says nothing
            tried, key = (by_composition, p.composition) if p.supports else (by_planner, p.planner.hash)
            tried.setdefault(key, []).append(attempt)
    try:
        for attempts in by_planner.values():
            attempt = min(attempts, key=lambda a: rank(a.verdict))
            scene = signature(record.found.situations[attempt.proposal.delay], attempt.proposal.bv, driver)
            success |= _learn_one(bank, entries, attempt, scene, network, settings.seed)
        for attempts in by_composition.values():
            success |= _learn_composition(bank, entries, attempts, record.casts, settings.goal)
    except BankError as error:
        return Learnt(success, f"Nothing was learnt: {error}")
    return Learnt(success)


def _learn_composition(
    bank: MemoryBank, entries: Sequence[LibraryEntry], attempts: Sequence[Attempt], casts: Sequence[Cast], goal: Goal
) -> bool:
    """Count the attempts of a composition, which a success adds if it is new; whether anything was learnt."""
    best = min(attempts, key=lambda a: rank(a.verdict)).proposal
    parts = tuple(Part(p.duty, p.label, p.planner.mode) for p in best.members)
    composition = Composition(best.composition, description_of(best, entries, casts), parts)
    met = [goal.met(a.verdict) for a in attempts]
    return bank.record_composition(composition, met) and any(met)


def _learn_one(
    bank: MemoryBank, entries: Sequence[LibraryEntry], attempt: Attempt, scene: SceneSignature, network: str, seed: int
) -> bool:
    """Write one piece of evidence; True if it is a success.

    An intent composed by the expert is written with all of its modes. They adapt the bank's own planners to another
    movement, and no planner is generated for an intent that the bank already has.
    """
    p = attempt.proposal
    entry = next((e for e in entries if e.label == p.label), None)
    if entry is None:  # a free motion that was named after an intent that was not composed here
        return False
    planner = p.planner
    evidence = evidence_of(
        attempt.verdict, label=p.label, planner_hash=planner.hash,
        scene=scene, attempts=attempt.index + 1, version=__version__, network=network, seed=seed,
        parameters=dict(p.parameters), acceleration=p.acceleration, delay=p.delay,
    )  # fmt: skip
    in_bank = planner.hash in {p.hash for p in bank.planners(entry.label)}
    if not evidence.success and not in_bank:
        return False
    record = IntentRecord(entry.label, entry.description, entry.applies) if entry.source == "generated" else None
    adapted = [p for p in entry.planners if p.origin == EXPERT and p.hash != planner.hash]
    if evidence.success and record is not None and adapted:
        bank.add(record, adapted)
    bank.record(evidence, intent=record, planner=None if in_bank else planner)
    return evidence.success


@dataclass(frozen=True, slots=True)
class BankView:
    """What an encounter depends on. templates: keys of what the search draws from, in order where nothing but the order
    is tried. evidence: number of pieces, 0 where no model is shown them and no scene is recalled."""

    templates: tuple[tuple[float, str, str, str], ...]
    evidence: int

    @classmethod
    def of(cls, prepared: PreparedEncounter, settings: Settings, agents: Agents, bank: MemoryBank) -> BankView:
        """Return the view of the bank as it is now, in an encounter."""
        library, _ = read_library(bank, prepared.scene, settings.seed, prepared.found.situations)
        plain = [e for e in library if not composed(e)]  # the expert composes the others anyway
        templates = [t.key for t in templates_of(prepared.found.situations, plain)]
        shown = agents.by_model("analyzer") and settings.evidence == "on"
        counts = shown or settings.recall == "scene"
        return cls(
            tuple(templates if settings.tuner == "off" else sorted(templates)),
            len(bank.evidence()) if counts else 0,
        )  # fmt: skip

    def difference(self, after: BankView) -> str:
        """What a later view has that this one has not, in a sentence; empty if the next run is the same."""
        new = sorted({label for *_, label, _ in set(after.templates) - set(self.templates)})
        learnt = [f"planners of {', '.join(new)}"] if new else []
        learnt += ["another order of planners"] if not new and after.templates != self.templates else []
        learnt += ["the outcome of this scene"] if after.evidence != self.evidence else []
        if not learnt:
            return ""
        return (
            f"The memory bank has learnt {' and '.join(learnt)}: the same command may run differently next time "
            "(--learn off keeps the bank as it is)."
        )
