"""A recorded attack repeated and made as mild as its level allows, against the same ego."""

from __future__ import annotations

import math
import time

from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Ending, Intent, Proposal
from sumo_adv.episode.assessment import attempt_of, confirmed
from sumo_adv.episode.attempt_runner import AttemptRunner
from sumo_adv.episode.episode import Episode
from sumo_adv.episode.loop import recorded_encounter
from sumo_adv.episode.planned_encounter import Tell
from sumo_adv.episode.task import AttemptResult, Task
from sumo_adv.errors import UsageError
from sumo_adv.metrics.gates import largest_acceleration
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.search.minimise import Minimiser
from sumo_adv.search.prediction import Predictor
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import RunInput
from sumo_adv.simulation.recording import tracks_of


def minimise_episode(
    source: RunInput, settings: Settings, task: Task, engine: Engine, sandbox: Sandbox, proposal: Proposal, skips: int,
    tell: Tell,
) -> Episode:  # fmt: skip
    """The encounter of a recorded attack again, with the attack and milder variants. The mildest one counts.

    settings: ``until`` is the level that a variant must reach, ``attempts`` the largest number of simulations.

    Raises:
        UsageError: the attack does not reach the level when it is repeated, or the encounter does not come back.
    """
    if settings.goal.ttc is not None:
        raise UsageError("The run looked for a near miss, which has no milder variants: minimise takes a collision.")
    episode = Episode(source, settings, task)
    began = time.perf_counter()
    encounter = recorded_encounter(episode, engine, proposal, skips)
    if encounter is None:
        raise UsageError(f"The encounter did not come back ({episode.reason}), so there is nothing to minimise.")
    episode.intent = Intent(proposal.bv, proposal.label, "", "", proposal.acceleration, "minimised from a manifest")
    episode.intents, level, done = (episode.intent,), settings.until.level, episode.refinement
    reached, met = settings.goal.reached, settings.goal.met
    runner = AttemptRunner(engine, sandbox, encounter, settings.seed)

    def attempted(p: Proposal) -> tuple[Attempt, AttemptResult]:
        result = runner.attempt([p])[0]
        phase = "replay" if not done.attempts else "minimise"
        attempt = confirmed(attempt_of(len(done.attempts), phase, p, result, encounter, settings), result, runner)
        done.attempts.append(attempt)
        done.results.append(result)
        tell("attempt", attempt)
        return attempt, result

    first, result = attempted(proposal)
    if not met(first.verdict) or first.verdict.delta_v is None:
        raise UsageError(
            f"The attack reaches the level {first.verdict.level}, not {settings.goal}; choose a lower --until."
        )
    predictor = Predictor(sandbox, settings, encounter.drivable, encounter.situations)
    starts = [
        delay for delay, situation in encounter.situations.items() if situation.targets.keys() >= set(proposal.bvs)
    ]
    search = Minimiser(predictor, proposal, math.inf, level, starts, settings.seed)
    search.harshness = before = _harshness(search, first, result, settings)
    done.chosen, done.ending, episode.ending = 0, Ending.CRITICAL, Ending.CRITICAL
    while len(done.attempts) < settings.attempts and (variant := search.propose()) is not None:
        attempt, result = attempted(variant)
        harshness = _harshness(search, attempt, result, settings) if met(attempt.verdict) else math.inf
        if search.observe(variant, reached(attempt.verdict), harshness):
            done.chosen = attempt.index
    episode.reason = (
        f"The mildest of {len(done.attempts)} attacks that reaches {level}: harshness {search.harshness:.1f} instead "
        f"of {before:.1f} m/s2."
    )
    episode.isolation = sandbox.isolation
    episode.timing |= {"prediction": predictor.seconds, "total": time.perf_counter() - began}
    done.seconds = episode.timing["total"]
    return episode


def _harshness(search: Minimiser, attempt: Attempt, result: AttemptResult, settings: Settings) -> float:
    """The harshness [m/s2] of a simulated collision."""
    verdict, p = attempt.verdict, attempt.proposal
    track = tracks_of(result.snapshots, result.sizes, {}, settings.step_length, (p.bv,))[0]
    assert verdict.contact_time is not None and verdict.delta_v is not None
    part = track.between(result.start + settings.step_length / 2, verdict.contact_time)
    strongest = float(largest_acceleration(part.boxes(), part.acceleration, part.time)) if len(part.time) > 1 else 0.0
    return search.harshness_of(strongest, verdict.delta_v, p.delay)
