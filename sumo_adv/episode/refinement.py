"""The loop of the paper: intent, planner, attempt, feedback, again; until the criterion is met or all is used up.

Inner loop: the tuner orders parameters, modes, vehicles and delays.  Outer loop: once a planner's share of attempts is
used up the modifier writes a new version of it.  Every attempt records who proposed it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from sumo_adv.agents.agents import Agents
from sumo_adv.config import Settings, Until
from sumo_adv.datatypes import Attempt, Ending, Intent, Level, LibraryEntry, ObservedMotion, Planner, Proposal, Verdict
from sumo_adv.episode.diagnosis import REACH, diagnose
from sumo_adv.episode.references import simulated
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.metrics.levels import judged
from sumo_adv.search.expert import Expert
from sumo_adv.search.ordering import Tuner
from sumo_adv.search.templates import AttackTemplate, templates_of
from sumo_adv.simulation.recording import tracks_of

AT_ONCE = 2  # attempts that run at the same time after the first; the same whether or not they can be forked
NOTHING = Verdict(float("inf"), float("inf"), False, False, False, False, None, None, None, ("no_motion",))


@dataclass(slots=True)
class Refinement:
    """What the loop has come to. ``results[k]`` belongs to ``attempts[k]``."""

    attempts: list[Attempt] = field(default_factory=list)
    results: list[AttemptResult] = field(default_factory=list)
    ending: Ending = Ending.ATTEMPTS_EXHAUSTED
    reason: str = ""
    seconds: float = 0.0
    first_success_seconds: float | None = None

    @property
    def best(self) -> int | None:
        """Index of the attempt that counts, None without attempts."""
        if not self.attempts:
            return None
        return min(range(len(self.attempts)), key=lambda k: (*rank(self.attempts[k].verdict), k))


def rank(verdict: Verdict) -> tuple[float, float]:
    """Order of attempts that count: by level, serious first; then feasible ones by min TTC, then what is not feasible
    (collisions first)."""
    honest = verdict.feasible and not verdict.rear_end
    if verdict.collided:
        return (float(Level.SERIOUS - verdict.level), 0.0) if honest else (5, 0.0)
    return (4, verdict.min_ttc) if honest else (6, verdict.min_ttc)


def succeeded(verdict: Verdict, until: Until) -> bool:
    """Whether the level is reached; never by an infeasible motion nor by running into the ego's back."""
    return verdict.level >= until.level


def attempt_of(
    index: int, phase: str, proposal: Proposal, result: AttemptResult, found: FoundEncounter, settings: Settings
) -> Attempt:
    """An attempt from what came of it; one whose planner failed is not feasible."""
    verdict = result.verdict or NOTHING
    if result.driven.ending == "planner_failed":
        verdict = replace(verdict, feasible=False, failed_gates=(*verdict.failed_gates, "planner_failed"))
    path = found.situations[proposal.delay].ego_path
    diagnosis = diagnose(result, found.ego, proposal.bv, path, settings.limits.limits(), settings.step_length)
    return Attempt(
        index, phase, proposal, result.start, verdict, result.driven.ending, result.driven.message, diagnosis
    )


def observed_motion(
    result: AttemptResult, found: FoundEncounter, delay: float, settings: Settings
) -> ObservedMotion | None:
    """How the ego went from the takeover on, at an even speed once that is over; None if it was gone at once."""
    tracks = tracks_of(result.snapshots, result.sizes, {}, settings.step_length, (found.ego,))
    track = tracks[0].between(result.start, math.inf) if tracks else None
    if track is None or len(track.time) < 2:
        return None
    now, dt = found.situations[delay], settings.step_length
    missing = range(round((float(track.time[0]) - result.start) / dt))  # at the trigger itself nothing is recorded
    path, station = now.ego_path, 0.0
    places = [(float(now.profile_s[k]), 0.0) for k in missing]
    speeds = np.concatenate([now.profile_v[: len(missing)], track.speed])
    for x, y in zip(track.x.tolist(), track.y.tolist(), strict=True):
        station, offset = path.project(x, y, near=station, reach=REACH)
        places.append((station, offset))
    steps = settings.steps(settings.duration)
    over = np.maximum(np.arange(steps + 1) - (len(places) - 1), 0) * dt
    k = np.minimum(np.arange(steps + 1), len(places) - 1)
    stations, offsets = np.array(places)[k].T
    return ObservedMotion(stations + over * float(speeds[-1]), offsets, speeds[k], len(places))


class Attempts(Protocol):
    """Who runs attempts; a result is asked for only where those before it did not succeed."""

    def attempt(self, proposals: Sequence[Proposal]) -> Iterable[AttemptResult]:
        """The results of the proposals, in order."""
        ...

    def references(self, proposal: Proposal, result: AttemptResult) -> dict[str, bool]:
        """Which reference drivers avoid an attempt's collision in the simulation; empty where that cannot be asked."""
        ...


