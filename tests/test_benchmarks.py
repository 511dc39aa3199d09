"""The benchmarks in miniature: they run and print figures of the right size; bounds are not checked here."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest
from cli_samples import ROOT, Program
from womd_samples import four_way, merge, straight, write

FOLDER = ROOT / "benchmarks"
NUMBER = r"\s+([\d.]+)"


def printed(program: Program, name: str, *arguments: str, statuses: tuple[int, ...] = (0,)) -> str:
    """What a benchmark says."""
    done = subprocess.run(
        [sys.executable, str(FOLDER / name), *arguments], cwd=program.folder, env=program.environment(),
        capture_output=True, text=True, timeout=120.0, check=False,
    )  # fmt: skip
    assert done.returncode in statuses and done.stderr == "", done.stderr[-2000:]
    assert program.leftovers() == []
    return done.stdout


@pytest.mark.soak
def test_step_overhead_has_a_row_for_each_case(program: Program) -> None:
    """Over its bound (status 1) is allowed: a window this short is mostly its verdict."""
    output = printed(
        program, "step_overhead.py", "--vehicles", "12", "--pairs", "2", "--steps", "45", statuses=(0, 1)
    )  # fmt: skip
    header, *rows = output.splitlines()
    assert header.startswith("vehicles") and len(rows) == 4
    assert [tuple(r.split()[1:4]) for r in rows] == [
        ("base", "idm", "local"), ("base", "idm", "sandbox"), ("base", "careful", "local"),
        ("duration", "idm", "local"),
    ]  # fmt: skip
    for row in rows:
        vehicles, _, _, _, steps, bare, loop, low, middle, high, ending = row.split()
        assert (vehicles, ending) == ("12", "contact") and 10 <= int(steps) <= 45
        assert 5 < float(bare) < 20_000 and float(bare) < float(loop) < 500_000
        assert 1.0 < float(low) <= float(middle) <= float(high)


@pytest.mark.soak
def test_environment_speed_has_a_row_for_an_environment(program: Program) -> None:
    """Below its bound (status 1) is allowed: one episode is too short to measure."""
    output = printed(
        program, "environment_speed.py", "--vehicles", "6", "--episodes", "1", "--only", "Ego-v0, nothing attacks",
        statuses=(0, 1),
    )  # fmt: skip
    speed_line = re.search(r"^Ego-v0, nothing attacks +120 steps +(-?\d+) steps per CPU second$", output, re.MULTILINE)
    assert speed_line is not None, output


@pytest.mark.soak
def test_attempt_cost_compares_the_same_attempt(program: Program) -> None:
    """Over a bound (status 1) is allowed: other tests run beside it."""
    output = printed(
        program, "attempt_cost.py", "motorway_cut_in_left", "--pairs", "2", "--proposals", "8", statuses=(0, 1)
    )
    assert "same states and verdict both ways: yes" in output
    for name in ("attempt by fork", "attempt by load and repeat", "two by fork at once, each"):
        timing = re.search(rf"{name}{NUMBER * 3}  ms", output)
        assert timing is not None, output
        low, middle, high = map(float, timing.groups())
        assert 1.0 < low <= middle <= high < 60_000.0
    search = re.search(r"prediction search, (\d+) proposals: ([\d.]+) s", output)
    assert search is not None and int(search[1]) >= 8 and 0.0 < float(search[2]) < 60.0
    call, batch = (re.search(rf"{re.escape(n)}{NUMBER * 3}", output) for n in ("sandbox: a call", "in a batch of 100"))
    assert call is not None and batch is not None
    assert 1e-3 * float(batch[2]) < float(call[2])  # us a call in a batch, ms a call by itself


@pytest.mark.soak
def test_batch_scaling_compares_ways_of_the_same_episodes(program: Program) -> None:
    """How the ways compare is not asked: four short episodes are mostly the start of processes."""
    options = ("--episodes", "4", "--pairs", "1", "--proposals", "8", "--ways", "warm,one,two,apart")
    output = printed(program, "batch_scaling.py", "t_junction_left_into_stem", *options, statuses=(0, 1))
    header, *rows = output.splitlines()
    assert header.startswith("4 episodes, 1 pairs; ms an episode")
    for name, row in zip(("warm", "one", "two", "apart"), rows[:4], strict=True):
        figures = re.fullmatch(rf"{name}{NUMBER * 3} \|{NUMBER} \| +([\d.]+)", row)
        assert figures is not None, row
        low, middle, high, steady, cores = map(float, figures.groups())
        assert 50.0 < low == middle == high < 60_000.0 and 10.0 < steady < 4 * high and 0.1 < cores < 1000.0
    two, apart = (
        re.fullmatch(rf"{n} over one: ([\d.]+) times as fast", row)
        for n, row in zip(("two", "apart"), rows[4:6], strict=True)
    )
    share = re.fullmatch(r"two over apart: ([\d.]+) \(bound 0\.9\)", rows[6])
    assert two is not None and apart is not None and share is not None
    assert float(share[1]) == pytest.approx(float(two[1]) / float(apart[1]), abs=0.05)
    assert re.fullmatch(r"one over the warm loop: [-+][\d.]+ % an episode \(bound 10 %\)", rows[7])


def test_womd_prints_totals_and_targets(program: Program) -> None:
    """Two records of this project's own; whether they meet a target of time is not asked."""
    records = program.home / "records"
    records.mkdir()
    write(records / "two.tfrecord", four_way(), merge())
    output = printed(program, "womd.py", str(records), "--no-traffic", statuses=(0, 1))
    for name, value in (("records", "2"), ("connectivity", "1"), ("broken", "0"), ("signals_mapped", "12")):
        assert re.search(rf"^{name} +{value}$", output, re.MULTILINE), output
    assert "met    connectivity: 1 >= 0.995" in output and "met    within_0.5" in output
    assert "nothing to do" in printed(program, "womd.py")


