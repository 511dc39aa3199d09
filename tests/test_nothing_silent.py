"""Misspelt names and options without effect are refused, and a change of the next run is reported."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_samples import ROOT, Program, refusal_of

from sumo_adv.app import batch_parts
from sumo_adv.benchmark.jobs import method_of
from sumo_adv.campaigns.plan import make_plan
from sumo_adv.cli.bench import DEFAULT_ROWS
from sumo_adv.config import load_settings
from sumo_adv.episode.learning import BankView
from sumo_adv.errors import UsageError, nearest

SCENARIOS = len(list((ROOT / "scenarios").glob("*.toml")))


# -- the inputs of a batch


def test_a_batch_with_a_misspelt_input_runs_nothing(program: Program) -> None:
    message = refusal_of(program, "batch", "motorway_cut_in_left", "motorway_cut_in_lefd", "--out", "out")
    assert "There is no file motorway_cut_in_lefd" in message and "the nearest is 'motorway_cut_in_left'" in message


def test_a_batch_with_a_misspelt_ego_or_record_runs_nothing(program: Program) -> None:
    message = refusal_of(program, "batch", "motorway", "--egos", "idm,carefull", "--out", "out")
    assert "There is no ego 'carefull'; the nearest is 'careful'" in message
    assert "No record '3' that can be read" in refusal_of(program, "batch", "motorway", "--records", "3")


def test_the_shipped_scenarios_are_found_from_every_folder(program: Program) -> None:
    done = program.here("batch", "scenarios", "--dry-run", "--json")
    assert done.status == 0, done.err
    names = {e["input"] for e in json.loads(done.out)["episodes"]}
    assert len(names) == SCENARIOS and "motorway_cut_in_left" in names
    assert program.leftovers() == []


def test_a_pattern_of_shipped_scenarios_and_an_own_folder_of_that_name(tmp_path: Path) -> None:
    plan = make_plan({"inputs": ["scenarios/motorway_*.toml"]}, tmp_path, "The plan", batch_parts())
    assert [job.input.name for job in plan.jobs] == ["motorway_cut_in_left", "motorway_cut_in_right"]
    (tmp_path / "scenarios").mkdir()
    with pytest.raises(UsageError, match="holds no scenario"):
        make_plan({"inputs": ["scenarios"]}, tmp_path, "The plan", batch_parts())


# -- options without an effect


@pytest.fixture
def configuration(program: Program) -> str:
    """A .sumocfg with traffic of its own."""
    network = ROOT / "networks" / "motorway.net.xml"
    routes = ROOT / "scenarios" / "demand" / "motorway_cut_in_left.rou.xml"
    text = f'<configuration><net-file value="{network}"/><route-files value="{routes}"/></configuration>\n'
    (program.folder / "own.sumocfg").write_text(text, encoding="utf-8")
    return "own.sumocfg"


def test_a_density_beside_own_traffic_is_refused(program: Program, configuration: str) -> None:
    says = "own.sumocfg brings its own traffic, so --density 30 would have no effect"
    assert says in refusal_of(program, "run", configuration, "--density", "30", "--out", "out")
    assert says in refusal_of(program, "batch", configuration, "--set", "density=30", "--out", "out")


LEFT = (
    "The step-length of coarse.sumocfg, 1 s, is not kept: this program takes steps of 0.01 to 0.5 s, here of 0.1 s, of "
    "which 10 make one. Drivers then decide at other times, so motions differ from those of SUMO alone.",
    "Not kept of coarse.sumocfg, because this program sets them itself: fcd-output=fcd.xml.",
)


@pytest.fixture
def coarse(program: Program) -> str:
    """A .sumocfg of which the step and an output are not kept, and the other options are."""
    network = ROOT / "networks" / "motorway.net.xml"
    routes = ROOT / "scenarios" / "demand" / "motorway_cut_in_left.rou.xml"
    text = (
        f'<configuration><net-file value="{network}"/><route-files value="{routes}"/><step-length value="1"/>'
        '<begin value="0"/><end value="20"/><collision.action value="teleport"/><fcd-output value="fcd.xml"/>'
        '<collision.mingap-factor value="1"/><lateral-resolution value="0.8"/><time-to-teleport value="-1"/>'
        '<default.speeddev value="0"/></configuration>\n'
    )
    (program.folder / "coarse.sumocfg").write_text(text, encoding="utf-8")
    return "coarse.sumocfg"


def test_run_batch_and_serve_say_what_of_a_simulation_is_not_kept(program: Program, coarse: str) -> None:
    few = ("--attempts", "1", "--out")
    run = program.here("run", coarse, "--total-seconds", "0", *few, "out")
    batch = program.here("batch", coarse, "--set", "total_seconds=0", "--workers", "1", *few, "batch")
    serve = program.here("serve", coarse, "--port", "0", "--patience", "1", "--out", "served")
    for done in (run, batch, serve):
        assert [line for line in done.out.splitlines() if "not kept" in line.lower()] == list(LEFT)


def test_files_of_a_run_say_what_was_not_kept_and_every_option_of_sumo(program: Program, coarse: str) -> None:
    done = program.here("run", coarse, "--total-seconds", "0", "--attempts", "1", "--out", "out", "--option", "scale=1")
    manifest = json.loads((done.folder / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["notes"] == done.outcome["notes"] == list(LEFT)
    assert manifest["step_length"] == 0.1
    assert manifest["sumo_options"] == {
        "collision.mingap-factor": "1", "lateral-resolution": "0.8", "time-to-teleport": "-1", "default.speeddev": "0",
        "scale": "1", "collision.action": "teleport", "end": "20", "device.ssm.file": "NUL",
        "xml-validation": "never", "no-step-log": "true", "duration-log.disable": "true",
    }  # fmt: skip


# -- settings


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"atempts": 3}, "There is no setting 'atempts'; the nearest is 'attempts'."),
        ({"limits": {"breaking": 3}}, "There is no setting 'limits.breaking'; the nearest is 'braking'."),
        ({"qqq": 3}, "There is no setting 'qqq'."),
    ],
)
def test_an_unknown_setting_names_the_nearest_one(given: dict[str, object], says: str) -> None:
    with pytest.raises(UsageError) as raised:
        load_settings(None, **given)
    assert str(raised.value) == says


def test_the_nearest_name_is_found_in_any_case() -> None:
    assert nearest("ONCOMMING", ["leader", "oncoming"]) == "; the nearest is 'oncoming'"
    assert nearest("ONCOMMING", ["leader"]) == ""


# -- the memory bank


def test_a_table_compares_with_banks_that_stay_as_they_are() -> None:
    methods = [method_of(row) for row in DEFAULT_ROWS]
    assert not any(method.learns for method in methods if method is not None)


def test_what_the_next_run_would_see_is_told_apart() -> None:
    view = BankView(((0.0, "bv", "Shift", "a"),), 0)
    assert view.difference(view) == ""
    learnt = BankView(((0.0, "bv", "Shift", "a"), (0.0, "bv", "Shift", "b")), 0)
    assert view.difference(learnt) == (
        "The memory bank has learnt planners of Shift: the same command may run differently next time "
        "(--learn off keeps the bank as it is)."
    )
