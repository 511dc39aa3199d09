"""Lines of progress without a terminal: what they say, and how often they come."""

from __future__ import annotations

import time

import pytest

from sumo_adv.cli.progress import BatchProgress, Counter, PacedLines


class Clock:
    """A clock that a test sets."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_line_comes_as_items_end_but_not_too_often(capsys: pytest.CaptureFixture[str]) -> None:
    """Two of eight took 21 s, so six take 63 s; at 30 s the last line is too recent."""
    clock = Clock()
    counter = Counter("cases", quiet=False, clock=clock)
    counter.begin(8)
    for clock.now, done in ((10.0, 1), (21.0, 2), (30.0, 3), (42.0, 4)):
        counter.tell(done, 8)
    counter.close()
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.splitlines() == ["2 of 8 cases done, about 63 s left.", "4 of 8 cases done, about 42 s left."]


def test_the_first_line_comes_even_if_nothing_ends(capsys: pytest.CaptureFixture[str]) -> None:
    lines = PacedLines("points of idm", at_most=True, first_s=0.02)
    lines.begin(1)
    time.sleep(0.5)
    lines.close()
    assert capsys.readouterr().err == "0 of at most 1 point of idm done.\n"


def test_no_time_is_estimated_where_fewer_items_may_be_needed(capsys: pytest.CaptureFixture[str]) -> None:
    clock = Clock()
    lines = PacedLines("points of idm", at_most=True, clock=clock)
    clock.now = 20.0
    lines.tell(25, 289)
    assert capsys.readouterr().err == "25 of at most 289 points of idm done.\n"


def test_items_of_an_earlier_call_took_no_time(capsys: pytest.CaptureFixture[str]) -> None:
    """One of the four that are left took 30 s, so three take 90 s."""
    clock = Clock()
    lines = PacedLines("episodes", clock=clock)
    lines.begin(10, 6)
    clock.now = 30.0
    lines.tell(7, 10, note="1 critical, 0 failed")
    assert capsys.readouterr().err == "7 of 10 episodes done, about 2 min left; 1 critical, 0 failed.\n"


def test_nothing_is_shown_with_json(capsys: pytest.CaptureFixture[str]) -> None:
    counter = Counter("cases", quiet=True)
    counter.begin(1)
    counter.tell(1, 1)
    with BatchProgress(quiet=True) as watcher:
        watcher.begin(1, [])
    assert capsys.readouterr() == ("", "")
