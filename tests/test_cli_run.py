"""``run`` through the real command line: the files of the contract, the same again, replays, every built-in ego."""

from __future__ import annotations

import gzip
import json
import struct
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from cli_samples import Done, Program, Runs, files_of, lacking, read_states, untimed

from sumo_adv.datatypes import Ending

HEADER = "time,id,role,x,y,heading,speed,acceleration,length,width,lane"
OUTCOME = {
    "schema", "ending", "reason", "network", "seed", "ego", "adversaries", "trigger_time", "agents", "intent", "raw",
    "attempts", "best", "outcome", "realism", "timing", "llm",
}  # fmt: skip
AGENTS = {"analyzer", "generator", "modifier", "tuner"}
INTENT = {"label", "description", "risk", "acceleration", "source", "recall"}
ATTEMPT = {
    "index", "by", "phase", "adversaries", "intent", "planner", "parameters", "trigger_time", "min_ttc", "min_distance",
    "collided", "critical", "feasible", "rear_end", "valid", "failed_gates", "ending",
}  # fmt: skip
BEST = {
    "min_ttc", "min_ttc_any", "min_pet", "max_drac", "min_distance", "collided", "critical", "feasible", "rear_end",
    "valid", "strict", "fault", "failed_gates",
}  # fmt: skip
MODEL = {"model", "calls", "prompt_tokens", "completion_tokens", "seconds"}
MANIFEST = {"schema", "versions", "network", "routes", "settings", "seed", "bank_hash", "planners", "model_answers"}


def quiet_success(done: Done) -> dict[str, Any]:
    """Exit 0, nothing on stderr, one JSON object on stdout that is the outcome; gives it back."""
    assert (done.status, done.err) == (0, "")
    printed = json.loads(done.out)
    assert printed.pop("folder") == "out"
    assert printed == done.outcome
    return dict(printed)


# -- the files of the contract


def test_a_run_leaves_all_files_and_says_one_json_object(runs: Runs) -> None:
    done = runs["first"]
    outcome = quiet_success(done)
    assert lacking(done.folder) == set()
    assert done.folder.stat().st_mode & 0o777 == 0o755
    assert set(outcome) >= OUTCOME
    assert (outcome["schema"], outcome["network"], outcome["seed"]) == (2, "leader_two_lanes", 0)
    assert outcome["ego"] == {"id": "ego", "controller": "idm"}
    assert outcome["ending"] in set(Ending)
    assert outcome["reason"].endswith(".")


def test_every_part_of_the_outcome_has_its_keys(runs: Runs) -> None:
    outcome = runs["first"].outcome
    assert set(outcome["agents"]) >= AGENTS
    assert set(outcome["intent"]) >= INTENT
    assert set(outcome["raw"]) >= {"min_ttc", "collided"}
    assert set(outcome["outcome"]) >= BEST
    assert set(outcome["llm"]) >= MODEL
    assert all(set(a) >= ATTEMPT for a in outcome["attempts"])
    assert [a["index"] for a in outcome["attempts"]] == list(range(len(outcome["attempts"])))


def test_the_attempt_that_counts_is_one_of_the_attempts(runs: Runs) -> None:
    outcome = runs["first"].outcome
    best = outcome["attempts"][outcome["best"]]
    same = ("min_ttc", "min_distance", "collided", "critical", "feasible", "rear_end", "valid")
    assert [best[k] for k in same] == [outcome["outcome"][k] for k in same]
    assert [each["id"] for each in outcome["adversaries"]] == best["adversaries"]
    assert outcome["trigger_time"] == best["trigger_time"]
    assert outcome["intent"]["label"] == best["intent"]
    if outcome["ending"] == "critical":
        assert best["valid"] is True
        assert f"Why: {outcome['outcome']['cause']['sentence']}" in runs["again"].out.splitlines()
        assert outcome["best"] == len(outcome["attempts"]) - 1


