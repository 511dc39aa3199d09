"""Free motions: where they aim, and what an attempt of one is called."""

from __future__ import annotations

from dataclasses import replace

import pytest
from situation_samples import crossing, leader, neighbour, situation

from sumo_adv.datatypes import LibraryEntry, Proposal, Verdict
from sumo_adv.search.intents import FREE, FREE_MOTION, entry_of, labelled_by_motion
from sumo_adv.search.sampling import templates_of
from sumo_adv.situation import Target

BRAKING = LibraryEntry("Emergency Braking", "It brakes.", ("leader",), ())
MISS = Verdict(1.0, 2.0, False, False, True, False, ())


def free(bv: str) -> Proposal:
    planner = FREE.planners[0]
    return Proposal(bv, FREE_MOTION, planner, planner.defaults(), 0.0, 0.0)


@pytest.mark.parametrize(
    ("target", "side", "label"),
    [
        (leader(), "front", "Emergency Braking"),
        (neighbour(), "front", "Aggressive Cut-in"),
        (neighbour(), "left", "Straight Lane Shift"),
        (neighbour(), "rear", "Close Car-following"),
        (leader(), "left", FREE_MOTION),
        (crossing(), "right", "Intersection Rush-through Go-straight"),
    ],
)
def test_one_that_hits_is_named_by_where_it_came_from_and_the_side_that_it_hits(
    target: Target, side: str, label: str
) -> None:
    hit = replace(MISS, collided=True, contact_side=side)
    found = labelled_by_motion(free(target.state.id), target, hit)
    assert (found.label, found.planner.label) == (label, label)
    assert entry_of(found, [BRAKING, FREE]) is FREE  # it was drawn from there, also where the library knows the label
    changed = replace(found, planner=replace(found.planner, text="changed by a model"))
    assert entry_of(changed, [BRAKING, FREE]) is (BRAKING if label == "Emergency Braking" else FREE)


def test_one_that_misses_keeps_its_name() -> None:
    assert labelled_by_motion(free("bv"), neighbour(), MISS).label == FREE_MOTION


def test_every_vehicle_on_a_way_to_the_ego_may_try_one() -> None:
    scene = situation([neighbour()])
    assert [t.entry.label for t in templates_of({0.0: scene}, [FREE])] == [FREE_MOTION]
