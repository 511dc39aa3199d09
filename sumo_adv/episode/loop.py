"""One episode from its input to its outcome: what the paper calls the full online loop.

encounter -> intent (analyzer) -> planner (memory bank, else generator) -> attempts (engine) -> outcome -> memory
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sumo_adv.agents.agents import Agents
from sumo_adv.config import Settings, reachable
from sumo_adv.datatypes import Attempt, Ending, Intent, LibraryEntry, Proposal
from sumo_adv.drivers.car_following import exact
from sumo_adv.episode.attempt_runner import AttemptRunner, SequentialRunner
from sumo_adv.episode.episode import Episode
from sumo_adv.episode.memory_access import (
    learn,
    read_library,
    recall,
    remembered,
    retrieve,
    signature,
)
from sumo_adv.episode.refinement import NOTHING, Attempts, Refiner, settle_best, succeeded
from sumo_adv.episode.task import FoundEncounter, NoEncounter, Task
from sumo_adv.errors import BudgetError, ModelError, SumoAdvError, UsageError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import SceneSignature
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.search.composed_intents import composed
from sumo_adv.search.prediction import Predictor
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.settings import SearchSettings
from sumo_adv.simulation.demand import generate
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import RunInput
from sumo_adv.simulation.playback_spec import with_background
from sumo_adv.simulation.scan import first_departure, scan_demand
from sumo_adv.simulation.simulation import SimulationSpec

MOST_SKIPS = 6  # encounters passed over for being out of reach
Tell = Callable[[str, Any], None]
"""Told what happens, for progress: ("encounter", FoundEncounter), ("attempt", Attempt), ..."""


def make_task(source: RunInput, settings: Settings, folder: Path) -> Task:
    """The engine's task; demand is generated into ``folder`` where the input has none."""
    if not reachable(settings):
        raise UsageError(
            f"--until {settings.until} cannot be reached against the ego 'careful': strict means that this very driver "
            "avoids the collision; use --until valid."
        )
    routes = source.routes
    playback = with_background(source.playback, settings.background, replayed=settings.ego == "replay")
    begin = settings.begin if settings.begin is not None else source.begin
    driven = any(scan.vehicles or scan.flows for scan in map(scan_demand, source.additional))
    if begin is None:
        begin = first_departure((*routes, *source.additional)) if routes or driven else 0.0
    end = settings.end if settings.end is not None else source.end
    end = min(end, begin + settings.search) if end is not None and settings.end is None else end
    end = begin + settings.search if end is None else end
    if playback is not None and (playback.background == "log" or settings.ego == "replay"):
        end = min(end, playback.end)  # what comes after is not in the log
    if not routes and not driven and (playback is None or playback.tracks is None):
        seed = settings.seed if source.demand_seed is None else source.demand_seed
        density = settings.density if settings.density is not None else source.density
        routes = (
            generate(source.network, folder / "demand.rou.xml", seed=seed, density=density, begin=begin, end=end),
        )
    spec = SimulationSpec(source.network, tuple(routes), source.additional, begin, settings.seed, settings.step_length)
    trigger = settings.trigger if settings.trigger is not None else source.trigger
    if end <= begin:
        raise UsageError(f"The end, {end:g} s, is not after the begin, {begin:g} s; give a later --end.")
    if trigger != "auto" and not begin <= float(trigger) < end:
        raise UsageError(f"The trigger, {trigger:g} s, is not between begin, {begin:g} s, and end, {end:g} s.")
    return Task(
        spec, settings, settings.ego_id or source.ego, source.ego_type, settings.ego,
        {**dict(source.ego_parameters), **settings.ego_parameters},
        (settings.adversary,) if settings.adversary else source.candidates,
        None if trigger == "auto" else float(trigger), source.warm_up, end, playback,
    )  # fmt: skip


def run_episode(
    source: RunInput, settings: Settings, task: Task, engine: Engine, agents: Agents, bank: MemoryBank, tell: Tell
) -> Episode:
    """The whole loop. Only wrong use is raised; everything else is an ending.

    Raises:
        UsageError, BankError: found to be wrong use once the simulation ran (an unknown ego, a broken driver class).
    """
    episode = Episode(source, settings, task, bank_hash=bank.content_hash(), agents=agents)
    began = time.perf_counter()
    try:
        _run(episode, engine, agents, bank, tell)
    except KeyboardInterrupt:
        episode.ending, episode.reason = Ending.INTERRUPTED, "Ctrl-C."
    except ModelError as error:
        episode.ending, episode.reason = model_ending(error), str(error)
    except SumoAdvError as error:
        if error.exit_status == 2:
            raise
        episode.ending, episode.reason = Ending.SIMULATION_FAILED, str(error)
    except Exception as error:  # a fault of ours: what was found so far is kept, and the sentence names it
        what = f"{type(error).__name__}: {error}"
        episode.ending, episode.reason = (
            Ending.SIMULATION_FAILED,
            f"A fault of sumo_adv itself ({what}); please report it.",
        )
        episode.traceback = traceback.format_exc()
    episode.timing["total"] = time.perf_counter() - began
    return episode


