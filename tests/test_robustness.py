"""Proposals weighed together with their neighbours: a fake scorer with a known good place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from random import Random

import pytest
from situation_samples import neighbour, situation

from sumo_adv.datatypes import ObservedMotion, Planner, Prediction, Proposal
from sumo_adv.planners.source import make_planner
from sumo_adv.search.robustness import drawn, is_robust, weighed_with_neighbours
from sumo_adv.search.sampling import varied
from sumo_adv.search.search import AttackSearch
from sumo_adv.search.settings import RobustnessSettings, SearchSettings

WEIGHTS = RobustnessSettings()
HEAD = "def endpoint(bv, ego, road, parameters, acc, horizon):\n    return {}\n"
WIDE = make_planner("Shift", "wide", 'PARAMETERS = {"gap": (0.0, -50.0, 50.0, "m", "where")}\n\n' + HEAD, "seed")
SHARP = make_planner("Shift", "sharp", 'PARAMETERS = {"gap": (0.0, -50.0, 50.0, "m", "there")}\n\n' + HEAD, "seed")
NOTHING = make_planner("Shift", "fixed", "PARAMETERS = {}\n\n" + HEAD, "seed")


class Road:
    """The wide planner hits from -50 m to 50 m, the sharp one only at 0 m sharp; a miss scores 3."""

    def __init__(self) -> None:
        self.asked = 0

    def score(self, proposals: Sequence[Proposal], motions: Sequence[ObservedMotion] | None = None) -> list[Proposal]:
        self.asked += len(proposals)
        return [replace(p, score=self._one(p), prediction=Prediction(hit=True)) for p in proposals]

    def _one(self, p: Proposal) -> float:
        if p.planner is WIDE:
            return 0.4
        return 0.0 if abs(p.parameters["gap"]) < 1e-3 else 3.0


def proposal(planner: Planner, score: float, gap: float = 0.0) -> Proposal:
    numbers = {"gap": gap} if planner.parameters else {}
    return Proposal("bv", "Shift", planner, numbers, 0.0, 0.0, score=score, prediction=Prediction(hit=True))


def search_over(road: Road, pool: Sequence[Proposal]) -> AttackSearch:
    """A search that has these candidates alone, and would draw no more."""
    weights = SearchSettings(proposals=10)
    sampling = replace(weights.sampling, for_spare=-10, most=0)
    search = AttackSearch(road, {0.0: situation([neighbour()])}, [], replace(weights, sampling=sampling), seed=1)
    search.pool = list(pool)
    return search


def test_one_whose_neighbours_miss_loses_to_one_whose_neighbours_hit() -> None:
    """Sharp: alone 0, with five neighbours that miss (counted as 1.5) a mean of 7.5 / 6 = 1.25, half of it is 0.625."""
    sharp, wide = proposal(SHARP, 0.0), proposal(WIDE, 0.4)
    weighed = weighed_with_neighbours([sharp, wide], Road().score, Random(1), WEIGHTS)
    assert len(weighed) == 2 * (1 + WEIGHTS.neighbours) == 12
    assert weighed[0].score == pytest.approx(0.625)
    assert weighed[6].score == pytest.approx(0.4)
    assert [p.nominal_score for p in weighed[:2]] == [0.0, 3.0]  # what each was alone
    assert weighed[1].score == pytest.approx(0.5 * 3.0 + 0.5 * 1.25)
    assert all(is_robust(p) for p in weighed)
    assert [p.nominal for p in drawn(weighed)] == [0.0, 0.4]  # neighbours are not counted as drawn
    assert all(p.prediction is not None and p.prediction.hit for p in weighed)


def test_a_neighbour_is_near() -> None:
    """0.04 of the range of 100 m are 4 m; five of them are 20 m."""
    draw = Random(2)
    gaps = [varied(proposal(WIDE, 0.4), draw, WEIGHTS.spread).parameters["gap"] for _ in range(300)]
    assert max(map(abs, gaps)) < 20.0
    assert 3.0 < sum(map(abs, gaps)) / 300 / 0.798 < 5.0  # the mean of |x| is 0.798 standard deviations
    assert varied(proposal(WIDE, 0.4), draw, WEIGHTS.spread).prediction is None


def test_neighbours_of_the_best_are_predicted_until_the_best_is_robust() -> None:
    """Sharp seems best, and three candidates are weighed with their neighbours: then a wide one is best, and robust."""
    road = Road()
    pool = [proposal(SHARP, 0.0), proposal(WIDE, 0.4), *(proposal(WIDE, 0.5, gap=float(k)) for k in range(20))]
    search = search_over(road, pool)
    (best,) = search.propose(1)
    assert road.asked == WEIGHTS.first * WEIGHTS.neighbours == 15
    assert len(search.pool) == 22 + 15 - 1
    assert is_robust(best) and is_robust(least := min(search.pool, key=lambda p: p.score)) and least.planner is WIDE


@pytest.mark.parametrize("pool", [
    [proposal(WIDE, 0.95), proposal(WIDE, 3.0)],  # not avoidable
    [proposal(NOTHING, 0.0), proposal(WIDE, 0.4)],  # without parameters there are no neighbours
    [replace(proposal(WIDE, 0.0), by="memory"), proposal(WIDE, 0.4)],  # it succeeded before
])  # fmt: skip
def test_nothing_is_predicted_where_there_is_nothing_to_choose(pool: list[Proposal]) -> None:
    road = Road()
    assert search_over(road, pool).propose(1) == pool[:1]
    assert road.asked == 0


def test_of_equals_a_robust_one_is_taken() -> None:
    """All wide ones score 0.4: before the first attempt the neighbours of three are predicted, later of eight."""
    road = Road()
    search = search_over(road, [proposal(WIDE, 0.4, gap=float(k)) for k in range(30)])
    (first,) = search.propose(1)
    assert road.asked == WEIGHTS.first * WEIGHTS.neighbours and is_robust(first)
    unlike = proposal(WIDE, 0.1, gap=40.0)
    search.pool.append(unlike)
    (second,) = search.propose(1)
    assert road.asked == (WEIGHTS.first + WEIGHTS.later) * WEIGHTS.neighbours and is_robust(second)


def test_neighbours_are_the_search_s_own() -> None:
    remembered = replace(proposal(WIDE, 0.4), by="memory")
    near = weighed_with_neighbours([remembered], Road().score, Random(1), WEIGHTS)
    assert [p.by for p in near] == ["memory", *["tuner"] * WEIGHTS.neighbours]