def test_womd_ground_counts_vehicles_that_leave_the_area(program: Program) -> None:
    """Three vehicles of the straight road move, all in the middle of a lane; the fourth is parked."""
    records = program.home / "ground"
    records.mkdir()
    write(records / "one.tfrecord", straight())
    output = printed(program, "womd_ground.py", str(records))
    assert "on the road: 3 moving vehicles, outside the lanes 0 (0.0%), outside the area 0 (0.0%)" in output
    assert "nothing to do" in printed(program, "womd_ground.py")


def test_a_profile_has_the_shares_of_attempts_in_all_processes(program: Program) -> None:
    """The observation, about a 25th of the time, needs a dozen attempts to be met by samples every few milliseconds."""
    header, *rows = printed(program, "profile_attempts.py", "--attempts", "12").splitlines()
    assert re.match(r"12 attempts on straight_4lane against cautious_ego:CautiousEgo: \d+ contacts", header)
    seconds = {row[:34].strip(): float(row[34:].split()[0]) for row in rows}
    processes = sum(seconds[name] for name in ("front", "engine", "forks of the engine"))
    assert abs(processes - seconds["all"]) < 0.05  # each is rounded
    parts = seconds["begin and end of the process"] + seconds["driving"] + seconds["verdict"]
    assert 0.0 < seconds["observation"] < seconds["ego's turn"] < seconds["driving"] < parts
    assert parts <= seconds["forks of the engine"] + 0.05


def test_prediction_says_of_how_many_attacks_it_foresaw_what_came(program: Program) -> None:
    output = printed(program, "prediction.py", "motorway_cut_in_left", "--attacks", "3", "--ego", "krauss")
    header, row, whole = output.splitlines()
    assert header.split() == ["krauss", "number", "touch", "valid", "s:", "min", "mean", "max"]
    assert row.split()[0] == "motorway_cut_in_left" and row.split()[1:] == whole.split()[1:]
    count, touch, valid, least, mean, most = map(float, whole.split()[1:])
    assert count == 3 and {touch, valid} <= {0.0, 0.33, 0.67, 1.0}
    assert 0.0 <= least <= mean <= most <= 12.1


def test_prediction_time_has_a_row_for_each_network(program: Program) -> None:
    """Over its bound (status 1) is allowed, where others use the machine."""
    rows = printed(program, "prediction_time.py", "--scenes", "2", statuses=(0, 1)).splitlines()
    assert [row.split()[0] for row in rows] == ["straight_3lane", "signalised_wide", "roundabout_large"]
    assert all(0.1 < float(row.split()[5]) < 1000.0 for row in rows)