def model_ending(error: ModelError) -> Ending:
    return Ending.BUDGET_EXHAUSTED if isinstance(error, BudgetError) else Ending.MODEL_FAILED


def _run(episode: Episode, engine: Engine, agents: Agents, bank: MemoryBank, tell: Tell) -> None:
    met = meet(episode, engine, agents.sandbox, bank, tell)
    entries = None if met is None else decide(episode, met, agents, bank)
    if met is None or entries is None:
        return
    tell("intents", episode.intents)
    brain = AttemptRunner(engine, agents.sandbox, met.found, episode.settings.seed)
    pursue(episode, met, entries, brain if engine.at_once > 1 else SequentialRunner(brain), agents, bank, tell)


def decide(episode: Episode, met: PlannedEncounter, agents: Agents, bank: MemoryBank) -> Sequence[LibraryEntry] | None:
    """Fill in the intents of an encounter; the library for it, or None if nothing can be tried (the episode says so).

    Raises:
        ModelError: a model plays a part and failed.
    """
    entries = met.library
    if met.known is not None:  # a like scene has evidence: nobody is asked
        episode.intents = [met.known]
    else:
        entries = analyze(episode, met, agents, bank)
    if met.search.pool:
        return entries
    episode.ending, episode.reason = Ending.NO_ENCOUNTER, "No intent of the library applies to any vehicle near."
    return None


def pursue(
    episode: Episode, met: PlannedEncounter, entries: Sequence[LibraryEntry], brain: Attempts, agents: Agents,
    bank: MemoryBank, tell: Tell,
) -> None:  # fmt: skip
    """Attempts until success or until all is used up, and what is learnt from them."""
    settings, timing = episode.settings, episode.timing
    refiner = Refiner(brain, met.found, met.search, agents, entries, settings, lambda a: tell("attempt", a))
    try:
        refiner.run(episode.intents, episode.refinement)
        episode.ending, episode.reason = episode.refinement.ending, episode.refinement.reason
    except ModelError as error:  # what was tried until then counts
        episode.ending, episode.reason = model_ending(error), str(error)
    finally:  # also of what was interrupted or failed
        _keep_intent(episode, met.library)
        episode.isolation = agents.sandbox.isolation
        timing["prediction"] = timing.get("prediction", 0.0) + met.predictor.seconds
        timing["attempts"] = episode.refinement.seconds
        episode.notes += sorted(f"planner {name[:12]}: {why}" for name, why in met.predictor.failures.items())
    learn(episode, bank, entries)


@dataclass(frozen=True, slots=True)
class PlannedEncounter:
    """An encounter with its predictions. ``known``: the intent that worked in a like scene, where that is recalled."""

    found: FoundEncounter
    predictor: Predictor
    library: Sequence[LibraryEntry]
    scene: SceneSignature
    search: AttackSearch
    known: Intent | None

    @property
    def reaches(self) -> bool:
        """Whether some intent reaches the ego, by prediction or by what worked before."""
        return self.known is not None or self.search.reaches


def meet(episode: Episode, engine: Engine, sandbox: Sandbox, bank: MemoryBank, tell: Tell) -> PlannedEncounter | None:
    """The first encounter that an intent reaches, by prediction; None if there is none (the episode says why)."""
    while True:
        found = seek(episode, engine, tell)
        if found is None:
            return None
        met = predicted(episode, found, sandbox, bank)
        if met.reaches or met.found.last or episode.task.trigger is not None or episode.skips == MOST_SKIPS:
            return met
        episode.skips += 1


def predicted(episode: Episode, found: FoundEncounter, sandbox: Sandbox, bank: MemoryBank) -> PlannedEncounter:
    """An encounter with the library as the bank has it and the predictions of what could be done."""
    settings = episode.settings
    predictor = Predictor(sandbox, settings, found.drivable, found.situations)
    now = signature(found.first, found.first.target_list()[0].state.id, episode.task.ego_driver)
    library, episode.bandit = read_library(bank, now, settings.seed)
    search, known = searched(episode, found, predictor, library, bank)
    return PlannedEncounter(found, predictor, library, now, search, known)


