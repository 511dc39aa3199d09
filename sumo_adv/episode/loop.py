"""Run an episode from its input to its records: the paper's full online loop.

A run goes through these steps: encounter -> intent (analyzer) -> planner -> attempts (engine) -> record -> memory. The
planner comes from the memory bank or, if the bank has none, from the generator.
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace

from sumo_adv.agents.agents import Agents
from sumo_adv.config import Settings
from sumo_adv.datatypes import Ending, Intent, LibraryEntry, Proposal
from sumo_adv.episode.assessment import Attempts, Fitting, attempt_of, reader_of, runner_of
from sumo_adv.episode.clock import PartsClock
from sumo_adv.episode.encounter_builder import place_in_words
from sumo_adv.episode.encounter_finder import OUT_OF_REACH, EncounterFinder, Tell
from sumo_adv.episode.engine import EpisodeEngine
from sumo_adv.episode.learning import BankView, learn
from sumo_adv.episode.prepared_encounter import PreparedEncounter, analyze
from sumo_adv.episode.refinement import Refinement, Refiner, settle_best, settle_roles
from sumo_adv.episode.run import EncounterRecord, Keep, Request, Run, Stop, forget
from sumo_adv.episode.task import FoundEncounter, Task
from sumo_adv.errors import BudgetError, MissingVehicleError, ModelError, SumoAdvError, UsageError, fault_sentence
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.simulation.inputs import RunInput
from sumo_adv.simulation.warnings_log import about, with_names

MAX_ANALYSED_ENCOUNTERS = 4  # maximum number of encounters that are analyzed while none can play the request


def run_episode(
    run_input: RunInput, settings: Settings, task: Task, engine: EpisodeEngine, agents: Agents, bank: MemoryBank,
    tell: Tell, clock: PartsClock | None = None, within: float = math.inf,
) -> Run:  # fmt: skip
    """Find encounters, attack in them until an attempt succeeds, and learn from them.

    Only wrong use and an unreadable bank raise an exception. Any other failure becomes the ending of the run.

    Args:
        run_input: The input.
        settings: The run's settings.
        task: What is simulated.
        engine: The engine process.
        agents: The analyzer, generator and modifier.
        bank: The memory bank.
        tell: Called with each encounter, its intents and each attempt.
        clock: The time that was spent on the run before this call.
        within: The time after which the run should end, even if the settings allow more [s].

    Returns:
        The run.

    Raises:
        UsageError: Wrong use that shows only in the simulation (an unknown ego, a broken driver class).
        BankError: The bank cannot be read.
    """
    finder = EncounterFinder(run_input, settings, task, engine, tell, clock, time.perf_counter() + within)
    bank_hash = bank.content_hash()
    try:
        _attack_encounters(finder, settings, task, engine, agents, bank, tell)
    except KeyboardInterrupt:
        finder.break_off(Stop(Ending.INTERRUPTED, "Ctrl-C.", failed=True))
    except ModelError as error:
        finder.break_off(Stop(model_ending(error), str(error), failed=True))
    except SumoAdvError as error:
        if error.exit_status == 2:
            raise _explained(error, task.own_names(engine.log.warnings())) from error
        finder.break_off(Stop(Ending.SIMULATION_FAILED, with_names(str(error), task.copies), failed=True))
    except Exception as error:  # a bug of sumo_adv or a lack of memory: earlier results are kept
        trace = traceback.format_exc()
        finder.break_off(Stop(Ending.SIMULATION_FAILED, fault_sentence(error), failed=True, traceback=trace))
    isolation = agents.sandbox.isolation if any(record.attacked for record in finder.records) else ""
    return finder.run(agents, isolation=isolation, bank_hash=bank_hash)


def _explained(error: SumoAdvError, warnings: Sequence[str]) -> SumoAdvError:
    """Add SUMO's reason why a vehicle is missing to the error, if SUMO warned of it."""
    why = about(warnings, error.vehicle) if isinstance(error, MissingVehicleError) else None
    return error if why is None else UsageError(f"{str(error).rstrip('.')}. SUMO warned: {why}")


def model_ending(error: ModelError) -> Ending:
    """Return the ending of a run in which a model failed or used up its budget.

    Args:
        error: The model's failure.
    """
    return Ending.BUDGET_EXHAUSTED if isinstance(error, BudgetError) else Ending.MODEL_FAILED


def _attack_encounters(
    finder: EncounterFinder, settings: Settings, task: Task, engine: EpisodeEngine, agents: Agents, bank: MemoryBank,
    tell: Tell,
) -> None:  # fmt: skip
    """Attack in one encounter after another until an attempt succeeds, or until the run must end."""
    began, varied = time.perf_counter(), settings.tuner == "builtin"
    while (prepared := finder.find_attackable(agents.sandbox, bank, agents, any_candidate=varied)) is not None:
        another = may_go_on(prepared.found, task, settings)
        decision = decide(finder.records[-1], prepared, settings, agents, bank, finder.keep)
        if decision.library is None:
            declined = decision.record.request.declined
            if not declined or not another or agents.calls["analyzer"] >= MAX_ANALYSED_ENCOUNTERS:
                return
            finder.leave(f"it cannot play the request: {declined}")
            continue
        tell("intents", decision.record.intents)
        runner = runner_of(engine, agents.sandbox, prepared.found, settings)
        record = pursue(
            decision, runner, settings, agents, bank, tell, finder.keep, another=another, ends_at=finder.ends_at
        )  # fmt: skip
        if record.ending is not Ending.ATTEMPTS_EXHAUSTED or not another:
            return
        finder.leave(f"{len(record.attempts)} attempts without success")
        if time.perf_counter() >= min(began + settings.total_seconds, finder.ends_at):
            return


