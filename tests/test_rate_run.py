"""Estimates in SUMO: runs that repeat, forced errors that end in a judged collision, the command, its folder."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cli_samples import Program

import sumo_adv
from sumo_adv.cli.rate import lines
from sumo_adv.errors import UsageError
from sumo_adv.rate.blocks import Block, BlockRunner, RatePlan, seed_of
from sumo_adv.rate.estimate import estimated
from sumo_adv.rate.proposal import ERROR_KINDS
from sumo_adv.rate.run import RateRecord
from sumo_adv.simulation.human_errors import ErrorKind

BESIDE = Path(__file__).resolve().parent.parent / "benchmarks" / "rate" / "side_by_side.toml"
DRIFTS = np.zeros((len(ERROR_KINDS), 4))
DRIFTS[ERROR_KINDS.index(ErrorKind.DRIFT_RIGHT), 3] = 0.5


def test_forced_drifts_end_in_collisions_with_small_weights_and_runs_repeat() -> None:
    plan = RatePlan(BESIDE, "idm", duration=8.0)
    with BlockRunner(plan) as runner:
        block = Block("runs", 0, DRIFTS.tolist())
        records = [runner.one(block, number)[1] for number in range(8)]
        again = runner.one(block, 0)[1]
        calm = runner.one(Block("plain", 0, None), 0)[1]
    assert again == records[0]
    hit = [r for r in records if r.contact]
    assert hit and all(r.error == "drift_right" for r in hit)
    assert any(r.level != "none" for r in hit)
    assert all(r.weight < 0.01 and r.weighted_hours <= r.hours * 10 for r in hit)
    assert (calm.contact, calm.weight) == (False, 1.0)
    assert calm.hours == calm.weighted_hours == pytest.approx(8 / 3600)
    assert 8 * 0.016 < calm.km < 8 * 0.020  # between 16 and 20 m/s


def test_the_ego_has_the_sensors_of_its_scenario(tmp_path: Path) -> None:
    scenario = tmp_path / "beside.toml"
    text = BESIDE.read_text(encoding="utf-8").replace('"side_by_side', f'"{BESIDE.parent}/side_by_side')
    scenario.write_text(f"{text}\n[ego.sensing]\nrange = 30.0\ndelay = 0.5\n", encoding="utf-8")
    sensing = RatePlan(scenario, "careful", duration=8.0).task(tmp_path).settings.ego_sensing
    assert (sensing.range, sensing.delay) == (30.0, 0.5)


def test_what_the_careful_driver_hits_it_does_not_avoid() -> None:
    """It drives ``cc_human``, on which the levels strict and serious depend."""
    with BlockRunner(RatePlan(BESIDE, "careful", duration=8.0)) as runner:
        records = [runner.one(Block("runs", 0, DRIFTS.tolist()), number)[1] for number in range(8)]
    levels = {record.level for record in records if record.contact}
    assert levels and not levels & {"strict", "serious"}


def test_generated_traffic_brings_an_ego_after_the_warm_up() -> None:
    with BlockRunner(RatePlan(Path("straight_2lane"), "krauss", warm_up=5.0, duration=4.0, density=60.0)) as runner:
        first, second = (runner.one(Block("plain", 0, None), number)[1] for number in (0, 1))
    assert first.hours == second.hours == pytest.approx(4 / 3600)
    assert first.km != second.km  # other traffic
    assert len({seed_of(0, phase, n) for phase in ("pilot", "runs", "plain") for n in range(50)}) == 150


def test_rates_of_levels_from_records() -> None:
    """Two of four runs crash with weight 0.5, one of them valid; each run is 0.25 h and 10 km, of weight 1."""
    calm = RateRecord(1, 0.25, 10.0, 0.25, 10.0, 1.0)
    records = [
        calm, calm,
        RateRecord(2, 0.25, 10.0, 0.25, 10.0, 0.5, True, "valid", "drift_left"),
        RateRecord(3, 0.25, 10.0, 0.25, 10.0, 0.5, True, "none", "inattention"),
    ]  # fmt: skip
    estimate = estimated(RatePlan(Path("x")), records, [calm])
    assert {name: rate.value for name, rate in estimate.per_hour.items()} == {
        "contact": 1.0, "collision": 0.5, "valid": 0.5, "strict": 0.0, "serious": 0.0
    }  # fmt: skip
    assert estimate.per_km["collision"].value == pytest.approx(0.5 / 40)
    assert estimate.by_error == {"drift_left": 1.0}
    assert (estimate.hours, estimate.km) == (1.25, 50.0)
    assert estimate.effective_runs == pytest.approx(9 / 2.5)
    table = lines(estimate)
    assert table[0].split()[:4] == ["level", "per", "1000", "h"]
    assert table[2].split()[:2] == ["collision", "500"] and table[-1] == "Errors before collisions: drift_left 100%"


def test_the_command_goes_on_in_its_folder(program: Program) -> None:
    folder = program.folder / "rate"
    words = ["rate", BESIDE, "--ego", "idm", "--errors", "100", "--duration", "6", "--workers", "1", "--json"]
    words += ["--pilot", "20", "--runs", "20", "--out", folder]
    done = program.here(*words)
    assert done.status == 0, done.err
    first, block = json.loads(done.out), folder / "blocks" / "runs-0.json"
    before = block.read_bytes()
    block.unlink()
    assert json.loads(program.here(*words).out) == first
    assert block.read_bytes() == before
    assert first["runs"] == 20 and first["pilot"] == 20
    assert json.loads((folder / "rate.json").read_text())["levels"] == first["levels"]
    refused = program.here(*words, "--seed", "1")
    assert refused.status == 2 and "another seed" in refused.err and "--out" in refused.err


def test_from_python_it_is_the_same_estimate(tmp_path: Path) -> None:
    progress: list[tuple[str, int, int]] = []
    estimate = sumo_adv.crash_rate(
        BESIDE, ego="idm", errors=100.0, duration=2.0, pilot=20, runs=40, workers=1, out=tmp_path / "rate",
        tell=lambda *words: progress.append(words),
    )  # fmt: skip
    assert estimate is not None
    assert progress == [("pilot", 1, 1), ("runs", 1, 2), ("runs", 2, 2)]
    assert json.loads((tmp_path / "rate" / "rate.json").read_text()) == json.loads(json.dumps(estimate.document()))
    assert (estimate.runs, estimate.plan.pilot) == (40, 20)
    assert estimate.per_hour["contact"].crashes >= estimate.per_hour["collision"].crashes
    with pytest.raises(UsageError, match=r"as a name \(module:Class\)"):
        sumo_adv.crash_rate(BESIDE, ego=object())  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="at least one run"):
        sumo_adv.crash_rate(BESIDE, runs=0)


def test_what_is_refused(program: Program) -> None:
    for words, message in (
        ((BESIDE, "--ego", "unknown"), "There is no ego 'unknown'"),
        (("nowhere.net.xml",), "There is no file nowhere.net.xml"),
        ((BESIDE, "--density", "10"), "brings its own traffic"),
        (("straight_2lane", "--density", "0.0001", "--pilot", "1", "--workers", "1"), "give more --density"),
    ):
        done = program.here("rate", *words, "--out", program.folder / "rate")
        assert (done.status, done.err.count("\n")) == (2, 1), done.err
        assert message in done.err
