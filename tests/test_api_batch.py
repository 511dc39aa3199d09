"""Batches from Python: the same as on the command line, from a script without a guard, read with pandas."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from batch_samples import INPUTS, SETTINGS
from test_api import python

import sumo_adv
from sumo_adv.campaigns.results import write_csv
from sumo_adv.errors import UsageError

UNGUARDED = f"""
import sumo_adv
print("once")
told = []
settings = {dict(SETTINGS)!r}
campaign = sumo_adv.batch({INPUTS!r}, out="out", memory="bank.sqlite", workers=1, tell=told.append, **settings)
print(len(told), campaign)
print(sumo_adv.batch({INPUTS!r}, out="out", memory="bank.sqlite", workers=1, tell=told.append, **settings), len(told))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A batch of two inputs, and what the script that ran it said, in ``said``."""
    place = tmp_path_factory.mktemp("batch")
    (place / "script.py").write_text(UNGUARDED)
    (place / "said").write_text(python(place / "script.py", place))
    yield place


def test_a_script_needs_no_guard_and_what_is_finished_is_not_run_again(folder: Path) -> None:
    shown = "<sumo_adv.Campaign of 2 episodes: out>"
    assert (folder / "said").read_text().splitlines() == ["once", f"2 {shown}", f"{shown} 2"]


def test_the_table_is_the_file_with_its_types(folder: Path) -> None:
    campaign = sumo_adv.Campaign(folder / "out")
    table = campaign.table
    assert table["network"].tolist() == list(INPUTS) and table["seed"].tolist() == [0, 0]
    assert table["delta_v"].dtype == np.float64 and table["attempts"].dtype == np.int64
    first = campaign.run(str(table["id"][0]))
    assert first.outcome.network == INPUTS[0]
    assert table["level"][0] == str(first.outcome.level) and table["relation"][0] == first.outcome.relation


def test_never_is_nan_and_what_was_not_asked_is_none(tmp_path: Path) -> None:
    (tmp_path / "plan.json").write_text("{}")
    row = dict.fromkeys(("id", "seed", "min_ttc", "attempts", "valid", "collided", "severity")) | {
        "id": "a", "seed": 3, "attempts": 2, "collided": False,
    }  # fmt: skip
    write_csv(tmp_path / "results.csv", [row], ())
    table = sumo_adv.Campaign(tmp_path).table
    assert math.isnan(table["min_ttc"][0]) and table["valid"][0] is None and table["severity"][0] is None
    assert table["collided"][0] is False and table["seed"][0] == 3


def test_pandas_takes_the_table(folder: Path) -> None:
    pandas = pytest.importorskip("pandas", reason="pandas is not installed (extra dev)")
    frame = pandas.DataFrame(sumo_adv.Campaign(folder / "out").table).set_index("network")
    assert frame.index.tolist() == list(INPUTS) and frame.ego.tolist() == ["idm", "idm"]
    assert frame.groupby("ego").attempts.sum()["idm"] == 2


def test_its_coverage_counts_both_encounters(folder: Path) -> None:
    covered = sumo_adv.Campaign(folder / "out").coverage()
    assert covered.unplaced == 0
    met = [row for row in covered.rows["all"] if row.encounters]
    assert sum(row.encounters for row in met) == 2 and {row.cell.road for row in met} == {"motorway", "urban"}


def test_states_of_all_runs_as_parquet(folder: Path, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed (extra batch)")
    settings = dict(SETTINGS)
    campaign = sumo_adv.batch(
        INPUTS, out=folder / "out", memory=folder / "bank.sqlite", workers=1, states=True, **settings
    )  # fmt: skip
    table = parquet.read_table(campaign.folder / "states.parquet").to_pandas()
    name = str(campaign.table["id"][1])
    states = campaign.run(name).states
    run_rows = table[table.run == name]
    assert len(run_rows) == len(states["time"]) and run_rows.x.tolist() == states["x"].tolist()
    assert set(table.run) == set(campaign.table["id"]) and table.speed.dtype == float


def test_wrong_use_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"as names \(module:Class\) or classes"):
        sumo_adv.batch(INPUTS[0], out=tmp_path / "out", egos=[UsageError("no driver")])  # type: ignore[list-item]
    with pytest.raises(UsageError, match="'UsageError' has no method 'reset'"):
        sumo_adv.batch(INPUTS[0], out=tmp_path / "out", egos=[UsageError])
    with pytest.raises(UsageError, match="nonsense"):
        sumo_adv.batch(INPUTS[0], out=tmp_path / "out", nonsense=3)
    with pytest.raises(UsageError, match=r"odd\.roads"):
        sumo_adv.batch(INPUTS[0], out=tmp_path / "out", odd={"roads": ["city"]})
    with pytest.raises(UsageError, match="is not the folder of a batch"):
        sumo_adv.Campaign(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_an_odd_is_part_of_the_plan(folder: Path, tmp_path: Path) -> None:
    quick = {"memory": folder / "bank.sqlite", "workers": 1, **SETTINGS}
    campaign = sumo_adv.batch(INPUTS[0], out=tmp_path / "out", odd={"roads": ["urban"]}, **quick)
    assert campaign.table["ending"].tolist() == ["no_encounter"]
    plan = json.loads((campaign.folder / "plan.json").read_text())
    assert plan["settings"][0]["odd"]["roads"] == ["urban"]
    assert {row.cell.road for row in campaign.coverage().rows["all"]} == {"urban"}
