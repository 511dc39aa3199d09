"""Recorded tracks: reading, refusals by file and line, and interpolation."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sumo_adv.errors import UsageError
from sumo_adv.simulation.tracks import TRACK_COLUMNS, TrackLog, read_tracks, write_tracks

HEADER = ",".join(TRACK_COLUMNS) + "\n"
CAR = """0.0,a,vehicle,1,0,0,0,10,4.0,2.0
0.0,p,pedestrian,1,5,5,1.5,1,0.6,0.6
0.1,a,vehicle,0,,,,,,
0.2,a,vehicle,1,2,0,0.2,10,5.0,1.8
0.3,a,vehicle,1,3,0,0.2,10,4.6,1.9
"""
MOVING = "".join(f"{k / 10},a,vehicle,1,{k},0,{{0}},10,4.5,1.8\n" for k in range(20))  # 10 m/s to the east


def written(folder: Path, text: str) -> Path:
    path = folder / "log.csv"
    path.write_text(text)
    return path


def test_a_log_says_who_is_there_when(tmp_path: Path) -> None:
    log = read_tracks(written(tmp_path, HEADER + CAR))
    car, walker = log.tracks["a"], log.tracks["p"]
    assert log.time == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert (log.end, log.first("a"), log.first("p")) == (pytest.approx(0.3), 0.0, 0.0)
    assert car.valid.tolist() == [True, False, True, True]
    assert car.spans() == ((0, 0), (2, 3))
    assert walker.spans() == ((0, 0),)
    assert (car.length, car.width) == (4.6, 1.9)  # the medians of 4, 5, 4.6 and of 2, 1.8, 1.9
    track = log.track("a")
    assert track.time == pytest.approx([0.0, 0.2, 0.3])
    assert track.x == pytest.approx([0.0, 2.0, 3.0])


def test_between_samples_it_is_linear_where_both_sides_are_valid(tmp_path: Path) -> None:
    log = read_tracks(written(tmp_path, HEADER + CAR)).resampled(0.0, 0.05)
    car = log.tracks["a"]
    assert log.time == pytest.approx([0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3])
    assert car.valid.tolist() == [True, False, False, False, True, True, True]
    assert car.x[4:] == pytest.approx([2.0, 2.5, 3.0])


@pytest.mark.parametrize("step", [0.005, 0.033, 1 / 30, 0.125, 0.1])
def test_times_are_written_with_the_digits_that_their_step_needs(tmp_path: Path, step: float) -> None:
    even = read_tracks(written(tmp_path, HEADER + MOVING.format(0)))
    log = TrackLog(1.0 + step * np.arange(20), even.tracks)
    log = TrackLog(log.time, {n: replace(t, x=10.0 * log.time) for n, t in log.tracks.items()})
    write_tracks(tmp_path / "steps.csv", log)
    assert read_tracks(tmp_path / "steps.csv").time == pytest.approx(log.time, abs=1e-6)


def test_headings_turn_the_shorter_way(tmp_path: Path) -> None:
    rows = "0.0,a,vehicle,1,0,0,3.1,10,4,2\n0.1,a,vehicle,1,0,0,-3.1,10,4,2\n"
    half = read_tracks(written(tmp_path, HEADER + rows)).resampled(0.0, 0.05).tracks["a"].heading[1]
    assert np.cos(half) == pytest.approx(-1.0, abs=1e-3)


def test_a_run_that_begins_later_sees_the_rest(tmp_path: Path) -> None:
    log = read_tracks(written(tmp_path, HEADER + CAR)).resampled(0.2, 0.1)
    assert log.time == pytest.approx([0.2, 0.3])
    assert log.tracks["a"].x == pytest.approx([2.0, 3.0])
    assert not log.tracks["p"].valid.any()


def test_what_is_written_is_read_and_has_the_same_bytes(tmp_path: Path) -> None:
    log = read_tracks(written(tmp_path, HEADER + CAR))
    for name in ("one.csv.gz", "two.csv.gz"):
        write_tracks(tmp_path / name, log)
    assert (tmp_path / "one.csv.gz").read_bytes() == (tmp_path / "two.csv.gz").read_bytes()
    again = read_tracks(tmp_path / "one.csv.gz")
    assert again.tracks["a"].valid.tolist() == log.tracks["a"].valid.tolist()
    assert again.tracks["a"].x[[0, 2, 3]] == pytest.approx([0.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "line 1 must be 'time,id,kind"),
        ("time,id\n", "line 1 must be 'time,id,kind"),
        (HEADER, "hold no valid row"),
        (HEADER + "0.0,a,vehicle,0,,,,,,\n", "hold no valid row"),
        (HEADER + "0.0,a,vehicle,1,0,0\n", "line 2 has 6 fields, not 10"),
        (HEADER + CAR + "0.4,a,vehicle,1,nan,0,0,1,4,2\n", "line 7 has 'nan' for x"),
        (HEADER + CAR + "later,a,vehicle,1,0,0,0,1,4,2\n", "line 7 has 'later' for time"),
        (HEADER + CAR + "0.4,a,tram,1,0,0,0,1,4,2\n", "line 7 has no usable kind"),
        (HEADER + CAR + "0.4,a,vehicle,yes,0,0,0,1,4,2\n", "line 7 has no usable valid"),
        (HEADER + CAR + "0.4,,vehicle,1,0,0,0,1,4,2\n", "line 7 has no usable id"),
        (HEADER + CAR + "0.4,a,cyclist,1,0,0,0,1,4,2\n", "line 7 calls 'a' a cyclist, which was a vehicle"),
        (HEADER + CAR + "0.3,a,vehicle,1,0,0,0,1,4,2\n", "line 7 is the second for 'a' at 0.3 s"),
        (HEADER + CAR + "0.4,a,vehicle,1,0,0,0,1,0,2\n", "line 7 gives 'a' a size of 0 by 2 m"),
        (
            HEADER + MOVING.format(90),
            "line 2 has the heading 90 rad for 'a', which is beyond 2 pi: headings look like deg",
        ),
        (
            HEADER + MOVING.format(2),
            "line 2 has the heading 2 rad for 'a', which moves towards 0 degrees from +x: headings",
        ),
        (
            HEADER + MOVING.format(0).replace(",10,4", ",36,4"),
            "line 2 has the speed 36 m/s for 'a', which moves at 10 m/s",
        ),
        (HEADER + MOVING.format(0).replace("4.5,1.8", "450,180"), "sizes look like centimetres"),
        (HEADER + CAR + "0.45,a,vehicle,1,0,0,0,1,4,2\n", "0.45 s is off the step of 0.1 s"),
    ],
)
def test_what_is_wrong_is_named_with_file_and_line(tmp_path: Path, text: str, part: str) -> None:
    with pytest.raises(UsageError, match=r"log\.csv") as caught:
        read_tracks(written(tmp_path, text))
    assert part in str(caught.value)


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress((HEADER + CAR).encode())[:40])
    with pytest.raises(UsageError, match="damaged or truncated"):
        read_tracks(path)
    path.write_bytes(b"\xff\xfe\xff")
    with pytest.raises(UsageError, match="not text"):
        read_tracks(path)
    with pytest.raises(UsageError, match="cannot be read"):
        read_tracks(tmp_path / "none.csv")


def test_a_byte_order_mark_is_no_part_of_the_header(tmp_path: Path) -> None:
    """Spreadsheets, and pandas with ``utf-8-sig``, begin a file with it."""
    plain, marked = written(tmp_path, HEADER + CAR), tmp_path / "marked.csv"
    marked.write_bytes(b"\xef\xbb\xbf" + plain.read_bytes())
    assert list(read_tracks(marked).tracks) == list(read_tracks(plain).tracks)


@given(st.text(alphabet='0123456789.,-eainf\nvehicl"', max_size=120))
def test_any_text_is_a_log_or_a_sentence(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_text(HEADER + text)
    try:
        assert isinstance(read_tracks(path), TrackLog)
    except UsageError as error:
        assert "any.csv" in str(error)
