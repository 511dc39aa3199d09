"""Attacks that keep up with an ego that learns: each episode is an attempt of the search, or repeats an earlier one.

The search begins with attacks that were predicted to collide. From then on it tests the ego as it drives now, and
learns from the verdicts on the episodes. Attacks that came near are kept by the level of their last verdict. As the ego
learns to avoid some of them, they fall to a lower level. Every ``ATTEMPTS_PER_ROUND`` attempts, the search restarts
with the best ones and looks for others. Repeating and varying what is hard for the learner follows ACCEL (Parker-Holder
et al. 2022, "Evolving curricula with regret-based environment design").
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sumo_adv.datatypes import Level, Proposal, Verdict
from sumo_adv.goal import Goal
from sumo_adv.search.evolution import badness
from sumo_adv.search.search import AttackSearch

KNOWN_ATTACK_SHARE = 0.5  # share of episodes that repeat a known attack
MAX_ATTACKS_PER_LEVEL = 16  # the newest attacks of each level are kept
ATTEMPTS_PER_ROUND = 60  # attempts of the search before it restarts, because the ego has learnt
KNOWN_ATTACKS_PER_ROUND = 6  # number of known attacks that a round begins with
KEPT_DISTANCE_M = 3.0  # attacks that are not critical are kept only if they come nearer


class Curriculum:
    """The attacks of one encounter, by difficulty."""

    def __init__(self, search: AttackSearch, goal: Goal, first: Sequence[Proposal] = ()) -> None:
        """Start with a search.

        Args:
            search: A search that predicts nothing.
            goal: What an attack is meant to achieve.
            first: The attacks that the search tries first.
        """
        self._search, self._goal = search, goal
        search.begin_anew(first)
        self._known: dict[Level, list[tuple[Proposal, float]]] = {}  # with their badness, newest last
        self._tried = 0

    def next(self, draws: np.random.Generator) -> Proposal | None:
        """Return a known attack, or an attempt of the search.

        For a known attack, the level is drawn first; all levels are equally likely.

        Args:
            draws: The random generator.
        """
        levels = [level for level, known in self._known.items() if known]
        if levels and draws.random() < KNOWN_ATTACK_SHARE:
            known = self._known[levels[int(draws.integers(len(levels)))]]
            return known[int(draws.integers(len(known)))][0]
        if self._tried and self._tried % ATTEMPTS_PER_ROUND == 0:
            best = sorted((attack for known in self._known.values() for attack in known), key=lambda attack: attack[1])
            self._search.begin_anew([p for p, _ in best[:KNOWN_ATTACKS_PER_ROUND]])
        self._tried += 1
        proposed = self._search.propose(1)
        return proposed[0] if proposed else None

    def observe(self, attack: Proposal, verdict: Verdict) -> None:
        """Keep an attack by the level that it reached, and let the search learn from it.

        Args:
            attack: The attack.
            verdict: The verdict on the episode.
        """
        for known in self._known.values():
            known[:] = [(p, worth) for p, worth in known if p is not attack]
        self._search.observe(attack, None, verdict)
        near = verdict.counts and (verdict.level > Level.NONE or verdict.min_distance < KEPT_DISTANCE_M)
        if near:
            known = self._known.setdefault(verdict.level, [])
            known.append((attack, badness(verdict, self._goal)))
            del known[:-MAX_ATTACKS_PER_LEVEL]
