"""Answers of a large language model, replayed: the runs of ``examples/recorded_model`` repeat offline."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli_samples import Program

from sumo_adv.simulation.inputs import data_folder

ROOT = Path(__file__).resolve().parent.parent
RECORDINGS = sorted((ROOT / "examples" / "recorded_model").glob("*.jsonl"))


@pytest.mark.parametrize("recording", RECORDINGS, ids=[r.stem for r in RECORDINGS])
def test_a_recorded_run_repeats(tmp_path: Path, recording: Path) -> None:
    case = data_folder("suites") / "suite81" / f"{recording.stem}.toml"
    settings = ("--ego", "idm", "--seed", "0", "--until", "strict", "--tuner", "off", "--learn", "off")
    done = Program(tmp_path, tmp_path).here(
        "run", case, *settings, "--llm", f"replay:{recording}", "--memory", "bank.sqlite", "--out", "out"
    )  # fmt: skip
    assert done.status == 0, done.err  # the same questions were asked, else the run ends with model_failed
    outcome = done.outcome
    assert outcome["llm"]["calls"] == len(recording.read_text().splitlines()) - 1
    assert outcome["attempts"] and {a["by"] for a in outcome["attempts"]} == {outcome["agents"]["analyzer"]}


def test_a_model_invents_the_drift_out_of_the_blind_side(tmp_path: Path) -> None:
    """Nothing is known for a neighbour: an analysis with two new intents, for each a comparison and a planner."""
    program = Program(tmp_path, tmp_path)
    labels = (
        "Close Car-following,Emergency Braking,Intersection Rush-through Go-straight,"
        "Intersection Rush-through Turn Left,Opposite Direction Intrusion"
    )
    assert program.here("memory", "new", "small.sqlite", "--only", labels).status == 0
    recording = ROOT / "examples" / "blind_side" / "recording.jsonl"
    done = program.here(
        "run", "dual_left_turn_blind_side", "--llm", f"replay:{recording}", "--tuner", "off", "--until", "collision",
        "--memory", "small.sqlite", "--out", "out",
    )  # fmt: skip
    assert done.status == 0, done.err
    (attempt,) = done.outcome["attempts"]
    assert attempt["intent"] == "Catch-up Lateral Drift Sideswipe" and attempt["collided"]
    assert done.outcome["llm"]["calls"] == 6


def test_there_are_recordings() -> None:
    assert len(RECORDINGS) >= 4