def checked(attempt: Attempt, result: AttemptResult, brain: Attempts, until: Until) -> Attempt:
    """The attempt; if it would be a success by what reference drivers do, they drive in the simulation first."""
    needed = until.level >= Level.VALID and succeeded(attempt.verdict, until)
    return confirmed(attempt, result, brain) if needed else attempt


def confirmed(attempt: Attempt, result: AttemptResult, brain: Attempts) -> Attempt:
    """The attempt with the answers of reference drivers in the simulation, if its collision counts."""
    verdict, kinematic = attempt.verdict, attempt.verdict.preventability
    if verdict.level < Level.COLLISION or kinematic is None or kinematic.simulated:
        return attempt
    answers = brain.references(attempt.proposal, result)
    if not answers:
        return attempt
    return replace(attempt, verdict=judged(replace(verdict, preventability=simulated(kinematic, answers))))


def settle_best(found: Refinement, brain: Attempts) -> None:
    """Have the attempt that counts confirmed; if that takes it back, the next best one, until one stays."""
    while (k := found.best) is not None:
        attempt = confirmed(found.attempts[k], found.results[k], brain)
        if attempt is found.attempts[k]:
            return
        found.attempts[k] = attempt


class Refiner:
    """One encounter's attempts."""

    def __init__(
        self,
        brain: Attempts,
        found: FoundEncounter,
        expert: Expert,
        agents: Agents,
        library: Sequence[LibraryEntry],
        settings: Settings,
        tell: Callable[[Attempt], None],
    ) -> None:
        self._brain, self._found, self._expert, self._cast = brain, found, expert, agents
        self._library, self._settings, self._tell = library, settings, tell
        self._versions: dict[str, int] = {}  # planner hash -> how often it was modified on the way to it
        self._asked: set[str] = set()
        self._new: dict[str, Planner] = {}
        self._proposed: list[Proposal] = []  # a model's own, tried first

    def run(self, intents: Sequence[Intent], found: Refinement) -> None:
        """Attempts until success, kept in ``found`` as they come; ``intents`` as ranked by the analyzer."""
        began = time.perf_counter()
        ways = templates_of(self._found.situations, self._library, [i.label for i in intents])
        if self._settings.tuner == "off":
            remembered = [p for p in self._expert.pool if p.by == "memory"]
            source: Tuner | list[Proposal] = _untuned(intents, ways, remembered)
        else:
            source = self._tuner(intents, ways)
        while len(found.attempts) < self._settings.attempts:
            plans = self._next(source, ways, found)
            if not plans:
                found.reason = "Nothing was left to try." if found.attempts else "There was nothing to try."
                break
            if self._try(plans, found, began):
                break
            if isinstance(source, Tuner):
                self._learn(source, found, len(plans))
        if found.attempts and all(a.ending == "planner_failed" for a in found.attempts):
            found.ending, found.reason = Ending.PLANNER_FAILED, found.attempts[-1].message
        settle_best(found, self._brain)
        found.seconds = time.perf_counter() - began

    def _tuner(self, intents: Sequence[Intent], ways: Sequence[AttackTemplate]) -> Tuner:
        """The inner loop; where a model ranked the intents, in its order, its first ones as it proposed them."""
        modelled = self._cast.by_model("analyzer") and not any(p.by == "memory" for p in self._expert.pool)
        ranks = {(i.bv, i.label): k for k, i in enumerate(intents)} if modelled else {}
        tuner = Tuner(self._expert, ways, share=self._settings.per_planner, ranks=ranks)
        for intent in intents[: AT_ONCE if self._cast.undecided else 1] if modelled else ():
            proposal = tuner.first_of(intent.bv, intent.label)
            if proposal is not None:
                self._proposed.append(replace(proposal, acceleration=intent.acceleration))
        return tuner

    def _next(
        self, source: Tuner | list[Proposal], ways: Sequence[AttackTemplate], found: Refinement
    ) -> list[Proposal]:
        left = self._settings.attempts - len(found.attempts)
        count = min(AT_ONCE if found.attempts or self._cast.undecided else 1, left)
        if isinstance(source, list):
            if not source:
                source += self._rewritten(ways, found)
            return [source.pop(0) for _ in range(min(count, len(source)))]
        if not found.attempts and self._proposed:
            return self._proposed[: min(AT_ONCE, left)]
        plans: list[Proposal] = []
        self._modify(source, ways, found)
        while len(plans) < count and (proposal := source.next()) is not None:
            plans.append(proposal)
        return plans

    def _try(self, plans: Sequence[Proposal], found: Refinement, began: float) -> bool:
        """Run proposals; True once one of them succeeded (those behind it are dropped)."""
        for proposal, result in zip(plans, self._brain.attempt(plans), strict=True):
            attempt = self._attempt(len(found.attempts), proposal, result)
            attempt = checked(attempt, result, self._brain, self._settings.until)
            found.attempts.append(attempt)
            found.results.append(result)
            self._tell(attempt)
            if succeeded(attempt.verdict, self._settings.until):
                found.ending, found.reason = Ending.CRITICAL, ""
                found.first_success_seconds = time.perf_counter() - began
                return True
        return False

    def _learn(self, tuner: Tuner, found: Refinement, count: int) -> None:
        """Tell the tuner how the ego went in the last ``count`` attempts."""
        for attempt, result in zip(found.attempts[-count:], found.results[-count:], strict=True):
            course = observed_motion(result, self._found, attempt.proposal.delay, self._settings)
            if course is not None:
                tuner.heard(attempt.proposal, course, attempt.verdict.avoidable_collision)

    def _attempt(self, index: int, proposal: Proposal, result: AttemptResult) -> Attempt:
        phase, by = self._credit(index, proposal)
        return attempt_of(index, phase, replace(proposal, by=by), result, self._found, self._settings)

    def _credit(self, index: int, proposal: Proposal) -> tuple[str, str]:
        """The phase of an attempt and who proposed it; what the tuner drew is never credited to a model."""
        if proposal.by == "memory":
            return "memory", "memory"
        own = dict(proposal.parameters) == proposal.planner.defaults()
        if self._versions.get(proposal.planner.hash, 0) > 0:
            return "modifier", proposal.planner.origin if own else "tuner"
        proposed = any(proposal is p for p in self._proposed)
        by_expert = index == 0 and not self._cast.by_model("analyzer")
        if proposed or by_expert or self._settings.tuner == "off":
            return "analyzer", self._cast.player("analyzer")
        return "tuner", "tuner"

    def _modify(self, tuner: Tuner, ways: Sequence[AttackTemplate], found: Refinement) -> None:
        """Have planners whose share is used up rewritten, at most ``modifications`` times in a line."""
        for name in tuner.exhausted():
            changed = self._changed(name, ways, found)
            if changed is not None:
                fresh = _with_planner(ways, changed)
                tuner.add(fresh, 3 * len(fresh))

    def _rewritten(self, ways: Sequence[AttackTemplate], found: Refinement) -> list[Proposal]:
        """Without a tuner: the vehicle and moment of the best attempt whose planner can still be rewritten, with its
        new version."""
        for attempt in sorted(found.attempts, key=lambda a: (rank(a.verdict), a.verdict.min_distance)):
            tried = attempt.proposal
            changed = self._changed(tried.planner.hash, ways, found)
            if changed is not None:
                return [replace(tried, planner=changed, parameters=changed.defaults(), by=changed.origin)]
        return []

    def _changed(self, name: str, ways: Sequence[AttackTemplate], found: Refinement) -> Planner | None:
        """The modifier's new version of a planner, asked for once; None if there is none."""
        depth = self._versions.get(name, 0)
        known = {w.planner.hash: w.planner for w in ways} | self._new
        if name in self._asked or depth >= self._settings.modifications or name not in known:
            return None
        self._asked.add(name)
        entry = next(e for e in self._library if e.label == known[name].label)
        changed = self._cast.modify(known[name], found.attempts, entry)
        if changed is not None:
            self._versions[changed.hash] = depth + 1
            self._new[changed.hash] = changed
        return changed


def _with_planner(ways: Sequence[AttackTemplate], changed: Planner) -> list[AttackTemplate]:
    """The ways of a planner's mode, with another version of it."""
    same = {
        (w.delay, w.target.state.id): w
        for w in ways
        if (w.planner.label, w.planner.mode) == (changed.label, changed.mode)
    }
    return [AttackTemplate(w.delay, w.target, w.entry, changed) for w in same.values()]


def _untuned(
    intents: Sequence[Intent], ways: Sequence[AttackTemplate], remembered: Sequence[Proposal]
) -> list[Proposal]:
    """Without a tuner: what was remembered, then each intent's planners with their authors' numbers, in the analyzer's
    order, at the earliest moment there is."""
    plans = list(remembered)
    for intent in intents:
        mine = [w for w in ways if w.entry.label == intent.label and w.target.state.id == intent.bv]
        earliest = min((w.delay for w in mine), default=0.0)
        plans += [replace(w.proposal(None), acceleration=intent.acceleration) for w in mine if w.delay == earliest]
    return plans
