"""The attack of a case on another driver: first as it was kept, then with nearby parameters.

Normally a case is one attempt. More attempts are made if the ego arrives differently from the one that the case was
found with, or if the user asks for more. Then the parameters are adapted to the new situation and varied around the
best attempts, as in the search (``search/evolution.py``).
"""

from __future__ import annotations

from dataclasses import dataclass

from sumo_adv.config import Settings
from sumo_adv.datatypes import Level, Verdict
from sumo_adv.episode.assessment import attempt_of, checked, runner_of
from sumo_adv.episode.engine import EpisodeEngine
from sumo_adv.episode.loop import attack_once
from sumo_adv.episode.refinement import Refinement, settle_best
from sumo_adv.episode.run import Request
from sumo_adv.episode.task import FoundEncounter
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.regression.at_trigger import AtTrigger
from sumo_adv.regression.case import Expectation, KeptCase
from sumo_adv.search.evolution import Evolution
from sumo_adv.search.sampling import Sampler
from sumo_adv.search.settings import SearchSettings

NEARBY_ATTEMPTS = 8  # attempts against an ego that arrives differently


@dataclass(frozen=True, slots=True)
class Arrived:
    """How the ego arrived at the start of the attack.

    Attributes:
        situation: The situation of the ego and the adversary.
        otherwise: How it differs from the kept case, in words; empty if it does not.
    """

    situation: AtTrigger
    otherwise: str


def arrived(case: KeptCase, encounter: FoundEncounter) -> Arrived:
    """Compare the situation at the start of the attack with that of the kept case.

    Args:
        case: The kept case.
        encounter: The encounter with the ego under test.
    """
    p = case.proposal
    here = encounter.situations[p.delay]
    situation = AtTrigger.of(here.ego, here.targets[p.bv].state)
    return Arrived(situation, "" if case.situation is None else case.situation.difference(situation))


def attack(
    case: KeptCase,
    settings: Settings,
    engine: EpisodeEngine,
    sandbox: Sandbox,
    encounter: FoundEncounter,
    attempts: int,
) -> tuple[Refinement, Arrived]:
    """Attack the ego until an attempt breaks what the case expects.

    Args:
        case: The kept case.
        settings: The settings of the run.
        engine: Simulates attempts.
        sandbox: Runs planners.
        encounter: The encounter with the ego under test.
        attempts: The maximum number of attempts. If the ego arrives differently, the maximum is at least
            ``NEARBY_ATTEMPTS``.

    Returns:
        The attempts, whose best one is confirmed, and how the ego arrived.
    """
    came, runner = arrived(case, encounter), runner_of(engine, sandbox, encounter, settings)
    done = attack_once(encounter, runner, settings, case.proposal, Request.of(case.run_input))
    most = max(attempts, NEARBY_ATTEMPTS if came.otherwise else 1)
    if most == 1:
        return done, came
    search = SearchSettings()
    evolution = Evolution(Sampler(search.sampling, settings.seed), settings.goal, search.evolution)
    if came.otherwise and case.situation is not None:
        evolution.add([case.situation.moved(case.proposal, came.situation)])
    while True:
        last = done.attempts[-1]
        evolution.observe(last.proposal, last.verdict, last.kind)
        broken = breaks(case.expect, last.verdict)
        if broken or last.ending in ("crashed", "planner_failed") or len(done.attempts) >= most:
            break
        proposal = evolution.propose()
        if proposal is None:
            break
        with done.clock.part("attempts"):
            (result,) = runner.attempt([proposal])
            attempt = attempt_of(len(done.attempts), "neighbour", proposal, result, encounter, settings)
        with done.clock.part("references"):
            attempt = checked(attempt, result, runner, settings.goal, Level.COLLISION)
        done.attempts.append(attempt)
        done.results.append(result)
    with done.clock.part("references"):
        settle_best(done, runner)
    return done, came


def breaks(expect: Expectation, verdict: Verdict) -> bool:
    """Return whether an attempt shows that the ego does not do what is expected of it.

    Args:
        expect: What is expected of the ego.
        verdict: The verdict on the attempt.
    """
    if not verdict.counts:
        return False
    near = expect.min_ttc is not None and verdict.min_ttc <= expect.min_ttc
    least = Level.COLLISION if expect.no_worse else expect.level
    return near or (least is not None and verdict.level >= least)
