"""The mildest variant of an attack: what counts as mild, and when the search for it ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest

from sumo_adv.datatypes import Level, ObservedMotion, Parameter, Planner, Prediction, Proposal
from sumo_adv.episode.minimise import MAX_ROUNDS_WITHOUT_GAIN, Minimiser

PLANNER = Planner("Shift", "side", "", (Parameter("push", 5.0, 0.0, 10.0, "m/s2", "how hard"),), "seed")
FIRST = Proposal("bv", "Shift", PLANNER, {"push": 8.0}, 0.0, 0.0)


class ByPush:
    """The acceleration is the parameter; below 3 m/s2 there is no collision. The ego's delta-v is 1 m/s."""

    def score(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        return [replace(p, score=0.0, prediction=self.of(p)) for p in proposals]

    def of(self, p: Proposal) -> Prediction:
        push = p.parameters["push"]
        return Prediction(acceleration=push, delta_v=1.0, level=Level.SERIOUS if push >= 3.0 else Level.CRITICAL)

    def observe(self, tried: Proposal, motion: ObservedMotion) -> bool:
        return False


def minimiser(starts: Sequence[float] = (0.0,)) -> Minimiser:
    return Minimiser(ByPush(), FIRST, 9.0, Level.SERIOUS, starts, seed=1)


def test_harshness_is_the_acceleration_the_delta_v_and_how_early_it_begins() -> None:
    """8 m/s2 and 1 m/s; beginning 3 s before the latest start counts 0.6."""
    search = minimiser((0.0, 1.5, 3.0))
    assert search.harshness_of(8.0, 1.0, 0.0) == pytest.approx(9.6)
    assert search.harshness_of(8.0, 1.0, 3.0) == pytest.approx(9.0)


def test_it_comes_down_to_the_least_that_still_reaches_the_level_and_ends() -> None:
    search, attempts = minimiser(), 0
    while (p := search.propose()) is not None:
        seen = ByPush().of(p)
        attempts += 1
        search.observe(p, seen.level, search.harshness_of(seen.acceleration, seen.delta_v, p.delay))
    assert 3.0 <= search.best.parameters["push"] < 3.3
    assert search.harshness == pytest.approx(search.best.parameters["push"] + 1.0)
    assert attempts < 20


def test_a_variant_that_does_not_reach_the_level_in_the_simulation_is_not_the_best() -> None:
    search = minimiser()
    for _ in range(MAX_ROUNDS_WITHOUT_GAIN):
        variant = search.propose()
        assert variant is not None and not search.observe(variant, Level.VALID, 1.0)
    assert search.propose() is None
    assert (search.best, search.harshness) == (FIRST, 9.0)