def searched(
    episode: Episode, found: FoundEncounter, predictor: Predictor, library: Sequence[LibraryEntry], bank: MemoryBank
) -> tuple[AttackSearch, Intent | None]:
    """The search with its predictions of an encounter; or, with ``recall = scene``, with what succeeded in a similar
    scene and its intent."""
    settings, driver = episode.settings, found.first.baseline.model
    known = recall(episode, found, library, bank) if settings.recall == "scene" else None
    search = AttackSearch(
        predictor, found.situations, library,
        SearchSettings(proposals=settings.proposals, share=settings.per_planner), seed=settings.seed,
        allowed=episode.source.intents, unknown_driver=not driver.known, exact_driver=exact(driver),
        recalled=None if known is None else known[1],
    )  # fmt: skip
    return search, None if known is None else known[0]


def analyze(episode: Episode, met: PlannedEncounter, agents: Agents, bank: MemoryBank) -> Sequence[LibraryEntry]:
    """Fill in the intents of an encounter; the library with what was retrieved or generated for new ones.

    Raises:
        ModelError: a model plays a part and failed.
    """
    began = time.perf_counter()
    situations, library = met.found.situations, met.library
    try:
        episode.intents = agents.analyze(
            met.search, situations, library, allowed=episode.source.intents,
            remembered=remembered(bank, library, met.scene),
        )  # fmt: skip
        entries = retrieve(episode, agents, met.found.first, library, bank)
    finally:
        episode.timing["analyzer"] = time.perf_counter() - began
    wanted = {i.label for i in episode.intents}
    if entries != library or any(composed(e) and e.label in wanted for e in entries):
        met.search.extend([e for e in entries if not composed(e) or e.label in wanted])
    return entries


def seek(episode: Episode, engine: Engine, tell: Tell) -> FoundEncounter | None:
    """Start the simulation and go on to an encounter; fills the episode in."""
    began = time.perf_counter()
    if episode.found is None:
        engine.request("open", episode.task)
        episode.forked = engine.request("forks")
        episode.timing["start"] = time.perf_counter() - began
        began = time.perf_counter()
    found = engine.request("seek", "" if episode.found is None else "no intent reaches the ego, by prediction")
    episode.timing["seek"] = episode.timing.get("seek", 0.0) + time.perf_counter() - began
    if isinstance(found, NoEncounter):
        episode.ending, episode.reason, episode.found = found.ending, found.reason, None
        episode.intents = ()  # those of an encounter that was passed over
        return None
    episode.found, episode.prefix = found, engine.request("prefix")
    episode.lanes = engine.request("lanes", *found.area)
    tell("encounter", found)
    return found


def replay_episode(
    source: RunInput, settings: Settings, task: Task, engine: Engine, sandbox: Sandbox, proposal: Proposal, skips: int
) -> Episode:
    """The encounter again, with one given attempt and nothing else: no analyzer, no bank; ``skips`` as recorded."""
    episode = Episode(source, settings, task)
    episode.intent = Intent(proposal.bv, proposal.label, "", "", proposal.acceleration, "replayed from a manifest")
    for _ in range(skips + 1):
        found = seek(episode, engine, lambda *_: None)
        if found is None:
            return episode
    assert found is not None
    if proposal.delay not in found.situations:
        raise UsageError(
            f"The manifest's delay of {proposal.delay:g} s is not one of the run, so it cannot be replayed."
        )
    if proposal.bv not in found.situations[proposal.delay].targets:
        raise UsageError(f"The manifest's vehicle '{proposal.bv}' is none of the run's, so it cannot be replayed.")
    brain = AttemptRunner(engine, sandbox, found, settings.seed)
    result = brain.attempt([proposal])[0]
    verdict = result.verdict or NOTHING
    attempt = Attempt(0, "replay", proposal, result.start, verdict, result.driven.ending, result.driven.message)
    episode.refinement.attempts.append(attempt)
    episode.refinement.results.append(result)
    settle_best(episode.refinement, brain)
    ok = succeeded(episode.refinement.attempts[0].verdict, settings.until)
    episode.ending = Ending.CRITICAL if ok else Ending.ATTEMPTS_EXHAUSTED
    return episode


def _keep_intent(episode: Episode, library: Sequence[LibraryEntry]) -> None:
    """The intent of the attempt that counts, as the analyzer ranked it."""
    best = episode.best
    if best is None:
        episode.intent = episode.intents[0]
        return
    p = best.proposal
    same = [i for i in episode.intents if i.label == p.label]
    intent = next((i for i in same if i.bv == p.bv), same[0] if same else episode.intents[0])
    known = {e.label for e in library}
    episode.intent = replace(
        intent, bv=p.bv, acceleration=p.acceleration, source="memory" if p.label in known else "generated"
    )
