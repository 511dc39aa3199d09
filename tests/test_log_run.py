"""``run`` on recorded tracks, through the real command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_samples import Done, Program, lacking, moves, read_states
from log_samples import LEFT, MIDDLE, RIGHT, moving, write_scenario

PARKED = "[[parked]]\nx = 300.0\ny = -3.0\nheading = 0.05\nlength = 4.0\nwidth = 2.0\n"


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An ego behind a leader, a neighbour beside it, a late vehicle, one unseen for a while, a walker, a parked car."""
    tracks = [
        moving("e", 60.0, RIGHT + 0.3, 14.0), moving("lead", 90.0, RIGHT, 14.0), moving("side", 50.0, MIDDLE, 15.0),
        moving("late", 20.0, LEFT - 0.4, 15.0, gone=(range(30),)),
        moving("gap", 150.0, MIDDLE, 10.0, gone=(range(40, 45),)), moving("off", 100.0, 30.0, 2.0),
        moving("walker", 120.0, -12.0, 1.0, kind="pedestrian", heading=0.3, size=(0.6, 0.6)),
    ]  # fmt: skip
    folder = tmp_path_factory.mktemp("log")
    routed = ("e", "lead", "side", "late", "gap")
    return write_scenario(folder, tracks, routed=routed, more=PARKED, top={"background": '"log"'})


@pytest.fixture(scope="module")
def done(case: Path, tmp_path_factory: pytest.TempPathFactory, caches: Path) -> dict[str, Done]:
    """Runs that forked, that did not, and a replay of the first."""
    runs = {}
    for name, more in {"forked": (), "loaded": ("--no-fork",)}.items():
        program = Program(tmp_path_factory.mktemp(name), caches)
        runs[name] = program.here("run", case, "--ego", "idm", "--attempts", "3", "--json", "--out", "out", *more)
    program = Program(tmp_path_factory.mktemp("replayed"), caches)
    runs["replayed"] = program.here("run", "--replay", runs["forked"].folder, "--json", "--out", "out")
    return runs


def test_it_leaves_all_files_with_the_log_among_its_inputs(done: dict[str, Done]) -> None:
    run = done["forked"]
    assert (run.status, run.err) == (0, "")
    assert lacking(run.folder) == set()
    kept = run.manifest["playback"]
    assert kept["background"] == "log"
    assert kept["tracks"].endswith("-tracks.csv.gz")
    assert (run.folder / "inputs" / kept["tracks"]).is_file()
    assert [p["id"] for p in kept["props"]] == ["parked0"]


def test_boxes_are_obstacles_in_its_tables_and_the_rest_is_where_the_log_had_it(done: dict[str, Done]) -> None:
    run = done["forked"]
    for name in ("raw", "states"):
        states = read_states(run.folder / f"{name}.csv.gz")
        roles = {vehicle: {row["role"] for row in rows.values()} for vehicle, rows in states.items()}
        assert roles["walker"] == roles["parked0"] == {"obstacle"}
        assert roles["e"] == {"ego"}
        assert "obstacle" not in roles["gap"] | roles["off"]
        assert 4.2 not in states["gap"]
        assert float(states["gap"][3.9]["x"]) == pytest.approx(189.0)
        assert max(max(rows) for rows in states.values()) <= 9.0  # nothing beyond the log
    assert states[run.outcome["adversaries"][0]["id"]][2.5]["role"] == "adversary"


def test_attempts_begin_after_the_hand_over(done: dict[str, Done]) -> None:
    assert done["forked"].outcome["encounter"]["time"] >= 1.0
    assert done["forked"].outcome["attempts"]


def test_without_forks_and_replayed_it_is_the_same_run(done: dict[str, Done]) -> None:
    first = done["forked"].folder
    for name in ("loaded", "replayed"):
        assert done[name].status == 0
        for file in ("raw.csv.gz", "states.csv.gz"):
            assert (done[name].folder / file).read_bytes() == (first / file).read_bytes()
    assert (done["forked"].outcome["forked"], done["loaded"].outcome["forked"]) == (True, False)


def test_a_log_that_was_changed_is_not_replayed(done: dict[str, Done], program: Program, case: Path) -> None:
    tracks = done["loaded"].folder / "inputs" / done["loaded"].manifest["playback"]["tracks"]
    kept = tracks.read_bytes()
    tracks.write_bytes(kept + b" ")
    again = program.here("run", "--replay", done["loaded"].folder, "--out", "out")
    tracks.write_bytes(kept)
    assert again.status == 2
    assert "was changed after the run" in again.err


