"""A run gave the driver another vehicle first: the kept case gives it that vehicle again."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

from cli_samples import Program

NETWORK = Path(__file__).parents[1] / "networks" / "motorway.net.xml"


def test_a_case_repeats_what_the_driver_drove_before(program: Program) -> None:
    """Nothing comes near the first egos, which are released after 15 s each; the next one is attacked."""
    run = program.here("run", NETWORK, "--ego", "idm", "--until", "valid", "--learn", "off", "--json", "--out", "out")
    before = run.outcome["encounter"]["driven_before"]
    assert before and all(until - begin > 15.0 for _, begin, until in before)
    program.here("keep", "out", "--suite", "suite", "--all")
    (case,) = (program.folder / "suite").glob("*/case.toml")
    assert tomllib.loads(case.read_text())["attack"]["ego_before"] == before
    again = program.here("regress", "suite", "--ego", "idm", "--out", "again", "--json")
    (row,) = json.loads(again.out)["cases"]
    assert row["level"] == run.outcome["outcome"]["level"] and row["level"] in ("valid", "strict", "serious")
    assert row["delta_v"] == run.outcome["outcome"]["delta_v"]
