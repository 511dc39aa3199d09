"""From an attempt's result to the attempt: its rank, whether it succeeded, and the confirmation of its verdict."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Level, ObservedMotion, Proposal, Verdict
from sumo_adv.episode.attempt_runner import Attempts
from sumo_adv.episode.diagnosis import REACH, diagnose
from sumo_adv.episode.references import simulated
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.goal import Goal
from sumo_adv.metrics.levels import judged
from sumo_adv.search.free_motion import named
from sumo_adv.search.templates import kind_of
from sumo_adv.simulation.recording import tracks_of

NOTHING = Verdict(float("inf"), float("inf"), False, False, False, False, None, None, None, ("no_motion",))


def rank(verdict: Verdict) -> tuple[float, float]:
    """A key that sorts attempts: collisions by level, serious first; then feasible ones by min TTC; then infeasible
    ones, collisions first."""
    if verdict.collided:
        return (float(Level.SERIOUS - verdict.level), 0.0) if verdict.counts else (5, 0.0)
    return (4, verdict.min_ttc) if verdict.counts else (6, verdict.min_ttc)


def attempt_of(
    index: int, phase: str, proposal: Proposal, result: AttemptResult, found: FoundEncounter, settings: Settings
) -> Attempt:
    """An attempt from its result; if the planner failed it is not feasible."""
    verdict = result.verdict or NOTHING
    if result.driven.ending == "planner_failed":
        verdict = replace(verdict, feasible=False, failed_gates=(*verdict.failed_gates, "planner_failed"))
    path = found.situations[proposal.delay].baseline.path
    target = found.situations[proposal.delay].targets.get(proposal.bv)
    limits = settings.limits.limits() if target is None else settings.limits.of(target.state)
    diagnosis = diagnose(result, found.ego, proposal.bv, path, limits, settings.step_length)
    kind = ""
    if target is not None:
        proposal = named(proposal, target, verdict)
        kind = kind_of(proposal.label, target.relation, verdict.contact_side)
    return Attempt(
        index, phase, proposal, result.start, verdict, result.driven.ending, result.driven.message, diagnosis, kind
    )


def observed_motion(
    result: AttemptResult, found: FoundEncounter, delay: float, settings: Settings
) -> ObservedMotion | None:
    """The ego's motion from the takeover on, at constant speed after the attempt; None if the ego was gone at once."""
    tracks = tracks_of(result.snapshots, result.sizes, {}, settings.step_length, (found.ego,))
    track = tracks[0].between(result.start, math.inf) if tracks else None
    if track is None or len(track.time) < 2:
        return None
    situation, dt = found.situations[delay], settings.step_length
    missing = range(round((float(track.time[0]) - result.start) / dt))  # at the trigger itself nothing is recorded
    path, station = situation.baseline.path, 0.0
    places = [(float(situation.baseline.s[k]), 0.0) for k in missing]
    speeds = np.concatenate([situation.baseline.v[: len(missing)], track.speed])
    for x, y in zip(track.x.tolist(), track.y.tolist(), strict=True):
        station, offset = path.project(x, y, near=station, reach=REACH)
        places.append((station, offset))
    steps = settings.steps(settings.duration)
    over = np.maximum(np.arange(steps + 1) - (len(places) - 1), 0) * dt
    k = np.minimum(np.arange(steps + 1), len(places) - 1)
    stations, offsets = np.array(places)[k].T
    return ObservedMotion(stations + over * float(speeds[-1]), offsets, speeds[k], len(places))


def checked(attempt: Attempt, result: AttemptResult, runner: Attempts, goal: Goal) -> Attempt:
    """The attempt; if it would be a success, reference drivers confirm it in the simulation first."""
    needed = goal.level >= Level.VALID and goal.met(attempt.verdict)
    return confirmed(attempt, result, runner) if needed else attempt


def confirmed(attempt: Attempt, result: AttemptResult, runner: Attempts) -> Attempt:
    """The attempt with the answers of reference drivers in the simulation, if its collision counts."""
    verdict, kinematic = attempt.verdict, attempt.verdict.preventability
    if verdict.level < Level.COLLISION or kinematic is None or kinematic.simulated:
        return attempt
    answers = runner.references(attempt.proposal, result)
    if not answers:
        return attempt
    return replace(attempt, verdict=judged(replace(verdict, preventability=simulated(kinematic, answers))))
