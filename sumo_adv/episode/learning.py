"""What the memory bank learns from the attempts of an encounter, and how that changes the next run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sumo_adv import __version__
from sumo_adv.agents.agents import Agents
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Duty, LibraryEntry
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
    """What the bank has learnt from an encounter.

    Attributes:
        success: Whether it has learnt a success.
        note: Why the bank could not be written, as a sentence; empty if it could.
    """

    success: bool = False
    note: str = ""


def learn(
    record: EncounterRecord, bank: MemoryBank, entries: Sequence[LibraryEntry], settings: Settings, network: str,
    driver: str,
) -> Learnt:  # fmt: skip
    """Write what the attempts of an encounter showed to the bank: a piece of evidence for each planner that was tried.

    The best attempt with a planner counts. If it is critical and feasible and no rear-end, its planner is added to the
    bank, and so is a generated intent. A failed attempt is recorded only if the bank has its planner. Attempts with
    supports count for their composition instead.

    Args:
        record: The encounter with its attempts.
        bank: The bank. If it cannot be written, nothing is raised.
        entries: The library that the attempts came from.
        settings: The run's settings. With ``learn`` off, nothing is written.
        network: The name of the run's input.
        driver: The name of the ego's driver.

    Returns:
        What the bank has learnt.
    """
    if settings.learn == "off":
        return Learnt()
    success = False
    by_planner: dict[str, list[Attempt]] = {}
    by_composition: dict[str, list[Attempt]] = {}  # attempts with several adversaries say nothing about a planner alone
    for attempt in record.attempts:
        p = attempt.proposal
        if attempt.ending not in ("ego_lost", "crashed"):  # such an attempt did not reach its end
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
    """Count the attempts of a composition, which a success adds to the bank; return whether one was a success.

    A composition with a part that the scene gives is of that scene alone, and the bank does not get it.
    """
    best = min(attempts, key=lambda a: rank(a.verdict)).proposal
    if any(p.duty is Duty.PLAY for p in best.members):
        return False
    parts = tuple(Part(p.duty, p.label, p.planner.mode) for p in best.members)
    composition = Composition(best.composition, description_of(best, entries, casts), parts)
    met = [goal.met(a.verdict) for a in attempts]
    return bank.record_composition(composition, met) and any(met)


def _learn_one(
    bank: MemoryBank, entries: Sequence[LibraryEntry], attempt: Attempt, scene: SceneSignature, network: str, seed: int
) -> bool:
    """Write one piece of evidence; return whether it is a success.

    An intent composed by the expert is written with all of its modes. They adapt the bank's own planners to another
    movement, and no planner is generated for an intent that the bank already has.
    """
    p = attempt.proposal
    entry = next((e for e in entries if e.label == p.label), None)
    if entry is None:  # a free motion whose label is an intent that was not composed here
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
    """The content of the bank on which an encounter depends.

    Attributes:
        templates: The keys of the templates that the search draws from. They are in order if only the order is tried.
        evidence: The number of pieces of evidence; 0 if no model is shown them and no scene is recalled.
    """

    templates: tuple[tuple[float, str, str, str], ...]
    evidence: int

    @classmethod
    def of(cls, prepared: PreparedEncounter, settings: Settings, agents: Agents, bank: MemoryBank) -> BankView:
        """Return the view of the bank as it is now, in an encounter.

        Args:
            prepared: The encounter.
            settings: The run's settings.
            agents: The models of the run.
            bank: The bank.
        """
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
        """Return what the bank has learnt between this view and a later one, as a sentence.

        Args:
            after: The later view.

        Returns:
            The sentence; empty if the next run is the same.
        """
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
