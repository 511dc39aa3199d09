"""``memory add | merge | retire | new | export | import | verify | calibrate | stats`` as a user has them."""

from __future__ import annotations

import json
import shutil
from typing import Any

import pytest
from bank_samples import evidence
from cli_samples import BAD_PLANNERS, ROOT, TRAIL, Done, Program, bank_with, refused

from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import RELATIONS, IntentRecord, SceneSignature, StoredIntent
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.text import make_planner
from sumo_adv.planners.trial import CROSSING_ANGLES_RAD, LANE_PLACES_M, UNPROTECTED_SIZES_M, probes, trial

SHIPPED = ROOT / "memory_bank.sqlite"
PARAPHRASES = ROOT / "tests" / "data" / "intents_paraphrases.toml"
COMMANDS = (
    "list", "show", "find", "stats", "add", "merge", "retire", "new", "export", "import", "build", "verify",
    "calibrate",
)  # fmt: skip


def printed_json(done: Done) -> dict[str, Any]:
    assert (done.status, done.err) == (0, ""), done.err
    return dict(json.loads(done.out))


def test_every_command_has_help_with_an_example(program: Program) -> None:
    listed = program.here("memory", "--help").out
    for command in COMMANDS:
        assert command in listed
    assert (
        "Example: sumo-adv memory merge" in program.here("memory", "merge", "--help").out
    )  # the others are made alike


def test_a_planner_of_ones_own_is_tried_added_merged_and_retired(program: Program) -> None:
    bank = program.folder / "bank.sqlite"
    (program.folder / "trail.py").write_text(TRAIL)
    (program.folder / "bad.py").write_text(BAD_PLANNERS["raises"])
    shutil.copy(SHIPPED, bank)
    use = ("--memory", bank)
    new_intent = ("--label", "Trailing Along", "--description", "It drives beside the ego.", "--applies", "neighbour")
    refused(program.here("memory", "add", "bad.py", *new_intent, *use), 2, "division by zero")
    refused(
        program.here("memory", "add", "trail.py", "--label", "Trailing Along", *use), 2, "is new: give --description"
    )
    with MemoryBank.open(bank) as opened, MemoryBank.open(SHIPPED, read_only=True) as shipped:
        assert opened.content_hash() == shipped.content_hash()
    added = printed_json(program.here("memory", "add", "trail.py", *new_intent, *use, "--json"))
    assert (added["label"], added["mode"]) == ("Trailing Along", "trail")
    refused(
        program.here("memory", "add", "trail.py", "--label", "trailing along", *use), 2, "already, as the mode 'trail'"
    )
    refused(
        program.here("memory", "merge", "Trailing Along", "Straight Lane Shift", *use),
        2,
        "Give two intents: memory merge",
    )
    merged = printed_json(
        program.here("memory", "merge", "trailing along", "into", "straight lane shift", *use, "--json")
    )
    assert merged == {
        "merged": "Trailing Along",
        "into": "Straight Lane Shift",
        "modes": ["nudge", "side", "tail", "trail", "weave"],
    }
    retired = printed_json(program.here("memory", "retire", "Straight Lane Shift", "--mode", "trail", *use, "--json"))
    assert retired == {"label": "Straight Lane Shift", "status": "active", "modes": ["nudge", "side", "tail", "weave"]}
    recalled = printed_json(program.here("memory", "find", "Trailing along", *use, "--json"))
    assert recalled["hit"] == "Straight Lane Shift"
    assert recalled["band"] is False
    counts = printed_json(program.here("memory", "stats", *use, "--json"))
    assert (counts["intents"], counts["active"], counts["planners"], counts["evidence"]) == (8, 7, 24, 0)
    assert [p["mode"] for p in counts["by_planner"] if p["retired"]] == ["trail"]
    shown = printed_json(program.here("memory", "show", "Straight Lane Shift", *use, "--json"))
    assert [(p["mode"], p["origin"], p["status"]) for p in shown["planners"]] == [
        ("nudge", "seed", "active"), ("side", "seed", "active"), ("tail", "seed", "active"),
        ("trail", "person", "retired"), ("weave", "seed", "active"),
    ]  # fmt: skip


