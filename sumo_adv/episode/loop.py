"""One episode from its input to its outcome: the paper's full online loop.

encounter -> intent (analyzer) -> planner (memory bank, else generator) -> attempts (engine) -> outcome -> memory
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Sequence

from sumo_adv.agents.agents import Agents
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Ending, Intent, LibraryEntry, Proposal
from sumo_adv.episode.assessment import NOTHING, Attempts, Fitting, rank, reader_of, runner_of
from sumo_adv.episode.engine import EpisodeEngine
from sumo_adv.episode.episode import Episode
from sumo_adv.episode.memory_access import learn
from sumo_adv.episode.planned_encounter import BankView, PlannedEncounter, Tell, analyze, find_attackable, seek
from sumo_adv.episode.refinement import Refiner, settle_best
from sumo_adv.episode.task import FoundEncounter, Task
from sumo_adv.errors import BudgetError, MissingVehicleError, ModelError, SumoAdvError, UsageError, fault_sentence
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.simulation.inputs import RunInput
from sumo_adv.simulation.warnings_log import about, with_names

MOST_ASKED = 4  # encounters that a model is asked about, where those before cannot play what was asked for


def run_episode(
    source: RunInput, settings: Settings, task: Task, engine: EpisodeEngine, agents: Agents, bank: MemoryBank,
    tell: Tell,
) -> Episode:  # fmt: skip
    """Find an encounter, attack it, and learn from it. Only wrong use is raised; everything else is an ending. Raises
    UsageError, BankError: wrong use that shows only in the simulation (an unknown ego, a broken driver class)."""
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
            raise _explained(error, task.own_names(engine.log.warnings())) from error
        episode.ending, episode.reason = Ending.SIMULATION_FAILED, with_names(str(error), task.copies)
    except Exception as error:  # a fault of ours: earlier results are kept
        episode.ending, episode.reason = Ending.SIMULATION_FAILED, fault_sentence(error)
        episode.traceback = traceback.format_exc()
    episode.warnings = task.own_names(engine.log.warnings())
    episode.timing["total"] = time.perf_counter() - began
    return episode


def _explained(error: SumoAdvError, warnings: Sequence[str]) -> SumoAdvError:
    """The error with SUMO's reason why a vehicle is not there, if it gave one."""
    why = about(warnings, error.vehicle) if isinstance(error, MissingVehicleError) else None
    return error if why is None else UsageError(f"{str(error).rstrip('.')}. SUMO warned: {why}")


def model_ending(error: ModelError) -> Ending:
    return Ending.BUDGET_EXHAUSTED if isinstance(error, BudgetError) else Ending.MODEL_FAILED


def _run(episode: Episode, engine: EpisodeEngine, agents: Agents, bank: MemoryBank, tell: Tell) -> None:
    began, best = time.perf_counter(), None
    try:
        while True:
            ask = episode.settings.tuner == "builtin" and episode.settings.total_seconds > 0
            planned = find_attackable(episode, engine, agents.sandbox, bank, tell, ask=ask)
            entries = None if planned is None else decide(episode, planned, agents, bank)
            if entries is None and episode.declined and may_go_on(episode) and agents.calls["analyzer"] < MOST_ASKED:
                episode.skips += 1
                continue
            if planned is None or entries is None:
                return
            tell("intents", episode.intents)
            runner = runner_of(engine, agents.sandbox, planned.found, episode.settings)
            another = may_go_on(episode)
            pursue(episode, planned, entries, runner, agents, bank, tell, another=another)
            if episode.ending is not Ending.ATTEMPTS_EXHAUSTED or not another:
                return
            left = episode.leave()
            best = left if best is None or _worth(left) < _worth(best) else best
            if time.perf_counter() - began >= episode.settings.total_seconds:
                return
    finally:  # also after an interruption: no attempt of an earlier encounter is lost
        if best is not None and episode.ending is not Ending.CRITICAL and _worth(best) <= _worth(episode):
            episode.back_to(best)


def may_go_on(episode: Episode) -> bool:
    """Whether the run goes on with the next encounter where this one gives nothing."""
    found, task = episode.found, episode.task
    last = found is None or found.last or task.trigger is not None or task.playback is not None
    return not last and episode.settings.tuner == "builtin" and episode.settings.total_seconds > 0


def _worth(episode: Episode) -> tuple[float, float]:
    """A key that sorts encounters without success, the best attempt first."""
    return (math.inf, 0.0) if episode.best is None else rank(episode.best.verdict)