def test_the_expert_is_called_the_expert(runs: Runs) -> None:
    outcome, text = runs["first"].outcome, runs["again"].out
    assert [outcome["agents"][k] for k in ("analyzer", "generator", "modifier")] == ["expert", "expert", "none"]
    assert "no language model" in outcome["agents"]["note"]
    assert outcome["llm"]["model"] is None and outcome["llm"]["calls"] == 0
    assert outcome["attempts"][0]["by"] == "expert"
    assert {a["by"] for a in outcome["attempts"][1:]} <= {"tuner", "expert"}
    assert outcome["agents"]["note"] in text


@pytest.mark.parametrize("name", ["states.csv.gz", "raw.csv.gz"])
def test_tables_of_states_are_regular(runs: Runs, name: str) -> None:
    file = runs["first"].folder / name
    assert struct.unpack("<I", file.read_bytes()[4:8]) == (0,)  # no time stamp in the gzip header
    assert gzip.decompress(file.read_bytes()).decode().splitlines()[0] == HEADER
    states = read_states(file)
    roles = {vehicle: {row["role"] for row in rows.values()} for vehicle, rows in states.items()}
    adversaries = {a["id"] for a in runs["first"].outcome["adversaries"]} if name.startswith("states") else set()
    assert roles.pop("ego") == {"ego"}
    assert {v for v, r in roles.items() if r == {"adversary"}} == adversaries
    assert all(r <= {"adversary", "background"} for r in roles.values())
    times = sorted(states["ego"])
    assert all(b - a == pytest.approx(0.1) for a, b in pairwise(times))


def test_the_picture_is_a_picture(runs: Runs) -> None:
    data = (runs["first"].folder / "encounter.png").read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    width, height = struct.unpack(">II", data[16:24])
    assert width > 500 and height > 300


def test_the_manifest_names_copies_of_the_inputs(runs: Runs) -> None:
    done = runs["first"]
    manifest = done.manifest
    assert set(manifest) >= MANIFEST
    copies = {p.name for p in (done.folder / "inputs").iterdir()}
    assert {manifest["network"], *manifest["routes"]} == copies
    used = {a["planner"]["hash"] for a in done.outcome["attempts"]}
    assert set(manifest["planners"]) == used
    assert str(done.folder.parent) not in (done.folder / "manifest.json").read_text(encoding="utf-8")


def test_people_get_lines(runs: Runs) -> None:
    done = runs["again"]
    assert (done.status, done.err) == (0, "")
    lines = done.out.splitlines()
    assert lines[0].startswith("Encounter at ")
    attempts = [line for line in lines if line.startswith("  attempt ")]
    made = len(done.outcome["attempts"]) + sum(t["attempts"] for t in done.outcome["encounters_tried"])
    assert 1 <= len(attempts) <= made  # a line for each that came to more than all before
    assert lines[-1] == "Files: out"
    assert "\x1b" not in done.out


def test_no_encounter_is_a_result(runs: Runs) -> None:
    outcome = quiet_success(runs["nothing"])
    assert outcome["ending"] == "no_encounter"
    assert "20 s" in outcome["reason"] and outcome["reason"].endswith(".")
    assert outcome["attempts"] == [] and outcome["best"] is None
    assert outcome["outcome"] is None and outcome["raw"] is None
    assert lacking(runs["nothing"].folder, {"outcome.json", "manifest.json", "inputs"}) == set()


@pytest.mark.parametrize("ego", ["krauss", "eidm", "replay", "careful"])
def test_every_built_in_ego_runs(runs: Runs, ego: str) -> None:
    outcome = quiet_success(runs[ego])
    assert outcome["ego"] == {"id": "ego", "controller": ego}
    assert outcome["attempts"]
    assert lacking(runs[ego].folder) == set()


# -- the same again


def test_the_same_again_in_another_new_home_is_the_same(runs: Runs) -> None:
    first, again = runs["first"], runs["again"]
    first_files, again_files = files_of(first.folder), files_of(again.folder)
    assert first_files.keys() == again_files.keys()
    assert [name for name in first_files if name != "outcome.json" and first_files[name] != again_files[name]] == []
    assert untimed(first.outcome) == untimed(again.outcome)


