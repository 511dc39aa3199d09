"""The picture of an attempt: right size, same bytes, any title."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sumo_adv.datatypes import LaneStrip, Role, Track, Verdict
from sumo_adv.report.encounter_figure import decisive_time, draw_encounter, lane_polygon


def track(id: str, role: Role, x: NDArray[np.floating], y: NDArray[np.floating]) -> Track:
    """Positions every 0.1 s from 10 s on; the heading follows them."""
    vx, vy = np.gradient(x, 0.1), np.gradient(y, 0.1)
    x64, y64 = x.astype(np.float64), y.astype(np.float64)
    time = np.asarray(10.0 + 0.1 * np.arange(x.size), dtype=np.float64)
    speed = np.hypot(vx, vy)
    return Track(id, role, time, x64, y64, np.arctan2(vy, vx), speed, np.gradient(speed, 0.1), 5.0, 1.8)


T = 0.1 * np.arange(61)
LANES = [LaneStrip(np.array([[-50.0, y], [200.0, y]]), 3.2, False) for y in (0.0, 3.2, 6.4)]
EGO = track("ego", Role.EGO, 14 * T, 0 * T)
RAW = track("bv", Role.ADVERSARY, 8 + 11 * T, 0 * T + 3.2)
CUT = track("bv", Role.ADVERSARY, 8 + 13 * T, 3.2 / (1 + np.exp(3 * (T - 3))))
OTHER = track("2", Role.BACKGROUND, 30 + 13 * T, 0 * T + 6.4)
VERDICT = Verdict(0.7, 0.4, False, True, True, False)


def draw(target: Path, title: str = "cut-in", verdict: Verdict = VERDICT) -> bytes:
    draw_encounter(
        target, lanes=LANES, ego=EGO, adversary=CUT, others=[OTHER], raw_ego=EGO, raw_adversary=RAW, trigger_time=11.0,
        verdict=verdict, title=title,
    )  # fmt: skip
    return target.read_bytes()


def test_a_png_of_the_right_size_and_the_same_bytes(tmp_path: Path) -> None:
    first = draw(tmp_path / "a.png")
    assert first[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", first[16:24])
    assert width == 1600
    assert 600 <= height <= 1400
    assert draw(tmp_path / "b.png") == first
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png"]  # nothing half-written is left


def test_a_hostile_title_is_only_text(tmp_path: Path) -> None:
    plain = draw(tmp_path / "a.png", title="cut-in")
    hostile = draw(tmp_path / "b.png", title="$\\frac{1}{ $ ${HOME} %s <script> \\input{x} " + "very long " * 40)
    assert hostile[:4] == b"\x89PNG"
    assert hostile != plain


def test_boxes_stand_where_it_matters() -> None:
    assert decisive_time(EGO, CUT, 11.0, VERDICT) == pytest.approx(16.0)  # 14 t against 8 + 13 t: closing until the end
    touched = Verdict(0.0, 0.0, True, True, True, False, True, True, "careful_driver", contact_time=13.37)
    assert decisive_time(EGO, CUT, 11.0, touched) == 13.37


def test_vehicles_that_never_meet_in_time_are_drawn_too(tmp_path: Path) -> None:
    late = track("ego", Role.EGO, 14 * T, 0 * T)
    gone = CUT.between(10.0, 10.5)
    draw_encounter(
        tmp_path / "a.png", lanes=[], ego=late, adversary=gone, others=[], raw_ego=None, raw_adversary=None,
        trigger_time=11.0, verdict=Verdict(float("inf"), float("inf"), False, False, True, False),
        title="",
    )  # fmt: skip
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_a_folder_that_is_not_there_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="none"):
        draw(tmp_path / "none" / "a.png")


def test_lane_outline_keeps_its_width_round_a_corner() -> None:
    outline = lane_polygon(np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 10.0]]), 2.0)
    expected = [[0, 1], [9, 1], [9, 10], [11, 10], [11, -1], [0, -1]]  # mitred: inner corner (9, 1), outer (11, -1)
    assert outline == pytest.approx(np.array(expected, dtype=float))
