"""Find the mildest variant of a recorded attack that still reaches a level: later, gentler and slower.

Variants meet the same ego. They are drawn near the parameters of the mildest attack so far, and at all starts. Among
those that are predicted to reach the level, the mildest one of each round is tried if it promises to be milder than the
mildest attack so far. The search ends after ``MAX_ROUNDS_WITHOUT_GAIN`` rounds without a milder attack.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import cycle
from random import Random

from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Ending, Level, Proposal
from sumo_adv.episode.assessment import attempt_of, confirmed, runner_of
from sumo_adv.episode.encounter_finder import EncounterFinder, Tell
from sumo_adv.episode.engine import EpisodeEngine
from sumo_adv.episode.loop import given_attack, recorded_encounter
from sumo_adv.episode.refinement import Refinement
from sumo_adv.episode.run import Run
from sumo_adv.episode.task import AttemptResult, Task
from sumo_adv.errors import UsageError
from sumo_adv.metrics.gates import largest_acceleration
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.search.prediction import Predictor
from sumo_adv.search.sampling import Scorer, varied
from sumo_adv.simulation.inputs import RunInput

HARSHNESS_OF_DELTA_V_PER_S = 1.0  # 1/s; a delta-v of 1 m/s counts as an acceleration of 1 m/s2
HARSHNESS_OF_EARLINESS_M_S3 = 0.2  # m/s3; per second before the latest start: a later attack tells more of the ego
VARIANTS_PER_ROUND = 120  # variants predicted in each round
VARIANT_SPREADS = (0.3, 0.1, 0.03)  # standard deviations, as shares of a parameter's range; used in turn
MAX_ROUNDS_WITHOUT_GAIN = 6  # rounds in a row without a milder attack after which the search ends
MIN_GAIN_SHARE = 0.02  # share by which a variant must be predicted to be milder


class Minimiser:
    """Proposes variants of an attack that promise to be milder.

    The harshness of an attack is a sum [m/s2]: its largest acceleration, the ego's delta-v, and how early it begins.

    Attributes:
        best: The mildest attack so far that reached the level.
        harshness: Its harshness in the simulation [m/s2].
    """

    def __init__(
        self, scorer: Scorer, first: Proposal, harshness: float, level: Level, starts: Sequence[float], seed: int
    ) -> None:
        """Start from an attack.

        Args:
            scorer: Predicts variants.
            first: The attack.
            harshness: The attack's harshness in the simulation [m/s2].
            level: The level that a variant must reach.
            starts: The delays after the trigger at which variants may begin [s].
            seed: The seed of the variants.
        """
        self._scorer, self._level, self._starts, self._random = scorer, level, tuple(starts), Random(seed)
        self.best, self.harshness = first, harshness
        self._latest, self._failed, self._spreads = max(starts), 0, cycle(VARIANT_SPREADS)

    def harshness_of(self, acceleration: float, delta_v: float, delay: float) -> float:
        """Return the harshness of an attack [m/s2].

        Args:
            acceleration: Its largest acceleration [m/s2].
            delta_v: The ego's delta-v [m/s].
            delay: Its start, as time after the trigger [s].
        """
        return (
            acceleration + HARSHNESS_OF_DELTA_V_PER_S * delta_v + HARSHNESS_OF_EARLINESS_M_S3 * (self._latest - delay)
        )

    def propose(self) -> Proposal | None:
        """Return the variant to try next.

        Returns:
            The variant; None after ``MAX_ROUNDS_WITHOUT_GAIN`` rounds in a row without a milder attack.
        """
        while self._failed < MAX_ROUNDS_WITHOUT_GAIN:
            spread = next(self._spreads)
            variants = [varied(self.best, self._random, spread) for _ in range(VARIANTS_PER_ROUND)]
            variants = [self._begun_elsewhen(p) for p in variants]
            scored = [(self._predicted(p), k, p) for k, p in enumerate(self._scorer.score(variants))]
            harshness, _, mildest = min(scored, key=lambda each: each[:2])
            if harshness < self.harshness * (1.0 - MIN_GAIN_SHARE):
                return mildest
            self._failed += 1
        return None

    def observe(self, tried: Proposal, level: Level, harshness: float) -> bool:
        """Learn from an attempt.

        Args:
            tried: The variant that was attempted.
            level: The level that it reached.
            harshness: Its harshness [m/s2].

        Returns:
            Whether it is the mildest so far that reaches the level.
        """
        if level >= self._level and harshness < self.harshness:
            self.best, self.harshness, self._failed = tried, harshness, 0
            return True
        self._failed += 1
        return False

    def _begun_elsewhen(self, p: Proposal) -> Proposal:
        """Give half of the variants, with their supports, a random start; the others keep theirs."""
        delay = p.delay if self._random.random() < 0.5 else self._random.choice(self._starts)
        return replace(p, delay=delay, supports=tuple(replace(support, delay=delay) for support in p.supports))

    def _predicted(self, p: Proposal) -> float:
        """Return the predicted harshness [m/s2]; infinite if the level is not predicted to be reached."""
        seen = p.prediction
        if seen is None or seen.failure or seen.level < self._level:
            return float("inf")
        return self.harshness_of(seen.acceleration, seen.delta_v, p.delay)


def minimise_episode(
    run_input: RunInput, settings: Settings, task: Task, engine: EpisodeEngine, sandbox: Sandbox, proposal: Proposal,
    skips: int, tell: Tell,
) -> Run:  # fmt: skip
    """Repeat the encounter of a recorded attack, with the attack and milder variants. The mildest one counts.

    Args:
        run_input: The input of the recorded run.
        settings: The run's settings. ``until`` is the level that a variant must reach, and ``attempts`` is the maximum
            number of simulations.
        task: What the engine is opened with.
        engine: Simulates the attempts.
        sandbox: Runs the planners.
        proposal: The recorded attack.
        skips: The number of encounters to pass over before that of the attack.
        tell: Reports progress.

    Returns:
        The run, in which the mildest attempt counts.

    Raises:
        UsageError: The run looked for a near miss, the attack does not reach the level when it is repeated, or the
            encounter does not come back.
    """
    if settings.goal.ttc is not None:
        raise UsageError("The run looked for a near miss, which has no milder variants: minimise takes a collision.")
    finder = EncounterFinder(run_input, settings, task, engine, lambda *_: None)
    record = recorded_encounter(finder, proposal, skips)
    if record is None:
        why = "" if finder.stop is None else finder.stop.reason
        raise UsageError(f"The encounter did not recur ({why}), so there is nothing to minimise.")
    found, level, done = record.found, settings.until.level, Refinement(goal=settings.goal)
    reached, met = settings.goal.reached, settings.goal.met
    runner = runner_of(engine, sandbox, found, settings)

    def attempted(p: Proposal) -> tuple[Attempt, AttemptResult]:
        with done.clock.part("attempts"):
            (result,) = runner.attempt([p])
            phase = "replay" if not done.attempts else "minimise"
            attempt = attempt_of(len(done.attempts), phase, p, result, found, settings)
        with done.clock.part("references"):
            attempt = confirmed(attempt, result, runner)
        done.attempts.append(attempt)
        done.results.append(result)
        tell("attempt", attempt)
        return attempt, result

    first, result = attempted(proposal)
    if not met(first.verdict) or first.verdict.delta_v is None:
        raise UsageError(
            f"The attack reaches the level {first.verdict.level}, not {settings.goal}; choose a lower --until."
        )
    predictor = Predictor(sandbox, settings, found.drivable, found.situations)
    starts = [delay for delay, situation in found.situations.items() if situation.targets.keys() >= set(proposal.bvs)]
    search = Minimiser(predictor, proposal, math.inf, level, starts, settings.seed)
    search.harshness = before = _harshness(search, first, result, settings)
    mildest = 0
    while len(done.attempts) < settings.attempts and (variant := search.propose()) is not None:
        attempt, result = attempted(variant)
        harshness = _harshness(search, attempt, result, settings) if met(attempt.verdict) else math.inf
        if search.observe(variant, reached(attempt.verdict), harshness):
            mildest = attempt.index
    done.ending = Ending.GOAL_MET
    done.reason = (
        f"The mildest of {len(done.attempts)} attacks that reaches {level}: harshness {search.harshness:.1f} instead "
        f"of {before:.1f} m/s2."
    )
    record = given_attack(done.recorded(record), proposal, "minimised from a manifest").of_attempt(mildest)
    finder.keep(record)
    return finder.run(isolation=sandbox.isolation)


def _harshness(search: Minimiser, attempt: Attempt, result: AttemptResult, settings: Settings) -> float:
    """Return the harshness of a simulated collision [m/s2]."""
    verdict, p = attempt.verdict, attempt.proposal
    track = result.tracks(settings.step_length, p.bv)[p.bv]
    assert verdict.contact_time is not None and verdict.delta_v is not None
    part = track.between(result.start + settings.step_length / 2, verdict.contact_time)
    strongest = float(largest_acceleration(part.boxes(), part.acceleration, part.time)) if len(part.time) > 1 else 0.0
    return search.harshness_of(strongest, verdict.delta_v, p.delay)
