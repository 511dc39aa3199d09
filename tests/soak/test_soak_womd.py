"""Every Waymo record of a folder, with several egos and one attempt each: no run may fail.

``SUMO_ADV_WOMD`` names the folder, by default ``shared/womd`` beside this checkout. It is not part of the project.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from cli_samples import ROOT, Program

from sumo_adv.datatypes import Ending

FOLDER = Path(os.environ.get("SUMO_ADV_WOMD", ROOT.parent / "shared" / "womd"))
RECORDS = sorted(FOLDER.glob("*.tfrecord"))
ENDINGS = {Ending.GOAL_MET, Ending.ATTEMPTS_EXHAUSTED, Ending.NO_ENCOUNTER, Ending.EGO_LEFT}


@pytest.mark.soak
@pytest.mark.skipif(not RECORDS, reason=f"{FOLDER} has no Waymo records; name their folder in SUMO_ADV_WOMD")
@pytest.mark.parametrize("ego", ["idm", "replay", "fiss_plus"])
def test_no_record_ends_in_a_failure(program: Program, ego: str) -> None:
    if ego == "fiss_plus":
        pytest.importorskip("fiss_planner", reason="fiss_plus needs the extra planners")
    failed = {}
    for record in RECORDS:
        done = program.here(
            "run", record, "--ego", ego, "--attempts", "1", "--learn", "off", "--out", "out", "--force", "--json"
        )  # fmt: skip
        ending = json.loads(done.out)["ending"] if done.status == 0 else done.err.strip()
        if ending not in ENDINGS:
            failed[record.stem] = ending
    print(f"\n{len(RECORDS)} records with {ego}: {len(failed)} failed")
    assert failed == {}
