"""The time that a driver's own code takes: its bins, its sum over forks, and what a run says of it."""

from __future__ import annotations

import time
from pathlib import Path

import libsumo
import pytest
from ego_samples import CalmEgo

from sumo_adv import Observation
from sumo_adv.datatypes import VehicleState
from sumo_adv.drivers import UserEgo
from sumo_adv.drivers.timing import (
    DriverTime,
    Stopwatch,
    TimedEgo,
    bin_of,
    engine_work,
    read_driver_time,
    total_time,
)
from sumo_adv.errors import DriverError, SumoError


def seen_at(now: float) -> Observation:
    return Observation(now, 0.1, VehicleState("ego", 0.0, 0.0, 0.0, 10.0, 0.0, 4.5, 1.8, "lane"), ())


def test_bins_are_eighths_of_a_doubling_from_a_hundredth_of_a_millisecond() -> None:
    assert [bin_of(s) for s in (0.0, 1e-5, 2e-5, 4e-5)] == [0, 0, 8, 16]


def test_99_percent_are_within_the_edge_of_the_bin_that_holds_the_99th_answer() -> None:
    """98 answers of at most 0.01 ms, one of 0.02 ms (bin 8), one of 0.16 ms (bin 32)."""
    took = DriverTime(100, 0.00116, {0: 98, 8: 1, 32: 1})
    assert took.within_ms(0.5) == 0.01 and took.within_ms(0.99) == 0.02 and took.within_ms(1.0) == 0.16
    assert took.mean_ms == pytest.approx(0.0116)


def test_the_times_of_forks_are_added() -> None:
    both = total_time([DriverTime(2, 0.3, {0: 2}), DriverTime(3, 0.2, {0: 1, 8: 2})])
    assert both == DriverTime(5, 0.5, {0: 3, 8: 2})
    assert total_time([]) == DriverTime() and DriverTime().within_ms(0.99) == 0.0


def test_a_sentence_says_share_calls_mean_and_quantile() -> None:
    """3120 calls in 40.56 s are 13 ms each; the upper edge of bin 104 is 0.01 ms * 2 ** 13 = 81.92 ms."""
    took = DriverTime(3120, 40.56, {80: 3000, 104: 120})
    words = "Your driver took 40.6 s of 60.0 s: 3,120 calls, mean 13 ms, 99 % within 82 ms."
    assert took.words(60.0) == words
    assert took.words(30.0).startswith("Your driver took 40.6 s of 30.0 s (in several processes at once): 3,120 calls")
    assert read_driver_time(took.as_data()) == took and read_driver_time(None) is None


def test_what_the_engine_works_out_for_an_observation_is_not_the_drivers_time() -> None:
    @engine_work
    def slow() -> None:
        time.sleep(0.05)

    with (watch := Stopwatch()):
        slow()
    assert watch.seconds < 0.04


def test_an_error_of_sumo_in_an_observation_is_not_the_drivers() -> None:
    def ask_sumo() -> None:
        raise libsumo.TraCIException("The disk is full.")

    class Reads(CalmEgo):
        def act(self, seen: Observation) -> None:
            engine_work(ask_sumo)()

    class AsksItself(CalmEgo):
        def act(self, seen: Observation) -> None:
            ask_sumo()

    with pytest.raises(SumoError, match=r"^SUMO failed while the ego's driver read its observation \(The disk is full"):
        UserEgo("m:Reads", Reads()).act(seen_at(0.0))
    with pytest.raises(DriverError, match=r"^The ego 'm:Asks' failed in act at 0\.0 s: TraCIException: The disk"):
        UserEgo("m:Asks", AsksItself()).act(seen_at(0.0))


def test_a_fork_counts_from_zero_and_is_added_to_its_parent() -> None:
    driver = TimedEgo(UserEgo("calm", CalmEgo()))
    driver.reset(0)
    driver.act(seen_at(0.0))
    before = driver.time
    driver.start_over()
    driver.act(seen_at(0.1))
    driver.add(before)
    assert driver.time.calls == 2 and sum(driver.time.bins.values()) == 2


def test_a_run_writes_how_long_the_driver_took_in_all_its_forks(tmp_path: Path) -> None:
    import sumo_adv

    result = sumo_adv.run(
        "motorway_cut_in_left", ego=CalmEgo, out=tmp_path / "run", memory=str(tmp_path / "bank.sqlite"),
        learn="off", attempts=3, seconds=20.0,
    )  # fmt: skip
    took = read_driver_time(result.outcome.document["driver_time"])
    assert took is not None
    answers = result.outcome.document["ego_actions"]
    assert took.calls > sum(answers[name] for name in answers if name != "limited")
    assert 0.0 < took.seconds < result.outcome.document["timing"]["total"] * 2