def test_a_bank_goes_out_and_comes_in_and_code_that_attacks_stays_out(program: Program) -> None:
    out = program.folder / "shared"
    exported = printed_json(program.here("memory", "export", out, "--memory", SHIPPED, "--json"))
    made = printed_json(
        program.here("memory", "new", "two.sqlite", "--only", "emergency braking,Close Car-following", "--json")
    )
    assert made["intents"] == ["Close Car-following", "Emergency Braking"]
    bad = out / "aggressive_cut_in" / "attack.py"
    bad.write_text(BAD_PLANNERS["allocates"])
    refused(program.here("memory", "import", out, "--memory", "two.sqlite"), 2, "Aggressive Cut-in / attack: ")
    with MemoryBank.open(program.folder / "two.sqlite", read_only=True) as bank:
        assert len(bank.intents()) == 2
    skipped = printed_json(program.here("memory", "import", out, "--memory", "two.sqlite", "--skip-refused", "--json"))
    assert (skipped["intents"], [each["mode"] for each in skipped["refused"]]) == (5, ["attack"])
    with MemoryBank.open(program.folder / "two.sqlite", read_only=True) as bank:
        assert bank.content_hash() == exported["hash"]
    assert {p.name for p in program.folder.iterdir()} >= {"shared", "two.sqlite"}
    assert not [p.name for p in program.folder.iterdir() if p.name.startswith(".")]


def test_verify_finds_the_planner_that_fails(program: Program) -> None:
    good = printed_json(program.here("memory", "verify", "--memory", SHIPPED, "--label", "emergency braking", "--json"))
    assert [(p["label"], p["ok"]) for p in good["planners"]] == [("Emergency Braking", True)]
    bank_with(program.folder / "bad.sqlite", BAD_PLANNERS["teleports"])
    bad = program.here("memory", "verify", "--memory", "bad.sqlite", "--json")
    assert bad.status == 1
    [planner] = json.loads(bad.out)["planners"]
    assert not planner["ok"]
    assert "which no vehicle reaches" in planner["failure"]


def test_verify_runs_a_scenario_again_and_finds_the_evidence_that_is_not_so(program: Program) -> None:
    path = program.folder / "bank.sqlite"
    with MemoryBank.open(SHIPPED, read_only=True) as shipped:
        cut_in = next(source for source in shipped.stored_intents() if source.intent.label == "Aggressive Cut-in")
    claims = {"network": "motorway_cut_in_left", "seed": 0, "scene": SceneSignature("straight", "neighbour", {}, "idm")}
    trail = make_planner("Odd Driving", "trail", TRAIL, "person")
    with MemoryBank.open(path) as bank:
        bank.absorb([cut_in, StoredIntent(IntentRecord("Odd Driving", "It drives along.", ("neighbour",)), (trail,))])
        bank.record(evidence(label="Aggressive Cut-in", planner_hash=cut_in.planners[0].hash, **claims))
        bank.record(evidence(label="Odd Driving", planner_hash=trail.hash, **claims))
    done = program.here(
        "memory", "verify", "--memory", path, "--scenario", "motorway_cut_in_left", "--attempts", "3", "--json"
    )  # fmt: skip
    assert (done.status, done.err) == (1, "")
    good, _, bad = json.loads(done.out)["planners"]  # of the cut-in, two planners
    assert (good["ok"], good["rerun"]["ok"]) == (True, True)
    assert 1 <= good["rerun"]["attempts"] <= 3
    assert (bad["ok"], bad["rerun"]["ok"]) == (False, False)
    assert "but not in" in bad["failure"]