def decide(
    episode: Episode, planned: PlannedEncounter, agents: Agents, bank: MemoryBank
) -> Sequence[LibraryEntry] | None:
    """Fill in the intents of an encounter; the library for it, or None if there is no candidate (the episode says so).
    Raises ModelError: a language model plays a part and failed."""
    entries = planned.library
    if planned.known is not None:  # recalled from a similar scene, so no agent is asked
        episode.intents = [planned.known]
    else:
        entries = analyze(episode, planned, agents, bank)
    if episode.declined:
        episode.ending, episode.reason = Ending.NO_ENCOUNTER, f"The request cannot be played: {episode.declined}"
        return None
    if not episode.intents and episode.settings.tuner == "off":
        episode.ending, episode.reason = Ending.NO_ENCOUNTER, "The analyzer sees nothing here that could be dangerous."
        return None
    if planned.search:
        return entries
    ranking = () if episode.found is None else episode.found.ranking
    near = ", ".join(f"{name} ({relation})" for name, relation, _ in ranking)
    reason = "No intent of the library applies to any vehicle near"
    episode.ending, episode.reason = Ending.NO_ENCOUNTER, f"{reason}: {near}." if near else f"{reason}."
    return None


def pursue(
    episode: Episode, planned: PlannedEncounter, entries: Sequence[LibraryEntry], runner: Attempts, agents: Agents,
    bank: MemoryBank, tell: Tell, *, another: bool = False,
) -> None:  # fmt: skip
    """Run attempts until one succeeds or the budget is used up, and learn from them. another: there may be another
    encounter, so this one is left sooner where nothing comes near."""
    settings, timing = episode.settings, episode.timing
    if episode.asked is not None:
        reader = reader_of(agents, episode.words)
        episode.refinement.fitting = Fitting(episode.asked, planned.found, settings, reader)
    refiner = Refiner(runner, planned.found, planned.search, agents, entries, settings, tell, another=another)
    try:
        refiner.run(episode.intents, episode.refinement)
        episode.ending, episode.reason = episode.refinement.ending, episode.refinement.reason
    except ModelError as error:  # the attempts until then count
        episode.ending, episode.reason = model_ending(error), str(error)
    finally:  # also after an interruption or a failure
        episode.known_labels = frozenset(e.label for e in planned.library)
        episode.keep_intent()
        episode.isolation = agents.sandbox.isolation
        timing["prediction"] = timing.get("prediction", 0.0) + planned.predictor.seconds
        timing["attempts"] = episode.refinement.seconds
        episode.notes += sorted(f"planner {name[:12]}: {why}" for name, why in planned.predictor.failures.items())
    before = BankView.of(episode, bank, planned)
    learn(episode, bank, entries)
    episode.bank_change = before.difference(BankView.of(episode, bank, planned))


def replay_episode(
    source: RunInput, settings: Settings, task: Task, engine: EpisodeEngine, sandbox: Sandbox, proposal: Proposal,
    skips: int,
) -> Episode:  # fmt: skip
    """The encounter again, with one given attempt and nothing else: no analyzer, no bank; ``skips`` as recorded."""
    episode = Episode(source, settings, task)
    episode.intent = Intent(proposal.bv, proposal.label, "", "", proposal.acceleration, "replayed from a manifest")
    encounter = recorded_encounter(episode, engine, proposal, skips)
    if encounter is not None:
        attack_once(episode, engine, sandbox, encounter, proposal)
    episode.warnings = task.own_names(engine.log.warnings())
    return episode


def attack_once(
    episode: Episode, engine: EpisodeEngine, sandbox: Sandbox, found: FoundEncounter, proposal: Proposal
) -> None:
    """Run one given attempt in an encounter, with its reference drivers, and keep it as the only one."""
    settings = episode.settings
    runner = runner_of(engine, sandbox, found, settings)
    (result,) = runner.attempt([proposal])
    verdict = result.verdict or NOTHING
    attempt = Attempt(0, "replay", proposal, result.start, verdict, result.driven.ending, result.driven.message)
    if episode.asked is not None:
        attempt = Fitting(episode.asked, found, settings).judged(attempt, result, settings.goal)
    episode.refinement.attempts.append(attempt)
    episode.refinement.results.append(result)
    settle_best(episode.refinement, runner)
    ok = settings.goal.met(episode.refinement.attempts[0].verdict)
    episode.ending = Ending.CRITICAL if ok else Ending.ATTEMPTS_EXHAUSTED


def recorded_encounter(
    episode: Episode, engine: EpisodeEngine, proposal: Proposal, skips: int
) -> FoundEncounter | None:
    """The encounter of a recorded attack; None if the simulation does not come to it (the episode says why). Raises
    UsageError: the recorded start or vehicle is none of the encounter's."""
    for _ in range(skips + 1):
        encounter = seek(episode, engine, lambda *_: None)
        if encounter is None:
            return None
    assert encounter is not None
    if proposal.delay not in encounter.situations:
        raise UsageError(
            f"The manifest's delay of {proposal.delay:g} s is not one of the run, so it cannot be replayed."
        )
    for bv in proposal.bvs:
        if bv not in encounter.situations[proposal.delay].targets:
            raise UsageError(f"The manifest's vehicle '{bv}' is none of the run's, so it cannot be replayed.")
    return encounter
