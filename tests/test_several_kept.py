"""``keep`` and ``regress`` with supports: a case holds all adversaries, and all drive again."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import pytest
from cli_samples import Program
from several_samples import COLLIDER, SUPPORT, pinch, pinched

from sumo_adv.datatypes import Duty
from sumo_adv.errors import UsageError
from sumo_adv.regression.case import Expectation, read_case
from sumo_adv.regression.keep import keep_run


def kept(folder: Path) -> Path:
    keep_run(pinched(), folder / "suite", Expectation(avoid="collision"), "pinch")
    return folder / "suite"


def test_a_case_holds_all_adversaries_and_regress_repeats_them(program: Program) -> None:
    suite = kept(program.folder)
    case = read_case(suite / "pinch")
    (support,) = case.proposal.supports
    proposal = pinch(COLLIDER, SUPPORT)
    assert (support.bv, support.duty, support.parameters) == (
        SUPPORT, Duty.BLOCK_RIGHT, proposal.supports[0].parameters
    )  # fmt: skip
    assert [p.planner for p in case.proposal.members] == [p.planner for p in proposal.members]
    assert case.proposal.composition == "Pinch"
    assert case.relations == {COLLIDER: "neighbour", SUPPORT: "neighbour"}

    original = json.loads((pinched() / "outcome.json").read_text())
    done = program.here("regress", suite, "--ego", "idm", "--workers", "1", "--out", "out")
    assert (done.status, done.err) == (3, "")
    (measured,) = json.loads((program.folder / "out" / "regress.json").read_text())["cases"]
    assert original["outcome"]["contact_time"] == measured["contact_time"] is not None
    run = program.folder / "out" / "runs" / "pinch"
    assert json.loads((run / "outcome.json").read_text())["adversaries"] == original["adversaries"]
    states = [gzip.decompress((folder / "states.csv.gz").read_bytes()) for folder in (pinched(), run)]
    assert states[0] == states[1]


@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        ("case.toml", 'role = "block_right"', 'role = "collider"', "a support is not a collider"),
        ("case.toml", 'role = "block_right"', 'role = "ram"', "bad 'attack.supports.0.role'"),
        ("case.toml", f'"{SUPPORT}"', f'"{COLLIDER}"', "each adversary must be another vehicle"),
        ("case.toml", "rate = 0.5", "wings = 2.0", "parameter 'wings'"),
        ("scenario.toml", f'["{SUPPORT}"]', '["left_behind"]', "must name the same supports"),
        ("planner_2.py", "def endpoint(", "def endless(", "planner of the case"),
    ],
)  # fmt: skip
def test_a_damaged_support_is_one_sentence(tmp_path: Path, file: str, old: str, new: str, said: str) -> None:
    folder = kept(tmp_path) / "pinch"
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new, 1))
    with pytest.raises(UsageError, match=said) as raised:
        read_case(folder)
    assert "\n" not in str(raised.value)
