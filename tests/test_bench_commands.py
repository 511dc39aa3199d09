"""The tables beside the main one, each from its command to its files, on one encounter; and a row played by a model."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from cli_samples import Done, Program
from model_server import ModelServer
from scripted_models import Author

from sumo_adv.benchmark.jobs import ANALYZER_SAMPLES

CASE = "motorway_cut_in_left"
SMALL = (
    "--suite", f"scenarios/{CASE}.toml", "--ego", "idm", "--attempts", "1", "--set", "proposals=20", "--workers", "2",
    "--out", "out",
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> Program:
    """All commands go on in one folder, so that what one has run the next one need not."""
    return Program(tmp_path_factory.mktemp("bench"), caches)


def run(program: Program, command: str, *more: str) -> Done:
    done = program.here("bench", command, *SMALL, *more)
    assert done.status == 0, done.err
    return done


def lines(program: Program, name: str) -> list[dict[str, str]]:
    with (program.folder / "out" / name).open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def document(program: Program, name: str) -> dict[str, Any]:
    return dict(json.loads((program.folder / "out" / name).read_text(encoding="utf-8")))


def test_the_analyzer_is_judged_by_the_oracle_of_the_same_folder(folder: Program) -> None:
    done = run(folder, "analyzer")
    simulated = document(folder, f"cells/idm/{CASE}/oracle.json")["attempts"]
    assert len(simulated) == 60  # all of the library's ways, filled up with drawn ones
    scores = {(s["criterion"], s["who"], s["figure"]): s for s in lines(folder, "analyzer.csv")}
    assert scores["collision", "expert+learn=off", "accuracy"]["n"] == "1"
    assert {who.split(" ")[0] for _, who, _ in scores} == {"expert+learn=off", "always", "chance", "ceiling:"}
    assert any(figure.startswith("success at risk") for _, _, figure in scores)
    assert "Against idm, by valid" in done.out and max(map(len, done.out.splitlines())) <= 100
    text = (folder.folder / "out" / "analyzer.md").read_text(encoding="utf-8")
    assert "## Ego idm, by valid" in text and "DeepSeek-R1" in text
    assert document(folder, "analyzer.manifest.json")["labels_hash"]
    assert list((folder.folder / "out" / "figures").glob("confusion-idm-*.png"))


def test_labels_are_what_the_oracle_finds(folder: Program) -> None:
    assert "1 of 1 encounters labelled." in run(folder, "label").out
    labels = document(folder, "labels.json")[CASE]["idm"]
    simulated = document(folder, f"cells/idm/{CASE}/oracle.json")["attempts"]
    won = {a["intent"] for a in simulated if a["valid"]}
    assert document(folder, "labels.manifest.json")["files"] == ["labels.json"]
    assert set(labels) == {"collision", "valid"} and labels["valid"] and set(labels["valid"]) <= won


@pytest.mark.soak
def test_every_ablation_stands_beside_the_expert_that_does_not_learn(folder: Program) -> None:
    run(folder, "ablations")
    valid = {r["row"]: r for r in lines(folder, "ablations.csv") if (r["part"], r["column"]) == ("all", "valid")}
    without = ("tuner=off", "replan=60", "forecast=constant", "shift=-1.5",
               "shift=1.5")  # fmt: skip
    assert set(valid) == {"expert", "expert+learn=off", *(f"expert+{ablation}+learn=off" for ablation in without)}
    assert [row for row, r in valid.items() if r["difference"] == ""] == ["expert+learn=off"]  # the others' reference


def test_growth_has_the_row_that_it_is_to_be_compared_with(folder: Program) -> None:
    run(folder, "growth")
    steps = lines(folder, "growth.csv")
    assert sorted(s["row"] for s in steps) == ["expert", "expert+learn=off", "expert+recall=scene"]
    assert {s["place"] for s in steps} == {"1"} and (folder.folder / "out" / "figures" / "growth.png").exists()


def test_any_row_can_be_what_others_are_compared_with(folder: Program) -> None:
    run(folder, "table", "--row", "raw", "--row", "random", "--row", "llm-f", "--reference", "random",
               "--keep-runs")  # fmt: skip
    text = (folder.folder / "out" / "table.md").read_text(encoding="utf-8")
    assert "### Differences to `random`" in text
    assert (folder.folder / "out" / "runs" / "idm" / CASE / "random" / "outcome.json").exists()


def test_a_model_in_a_row_is_asked_so_many_times_and_what_it_costs_is_told(program: Program) -> None:
    row = f"llm-a:scripted+samples={ANALYZER_SAMPLES[1]}+learn=off"
    with ModelServer(Author("Aggressive Cut-in")) as server:
        program.variables = server.environment()
        run(program, "table", "--row", row, "--keep-runs")
        questions = len(server.asked)
    (recording,) = (program.folder / "out" / "runs").rglob("model.jsonl")
    assert len(recording.read_text().splitlines()) == 1 + questions  # and a header
    cost = {
        r["column"]: float(r["value"]) for r in lines(program, "table.csv") if (r["part"], r["row"]) == ("all", row)
    }
    assert cost["calls"] == questions >= ANALYZER_SAMPLES[1] and cost["tokens"] == 110 * questions
    assert 0 < cost["seconds"] < cost["seconds_model"] and cost["memory_hit"] == 1
