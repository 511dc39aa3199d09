"""Situations of several moments side by side: each row as it is alone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from situation_samples import KRAUSS, changed, crossing, neighbour, situation

from sumo_adv.datatypes import Limits, Planner, Proposal
from sumo_adv.geometry import Frame
from sumo_adv.planners.answers import Answer, PlannerObservation, world_endpoint
from sumo_adv.search.rollouts import Rollouts, predict
from sumo_adv.simulation.sumo_rules import SituationBatch, profile_at
from sumo_adv.situation import Situation

IDM = replace(KRAUSS, kind="idm")
ACROSS = replace(crossing(), state=replace(crossing().state, id="across"))
EARLY = situation([neighbour(), ACROSS], model=IDM)
LATE = changed(  # the ego is 7 m further on and turned, and will brake
    situation([neighbour(x=14.0, speed=9.0), ACROSS], model=IDM), frame=Frame(7.0, -3.0, 0.4),
    v=np.linspace(10.0, 6.0, 51), s=np.linspace(0.0, 40.0, 51), lane_width=3.0,
    junction=30.0, rule="m",
)  # fmt: skip
BOTH: Mapping[float, Situation] = {0.0: EARLY, 1.5: LATE}
PLANNER = Planner("any", "plain", "", (), "seed")
END = {"x": 45.0, "y": 0.0, "heading": 0.0, "speed": 6.0, "time": 4.0}


@given(st.floats(-1.0, 9.0))
def test_the_profiles_at_one_time_are_those_at_many(time: float) -> None:
    scenes = SituationBatch([EARLY, LATE, EARLY])
    s, v = scenes.profile_now(time)
    alone = [profile_at(situation, np.array([time])) for situation in (EARLY, LATE, EARLY)]
    assert s.tolist() == [float(a[0][0]) for a in alone] and v.tolist() == [float(a[1][0]) for a in alone]
    many = scenes.profile(np.array([0.0, time]))
    assert many[0][:, 1].tolist() == s.tolist() and many[1][:, 1].tolist() == v.tolist()


@given(st.lists(st.floats(-20.0, 400.0), min_size=3, max_size=3), st.floats(-5.0, 5.0))
def test_places_on_the_egos_paths_and_in_their_frames_are_those_of_each(stations: list[float], offset: float) -> None:
    rows, s, d = (LATE, EARLY, LATE), np.array(stations), np.full(3, offset)
    scenes = SituationBatch(rows)
    world = scenes.ego_at(s, d)
    local = scenes.to_local(*world)
    for k, scene in enumerate(rows):
        x, y, h = scene.baseline.path.at(s[k : k + 1], d[k : k + 1])
        assert [q[k] for q in world] == [x[0], y[0], h[0]]
        assert [q[k] for q in local] == [q[0] for q in scene.frame.to_local(x, y, h)]


def roll(proposals: Sequence[Proposal]) -> Rollouts:
    """Every adversary is sent into the ego's lane."""

    def ask(rows: Sequence[int], told: Sequence[PlannerObservation]) -> list[Answer | None]:
        return [Answer(world_endpoint(BOTH[p.delay], END)) for p in proposals]

    return predict(BOTH, proposals, ask, limits=Limits(), steps=60, replan=5)


def test_attacks_at_different_moments_go_together_as_each_goes_alone() -> None:
    """They are exactly equal: a prediction does not depend on the other predictions in its batch."""
    proposals = [Proposal(bv, "any", PLANNER, {}, 0.0, delay) for bv in ("bv", "across") for delay in (0.0, 1.5)]
    together = roll(proposals)
    for k, proposal in enumerate(proposals):
        alone = roll([proposal])
        for a, b in zip((*together.ego, *together.adversary), (*alone.ego, *alone.adversary), strict=True):
            assert a[k].tolist() == b[0].tolist()
    assert together.ego[0][1, 0] == pytest.approx(EARLY.baseline.path.at(np.array([0.0]))[0][0])
    assert together.ego[3][:, 1] == pytest.approx([10.0, 9.92, 10.0, 9.92])  # the late ego slows down by itself
    assert math.isclose(together.adversary[3][0, 0], 12.0) and math.isclose(together.adversary[3][1, 0], 9.0)
