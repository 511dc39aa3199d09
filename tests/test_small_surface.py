"""What a newcomer meets: classes for a hunt, results in words, a hunt's failures as cases, an index without scripts."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from cli_samples import Program
from ego_samples import CalmEgo

import sumo_adv
from sumo_adv.drivers.registry import find_class, spec_of
from sumo_adv.errors import UsageError
from sumo_adv.report.index import MadePages, plain_table


def test_a_class_is_named_as_other_processes_import_it() -> None:
    assert spec_of(CalmEgo) == "ego_samples:CalmEgo"
    assert find_class("ego", spec_of(CalmEgo)) is CalmEgo

    class Local(CalmEgo):
        pass

    with pytest.raises(UsageError, match=r"Other processes cannot import the class 'Local'"):
        spec_of(Local)


def test_a_hunt_takes_a_class_and_says_what_it_found(tmp_path: Path) -> None:
    result = sumo_adv.hunt(
        "motorway_cut_in_left", ego=CalmEgo, minutes=0.1, out=tmp_path / "hunt", pages=False, workers=1,
        memory=str(tmp_path / "bank.sqlite"), distinct=1,
    )  # fmt: skip
    plan = json.loads((tmp_path / "hunt" / "hunt.json").read_text())["plan"]
    assert "ego_samples:CalmEgo" in json.dumps(plan)
    assert repr(result).startswith(f"<sumo_adv.HuntResult of {len(result.rows)} distinct failures in ")
    with pytest.raises(UsageError, match="each worker makes its own object"):
        sumo_adv.hunt("motorway_cut_in_left", ego=CalmEgo(), out=tmp_path / "other")  # type: ignore[arg-type]


def test_keeping_a_hunt_looks_at_its_failures_alone(program: Program) -> None:
    """Its rounds hold runs, too; without failures there is nothing to keep."""
    (program.folder / "hunt" / "rounds" / "0001" / "runs" / "a").mkdir(parents=True)
    (program.folder / "hunt" / "rounds" / "0001" / "runs" / "a" / "outcome.json").write_text("{}")
    (program.folder / "hunt" / "hunt.json").write_text("{}")
    (program.folder / "hunt" / "failures").mkdir()
    done = program("keep", "hunt", "--suite", "suite")
    assert done.status == 2 and "failures holds no run" in done.err.replace("\n", " ")


def test_an_index_without_scripts_counts_episodes_and_links_their_pages() -> None:
    row = dict.fromkeys(("network", "ego", "seed", "intent", "min_ttc", "delta_v", "failure"))
    rows = [{**row, "id": "a", "level": "strict", "ending": "critical", "delta_v": 3.456}] * 2
    rows.append({**row, "id": "b", "level": None, "ending": "no_encounter", "network": "<b>"})
    text = plain_table("hunt", rows, {"a": MadePages(1, None, "")})
    assert text.startswith("<noscript><h1>hunt</h1><p>3 episodes: 2 strict, 1 no_encounter.")
    assert '<a href="pages/a.html">a</a>' in text and "<td>3.46</td>" in text
    assert "&lt;b&gt;" in text and "<b>" not in text