def may_go_on(found: FoundEncounter, task: Task, settings: Settings) -> bool:
    """Return whether a run may continue with the next encounter if this encounter brings no success.

    Args:
        found: This encounter.
        task: What is simulated. With a given trigger or a playback, the run does not continue.
        settings: The run's settings.
    """
    last = found.last or task.trigger is not None or task.playback is not None
    return not last and settings.tuner == "builtin" and settings.total_seconds > 0


@dataclass(frozen=True, slots=True)
class Decision:
    """What to attack with in an encounter.

    Attributes:
        record: The record of the encounter, with its intents.
        prepared: The encounter with its predictions.
        library: The intents with their planners to try; None if there is no candidate (the record says why).
    """

    record: EncounterRecord
    prepared: PreparedEncounter
    library: Sequence[LibraryEntry] | None


def decide(
    record: EncounterRecord, prepared: PreparedEncounter, settings: Settings, agents: Agents, bank: MemoryBank,
    keep: Keep = forget,
) -> Decision:  # fmt: skip
    """Decide which intents to attack with.

    Args:
        record: The record of the encounter.
        prepared: The encounter with its predictions.
        settings: The run's settings.
        agents: The analyzer, generator and modifier.
        bank: The memory bank.
        keep: Called with the record whenever it has grown.

    Returns:
        The decision. If there is nothing to attack with, its record has the ending ``NO_ENCOUNTER`` and the reason.

    Raises:
        ModelError: A language model plays an agent and failed.
    """
    record = replace(record, bandit=prepared.bandit).took(prepared.timing)
    if prepared.known is not None:  # recalled from a similar scene, so no agent is needed
        record, library = replace(record, intents=[prepared.known]), prepared.library
    else:
        record, library = analyze(record, prepared, settings, agents, bank, keep)
    why_not = _why_not(record, prepared, settings)
    if why_not:
        record = replace(record, ending=Ending.NO_ENCOUNTER, reason=why_not)
    keep(record)
    return Decision(record, prepared, None if why_not else library)


def _why_not(record: EncounterRecord, prepared: PreparedEncounter, settings: Settings) -> str:
    """Return why there is nothing to attack with; empty if there is something."""
    if record.request.declined:
        return f"The request cannot be played: {record.request.declined}"
    if not record.intents and settings.tuner == "off":
        return "The analyzer sees nothing here that could be dangerous."
    if prepared.search:
        return ""
    there = {name for situation in prepared.found.situations.values() for name in situation.targets}
    gone = [each.id for each in prepared.attackers if each.id not in there]
    if gone:
        found = prepared.found
        now = found.baseline[0] if found.baseline else None
        places = "; ".join(
            place_in_words(now, found.ego, name)[1] if now is not None and name in now.raw else f"{name} is not there"
            for name in gone
        )
        return (
            f"{' and '.join(gone)} cannot attack here, and all attackers of the scene attack together. Seen from the "
            f"ego at {found.time:g} s: {places}."
        )
    near = ", ".join(f"{name} ({relation})" for name, relation, _ in prepared.found.ranking)
    reason = "No intent of the library applies to any vehicle near"
    return f"{reason}: {near}." if near else f"{reason}."


def pursue(
    decision: Decision, runner: Attempts, settings: Settings, agents: Agents, bank: MemoryBank, tell: Tell,
    keep: Keep = forget, *, another: bool = False, ends_at: float = math.inf,
) -> EncounterRecord:  # fmt: skip
    """Run attempts until one succeeds or the budget is used up, and learn from them.

    Args:
        decision: What to attack with. Its ``library`` must not be None.
        runner: Runs the attempts.
        settings: The run's settings.
        agents: The analyzer, generator and modifier.
        bank: The memory bank.
        tell: Called with each attempt.
        keep: Called with the record after the attempts, even if they were interrupted or failed, and after learning.
        another: Whether another encounter may follow. If so, this encounter is left sooner if the attempts do not
            improve.
        ends_at: When the run should end, as ``time.perf_counter()`` [s].

    Returns:
        The record with the attempts and what was learnt from them. If a model fails, the record holds the attempts
        before the failure.
    """
    record, prepared, library = decision.record, decision.prepared, decision.library
    assert library is not None
    done, request = Refinement(goal=settings.goal), record.request
    if request.asked is not None:
        reader = reader_of(agents, request.words)
        done.fitting = Fitting(request.asked, request.attackers, prepared.found, settings, reader)
    refiner = Refiner(
        runner, prepared.found, prepared.search, agents, library, settings, tell, another=another, ends_at=ends_at
    )  # fmt: skip
    try:
        refiner.run(record.intents, done)
    except ModelError as error:  # the attempts before the failure count
        done.ending, done.reason = model_ending(error), str(error)
    finally:
        failures = sorted(f"planner {name[:12]}: {why}" for name, why in prepared.predictor.failures.items())
        known = frozenset(entry.label for entry in prepared.library)
        record = replace(done.recorded(record), known_labels=known, notes=[*record.notes, *failures])
        keep(record)
    after = PartsClock()
    with after.part("learning"):
        before = BankView.of(prepared, settings, agents, bank)
        learnt = learn(record, bank, library, settings, prepared.network, prepared.scene.controller)
        change = before.difference(BankView.of(prepared, settings, agents, bank))
    notes = [*record.notes, learnt.note] if learnt.note else record.notes
    record = replace(record, learnt=learnt.success, bank_change=change, notes=notes).took(after.seconds)
    keep(record)
    return record


