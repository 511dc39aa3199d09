"""``memory``: looking into banks and building one, through the real command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from bank_samples import shipped_planners
from cli_samples import ROOT, TRAIL, Done, Program, Runs, bank_with

from sumo_adv.memory.bank import MemoryBank

SEVEN = {
    "Emergency Braking", "Close Car-following", "Aggressive Cut-in", "Opposite Direction Intrusion",
    "Intersection Rush-through Turn Left", "Intersection Rush-through Go-straight", "Straight Lane Shift",
}  # fmt: skip


def succeeded(done: Done) -> str:
    assert (done.status, done.err) == (0, "")
    return done.out


def test_a_new_home_gets_the_seven_intents_of_the_paper(program: Program) -> None:
    listing = json.loads(succeeded(program.here("memory", "list", "--json")))
    assert {row["label"] for row in listing["intents"]} == SEVEN
    assert all(row["modes"] and row["evidence"] == 0 and row["status"] == "active" for row in listing["intents"])
    assert (program.home / "data" / "sumo_adv" / "memory_bank.sqlite").is_file()
    lines = succeeded(program.here("memory", "list")).splitlines()
    assert len(lines) == 7 and any(line.startswith("Straight Lane Shift: modes ") for line in lines)


def test_the_bank_of_the_variable_is_the_one_that_runs_use(program: Program) -> None:
    succeeded(program.here("memory", "new", "one.sqlite", "--only", "Emergency Braking"))
    program.variables["SUMO_ADV_MEMORY"] = "one.sqlite"
    said = json.loads(succeeded(program.here("memory", "list", "--json")))
    assert [row["label"] for row in said["intents"]] == ["Emergency Braking"]
    assert json.loads(succeeded(program.here("memory", "list", "--json", "--memory", "one.sqlite"))) == said
    assert not (program.home / "data" / "sumo_adv" / "memory_bank.sqlite").exists()


def test_show_prints_the_sources(program: Program) -> None:
    text = succeeded(program.here("memory", "show", "straight lane-shift"))
    assert text.splitlines()[0] == "Straight Lane Shift"
    sources = [p.text for p in shipped_planners().values() if p.label == "Straight Lane Shift"]
    assert len(sources) == 4 and all(source in text for source in sources)
    done = program.here("memory", "show", "Dancing")
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith("sumo-adv: ") and "Dancing" in done.err and "Aggressive Cut-in" in done.err


def test_find_says_how_near(program: Program) -> None:
    same = json.loads(succeeded(program.here("memory", "find", "aggressive cut in", "--json")))
    assert same["hit"] == "Aggressive Cut-in" and same["nearest"][0] == {"label": "Aggressive Cut-in", "distance": 0.0}
    far = json.loads(succeeded(program.here("memory", "find", "zebra xylophone quartz", "--json")))
    assert far["hit"] is None
    assert all(n["distance"] > far["epsilon"] for n in far["nearest"])
    assert succeeded(program.here("memory", "find", "zebra xylophone quartz")).startswith("No hit")


def test_a_bank_of_ones_own(program: Program) -> None:
    bank = bank_with(program.folder / "bank.sqlite", TRAIL)
    listing = json.loads(succeeded(program.here("memory", "list", "--json", "--memory", bank)))
    assert listing["intents"] == [
        {
            "label": "Odd Driving",
            "applies": ["neighbour", "leader"],
            "status": "active",
            "modes": ["odd"],
            "evidence": 0,
        }
    ]
    assert not (program.home / "data").exists()
    (program.folder / "diary").write_text("Dear diary, ...\n" * 100)
    done = program.here("memory", "list", "--memory", "diary")
    assert done.status == 2 and done.err.startswith("sumo-adv: ") and "diary" in done.err


def test_build_gives_the_shipped_bank(program: Program) -> None:
    target = program.folder / "built.sqlite"
    succeeded(program.here("memory", "build", ROOT / "memory_bank", target))
    shipped = ROOT / "memory_bank.sqlite"
    with MemoryBank.open(target, read_only=True) as built, MemoryBank.open(shipped, read_only=True) as expected:
        assert built.content_hash() == expected.content_hash()
    assert program.leftovers() == ["built.sqlite"]


@pytest.mark.parametrize("folder", ["nowhere", "."])
def test_build_from_nothing_is_refused(program: Program, folder: str) -> None:
    done = program.here("memory", "build", folder, "built.sqlite")
    assert (done.status, done.out) == (2, "")
    assert done.err.startswith("sumo-adv: ") and len(done.err.splitlines()) == 1
    assert program.leftovers() == []


def test_a_run_teaches_its_own_bank_and_never_the_shipped_one(runs: Runs) -> None:
    first = runs["first"]
    shipped = (ROOT / "memory_bank.sqlite").read_bytes()
    taught = Path(first.folder).parent / "home" / "data" / "sumo_adv" / "memory_bank.sqlite"
    with MemoryBank.open(taught, read_only=True) as bank:
        evidence = bank.evidence()
        tried = {(a["intent"], a["planner"]["hash"]) for a in first.outcome["attempts"]}
        assert {(e.label, e.planner_hash) for e in evidence} >= tried  # and what earlier encounters tried
        won = {(e.label, e.planner_hash) for e in evidence if e.success}
        best = first.outcome["attempts"][first.outcome["best"]]
        assert first.outcome["learnt"] and (best["intent"], best["planner"]["hash"]) in won
    with MemoryBank.open(ROOT / "memory_bank.sqlite", read_only=True) as bank:
        assert bank.content_hash() == first.manifest["bank_hash"]
        assert bank.evidence() == []
    assert (ROOT / "memory_bank.sqlite").read_bytes() == shipped


def test_an_intent_that_was_composed_is_kept_with_all_its_modes(program: Program) -> None:
    """Nothing in the library is for a vehicle from a road that joins. The success there is the rush through a junction
    for another movement. All its modes are kept, since the next time nothing is composed."""
    merge = ROOT / "suites" / "suite81" / "intersection-30.toml"
    succeeded(program.here("run", merge, "--seed", "2", "--out", "out", "--json"))
    listing = json.loads(succeeded(program.here("memory", "list", "--json")))
    modes = {intent["label"]: intent["modes"] for intent in listing["intents"]}
    pattern = next(v for k, v in modes.items() if k == "Intersection Rush-through Go-straight")
    assert sorted(modes["Ramp Merge Rush"]) == sorted(pattern)
    assert len(pattern) > 1
