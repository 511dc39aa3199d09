"""SUMO's warnings reach the user: counted, the first of each kind in words, all in a file; not those of attempts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_samples import ROOT, Program
from simulation_samples import COUNTRY_EDGES, COUNTRY_NODES, configuration
from sumo_samples import make_net

from sumo_adv.simulation.warnings_log import WarningKind, about, kinds_of, said_of, warnings_in, with_names

PRINTED = """Warning: Teleporting vehicle 'a.1'; waited too long (jam), lane='AB_0', time=31.00.
Loading done.
Error: nothing of it
Warning: Teleporting vehicle 'b.22'; waited too long (jam), lane='BA_1', time=45.50.
Warning: Speed of lane 'x' is 3,
 which is low.
"""


def test_a_kind_is_a_message_without_its_ids_and_numbers() -> None:
    warnings = warnings_in(PRINTED)
    assert len(warnings) == 3 and warnings[2] == "Speed of lane 'x' is 3, which is low."
    kinds = kinds_of(warnings)
    assert kinds == (WarningKind(warnings[0], 2), WarningKind(warnings[2], 1))
    assert said_of(kinds) == (f"SUMO warns (2 times): {warnings[0]}", f"SUMO warns: {warnings[2]}")
    assert about(warnings, "b.22") == warnings[1] and about(warnings, "c") is None


def test_of_many_kinds_the_first_six_are_said_and_the_others_counted() -> None:
    words = [f"Kind {letter}{letter}." for letter in "abcdefgh"]
    said = said_of(kinds_of([*words, words[7]]))
    assert len(said) == 7 and said[6] == "SUMO warns (3 times) of 2 further kinds."


@pytest.fixture
def unsorted(program: Program) -> Path:
    """A vehicle that departs before the one that stands above it in the file, which SUMO ignores."""
    network = make_net(program.folder, COUNTRY_NODES, COUNTRY_EDGES, name="country")
    demand = """<route id="r" edges="AB"/><vehicle id="first" route="r" depart="2" departPos="300"/>
    <vehicle id="second" route="r" depart="3"/><vehicle id="early" route="r" depart="1"/>"""
    return configuration(program.folder / "own", network, demand)


FEW = ("--attempts", "2", "--total-seconds", "0", "--end", "30", "--learn", "off", "--out")


def test_a_vehicle_that_sumo_ignored_is_named_with_the_reason(program: Program, unsorted: Path) -> None:
    done = program.here("run", str(unsorted), "--ego-id", "early", *FEW, "out")
    assert done.status == 2
    assert done.err == (
        "sumo-adv: No vehicle 'early' was inserted before 30 s; check --ego-id. SUMO warned: Route file should be "
        "sorted by departure time, ignoring 'early'!\n"
    )


@pytest.mark.parametrize("more", [(), ("--no-fork",)])
def test_a_run_shows_each_kind_once_and_keeps_all(program: Program, unsorted: Path, more: tuple[str, ...]) -> None:
    """Attempts print further warnings, in forks and in place, and each repetition prints the first one again."""
    done = program.here("run", str(unsorted), "--ego-id", "second", *more, *FEW, "out")
    ignored = "Route file should be sorted by departure time, ignoring 'early'!"
    assert done.out.count(f"SUMO warns: {ignored}\n") == 1
    assert (done.folder / "warnings.txt").read_text().splitlines() == [ignored]
    assert done.outcome["warnings"] == [{"first": ignored, "count": 1}]


def test_a_warning_names_the_users_file() -> None:
    """A file with outputs is copied without them; the copy is the program's own business."""
    text = "Unknown attribute in 'scratch/silent-1/a.add.xml'."
    assert with_names(text, {"scratch/silent-1/a.add.xml": "own/a.add.xml"}) == (
        "Unknown attribute in 'own/a.add.xml'."
    )


def test_a_batch_says_the_warnings_of_all_its_runs(program: Program, unsorted: Path) -> None:
    done = program.here(
        "batch", str(unsorted), "--seeds", "2", "--set", "total_seconds=0", "--set", "end=20", "--attempts", "1",
        "--workers", "1", "--out", "many",
    )  # fmt: skip
    assert "SUMO warns (2 times): Route file should be sorted by departure time, ignoring 'early'!" in done.out


def test_a_run_without_warnings_has_no_file_of_them(program: Program) -> None:
    scenario = str(ROOT / "scenarios" / "leader_two_lanes.toml")
    done = program.here("run", scenario, "--attempts", "1", "--total-seconds", "0", "--learn", "off", "--json",
                        "--out", "out")  # fmt: skip
    assert json.loads(done.out)["warnings"] == [] and not (done.folder / "warnings.txt").exists()
