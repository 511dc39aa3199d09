"""SUMO's edges along the ego's way: who comes onto one beside the ego, and who was in its lane on another one.

The ego starts at station 0 with 10 m/s in a lane 3.2 m wide; on its way edges begin at 0, 40 and 60 m. The other
vehicle is 5 m long and 2 m wide: at 2.5 m to the left its side is 0.1 m over the line, at 2.7 m it is not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from situation_samples import KRAUSS, leader, neighbour, situation

from sumo_adv.datatypes import Floats, Ints
from sumo_adv.planning.drivers import PredictedEgos
from sumo_adv.planning.edges import NOWHERE, Edges, begins_of, edge_at
from sumo_adv.planning.ground import Ground
from sumo_adv.planning.scenes import Scenes
from sumo_adv.situation import Situation

ON = ((0.0, "in"), (40.0, ":centre"), (60.0, "out"))


def one(value: float) -> Floats:
    return np.array([value])


def on(edge: int) -> Ints:
    return np.array([edge], np.intp)


def road() -> Situation:
    sides = ((3.2, "same"), (-3.2, "same"))
    return replace(situation([leader()], model=KRAUSS), edges=ON, ego_sides=sides)


def edges() -> Edges:
    return Edges(Scenes([road()]), one(5.0), one(2.0))


def test_the_edge_at_a_station() -> None:
    begins = begins_of([road(), situation([leader()])])
    assert begins.tolist() == [[0.0, 40.0, 60.0], [np.inf] * 3]
    stations = np.array([-3.0, 39.9, 40.0, 75.0])
    assert edge_at(begins[[0, 0, 0, 0]], stations).tolist() == [0, 0, 1, 2]
    assert edge_at(begins[[1]], one(50.0)).tolist() == [0]  # nothing is known of its edges


@pytest.mark.parametrize(("left", "steps"), [(2.5, 4), (-2.5, 4), (2.7, 0)])
def test_who_comes_onto_an_edge_over_the_line_is_in_both_lanes_for_its_length(left: float, steps: int) -> None:
    """At 10 m/s it comes 1 m a step: of 5 - 0.3 = 4.7 m are left 3.7, 2.7, 1.7, 0.7 and none."""
    found = edges()
    assert not found.step(on(0), one(left), one(10.0))[0]
    assert not found.comes[0]  # where it was from the start it does not come onto
    seen = []
    for k in range(8):
        assert found.step(on(1), one(left), one(10.0))[0] == (k == 0)
        seen.append(bool(found.comes[0]))
    assert seen == [True] * steps + [False] * (8 - steps)
    assert found.came[0] == (steps > 0)


def test_it_came_over_the_line_until_it_is_on_the_next_edge() -> None:
    found = edges()
    for edge, left in ((0, 2.5), (1, 2.5), (2, 3.2)):
        found.step(on(edge), one(left), one(10.0))
    assert not found.came[0]
    found.step(on(NOWHERE), one(2.5), one(10.0))  # onto an edge that is not the ego's
    assert not found.came[0]
    assert not found.comes[0]


def test_room_is_made_on_one_and_the_same_edge_only() -> None:
    """The ego's front is 2.5 m before its middle: at 37.4 m it is on the first edge, at 37.5 m on the second."""
    found = edges()
    assert [bool(found.same(on(1), one(s))[0]) for s in (37.4, 37.5)] == [False, True]
    assert Edges(Scenes([situation([leader()])]), one(5.0), one(2.0)).same(on(0), one(99.0))[0]


def drive(way: list[tuple[float, float, int]]) -> PredictedEgos:
    """Steps of 0.1 s against one that goes 10 m/s, so far ahead of the ego's start, so far to the left, on an edge."""
    egos = PredictedEgos(Scenes([road()]), ["bv"], one(5.0), one(2.0))
    for k, (station, left, edge) in enumerate(way):
        egos.step(0.1 * k, (one(station), one(left), one(0.0)), one(10.0), None, on(edge))
    return egos


def test_the_ego_brakes_for_who_comes_onto_an_edge_beside_it_and_then_makes_room() -> None:
    """Its bumper is 2 m behind the ego's: no gap at all, so it brakes with 9 m/s2, in one step by 0.9 m/s."""
    beside = [(k + 3.0, 2.5, 0 if k < 3 else 1) for k in range(4)]
    assert drive(beside[:3]).v[0] == pytest.approx(10.0)
    assert drive(beside).v[0] == pytest.approx(9.1)
    on_one = [(k + 3.0, 2.5, 1) for k in range(4)]
    assert drive(on_one).v[0] == pytest.approx(10.0)  # it was there already


def test_who_was_in_the_lane_is_partly_there_on_that_edge_only() -> None:
    """It goes out of the lane 3 m before the ego's bumper: 0.6 m of it are still in it. On the next edge it is not."""
    out = [(8.0, 0.0, 0), (9.0, 2.0, 0)]
    stays, goes = drive([*out, (10.0, 2.0, 0)]), drive([*out, (10.0, 2.7, 1)])
    assert stays.v[0] < goes.v[0]


def test_the_edges_that_a_vehicle_shares_with_the_ego() -> None:
    """From 35 m on in the lane to the left, one goes the ego's way and one turns off."""
    there = neighbour(x=35.0)
    sit = replace(situation([there]), edges=ON)

    def edge(*names: str) -> list[int]:
        way = replace(there.ways[0], edges=frozenset(names))
        ground = Ground([replace(sit, targets={"bv": replace(there, ways=(way,))})], ["bv"])
        found = []
        for station in (0.0, 2.5, 30.0):  # along its way: its front is at 37.5, 40 and 67.5 m
            motion = ground.begin()._replace(s=one(station))
            ground.blocked(motion)
            found.append(int(ground.edges(ground.relative(motion))[0]))
        return found

    assert edge("in", ":centre", "out") == [0, 1, 2]
    assert edge("in", ":turn", "aside") == [0, NOWHERE, NOWHERE]
