"""answers of a large language model to eight requests, replayed: the scenarios of ``examples/words`` come out again."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest
from cli_samples import ROOT, Program

FOLDER = ROOT / "examples" / "words"
REQUESTS = tomllib.loads((FOLDER / "requests.toml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", REQUESTS)
def test_a_recorded_request_becomes_the_same_scenario(tmp_path: Path, name: str) -> None:
    recording, words = FOLDER / f"{name}.jsonl", REQUESTS[name]["words"]
    done = Program(tmp_path, tmp_path).here(
        "write", words, "--attempts", "40", "--seconds", "3600", "--llm", f"replay:{recording}",
        "--memory", "bank.sqlite", "--out", "made.toml", "--run-out", "run", "--json",
    )  # fmt: skip
    assert done.status == 0, done.err  # the same questions were asked
    said = json.loads(done.out)
    assert said["reached"] and said["fits"] and said["read"]
    scenario = tomllib.loads((tmp_path / "made.toml").read_text(encoding="utf-8"))
    assert scenario["written"]["words"] == words and scenario["asked"]
    asked = (tmp_path / "run" / "model.jsonl").read_text(encoding="utf-8").splitlines()
    assert len(asked) == len(recording.read_text(encoding="utf-8").splitlines()) <= 9  # a header and eight questions
