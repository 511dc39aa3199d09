"""Line of sight: boxes of 5 m by 2 m and a building, seen from (0, 0)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from sumo_adv.datatypes import VehicleState
from sumo_adv.episode.surroundings import Sight, read_buildings

EYE = (0.0, 0.0)


def box(x: float, y: float, width: float = 2.0) -> VehicleState:
    return VehicleState(f"{x} {y}", x, y, 0.0, 0.0, 0.0, 5.0, width, "")


def test_a_car_hides_the_one_behind_it() -> None:
    """The near one ends at x = 7.5 and y = +-1: behind it, at x = 27.5, 1 / 12.5 x 27.5 = 2.2 m are hidden."""
    assert Sight().visible(EYE, [box(10.0, 0.0), box(30.0, 0.0)]).tolist() == [True, False]


def test_a_corner_that_shows_is_enough() -> None:
    """The far corner of a box at y = 4 is at (32.5, 5): the line to it passes x = 12.5 at 1.9 m."""
    assert Sight().visible(EYE, [box(10.0, 0.0), box(30.0, 4.0)]).tolist() == [True, True]
    assert Sight().visible(EYE, [box(10.0, 0.0, width=4.6), box(30.0, 4.0)]).tolist() == [True, False]


def test_boxes_on_the_other_side_hide_nothing() -> None:
    assert Sight().visible(EYE, [box(-10.0, 0.0), box(30.0, 0.0)]).tolist() == [True, True]
    assert Sight().visible(EYE, []).tolist() == []


def test_a_box_around_the_eye_hides_nothing() -> None:
    assert Sight().visible(EYE, [box(1.0, 0.0), box(30.0, 0.0)]).tolist() == [True, True]


def test_buildings_are_read_from_additional_files_and_hide_what_is_behind(tmp_path: Path) -> None:
    file = tmp_path / "houses.add.xml"
    file.write_text(
        '<additional><poly id="a" type="building.yes" shape="10,-5 20,-5 20,5 10,5"/>'
        '<poly id="b" type="landuse.forest" shape="-10,-5 -20,-5 -20,5 -10,5"/></additional>'
    )
    (outline,) = read_buildings([file])
    assert np.array_equal(outline, [[10, -5], [20, -5], [20, 5], [10, 5]])
    assert Sight([outline]).visible(EYE, [box(40.0, 0.0), box(-40.0, 0.0)]).tolist() == [False, True]