def test_the_command_line_chooses_who_drives_the_background(program: Program, case: Path) -> None:
    run = program.here(
        "run", case, "--background", "sumo", "--ego", "replay", "--attempts", "1", "--json", "--out", "out"
    )
    assert run.status == 0
    assert run.manifest["playback"]["background"] == "sumo"
    raw = read_states(run.folder / "raw.csv.gz")
    assert float(raw["gap"][6.0]["x"]) > 213.0  # faster than the logged 10 m/s
    assert [float(raw["e"][t]["x"]) for t in (1.0, 6.0)] == pytest.approx([74.0, 144.0])


def test_where_nobody_is_near_it_ends_with_the_log_and_says_so(program: Program, tmp_path: Path) -> None:
    case = write_scenario(tmp_path, [moving("e", 60.0, RIGHT, 14.0)], routed=("e",))
    run = program.here("run", case, "--ego", "replay", "--json", "--out", "out")
    assert run.status == 0
    assert json.loads(run.out)["ending"] == "no_encounter"
    assert "In the rest of the recording no other vehicle is there" in run.outcome["reason"]
    assert {"outcome.json", "manifest.json", "inputs"} <= {p.name for p in run.folder.iterdir()}


def test_a_short_log_is_attacked_from_its_second_second_on_however_low_the_risk(
    program: Program, tmp_path: Path
) -> None:
    """The leader drives away, 62 m ahead: its risk never reaches the 0.40 of an encounter in traffic."""
    tracks = [moving("e", 60.0, RIGHT, 14.0), moving("lead", 121.5, RIGHT, 14.5)]
    case = write_scenario(tmp_path, tracks, routed=("e", "lead"))
    run = program.here("run", case, "--ego", "replay", "--attempts", "1", "--json", "--out", "out")
    assert run.status == 0 and run.outcome["ending"] != "no_encounter"
    assert run.outcome["encounter"]["time"] == pytest.approx(1.2, abs=0.11)


def test_a_log_that_becomes_dangerous_by_itself_is_attacked_before(program: Program, tmp_path: Path) -> None:
    """The ego comes at 14 m/s to a standing car, both 4.5 m long. Their centres are 136.5 m apart, so the TTC is 1 s
    after (136.5 - 4.5 - 14) / 14 = 8.4 s. The attempts and the unattacked run end 0.3 s before."""
    tracks = [moving("e", 60.0, RIGHT, 14.0), moving("wall", 196.5, RIGHT, 0.0)]
    case = write_scenario(tmp_path, tracks, routed=("e", "wall"))
    run = program.here(
        "run", case, "--background", "log", "--ego", "replay", "--attempts", "1", "--json", "--out", "out"
    )
    assert [a["adversaries"] for a in run.outcome["attempts"]] == [["wall"]]
    assert max(max(rows) for rows in read_states(run.folder / "raw.csv.gz").values()) == pytest.approx(8.1, abs=0.11)


def test_an_ego_that_is_never_on_a_lane_cannot_be_taken_over(program: Program, tmp_path: Path) -> None:
    case = write_scenario(tmp_path, [moving("e", 60.0, 40.0, 5.0), moving("bv", 60.0, RIGHT, 14.0)], routed=("bv",))
    run = program.here("run", case, "--ego", "idm", "--json", "--out", "out")
    assert run.status == 0
    assert "was on no lane" in run.outcome["reason"]


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("leader_two_lanes", "--background", "log"), "--background log needs recorded tracks"),
        (("leader_two_lanes", "--background", "both"), "background"),
    ],
)
def test_a_background_that_cannot_be_is_wrong_use(program: Program, arguments: tuple[str, ...], part: str) -> None:
    run = program.here("run", *arguments, "--out", "out")
    assert run.status == 2
    assert part in run.err
    assert not run.folder.exists()


def test_states_up_to_the_attack_are_those_of_the_unattacked_run(done: dict[str, Done]) -> None:
    run = done["forked"]
    raw, states = (read_states(run.folder / f"{name}.csv.gz") for name in ("raw", "states"))
    start = run.outcome["trigger_time"]
    for vehicle, rows in states.items():
        for time, row in rows.items():
            if time <= start:
                assert moves(row) == moves(raw[vehicle][time])
