"""An encounter that is worth attacking: found by the engine, with the predictions that say so and its intents."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from sumo_adv.agents.agents import Agents
from sumo_adv.agents.teams import Teamwork
from sumo_adv.datatypes import Intent, LibraryEntry
from sumo_adv.episode.engine import EpisodeCalls, EpisodeEngine
from sumo_adv.episode.episode import Episode
from sumo_adv.episode.memory_access import (
    known_casts,
    read_library,
    recall,
    remembered,
    retrieve,
    selection_of,
    signature,
)
from sumo_adv.episode.task import FoundEncounter, NoEncounter
from sumo_adv.memory.bank import MemoryBank, compositions
from sumo_adv.memory.records import SceneSignature
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.search.intents import FREE, composed
from sumo_adv.search.prediction import Predictor
from sumo_adv.search.sampling import templates_of
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.settings import SearchSettings
from sumo_adv.words.request import needs_model

MOST_SKIPS = 6  # encounters that are passed over because no candidate is predicted to collide
Tell = Callable[[str, Any], None]
"""Called with what happens, for progress: ("encounter", FoundEncounter), ("intents", ...), ("attempt", Attempt)."""


@dataclass(frozen=True, slots=True)
class PlannedEncounter:
    """An encounter with its predictions. ``known``: the intent recalled from a similar scene, if there is one."""

    found: FoundEncounter
    predictor: Predictor
    library: Sequence[LibraryEntry]
    scene: SceneSignature
    search: AttackSearch
    known: Intent | None

    @property
    def reaches(self) -> bool:
        """Whether some candidate is predicted to collide, or an intent is recalled."""
        return self.known is not None or self.search.reaches


def find_attackable(
    episode: Episode, engine: EpisodeEngine, sandbox: Sandbox, bank: MemoryBank, tell: Tell, *, ask: bool = False
) -> PlannedEncounter | None:
    """The first encounter in which some candidate is predicted to collide; None if there is none.

    ask: any candidate is enough, because attempts will tell. The episode says why there is no encounter. Raises
    UsageError for intents in the settings that the bank does not know.
    """
    selection_of(episode, bank)  # refuses misspelt names before anything is simulated
    while True:
        encounter = seek(episode, engine, tell)
        if encounter is None:
            return None
        planned = with_predictions(episode, encounter, sandbox, bank)
        episode.stopped = planned.predictor.stopped
        reaches = planned.reaches or (ask and bool(planned.search))
        if reaches or planned.found.last or episode.task.trigger is not None or episode.skips >= MOST_SKIPS:
            return planned
        episode.skips += 1


def with_predictions(
    episode: Episode, found: FoundEncounter, sandbox: Sandbox, bank: MemoryBank, *, forecast: bool = False
) -> PlannedEncounter:
    """An encounter with the bank's library and the predictions of the first candidates.

    A driver that is not known is asked, not predicted, unless ``forecast``: for those that cannot ask it by attempts.
    With ``recall = scene`` the search starts with a candidate that succeeded in a similar scene.
    """
    settings, agents = episode.settings, episode.agents
    share = settings.per_planner if agents is not None and agents.by_model("modifier") else settings.attempts
    evidence = agents is not None and agents.by_model("analyzer") and settings.evidence == "on"
    weights = SearchSettings(proposals=settings.proposals, share=share)
    predictor = Predictor(sandbox, settings, found.drivable, found.situations, weights.score, episode.stopped)
    scene = signature(found.first, found.first.target_list()[0].state.id, episode.task.ego_driver)
    library, episode.bandit = read_library(bank, scene, settings.seed, found.situations)
    predicts = forecast or found.first.baseline.model.known or evidence
    log = episode.task.playback
    if settings.tuner == "builtin" and (not predicts or (log is not None and log.tracks is not None)):
        library = [*library, FREE]
    recalled = recall(episode, found, library, bank) if settings.recall == "scene" else None
    intent, first = (None, None) if recalled is None else recalled
    search = AttackSearch(
        predictor, found.situations, library, weights, seed=settings.seed, goal=settings.goal,
        selection=selection_of(episode, bank), recalled=first, adversaries=settings.adversaries,
        colliders=episode.task.colliders, compositions=compositions(bank) if settings.adversaries > 1 else (),
        predicts=predicts,
    )  # fmt: skip
    return PlannedEncounter(found, predictor, library, scene, search, intent)


def analyze(episode: Episode, planned: PlannedEncounter, agents: Agents, bank: MemoryBank) -> Sequence[LibraryEntry]:
    """Fill in the intents of an encounter; the library, with retrieved or generated planners for new intents. Raises
    ModelError: a language model plays a part and failed."""
    began = time.perf_counter()
    situations, library = planned.found.situations, planned.library
    try:
        episode.intents = agents.analyze(
            planned.search, situations, library, selection=selection_of(episode, bank),
            remembered=remembered(bank, library, planned.scene), teamwork=teamwork(episode, bank),
        )  # fmt: skip
        _note_request(episode, agents)
        if agents.by_model("analyzer") and episode.settings.tuner == "builtin" and episode.settings.ask is None:
            chosen = {(i.bv, i.label) for i in episode.intents}
            others = planned.search.ranking(library)
            episode.intents = [*episode.intents, *(i for i in others if (i.bv, i.label) not in chosen)]
        entries = retrieve(episode, agents, situations, library, bank)
    finally:
        episode.timing["analyzer"] = time.perf_counter() - began
    episode.casts = known_casts(agents.casts, bank)
    labels = {i.label for i in episode.intents}
    if entries != library or any(composed(e) and e.label in labels for e in entries):
        planned.search.extend([e for e in entries if not composed(e) or e.label in labels])
    if episode.settings.ask is not None:
        planned.search.confine({(i.bv, i.label) for i in episode.intents})
    if episode.casts and episode.settings.tuner == "builtin":
        planned.search.add_casts(episode.casts, agents.player("analyzer"))
    return entries


def _note_request(episode: Episode, agents: Agents) -> None:
    """Keep what a model made of the words of ``ask``, or why they cannot be played here. Raises UsageError."""
    if episode.settings.ask is None or episode.found is None:
        return
    if agents.asked is None:  # no model, or one that failed and was replaced
        raise needs_model("An attack asked for in words", episode.settings.ask)
    episode.asked, episode.words, episode.declined = agents.asked, episode.settings.ask, agents.why_not
    if agents.why_not:
        episode.notes.append(f"The encounter at {episode.found.time:.1f} s cannot play the request: {agents.why_not}")


def teamwork(episode: Episode, bank: MemoryBank) -> Teamwork | None:
    """What an analyzer may compose; None if one adversary is all that is allowed."""
    most = episode.settings.adversaries
    return Teamwork(most, episode.task.colliders, tuple(compositions(bank))) if most > 1 else None


def passed_over(episode: Episode) -> str:
    """Why the last encounter is left."""
    if episode.declined:
        return f"it cannot play the request: {episode.declined}"
    if episode.tried and episode.tried[-1].time == getattr(episode.found, "time", None):
        return f"{episode.tried[-1].attempts} attempts without success"
    return "no intent reaches the ego, by prediction"


def seek(episode: Episode, engine: EpisodeEngine, tell: Tell) -> FoundEncounter | None:
    """Start the simulation, if it has not started, and go on to the next encounter; None if there is none."""
    began = time.perf_counter()
    if episode.found is None:
        engine.call(EpisodeCalls.open, episode.task)
        episode.forked = engine.call(EpisodeCalls.forks)
        episode.timing["start"] = time.perf_counter() - began
        began = time.perf_counter()
    encounter = engine.call(EpisodeCalls.seek, "" if episode.found is None else passed_over(episode))
    episode.timing["seek"] = episode.timing.get("seek", 0.0) + time.perf_counter() - began
    if isinstance(encounter, NoEncounter):
        episode.ending, episode.reason, episode.found = encounter.ending, encounter.reason, None
        episode.intents = ()  # they belong to an encounter that was passed over
        return None
    episode.found, episode.prefix = encounter, engine.call(EpisodeCalls.prefix)
    episode.lanes = engine.call(EpisodeCalls.lanes, *encounter.area)
    tell("encounter", encounter)
    return encounter


# -- what the next run would see of the bank ------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class BankView:
    """What an encounter depends on. templates: keys of what the search draws from, in order where nothing but the order
    is tried. evidence: number of pieces, 0 where no model is shown them and no scene is recalled."""

    templates: tuple[tuple[float, str, str, str], ...]
    evidence: int

    @classmethod
    def of(cls, episode: Episode, bank: MemoryBank, planned: PlannedEncounter) -> BankView:
        """The view of the bank as it is now, in the encounter of an episode."""
        settings, agents = episode.settings, episode.agents
        library, _ = read_library(bank, planned.scene, settings.seed, planned.found.situations)
        plain = [e for e in library if not composed(e)]  # the expert composes the others anyway
        templates = [t.key for t in templates_of(planned.found.situations, plain)]
        shown = agents is not None and agents.by_model("analyzer") and settings.evidence == "on"
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