# -- replaying a recorded attack -------------------------------------------------------------------------------------


def replay_episode(
    run_input: RunInput, settings: Settings, task: Task, engine: EpisodeEngine, sandbox: Sandbox, proposal: Proposal,
    skips: int,
) -> Run:  # fmt: skip
    """Repeat one recorded attempt in its encounter, without agents and without a bank.

    Args:
        run_input: The input.
        settings: The run's settings.
        task: What is simulated.
        engine: The engine process.
        sandbox: Runs the planners.
        proposal: The recorded candidate.
        skips: The number of encounters before that of the attempt.

    Returns:
        The run. It has no attempt if the simulation does not reach the encounter (``Run.stop`` says why).

    Raises:
        UsageError: The encounter lacks the recorded start or vehicle.
    """
    finder = EncounterFinder(run_input, settings, task, engine, lambda *_: None)
    record = recorded_encounter(finder, proposal, skips)
    if record is not None:
        runner = runner_of(engine, sandbox, record.found, settings)
        done = attack_once(record.found, runner, settings, proposal, record.request)
        finder.keep(given_attack(done.recorded(record), proposal, "replayed from a manifest"))
    return finder.run(isolation=sandbox.isolation)


def given_attack(record: EncounterRecord, proposal: Proposal, reason: str) -> EncounterRecord:
    """Return a record with the intent of a given attack as its only intent.

    Args:
        record: The record of the encounter.
        proposal: The given attack.
        reason: Where the attack comes from (``Intent.reason``).
    """
    intent = Intent(proposal.bv, proposal.label, "", "", proposal.acceleration, reason)
    return replace(record, intents=(intent,), known_labels=frozenset({proposal.label}))


def attack_once(
    found: FoundEncounter, runner: Attempts, settings: Settings, proposal: Proposal, request: Request
) -> Refinement:
    """Run one given attempt and judge it.

    The attempt is judged like any attempt of a run, except that no model reads its motion.

    Args:
        found: The encounter.
        runner: Runs the attempt.
        settings: The run's settings.
        proposal: The candidate to attempt.
        request: The request that the attempt is compared with, if it asks for anything.

    Returns:
        A refinement with this attempt alone. Its ending says whether the attempt meets the goal, or what failed.
    """
    done = Refinement(goal=settings.goal)
    with done.clock.part("attempts"):
        (result,) = runner.attempt([proposal])
        attempt = attempt_of(0, "replay", proposal, result, found, settings)
    if request.asked is not None:
        fitting = Fitting(request.asked, request.attackers, found, settings)
        attempt = fitting.judged(attempt, result, settings.goal)
    done.attempts, done.results = [attempt], [result]
    with done.clock.part("references"):
        settle_best(done, runner)
        settle_roles(done, runner)
    if settings.goal.met(done.attempts[0].verdict):
        done.ending = Ending.GOAL_MET
    done.end_if_all_failed()
    return done


def recorded_encounter(finder: EncounterFinder, proposal: Proposal, skips: int) -> EncounterRecord | None:
    """Find the encounter of a recorded attack.

    Args:
        finder: Finds the encounters.
        proposal: The recorded attack.
        skips: The number of encounters before that of the attack.

    Returns:
        The record of the encounter; None if the simulation does not reach it (``finder.stop`` says why).

    Raises:
        UsageError: The encounter lacks the recorded start or vehicle.
    """
    record = finder.seek()
    for _ in range(skips):
        if record is not None:
            finder.leave(OUT_OF_REACH)
            record = finder.seek()
    if record is None:
        return None
    if proposal.delay not in record.found.situations:
        raise UsageError(
            f"The manifest's delay of {proposal.delay:g} s is not one of the run's delays, so it cannot be replayed."
        )
    for bv in proposal.bvs:
        if bv not in record.found.situations[proposal.delay].targets:
            raise UsageError(
                f"The manifest's vehicle '{bv}' cannot attack in the run, so the attempt cannot be replayed."
            )
    return record