def test_another_seed_is_another_run(runs: Runs) -> None:
    first, other_seed = runs["first"], runs["other seed"]
    assert quiet_success(other_seed)["seed"] == 1
    assert first.outcome["attempts"] != other_seed.outcome["attempts"]
    assert (first.folder / "raw.csv.gz").read_bytes() != (other_seed.folder / "raw.csv.gz").read_bytes()


def test_a_fork_is_the_same_as_loading_and_repeating(runs: Runs) -> None:
    first, loaded = runs["first"], runs["loaded"]
    a, b = quiet_success(first), quiet_success(loaded)
    assert (a.pop("forked"), b.pop("forked")) == (True, False)
    assert untimed(a) == untimed(b)
    for name in ("states.csv.gz", "raw.csv.gz", "encounter.png"):
        assert (first.folder / name).read_bytes() == (loaded.folder / name).read_bytes()


# -- replays


def test_a_replay_gives_the_same_states(runs: Runs, program: Program) -> None:
    first = runs["first"]
    done = program("run", "--replay", first.folder, "--out", "out", "--json")
    outcome = quiet_success(done)
    for name in ("states.csv.gz", "raw.csv.gz", "encounter.png"):
        assert (done.folder / name).read_bytes() == (first.folder / name).read_bytes(), name
    assert outcome["outcome"] == first.outcome["outcome"]
    assert len(outcome["attempts"]) == 1
    assert files_of(done.folder / "inputs") == files_of(first.folder / "inputs")
    assert not (program.home / "data").exists()  # a replay needs no bank
    assert program.leftovers() == ["out"]


def copy_of(done: Done, target: Path) -> Path:
    for name, data in files_of(done.folder).items():
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (target / name).write_bytes(data)
    return target


def changed(manifest: dict[str, Any], change: str) -> None:
    """Damage a manifest in one place."""
    if change == "planner":
        planner = manifest["planners"][manifest["attempt"]["planner"]]
        planner["source"] = planner["source"].replace("0.45", "0.46") + "\n"
    elif change == "schema":
        manifest["schema"] = 99
    elif change == "lacking":
        del manifest["attempt"]["parameters"]
    elif change == "delay":
        manifest["attempt"]["delay"] = 99.0
    elif change == "vehicle":
        manifest["attempt"]["bv"] = "nobody"
    else:
        manifest["settings"]["attempts"] = "many"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("planner", "changed"), ("schema", "schema 99"), ("lacking", "not a manifest"), ("settings", "attempts"),
        ("delay", "99"), ("vehicle", "nobody"), ("network", "changed"), ("demand", "missing"),
        ("json", "not a manifest"), ("none", "manifest.json"),
    ],
)  # fmt: skip
def test_a_changed_run_is_not_replayed(runs: Runs, program: Program, change: str, says: str) -> None:
    folder = copy_of(runs["first"], program.folder / "copy")
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    if change == "network":
        (folder / "inputs" / manifest["network"]).open("a").write("<!-- -->\n")
    elif change == "demand":
        (folder / "inputs" / manifest["routes"][0]).unlink()
    elif change == "json":
        (folder / "manifest.json").write_text("{")
    elif change == "none":
        (folder / "manifest.json").unlink()
    else:
        changed(manifest, change)
        (folder / "manifest.json").write_text(json.dumps(manifest))
    done = program.here("run", "--replay", folder, "--out", "out", "--json")
    assert done.status in (1, 2)
    assert done.err.startswith("sumo-adv: ") and len(done.err.splitlines()) == 1
    assert says in done.err
    assert (done.out, program.leftovers()) == ("", ["copy"])


def test_without_time_for_a_further_encounter_the_first_one_is_attacked(program: Program) -> None:
    """At 16 s no candidate is predicted to collide; attempts will tell, so the encounter is not passed over."""
    few = ("--seed", "1", "--attempts", "1", "--learn", "off", "--total-seconds", "0")
    done = program.here("run", "roundabout", *few, "--out", "run")
    manifest = json.loads((program.folder / "run" / "manifest.json").read_text(encoding="utf-8"))
    assert manifest["skips"] == 0, done.err
