"""The program from Python: a light import, what a run gives back, and no guard needed in scripts."""

from __future__ import annotations

import csv
import gzip
import json
import math
import subprocess
import sys
from dataclasses import FrozenInstanceError
from pathlib import Path

import numpy as np
import pytest
from cli_samples import ROOT
from run_samples import run_folder

import sumo_adv
from sumo_adv.datatypes import Level, Verdict
from sumo_adv.errors import UsageError
from sumo_adv.report.run_outcome import verdict_of

UNGUARDED = """
import sumo_adv
print("once")
told = []
result = sumo_adv.run("motorway_cut_in_left", attempts=1, proposals=24, seed=0, learn="off", memory="bank.sqlite",
                      tell=lambda what, value: told.append(what))
folder = result.folder
assert (folder / "outcome.json").is_file()
print(result.outcome.ending, told)
del result
print(folder.exists())
"""


def python(code: str | Path, folder: Path, *options: str) -> str:
    """What a new interpreter prints in ``folder``."""
    arguments = [str(code)] if isinstance(code, Path) else ["-c", code]
    done = subprocess.run(
        [sys.executable, *options, *arguments], capture_output=True, text=True, check=False, cwd=folder, timeout=180
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_is_light(tmp_path: Path) -> None:
    heavy = "numpy", "pydantic", "matplotlib", "typer", "libsumo", "httpx", "shapely", "IPython"
    output = python(f"import sumo_adv, sys; print([m for m in {heavy!r} if m in sys.modules])", tmp_path)
    assert output == "[]\n"


def test_the_names_are_few() -> None:
    drivers = {"LaneSpeed", "Observation", "PlannedPose", "Pose", "Steer"}
    names = {"Campaign", "Result", "__version__", "batch", "crash_rate", "hunt", "judge", "load", "run"}
    assert set(sumo_adv.__all__) == names | drivers == set(dir(sumo_adv))
    assert all(getattr(sumo_adv, name) for name in sumo_adv.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'walk'"):
        _ = sumo_adv.walk


def test_a_script_needs_no_guard_and_a_temporary_folder_goes_with_its_result(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED)
    once, ending_and_events, there = python(script, tmp_path).splitlines()
    assert once == "once"  # the engine's process did not run the script again
    assert ending_and_events.endswith("['encounter', 'intents', 'attempt']")
    assert there == "False"
    assert sorted(p.name for p in tmp_path.iterdir() if not p.name.startswith("bank.sqlite")) == ["script.py"]


def test_a_bare_network_gets_traffic(tmp_path: Path) -> None:
    result = sumo_adv.run("straight_3lane", density=1, end=20, out=tmp_path / "out", memory=tmp_path / "bank.sqlite")
    assert result.outcome.ending == "no_encounter"
    assert result.outcome.verdict is None and result.outcome.level == Level.NONE
    assert {len(column) for column in result.states.values()} == {0}
    assert len(list((result.folder / "inputs").glob("*.rou.xml"))) == 1  # a copy of what was generated
    with pytest.raises(UsageError, match="made no attempt"):
        result.plot()
    with pytest.raises(UsageError, match="nothing to export"):
        result.export(tmp_path / "a.csv", "csv")


def test_the_outcome_is_the_file() -> None:
    result = sumo_adv.load(run_folder("crossing"))
    outcome, written = result.outcome, json.loads((result.folder / "outcome.json").read_text())
    assert outcome.document == written
    level = (written["outcome"] or {}).get("level")
    came_to = level if written["ending"] == "critical" else written["ending"]
    assert repr(result) == f"<sumo_adv.Result {came_to}, {len(written['attempts'])} attempts: {result.folder}>"
    assert (outcome.ending, outcome.network, outcome.seed) == (written["ending"], written["network"], written["seed"])
    assert (outcome.ego, outcome.ego_driver) == ("ego", "idm")
    assert outcome.adversary == written["adversaries"][0]["id"] and outcome.trigger_time == written["trigger_time"]
    cause = written["outcome"]["cause"]
    assert (outcome.cause is None) is (cause is None)
    if cause is not None and outcome.cause is not None:
        assert (str(outcome.cause.kind), outcome.cause.sentence) == (cause["kind"], cause["sentence"])
        assert outcome.cause.enough == cause["enough"]
    assert outcome.intent is not None and outcome.intent.label == written["intent"]["label"]
    assert [(a.index, a.intent, str(a.level)) for a in outcome.attempts] == [
        (a["index"], a["intent"], a["level"]) for a in written["attempts"]
    ]


def test_the_verdict_is_the_noun_that_judge_returns() -> None:
    result = sumo_adv.load(run_folder("crossing"))
    verdict, written = result.outcome.verdict, result.outcome.document["outcome"]
    assert isinstance(verdict, Verdict)
    assert (str(verdict.level), verdict.collided) == (written["level"], written["collided"])
    assert verdict.min_ttc == (math.inf if written["min_ttc"] is None else written["min_ttc"])
    assert result.outcome.level == verdict.level
    if written["preventable_by"] is not None:
        assert verdict.preventability is not None
        assert list(verdict.preventability.by) == written["preventable_by"]
    with pytest.raises(FrozenInstanceError):
        result.outcome.seed = 3  # type: ignore[misc]


def test_never_is_infinite_and_null_in_the_file() -> None:
    verdict = verdict_of(
        {
            "min_ttc": None, "min_distance": 2.5, "collided": False, "critical": False, "feasible": True,
            "rear_end": False, "failed_gates": [], "level": "none", "min_ttc_any": None, "min_pet": None,
            "log_gates": [], "beyond_human": [], "references": None,
        }
    )  # fmt: skip
    assert (verdict.min_ttc, verdict.min_distance, verdict.level) == (math.inf, 2.5, Level.NONE)


def test_criticality_is_a_table_in_which_never_is_nan() -> None:
    result = sumo_adv.load(run_folder("crossing"))
    with gzip.open(result.folder / "criticality.csv.gz", "rt") as file:
        rows = list(csv.DictReader(file))
    table = result.criticality
    assert list(table) == list(rows[0]) and {len(column) for column in table.values()} == {len(rows)}
    k = next(k for k, row in enumerate(rows) if row["ttc"] == "")
    assert np.isnan(table["ttc"][k]) and table["gap"][k] == float(rows[k]["gap"])
    assert table["id"][k] == rows[k]["id"]


@pytest.mark.parametrize("table_name", ["states", "raw"])
def test_tables_are_columns_of_the_files(table_name: str) -> None:
    result = sumo_adv.load(run_folder("crossing"))
    table = getattr(result, table_name)
    with gzip.open(result.folder / f"{table_name}.csv.gz", "rt") as file:
        rows = list(csv.DictReader(file))
    assert list(table) == list(rows[0])
    assert {len(column) for column in table.values()} == {len(rows)}
    assert table["x"].dtype == np.float64 and table["id"][0] == rows[0]["id"]
    assert table["y"][-1] == float(rows[-1]["y"])


def test_pandas_takes_them() -> None:
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    result = sumo_adv.load(run_folder("crossing"))
    frame = pandas.DataFrame(result.states)
    assert set(frame[frame.role == "ego"].id) == {"ego"}
    least = pandas.DataFrame(result.criticality).groupby("id").gap.min()
    adversary = result.criticality["id"] == result.outcome.adversary
    assert least[result.outcome.adversary] == result.criticality["gap"][adversary].min()


def test_plot_and_show_can_be_seen_inline() -> None:
    result = sumo_adv.load(run_folder("crossing"))
    assert result.plot()._repr_png_()[:4] == b"\x89PNG"  # type: ignore[attr-defined]
    frame = result.show(height=500)._repr_html_()
    assert frame.startswith('<iframe srcdoc="&lt;!DOCTYPE html&gt;') and frame.endswith("</iframe>")
    assert frame.count("<") == 2 and frame.count('"') == 12  # the page itself is quoted
    assert 'height="500" sandbox="allow-scripts"' in frame


def test_exports_are_those_of_the_command_line(tmp_path: Path) -> None:
    result = sumo_adv.load(run_folder("crossing"))
    assert result.export(tmp_path / "a.csv", "csv") == tmp_path / "a.csv"
    assert (tmp_path / "a.csv").read_text().startswith("time_s,vehicle,")
    with pytest.raises(UsageError, match="already exists"):
        result.export(tmp_path / "a.csv", "csv")
    with pytest.raises(UsageError, match="'video' is not a valid Format for an export"):
        result.export(tmp_path / "b", "video")


def test_wrong_use_leaves_nothing(tmp_path: Path) -> None:
    for arguments, says in (
        ({"nonsense": 1}, "nonsense"),
        ({"ego": "nobody"}, "nobody"),
        ({"until": "never"}, "until"),
    ):
        with pytest.raises(UsageError, match=says):
            sumo_adv.run(
                "motorway_cut_in_left", out=tmp_path / "out", memory=tmp_path / "bank.sqlite", learn="off", **arguments
            )
        assert not (tmp_path / "out").exists()
    with pytest.raises(UsageError, match="There is no file"):
        sumo_adv.run("nowhere")
    with pytest.raises(UsageError, match=r"holds no outcome\.json"):
        sumo_adv.load(tmp_path)
    with pytest.raises(UsageError, match="already exists"):
        sumo_adv.run("motorway_cut_in_left", out=run_folder("crossing"))


def test_the_package_says_that_it_is_typed() -> None:
    assert (ROOT / "sumo_adv" / "py.typed").is_file()
