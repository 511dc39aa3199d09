"""Prepare an encounter for attacks: the bank's library, the search with its first candidates, and the intents."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from sumo_adv.agents.agents import Agents
from sumo_adv.agents.teams import Teamwork
from sumo_adv.asked import Attacker
from sumo_adv.config import Settings
from sumo_adv.datatypes import Intent, LibraryEntry
from sumo_adv.episode.clock import PartsClock
from sumo_adv.episode.memory_access import (
    known_casts,
    read_library,
    recall,
    remembered,
    retrieve,
    selected,
    signature,
    with_scripts,
)
from sumo_adv.episode.run import EncounterRecord, Keep, Request
from sumo_adv.episode.task import FoundEncounter, Task
from sumo_adv.memory.bank import MemoryBank, compositions
from sumo_adv.memory.records import SceneSignature
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.search.intents import FREE, Selection, composed
from sumo_adv.search.prediction import Predictor
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.settings import SearchSettings
from sumo_adv.simulation.inputs import RunInput
from sumo_adv.words.request import needs_model


@dataclass(frozen=True, slots=True)
class PreparedEncounter:
    """An encounter with the predictions of the first candidates.

    Attributes:
        found: The encounter.
        predictor: Predicts candidates.
        library: The bank's intents, including those for pedestrians and cyclists near the ego.
        scene: The signature by which the bank compares this encounter with others.
        search: The search for attacks.
        known: The intent recalled from a similar scene; None if there is none.
        selection: The intents that may be tried.
        teamwork: What an analyzer may compose; None if only one adversary is allowed.
        attackers: The vehicles that attack together; empty for one collider.
        network: The name of the run's input.
        bandit: How the planners of each intent were ordered, for the manifest.
        timing: How long each part took [s].
    """

    found: FoundEncounter
    predictor: Predictor
    library: Sequence[LibraryEntry]
    scene: SceneSignature
    search: AttackSearch
    known: Intent | None
    selection: Selection
    teamwork: Teamwork | None
    attackers: Sequence[Attacker]
    network: str
    bandit: Sequence[Mapping[str, object]] = ()
    timing: Mapping[str, float] = field(default_factory=dict)

    @property
    def reaches(self) -> bool:
        """Whether an intent is recalled, or a candidate is predicted to reach the ego in a way that counts.

        Also true if candidates are left and nothing is predicted.
        """
        return self.known is not None or self.search.reaches


def prepare(
    found: FoundEncounter, run_input: RunInput, settings: Settings, task: Task, sandbox: Sandbox, bank: MemoryBank,
    agents: Agents | None = None, *, stopped: Mapping[str, int] | None = None, forecast: bool = False,
) -> PreparedEncounter:  # fmt: skip
    """Prepare an encounter for attacks.

    With ``recall = scene``, the search starts with a candidate that succeeded in a similar scene.

    Args:
        found: The encounter.
        run_input: The input of the run.
        settings: The settings of the run.
        task: The task of the episode.
        sandbox: Runs the planners.
        bank: The memory bank.
        agents: The analyzer, generator and modifier; None if there are none.
        stopped: How many calls of each planner ran into a limit in earlier encounters, by hash.
        forecast: Whether to predict a driver that is not known, for callers that cannot ask the driver by attempts.
            Otherwise such a driver is predicted only if a model plays the analyzer and is shown evidence.

    Returns:
        The encounter with the library and the predictions of the first candidates.
    """
    clock = PartsClock()
    with clock.part("prediction"):
        made = _prepared(found, run_input, settings, task, sandbox, bank, agents, clock, stopped, forecast=forecast)
    return replace(made, timing=clock.seconds)


def _prepared(
    found: FoundEncounter, run_input: RunInput, settings: Settings, task: Task, sandbox: Sandbox, bank: MemoryBank,
    agents: Agents | None, clock: PartsClock, stopped: Mapping[str, int] | None, *, forecast: bool,
) -> PreparedEncounter:  # fmt: skip
    share = settings.per_planner if agents is not None and agents.by_model("modifier") else settings.attempts
    evidence = agents is not None and agents.by_model("analyzer") and settings.evidence == "on"
    weights = SearchSettings(proposals=settings.proposals, share=share)
    selection = selected(settings, bank, run_input.intents, run_input.scripts)
    predictor = Predictor(sandbox, settings, found.drivable, found.situations, weights.score, stopped)
    scene = signature(found.first, found.first.target_list()[0].state.id, task.ego_driver)
    library, bandit = read_library(bank, scene, settings.seed, found.situations, run_input.scripts)
    together = run_input.attackers  # their candidates are not predicted, because a prediction knows one collider
    predicts = not together and (forecast or found.first.baseline.model.known or evidence)
    log = task.playback
    if not together and settings.tuner == "builtin" and (not predicts or (log is not None and log.tracks is not None)):
        library = [*library, FREE]
    recalled = None
    if settings.recall == "scene" and not together:
        with clock.part("recall"):
            recalled = recall(found, library, bank, selection, settings.limits.limits(), task.ego_driver)
    intent, first = (None, None) if recalled is None else recalled
    known = tuple(compositions(bank)) if settings.adversaries > 1 else ()
    search = AttackSearch(
        predictor, found.situations, library, weights, seed=settings.seed, goal=settings.goal, selection=selection,
        recalled=first, adversaries=settings.adversaries, colliders=task.colliders, compositions=known,
        attackers=together, predicts=predicts,
    )  # fmt: skip
    teamwork = Teamwork(settings.adversaries, task.colliders, known) if settings.adversaries > 1 else None
    return PreparedEncounter(
        found, predictor, library, scene, search, intent, selection, teamwork, together, run_input.name, bandit
    )


def analyze(
    record: EncounterRecord, prepared: PreparedEncounter, settings: Settings, agents: Agents, bank: MemoryBank,
    keep: Keep,
) -> tuple[EncounterRecord, Sequence[LibraryEntry]]:  # fmt: skip
    """Have the analyzer choose the intents of an encounter.

    Args:
        record: The record of the encounter.
        prepared: The prepared encounter.
        settings: The settings of the run.
        agents: The analyzer, generator and modifier.
        bank: The memory bank.
        keep: Called with the record as it grows.

    Returns:
        The record with the intents, and the library with retrieved or generated planners for new intents.

    Raises:
        ModelError: A language model plays a part and failed.
        UsageError: An attack is asked for in words, and no model reads them.
    """
    situations, library, clock = prepared.found.situations, prepared.library, PartsClock()
    try:
        with clock.part("analyzer"):
            intents = agents.analyze(
                prepared.search, situations, library, selection=prepared.selection,
                remembered=remembered(bank, library, prepared.scene), teamwork=prepared.teamwork,
            )  # fmt: skip
            record = _with_request(replace(record, intents=intents), settings, agents)
            if agents.by_model("analyzer") and settings.tuner == "builtin" and settings.ask is None:
                chosen = {(i.bv, i.label) for i in intents}
                others = (i for i in prepared.search.ranking(library) if (i.bv, i.label) not in chosen)
                record = replace(record, intents=[*intents, *others])
            scripts = () if agents.read is None else agents.read.scripts
            library = with_scripts(library, scripts)
            retrieved = retrieve(record.intents, agents, situations, library, bank)
            record = replace(record, intents=retrieved.intents)
        clock.move(retrieved.seconds, "analyzer", "retrieval")
    finally:
        record = record.took(clock.seconds)
        keep(record)
    clock = PartsClock()
    with clock.part("prediction"):
        record = replace(record, casts=known_casts(agents.casts, bank))
        _draw_from(retrieved.library, record, prepared, settings, agents)
    return record.took(clock.seconds), retrieved.library


def _draw_from(
    entries: Sequence[LibraryEntry], record: EncounterRecord, prepared: PreparedEncounter, settings: Settings,
    agents: Agents,
) -> None:  # fmt: skip
    """Have the search draw from the analyzer's choice: its library, and the intents and casts of the record."""
    labels = {i.label for i in record.intents}
    if agents.read is not None:
        prepared.search.confine({(i.bv, i.label) for i in record.intents}, prepared.library, agents.read.attackers)
    if entries != prepared.library or any(composed(e) and e.label in labels for e in entries):
        prepared.search.extend([e for e in entries if not composed(e) or e.label in labels])
    if record.casts and settings.tuner == "builtin":
        prepared.search.add_casts(record.casts, agents.player("analyzer"))


def _with_request(record: EncounterRecord, settings: Settings, agents: Agents) -> EncounterRecord:
    """Add to the record what a model made of the words of ``ask``, or why they cannot be played here."""
    if settings.ask is None:
        return record
    read = agents.read
    if read is None:  # no model, or one that failed and was replaced
        raise needs_model("An attack in words", settings.ask)
    attackers = {each.id: each.asked for each in read.attackers}
    record = replace(record, request=Request(read.asked, settings.ask, read.why_not, attackers, read.scripts))
    if not read.why_not:
        return record
    note = f"The encounter at {record.found.time:.1f} s cannot play the request: {read.why_not}"
    return replace(record, notes=[*record.notes, note])
