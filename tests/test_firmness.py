"""Proposals weighed together with their neighbours: a fake scorer whose good place is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from random import Random

import pytest

from sumo_adv.datatypes import ObservedMotion, Planner, Proposal
from sumo_adv.planners.source import make_planner
from sumo_adv.search.expert import AT_LEAST_FIRMED, AVOIDABLE, FIRMED, Expert
from sumo_adv.search.robustness import ALONE, NEAR, NEIGHBOURS, alone, drawn, firm, firmed, varied

HEAD = "def endpoint(bv, ego, road, parameters, acc, horizon):\n    return {}\n"
WIDE = make_planner("Shift", "wide", 'PARAMETERS = {"gap": (0.0, -50.0, 50.0, "m", "where")}\n\n' + HEAD, "seed")
SHARP = make_planner("Shift", "sharp", 'PARAMETERS = {"gap": (0.0, -50.0, 50.0, "m", "there")}\n\n' + HEAD, "seed")
NOTHING = make_planner("Shift", "fixed", "PARAMETERS = {}\n\n" + HEAD, "seed")


class Road:
    """The wide planner hits from -50 m to 50 m, the sharp one only at 0 m sharp; a miss scores 3."""

    def __init__(self) -> None:
        self.asked = 0

    def score(self, proposals: Sequence[Proposal], seen: Sequence[ObservedMotion] | None = None) -> list[Proposal]:
        self.asked += len(proposals)
        return [replace(p, score=self._one(p), predicted={"hit": True}) for p in proposals]

    def heard(self, tried: Proposal, course: ObservedMotion) -> bool:
        return False

    def _one(self, p: Proposal) -> float:
        if p.planner is WIDE:
            return 0.4
        return 0.0 if abs(p.parameters["gap"]) < 1e-3 else 3.0


def proposal(planner: Planner, score: float, gap: float = 0.0) -> Proposal:
    numbers = {"gap": gap} if planner.parameters else {}
    return Proposal("bv", "Shift", planner, numbers, 0.0, 0.0, score=score, predicted={"hit": True})


def test_one_whose_neighbours_miss_loses_to_one_whose_neighbours_hit() -> None:
    """Sharp: alone 0, with five neighbours that miss (counted as 1.5) a mean of 7.5 / 6 = 1.25, half of it is 0.625."""
    sharp, wide = proposal(SHARP, 0.0), proposal(WIDE, 0.4)
    found = firmed([sharp, wide], Road().score, Random(1))
    assert len(found) == 2 * (1 + NEIGHBOURS) == 12
    assert found[0].score == pytest.approx(0.625)
    assert found[6].score == pytest.approx(0.4)
    assert [alone(p) for p in found[:2]] == [0.0, 3.0]  # what each was alone
    assert found[1].score == pytest.approx(0.5 * 3.0 + 0.5 * 1.25)
    assert all(firm(p) for p in found)
    assert [p.predicted[ALONE] for p in drawn(found)] == [0.0, 0.4]  # neighbours are not counted as drawn
    assert all(p.predicted["hit"] for p in found)


def test_a_neighbour_is_near() -> None:
    """0.04 of the range of 100 m are 4 m; five of them are 20 m."""
    draw = Random(2)
    gaps = [varied(proposal(WIDE, 0.4), draw, NEAR).parameters["gap"] for _ in range(300)]
    assert max(map(abs, gaps)) < 20.0
    assert 3.0 < sum(map(abs, gaps)) / 300 / 0.798 < 5.0  # the mean of |x| is 0.798 standard deviations
    assert varied(proposal(WIDE, 0.4), draw).predicted == {}


def test_the_expert_asks_neighbours_of_the_best_until_the_best_is_firm() -> None:
    road = Road()
    pool = [proposal(SHARP, 0.0), proposal(WIDE, 0.4), *(proposal(WIDE, 0.5, gap=float(k)) for k in range(20))]
    found = Expert(road, proposals=10, seed=1).firmed(pool)
    assert road.asked == AT_LEAST_FIRMED * NEIGHBOURS == 15
    assert len(found) == 22 + 15
    best = min(found, key=lambda p: p.score)
    assert best.planner is WIDE
    assert firm(best)
    again = Expert(road, proposals=10, seed=1).firmed(found)  # nothing new is asked
    assert (road.asked, again) == (15, found)


def test_nothing_is_asked_where_there_is_nothing_to_choose() -> None:
    road = Road()
    expert = Expert(road, proposals=10, seed=1)
    unavoidable = [proposal(WIDE, AVOIDABLE), proposal(WIDE, 3.0)]
    fixed = [proposal(NOTHING, 0.0), proposal(WIDE, 0.4)]  # without numbers there are no neighbours
    known = [replace(proposal(WIDE, 0.0), by="memory"), proposal(WIDE, 0.4)]  # it worked before
    assert expert.firmed([]) == []
    assert expert.firmed(unavoidable) == unavoidable
    assert expert.firmed(fixed) == fixed
    assert expert.firmed(known) == known
    assert road.asked == 0


def test_of_equals_a_firm_one_is_taken() -> None:
    """All wide ones score 0.4: after one round the first is firm, and nothing more is asked; before the first attempt
    the neighbours of three, later of eight."""
    pool = [proposal(WIDE, 0.4, gap=float(k)) for k in range(30)]
    for at_once in (AT_LEAST_FIRMED, FIRMED):
        road = Road()
        found = Expert(road, proposals=10, seed=1).firmed(pool, at_once=at_once)
        assert road.asked == at_once * NEIGHBOURS
        assert firm(min(found, key=lambda p: p.score))


def test_another_order_of_choice_is_made_firm_as_well() -> None:
    road = Road()
    pool = [proposal(WIDE, 0.4), proposal(WIDE, 0.6, gap=10.0)]
    found = Expert(road, proposals=10, seed=1).firmed(pool, lambda some: max(some, key=lambda p: p.score))
    assert all(firm(p) for p in found)
    assert road.asked == 2 * NEIGHBOURS


def test_what_the_tuner_varies_is_the_tuner_s() -> None:
    near = firmed([replace(proposal(WIDE, 0.4), by="memory")], Road().score, Random(1))
    assert [p.by for p in near] == ["memory", *["tuner"] * NEIGHBOURS]
