"""Refine the attack in an encounter: try candidates until enough attempts succeed or the budget is used up.

The search proposes candidates and observes how the ego drove. The modifier is asked for changes (``repairs.py``) if a
planner's share of attempts is used up or, in a fixed order without the search, if no candidate is left. Every attempt
records its proposer.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from random import Random
from typing import Any

from sumo_adv.agents.agents import Agents
from sumo_adv.config import Settings
from sumo_adv.datatypes import AttackerRole, Attempt, Ending, Intent, Level, LibraryEntry, Proposal, Verdict
from sumo_adv.episode.assessment import Attempts, Fitting, attempt_of, checked, confirmed, observed_motion
from sumo_adv.episode.clock import PartsClock
from sumo_adv.episode.neighbours import Robustness, holds, neighbours
from sumo_adv.episode.order import best_index, worth
from sumo_adv.episode.repairs import Repairs
from sumo_adv.episode.run import EncounterRecord
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.errors import ModelError
from sumo_adv.goal import Goal
from sumo_adv.search.ranking import FixedOrder, as_written, chosen_candidates
from sumo_adv.search.search import AttackSearch

GENERATION_ATTEMPTS = 8  # candidates chosen at a time; fixed, so that results do not depend on the number of cores
FULL_GENERATION_AFTER_ATTEMPTS = 2 * GENERATION_ATTEMPTS  # fewer are chosen at a time before: most searches end early
MAX_ATTEMPTS_WITHOUT_GAIN = 120  # attempts without a higher level after which the next encounter is tried, if any
MAX_ATTEMPTS_WITHOUT_DANGER = 40  # the same number if no attempt has been critical
BROKEN_ATTEMPTS = 5  # attempts after which a run ends if the ego's driver or SUMO failed in all of them
MAX_ATTEMPTS_FOR_ROBUST = 24  # attempts after the first success of a kind in which a robust one is still searched for
FIRST_KEPT_ATTEMPTS, BEST_KEPT_ATTEMPTS = 25, 10  # the first and the best attempts keep their recorded states
FAVOURITE_INTENTS = 2  # intents that are tried first if a model's answers disagree
Optimizer = AttackSearch | FixedOrder
"""Proposes candidates (``propose``) and learns from the attempts (``observe``)."""


@dataclass(slots=True)
class Refinement:
    """The attempts of an encounter so far.

    Attributes:
        goal: What an attempt must reach.
        attempts: The attempts in order; ``results[k]`` belongs to ``attempts[k]``.
        results: The results of the attempts. Those that no longer matter lose their recorded states.
        ending: How the attempts ended.
        reason: Why they ended, as a sentence; empty after a success.
        clock: How long each part took.
        first_success_seconds: Time from the start of the search to the first success [s]; None without a success.
        successes: Indices of the attempts that reached the goal, one of each kind.
        robust: By index of a success, in how many of its neighbours it holds.
        fitting: Compares attempts with the request; None without a request.
    """

    goal: Goal = field(default_factory=Goal)
    attempts: list[Attempt] = field(default_factory=list)
    results: list[AttemptResult] = field(default_factory=list)
    ending: Ending = Ending.ATTEMPTS_EXHAUSTED
    reason: str = ""
    clock: PartsClock = field(default_factory=PartsClock)
    first_success_seconds: float | None = None
    successes: list[int] = field(default_factory=list)
    robust: dict[int, Robustness] = field(default_factory=dict)
    fitting: Fitting | None = None

    @property
    def best(self) -> int | None:
        """The index of the best attempt; None without attempts."""
        return best_index(self.attempts, self.goal, self.robust, asked=self.fitting is not None)

    @property
    def level(self) -> Level:
        """The highest level of the attempts so far."""
        return max((a.verdict.level for a in self.attempts), default=Level.NONE)

    def all_ended(self, ending: str) -> bool:
        """Return whether there are attempts and all of them ended in the same given way.

        Args:
            ending: The way (``Attempt.ending``).
        """
        return bool(self.attempts) and all(a.ending == ending for a in self.attempts)

    def end_if_all_failed(self) -> None:
        """Set the ending to ``PLANNER_FAILED`` or ``SIMULATION_FAILED`` if this failure ended all attempts."""
        for way, ending in (("planner_failed", Ending.PLANNER_FAILED), ("crashed", Ending.SIMULATION_FAILED)):
            if self.all_ended(way):
                self.ending, self.reason = ending, self.attempts[-1].message

    def recorded(self, record: EncounterRecord) -> EncounterRecord:
        """Return a record with these attempts added.

        Args:
            record: The record of the encounter.
        """
        readings = {} if self.fitting is None else dict(self.fitting.readings)
        record = replace(
            record, goal=self.goal, attacked=True, attempts=tuple(self.attempts), results=tuple(self.results),
            successes=tuple(self.successes), robust=dict(self.robust), readings=readings,
            first_success_seconds=self.first_success_seconds, ending=self.ending, reason=self.reason,
        )  # fmt: skip
        return record.took(self.clock.seconds)


def settle_best(done: Refinement, runner: Attempts) -> None:
    """Confirm the best attempt with all reference drivers.

    If its level falls, another attempt may be the best. This is repeated until the best attempt keeps its level.

    Args:
        done: The attempts. Confirmed attempts are replaced in it.
        runner: Runs the reference drivers.
    """
    while (k := done.best) is not None:
        attempt = confirmed(done.attempts[k], done.results[k], runner, all_drivers=True)
        held = attempt.verdict.level == done.attempts[k].verdict.level
        done.attempts[k] = attempt
        if held:
            return


def settle_roles(done: Refinement, runner: Attempts) -> None:
    """Find which attackers forced the contact of the best attempt.

    The attempt is simulated once more for each attacker that did not touch the ego, without its attack.

    Args:
        done: The attempts. The best one is replaced in it.
        runner: Runs the simulations.
    """
    k = done.best
    others = () if k is None or not runner.repeats else done.attempts[k].verdict.attackers[1:]
    if k is None or not others or not done.attempts[k].verdict.collided:
        return
    attempt = done.attempts[k]
    without = runner.attempt([attempt.proposal.without(each.id) for each in others])
    settled = [
        replace(each, role=AttackerRole.FORCED) if _missed(result) else each
        for each, result in zip(others, without, strict=True)
    ]
    attackers = (attempt.verdict.attackers[0], *settled)
    done.attempts[k] = replace(attempt, verdict=replace(attempt.verdict, attackers=attackers))


def _missed(result: AttemptResult) -> bool:
    """Return whether an attempt was judged and the ego touched no adversary in it."""
    return result.verdict is not None and not result.verdict.collided


class Refiner:
    """Runs the attempts of one encounter."""

    def __init__(
        self, runner: Attempts, found: FoundEncounter, search: AttackSearch, agents: Agents,
        library: Sequence[LibraryEntry], settings: Settings, tell: Callable[[str, Any], None], *, another: bool = False,
        ends_at: float = math.inf,
    ) -> None:  # fmt: skip
        """Prepare the attempts; nothing is simulated yet.

        Args:
            runner: Runs the attempts.
            found: The encounter.
            search: Proposes candidates.
            agents: The analyzer, generator and modifier.
            library: The intents with their planners.
            settings: The run's settings.
            tell: Called with each attempt.
            another: Whether another encounter may follow. If so, this encounter is left if the attempts do not improve.
            ends_at: When the run should end, as ``time.perf_counter()`` [s].
        """
        self._another, self._ends_at = another, ends_at
        self._runner, self._found, self._search, self._agents = runner, found, search, agents
        self._library, self._settings, self._tell = library, settings, tell
        self._repairs = Repairs(agents, found, library, (), settings)
        self._settled = set[str]()  # kinds of successes that are no longer searched for
        self._favourites: list[Proposal] = []  # candidates that are tried first if the model's answers disagree

    def run(self, intents: Sequence[Intent], done: Refinement) -> None:
        """Run attempts until enough kinds of attack succeeded (``settings.diverse``), or until the attempts must end.

        They end if the budget or the candidates are used up, if the first ``BROKEN_ATTEMPTS`` or more have all crashed,
        and, if another encounter may follow, if they do not improve.

        Args:
            intents: The intents, as the analyzer ranked them.
            done: Collects the attempts. Its ending and reason say how they ended.

        Raises:
            ModelError: A model that plays an agent failed. ``done`` then holds the attempts before the failure. If the
                reader failed, the last of them is the attempt that it was to read, as the rules judge it.
        """
        with done.clock.part("prediction"):
            self._search_attack(intents, done)

    def _search_attack(self, intents: Sequence[Intent], done: Refinement) -> None:
        """Propose candidates and try them, within the clock's part ``prediction``."""
        began = time.perf_counter()
        optimizer = self.optimizer(intents)
        while len(done.attempts) < self._settings.attempts:
            if self._late(began, done):
                break
            if self._another and (vain := _in_vain(done)):
                done.reason = f"The last {vain} attempts brought no improvement, and another encounter may follow."
                break
            plans = self._next(optimizer, done)
            if not plans:
                done.reason = self._why_ended(optimizer, done)
                break
            with done.clock.part("attempts"):
                ended = self._try(plans, done, began, optimizer)
            if ended:
                break
            if len(done.attempts) >= BROKEN_ATTEMPTS and done.all_ended("crashed"):
                break
            self._observe(optimizer, done, plans)
            self._forget(done)
        if done.successes:
            done.reason = ""
        done.end_if_all_failed()
        with done.clock.part("references"):
            settle_best(done, self._runner)
            settle_roles(done, self._runner)
        best = done.best
        in_time = time.perf_counter() < self._ends_at
        if in_time and done.successes and best is not None and best not in done.robust and self._runner.repeats:
            self._try_neighbours(done, best)

    def optimizer(self, intents: Sequence[Intent]) -> Optimizer:
        """Prepare what proposes the candidates.

        If a model plays the analyzer and nothing is recalled from memory, the candidates that the model chose join
        those of the search, and its ranking of the intents counts. If its answers disagree, the best candidates of its
        first ``FAVOURITE_INTENTS`` intents are tried first.

        Args:
            intents: The intents, as the analyzer ranked them.

        Returns:
            The search or, with ``tuner = off``, a fixed order.
        """
        recalled = [p for p in self._search.pool if p.by == "memory"]
        modelled = self._agents.by_model("analyzer") and not recalled
        templates = self._search.follow(intents, self._library, in_their_order=modelled)
        self._repairs = Repairs(self._agents, self._found, self._library, templates, self._settings)
        if self._settings.tuner == "off":
            return FixedOrder(as_written(intents, templates, recalled))
        if modelled:
            player = self._agents.player("analyzer")
            self._search.add_chosen([replace(p, by=player) for i in intents for p in chosen_candidates(i, templates)])
            favourites = intents[:FAVOURITE_INTENTS] if self._agents.undecided else ()
            taken = [self._search.take_best(i.bv, i.label) for i in favourites]
            self._favourites = [p for p in taken if p is not None]
        return self._search

    def _next(self, optimizer: Optimizer, done: Refinement) -> list[Proposal]:
        """Return the candidates to try next: the favourites first, then few at a time, later whole generations."""
        left = self._settings.attempts - len(done.attempts)
        if not done.attempts and self._favourites:
            return [self._search.completed(p) for p in self._favourites[:left]]
        if isinstance(optimizer, AttackSearch):
            with done.clock.part("modifier"):
                self._modify(optimizer, done)
        size = FAVOURITE_INTENTS if self._agents.undecided else 1
        budget = min(
            GENERATION_ATTEMPTS
            if len(done.attempts) >= FULL_GENERATION_AFTER_ATTEMPTS
            else size
            if not done.attempts
            else 2,
            left,
        )
        plans = optimizer.propose(budget)
        plans = plans or (self._repairs.next(_tried(done)) if isinstance(optimizer, FixedOrder) else [])
        return [self._search.completed(p) for p in plans]

    def _try(self, plans: Sequence[Proposal], done: Refinement, began: float, optimizer: Optimizer) -> bool:
        """Run candidates; return whether enough kinds succeeded or the time is used up, and drop the rest then."""
        for proposal, result in zip(plans, self._runner.attempt(plans), strict=True):
            attempt = self._attempt(len(done.attempts), proposal, result)
            with done.clock.part("references"):
                attempt = checked(attempt, result, self._runner, done.goal, done.level)
            try:
                attempt, failure = _fitted(done, attempt, result), None
            except ModelError as error:  # the reader failed: the rules alone judge this attempt, and the run ends
                attempt, failure = _fitted(done, attempt, result, read=False), error
            done.attempts.append(attempt)
            done.results.append(result)
            self._tell("attempt", attempt)
            met = done.goal.met(attempt.verdict)
            if met:
                self._keep(attempt, done, began)
            if failure is not None:
                raise failure
            if met and self._runner.repeats and time.perf_counter() < self._ends_at:
                for tried, verdict in self._try_neighbours(done, attempt.index):
                    optimizer.observe(tried, None, verdict)
            if self._enough(done) or self._late(began, done):
                return True
        return False

    def _late(self, began: float, done: Refinement) -> bool:
        """Return whether the time for attempts is used up; if so, set this as the reason."""
        now, seconds = time.perf_counter(), self._settings.seconds
        if now - began >= seconds:
            done.reason = f"The {seconds:g} s for attempts were used up."
        elif now >= self._ends_at:
            done.reason = "The time of the run was used up."
        return now >= min(began + seconds, self._ends_at)

    def _forget(self, done: Refinement) -> None:
        """Drop the recorded states of attempts that no longer matter; they take a megabyte each."""
        kept = set(range(len(done.attempts) - GENERATION_ATTEMPTS, len(done.attempts))) | set(done.successes)
        asked = done.fitting is not None
        ordered = sorted(range(len(done.attempts)), key=lambda k: worth(done.attempts[k], done.goal, asked=asked))
        kept |= set(ordered[:BEST_KEPT_ATTEMPTS])
        for k, result in enumerate(done.results):
            if k >= FIRST_KEPT_ATTEMPTS and k not in kept and len(result.snapshots):
                done.results[k] = replace(result, snapshots=(), sizes={})

    def _try_neighbours(self, done: Refinement, index: int) -> list[tuple[Proposal, Verdict]]:
        """Simulate the neighbours of a success, note in how many it holds, and return them with their verdicts."""
        random, dt = Random(self._settings.seed), self._settings.step_length
        attempt, result = done.attempts[index], done.results[index]
        near = neighbours(attempt, result, random, dt, displaces=self._runner.displaces)
        with done.clock.part("robustness"):
            tried = [
                _fitted(done, self._attempt(len(done.attempts), p, r), r, read=False)
                for p, r in zip(near, self._runner.attempt(near), strict=True)
            ]
        done.robust[index] = Robustness(sum(holds(a.verdict, done.goal) for a in tried), len(tried))
        return [(p, a.verdict) for p, a in zip(near, tried, strict=True)]

    def _keep(self, attempt: Attempt, done: Refinement, began: float) -> None:
        """Note a success; ``successes`` lists only the first one of each kind."""
        if done.first_success_seconds is None:
            done.ending, done.reason = Ending.GOAL_MET, ""
            done.first_success_seconds = time.perf_counter() - began
        if attempt.kind not in {done.attempts[k].kind for k in done.successes}:
            done.successes.append(attempt.index)

    def _enough(self, done: Refinement) -> bool:
        """Return whether enough kinds of attack succeeded, and tell the search about the new ones that count.

        A kind counts if one of its successes is robust, or if no robust one was found in the
        ``MAX_ATTEMPTS_FOR_ROBUST`` attempts after the first success of the kind. If successes cannot be repeated, or
        with ``tuner = off``, every kind with a success counts.
        """
        last, settled = len(done.attempts) - 1, set[str]()
        for k in done.successes:
            kind = done.attempts[k].kind
            given_up = self._settings.tuner == "off" or not self._runner.repeats or last - k >= MAX_ATTEMPTS_FOR_ROBUST
            if given_up or kind in _robust_kinds(done):
                settled.add(kind)
        for kind in sorted(settled - self._settled):
            self._search.succeeded(kind)
        self._settled |= settled
        return len(settled) >= self._settings.diverse

    def _observe(self, optimizer: Optimizer, done: Refinement, plans: Sequence[Proposal]) -> None:
        """Pass the verdicts and the ego's motions in the last attempts to the optimizer."""
        count = len(plans)
        for plan, attempt, result in zip(plans, done.attempts[-count:], done.results[-count:], strict=True):
            motion = observed_motion(result, self._found, plan.delay, self._settings)
            optimizer.observe(plan, motion, attempt.verdict)

    def _why_ended(self, optimizer: Optimizer, done: Refinement) -> str:
        if isinstance(optimizer, AttackSearch):
            return optimizer.result
        return "Nothing was left to try." if done.attempts else "There was nothing to try."

    def _attempt(self, index: int, proposal: Proposal, result: AttemptResult) -> Attempt:
        phase, by = self._credit(index, proposal)
        return attempt_of(index, phase, replace(proposal, by=by), result, self._found, self._settings)

    def _credit(self, index: int, proposal: Proposal) -> tuple[str, str]:
        """Return the phase of an attempt and its proposer.

        The search's own candidates are never credited to a model.
        """
        if proposal.by == "memory":
            return "memory", "memory"
        if self._repairs.made(proposal):
            return "modifier", self._agents.player("modifier")
        if proposal.planner.hash in self._repairs.versions:
            own = dict(proposal.parameters) == proposal.planner.defaults()
            return "modifier", proposal.planner.origin if own else "tuner"
        player = self._agents.player("analyzer")
        by_expert = index == 0 and not self._agents.by_model("analyzer")
        if proposal.by == player or by_expert or self._settings.tuner == "off":
            return "analyzer", player
        return "tuner", "tuner"

    def _modify(self, search: AttackSearch, done: Refinement) -> None:
        """Ask the modifier to change planners whose attempts are used up, and add the changes to the search."""
        for name in search.exhausted():
            for candidate in self._repairs.next(_tried(done), only=name):
                if candidate.planner.hash in self._repairs.versions:
                    search.add_version(candidate.planner)
                else:
                    search.add_chosen([candidate])


def _fitted(done: Refinement, attempt: Attempt, result: AttemptResult, *, read: bool = True) -> Attempt:
    """Compare an attempt with the request, if there is one."""
    return attempt if done.fitting is None else done.fitting.judged(attempt, result, done.goal, read=read)


def _robust_kinds(done: Refinement) -> set[str]:
    return {done.attempts[k].kind for k, seen in done.robust.items() if seen.enough}


def _in_vain(done: Refinement) -> int:
    """Count the attempts since the first one of the highest level, including it; 0 if they are too few to leave."""
    levels = [done.goal.reached(a.verdict) for a in done.attempts]
    since = len(levels) - levels.index(max(levels)) if levels else 0
    enough = MAX_ATTEMPTS_WITHOUT_GAIN if levels and max(levels) >= Level.CRITICAL else MAX_ATTEMPTS_WITHOUT_DANGER
    return since if since >= enough else 0


def _tried(done: Refinement) -> list[tuple[Attempt, AttemptResult]]:
    return list(zip(done.attempts, done.results, strict=True))
