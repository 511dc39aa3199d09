"""``run`` with pedestrians and cyclists, through the real command line."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_samples import Done, Program, read_states
from log_samples import RIGHT, moving, write_scenario

from sumo_adv.memory.bank import MemoryBank


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> Done:
    """A pedestrian runs out from behind a van across the road, against IDM."""
    program = Program(tmp_path_factory.mktemp("foot"), caches)
    return program.here(
        "run", "pedestrian_far_side_parked", "--ego", "idm", "--until", "strict", "--attempts", "6", "--memory",
        "bank.sqlite", "--json", "--out", "out",
    )  # fmt: skip


def test_it_is_hit_and_a_careful_driver_would_have_avoided_it(done: Done) -> None:
    assert (done.status, done.err) == (0, "")
    document = done.outcome
    best = document["outcome"]
    assert document["ending"] == "critical" and best["level"] in ("strict", "serious")
    assert {a["adversaries"][0] for a in document["attempts"]} == {"pedestrian0"}
    assert best["impact_speed"] > 0.0 and best["humanlike"] and best["failed_gates"] == []
    assert best["cause"]["sentence"].startswith("Your driver ") and best["cause"]["reference"] == "cc_human"
    assert (best["injury_risk"] >= 0.1) is (best["level"] == "serious")


def test_it_stands_behind_the_van_until_it_starts_and_never_runs(done: Done) -> None:
    """It is at most as fast as a person; the van's side towards the road is at y = 4.6."""
    rows = read_states(done.folder / "states.csv.gz")["pedestrian0"]
    first = min(rows)
    assert (float(rows[first]["x"]), float(rows[first]["y"])) == pytest.approx((184.8, 6.7))
    assert max(float(row["speed"]) for row in rows.values()) <= 4.0
    assert {row["role"] for row in rows.values()} == {"adversary"}


def test_the_bank_learns_the_intent(done: Done) -> None:
    label = done.outcome["attempts"][-1]["intent"]
    with MemoryBank.open(done.folder.parent / "bank.sqlite", read_only=True) as bank:
        assert label in {record.label for record in bank.intents()}
        assert [e.success for e in bank.evidence(label)] == [True]


def test_it_repeats(done: Done, tmp_path: Path, caches: Path) -> None:
    again = Program(tmp_path, caches).here("run", "--replay", done.folder, "--json", "--out", "out")
    assert again.status == 0
    assert read_states(again.folder / "states.csv.gz") == read_states(done.folder / "states.csv.gz")


def test_a_pedestrian_of_a_log_attacks_only_where_it_is_named(tmp_path: Path, caches: Path) -> None:
    tracks = [
        moving("e", 60.0, RIGHT, 10.0),
        moving("walker", 150.0, RIGHT - 5.0, 0.0, kind="pedestrian", heading=1.57, size=(0.6, 0.6)),
    ]
    case = write_scenario(tmp_path, tracks, routed=("e",))
    command = ("run", case, "--ego", "idm", "--attempts", "1", "--json", "--out", "out")
    assert Program(tmp_path / "alone", caches).here(*command).outcome["attempts"] == []
    named = Program(tmp_path / "named", caches).here(*command, "--adversary", "walker").outcome
    assert [a["adversaries"] for a in named["attempts"]] == [["walker"]]
