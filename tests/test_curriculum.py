"""Attacks that keep up with a learner: known ones by the level that they last came to, and attempts of the search."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from several_samples import pinch

from sumo_adv.datatypes import Level, Proposal, Verdict
from sumo_adv.goal import Goal
from sumo_adv.gym.curriculum import (
    ATTEMPTS_PER_ROUND,
    KNOWN_ATTACK_SHARE,
    KNOWN_ATTACKS_PER_ROUND,
    MAX_ATTACKS_PER_LEVEL,
    Curriculum,
)

MISS = Verdict(9.0, 20.0, False, False, True, False)
NEAR = replace(MISS, min_ttc=2.0, min_distance=1.0)
HIT = replace(MISS, min_ttc=0.0, min_distance=0.0, collided=True, level=Level.SERIOUS, delta_v=4.0)


class Search:
    """Proposes a new attack each time."""

    def __init__(self) -> None:
        self.proposed: list[Proposal] = []
        self.observed: list[Verdict] = []
        self.begun: list[list[Proposal]] = []

    def propose(self, budget: int) -> list[Proposal]:
        self.proposed.append(pinch("a", "b", ahead=float(len(self.proposed))))
        return [self.proposed[-1]]

    def observe(self, tried: Proposal, motion: object, verdict: Verdict) -> None:
        self.observed.append(verdict)

    def begin_anew(self, chosen: Sequence[Proposal]) -> None:
        self.begun.append(list(chosen))


def made() -> tuple[Curriculum, Search]:
    search = Search()
    curriculum = Curriculum(search, Goal(), [pinch("a", "b")])  # type: ignore[arg-type]
    assert len(search.begun.pop()) == 1
    return curriculum, search


def test_what_comes_nowhere_near_is_never_repeated() -> None:
    curriculum, search = made()
    draws = np.random.default_rng(0)
    for _ in range(20):
        attack = curriculum.next(draws)
        assert attack is search.proposed[-1]
        curriculum.observe(attack, MISS)
    assert len(search.observed) == 20


def test_each_level_is_repeated_as_often_however_many_attacks_reach_it() -> None:
    curriculum, search = made()
    draws = np.random.default_rng(0)
    attacks = [search.propose(1)[0] for _ in range(12)]
    for k, attack in enumerate(attacks):
        curriculum.observe(attack, HIT if k == 0 else NEAR)
    drawn = Counter(id(curriculum.next(draws)) for _ in range(400))
    serious, near = drawn[id(attacks[0])], sum(drawn[id(a)] for a in attacks[1:])
    assert abs(serious - 400 * KNOWN_ATTACK_SHARE / 2) < 40
    assert abs(near - 400 * KNOWN_ATTACK_SHARE / 2) < 40


def test_an_attack_that_the_ego_has_learnt_to_avoid_falls_to_a_lower_level_or_out() -> None:
    curriculum, search = made()
    draws = np.random.default_rng(0)
    attack = search.propose(1)[0]
    curriculum.observe(attack, HIT)
    assert attack in [curriculum.next(draws) for _ in range(20)]
    curriculum.observe(attack, MISS)
    assert attack not in [curriculum.next(draws) for _ in range(20)]


def test_the_search_begins_anew_with_the_most_serious_ones() -> None:
    curriculum, search = made()
    draws = np.random.default_rng(0)
    attacks = [search.propose(1)[0] for _ in range(MAX_ATTACKS_PER_LEVEL + 4)]
    for k, attack in enumerate(attacks):
        curriculum.observe(attack, HIT if k in (5, 6) else NEAR)
    while not search.begun:
        curriculum.next(draws)
    assert len(search.proposed) - len(attacks) == ATTEMPTS_PER_ROUND + 1
    assert len(search.begun[0]) == KNOWN_ATTACKS_PER_ROUND
    assert search.begun[0][:2] == [attacks[5], attacks[6]]