def test_calibration_is_printed_and_stored_only_when_asked(program: Program) -> None:
    shutil.copy(SHIPPED, program.folder / "bank.sqlite")
    first = printed_json(program.here("memory", "calibrate", PARAPHRASES, "--memory", "bank.sqlite", "--json"))
    assert (first["stored"], first["sets"][0]["known"], first["sets"][0]["novel"]) == (False, 77, 30)
    with MemoryBank.open(program.folder / "bank.sqlite") as bank:
        assert bank.epsilon()[0] == first["before"]
        bank.retire("Straight Lane Shift")
    stored = printed_json(
        program.here("memory", "calibrate", PARAPHRASES, "--memory", "bank.sqlite", "--store", "--json")
    )
    assert (stored["sets"][0]["known"], stored["sets"][0]["novel"]) == (
        66,
        41,
    )  # 11 paraphrases of the retired one are novel now
    with MemoryBank.open(program.folder / "bank.sqlite") as bank:
        assert bank.epsilon() == (stored["epsilon"], stored["calibrated_on"])
    assert stored["calibrated_on"].endswith("41 novel behaviours, a bank of 6 intents")


def test_there_are_probes_for_every_relation() -> None:
    assert set(LANE_PLACES_M) | set(CROSSING_ANGLES_RAD) | set(UNPROTECTED_SIZES_M) == set(RELATIONS)
    names = [probe.name for relation in RELATIONS for probe in probes(relation)]
    assert len(set(names)) == len(names) == len(RELATIONS) * 2 * 3 * 3
    behind = probes("follower")[6]  # fast, straight: 16 m behind at 25 m/s
    assert behind.name == "follower, fast, straight, after 0 s"
    assert (behind.bv["x"], behind.bv["ahead"], behind.bv["speed"]) == (-16.0, -16.0, 25.0)
    assert behind.ego["path"][2] == [2.0, 48.0, 0.0, 0.0, 24.0]


def test_every_planner_of_the_shipped_bank_passes(sandbox: Sandbox) -> None:
    with MemoryBank.open(SHIPPED, read_only=True) as bank:
        results = {
            (record.label, planner.mode): trial(sandbox, planner, record.applies)
            for record in bank.intents()
            for planner in bank.planners(record.label)
        }
    assert set(results.values()) == {None}
    assert len(results) == 23


HEAD = TRAIL.partition('    pose = at(ego["path"]')[0]


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        (BAD_PLANNERS["loops"], "time limit"),
        (BAD_PLANNERS["another type"], "must return a dict"),
        (HEAD.replace("def ", "asked = []\n\n\ndef ") + "    asked.append(1)\n"
         '    return {"x": bv["x"] + len(asked) * 0.001, "y": bv["y"], "heading": 0.0, "speed": 5.0, "time": 2.0}\n',
         "depends on earlier calls"),
        (HEAD + '    return {"x": 1 / ego["speed"], "y": 0.0, "heading": 0.0, "speed": 5.0, "time": 9.0}\n',
         "standing"),
        (TRAIL + "\n\ndef trajectory(bv, endpoint, road, dt):\n    return []\n", "1 to 400 states"),
        (TRAIL + "\n\ndef trajectory(bv, endpoint, road, dt):\n    v = bv['speed']\n"
         "    return [(bv['x'], bv['y'], 0.0, v), (bv['x'] + 500.0, bv['y'], 0.0, v)]\n", "jumps between states 0"),
        (HEAD + '    return {"x": bv["x"], "y": bv["y"] + 40.0, "heading": 0.0, "speed": 5.0, "time": 3.0}\n',
         "m beside the road"),
    ],
)  # fmt: skip
def test_a_trial_names_what_is_wrong(sandbox: Sandbox, source: str, sentence: str) -> None:
    wrong = trial(sandbox, make_planner("Odd", "m", source, "person"), ("leader", "neighbour"))
    assert wrong is not None
    assert sentence in wrong
