"""What a run's files say of the attempt that counts: one real run."""

from __future__ import annotations

import csv
import gzip
import json
import math
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from metrics_tracks import cruise
from shapely import box

from sumo_adv.agents.agents import Agents
from sumo_adv.config import load_settings
from sumo_adv.datatypes import Track
from sumo_adv.episode.engine import episode_worker
from sumo_adv.episode.loop import replay_episode, run_episode
from sumo_adv.episode.run import EncounterRecord, Run
from sumo_adv.episode.task import make_task
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.report.folder import write_run
from sumo_adv.report.manifest import read_manifest
from sumo_adv.report.staging import staged
from sumo_adv.report.tables import SERIES_HEADER, series_rows
from sumo_adv.report.verdicts import demand_sigmas, edge_distance, findings_on, further_keys, realism_figures
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import data_folder, load_input
from sumo_adv.simulation.network import Drivable

FURTHER = {
    "collision_class", "impact", "rss", "tet", "tit", "paper_centre_distance", "contact_time", "min_ttc_time",
    "markings_crossed",
}  # fmt: skip
IMPACT = {"speed", "ego_speed", "adversary_speed", "angle", "ego_point", "adversary_point", "adversary_side"}


@dataclass(frozen=True)
class Written:
    """A run and its folder."""

    run: Run
    folder: Path

    @property
    def record(self) -> EncounterRecord:
        assert self.run.best is not None
        return self.run.best

    @property
    def outcome(self) -> dict[str, Any]:
        return dict(json.loads((self.folder / "outcome.json").read_text(encoding="utf-8")))

    def table(self, name: str) -> list[dict[str, str]]:
        with gzip.open(self.folder / name, "rt", newline="", encoding="utf-8") as text:
            return list(csv.DictReader(text))


def write(run: Run, target: Path) -> Written:
    with staged(target, force=False) as folder:
        write_run(folder, run)
        folder.keep(force=False)
    return Written(run, target)


@pytest.fixture(scope="module")
def crossing(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Written]:
    """A vehicle from the right rushes through a crossing into the ego."""
    folder = tmp_path_factory.mktemp("verdicts")
    run_input = load_input(Path("priority_straight_from_right"))
    settings = load_settings(None, until="valid", learn="off", horizon=run_input.horizon, ego=run_input.ego_controller)
    task = make_task(run_input, settings, folder)
    with (
        MemoryBank.open(folder / "bank.sqlite", seed_from=data_folder("memory_bank.sqlite")) as bank,
        Sandbox() as sandbox,
        Engine(episode_worker) as engine,
    ):
        run = run_episode(run_input, settings, task, engine, Agents(settings, sandbox), bank, lambda *_: None)
    yield write(run, folder / "run")


# -- the verdict of the attempt that counts


def test_the_outcome_holds_further_figures(crossing: Written) -> None:
    outcome = crossing.outcome["outcome"]
    assert set(outcome) >= FURTHER
    assert (outcome["collided"], outcome["rss"]) == (True, None)
    impact = outcome["impact"]
    assert set(impact) == IMPACT
    closing = math.hypot(impact["ego_speed"], impact["adversary_speed"])  # they meet at right angles
    assert impact["speed"] == pytest.approx(closing, abs=0.01)
    assert outcome["markings_crossed"] == []
    assert crossing.outcome["timing"]["verdict"] > 0


def test_the_paper_s_distance_is_between_the_centres_where_they_met(crossing: Written) -> None:
    """From the contact points: the ego's seen from its centre and the adversary's, turned by the angle."""
    outcome = crossing.outcome["outcome"]
    (ax, ay), (bx, by), angle = (outcome["impact"][k] for k in ("ego_point", "adversary_point", "angle"))
    x = ax - (bx * math.cos(angle) - by * math.sin(angle))
    y = ay - (bx * math.sin(angle) + by * math.cos(angle))
    paper = outcome["paper_centre_distance"]
    assert paper["minimum"] == pytest.approx(math.hypot(x, y), abs=0.01)
    assert paper["within"] is (paper["minimum"] <= paper["epsilon"])


# -- criticality.csv.gz


def test_the_series_agree_with_the_states_and_the_extremes(crossing: Written) -> None:
    outcome = crossing.outcome
    rows, adversary = crossing.table("criticality.csv.gz"), outcome["adversaries"][0]["id"]
    states = {(r["time"], r["id"]): r for r in crossing.table("states.csv.gz")}
    for row in rows:
        ego, vehicle = states[row["time"], "ego"], states[row["time"], row["id"]]
        apart = math.hypot(float(ego["x"]) - float(vehicle["x"]), float(ego["y"]) - float(vehicle["y"]))
        assert float(row["centre_distance"]) == pytest.approx(apart, abs=2e-4)
        assert row["id"] == adversary or apart <= 60.001
    own = [r for r in rows if r["id"] == adversary]
    assert float(own[0]["time"]) == outcome["trigger_time"]
    assert [float(own[-1][k]) for k in ("ttc", "gap")] == [0.0, 0.0]  # the first step after the contact
    before = [r for r in own if float(r["time"]) <= outcome["outcome"]["contact_time"]]
    assert max(float(r["drac"]) for r in before) == outcome["outcome"]["max_drac"]
    assert max(float(r["btn"]) for r in before) == outcome["outcome"]["max_btn"]
    exposed = [float(r["ttc"]) for r in before if r["ttc"] and float(r["ttc"]) <= 1.5]
    assert outcome["outcome"]["tet"] == pytest.approx(0.1 * len(exposed))


def test_rows_are_the_adversary_s_and_those_of_whoever_is_within_60_m() -> None:
    """A leader 10 m before the ego and 5 m/s slower; a far adversary; a vehicle that is 61 m away and stays so."""
    ego = cruise("ego", 0.0, 0.0, 15.0)
    tracks = [ego, cruise("adversary", 200.0, 0.0, 15.0), cruise("a,b", 15.0, 0.0, 10.0), cruise("c", 61.0, 0.0, 15.0)]
    rows = series_rows(ego.between(0.0, 0.1), tracks, "adversary")
    assert SERIES_HEADER == "time,id,ttc,gap,drac,btn,headway,required_lateral,centre_distance\n"
    assert rows[0] == "0.00,adversary,,195.0000,0.0000,0.0000,13.0000,0.0000,200.0000\n"
    assert rows[1] == '0.00,"a,b",2.0000,10.0000,1.2500,0.1562,0.6667,1.0000,15.0000\n'  # 10 / 5; 25 / 20; 2 x 2 / 4
    assert [r.split(",")[0] for r in rows] == ["0.00", "0.00", "0.10", "0.10"]


# -- realism


def test_realism_says_against_what(crossing: Written) -> None:
    realism = crossing.outcome["realism"]
    reference, outcome = realism["reference"], crossing.outcome["outcome"]
    assert reference["vehicles"] >= 3 and reference["steps"] >= 100
    assert reference["sigma"] == [0.5]
    assert reference["to"] <= outcome["contact_time"] < reference["to"] + 0.1
    assert realism["steps"] == round((reference["to"] - reference["from"]) / 0.1) + 1
    for name in ("speed", "acceleration", "jerk", "yaw_rate", "curvature"):
        assert realism[f"{name}_kl"] >= 0 and 0 <= realism[f"{name}_js"] <= math.log(2)
        assert realism[f"{name}_wasserstein"] >= 0
    assert (realism["abnormal_lateral_share"], realism["off_road_share"]) == (0.0, 0.0)
    assert set(realism["wosac_js"]) >= {"linear_speed", "linear_acceleration", "distance_to_road_edge"}


def road() -> Drivable:
    return Drivable(box(-50.0, -10.0, 300.0, 10.0))


def traffic(count: int) -> list[Track]:
    return [cruise(f"b{k}", 30.0 * k, 3.0, 10.0 + k) for k in range(count)]


def test_too_little_data_is_null_and_not_nought() -> None:
    moved = cruise("adversary", 0.0, 0.0, 12.0)
    short, full = (
        realism_figures(moved.between(0.0, 0.5), traffic(3), road()),
        realism_figures(moved, traffic(3), road()),
    )
    alone = realism_figures(moved, [t.between(0.0, 1.0) for t in traffic(2)], road())
    assert set(short) == set(alone) == set(full)
    assert all(v is None for k, v in short.items() if k != "wosac_js")
    assert alone["speed_kl"] is None and alone["off_road_share"] == 0.0 and alone["jerk_max"] == 0.0
    assert all(v is not None for v in full.values())


def test_distance_to_the_edge_of_the_road_is_negative_off_it() -> None:
    away = edge_distance(road())(np.array([[0.0, 100.0]]), np.array([[4.0, -13.0]]))
    assert away.tolist() == [[6.0, -3.0]]


def test_sigmas_are_read_from_the_demand(tmp_path: Path) -> None:
    plain, packed = tmp_path / "a.rou.xml", tmp_path / "b.rou.xml.gz"
    plain.write_text('<routes><vType id="a" sigma="0.3"/><vType id="b"/></routes>')
    packed.write_bytes(gzip.compress(b"<routes><vType sigma='0' id='c'/></routes>"))
    assert demand_sigmas([plain, packed]) == [0.0, 0.3, 0.5]
    assert demand_sigmas([]) == [0.5]


# -- without an attempt, and again


def test_without_an_attempt_there_is_nothing_to_say(crossing: Written) -> None:
    assert findings_on(crossing.run, EncounterRecord(crossing.record.found)) is None
    columns = further_keys(None)
    assert columns.pop("markings_crossed") == []
    assert set(columns) <= set(crossing.outcome["outcome"]) and set(columns.values()) == {None}


def test_a_replay_comes_to_the_same_bytes(crossing: Written, tmp_path: Path) -> None:
    recorded = read_manifest(crossing.folder)
    with Sandbox() as sandbox, Engine(episode_worker) as engine:
        run = replay_episode(
            recorded.run_input, recorded.settings, recorded.task, engine, sandbox, recorded.proposal, recorded.skips
        )
    again = write(run, tmp_path / "again")
    for name in ("states.csv.gz", "criticality.csv.gz", "raw.csv.gz"):
        assert (again.folder / name).read_bytes() == (crossing.folder / name).read_bytes()
    assert [again.outcome[k] for k in ("outcome", "realism")] == [crossing.outcome[k] for k in ("outcome", "realism")]


def test_a_stored_run_with_a_setting_that_is_gone_can_still_be_read(crossing: Written, tmp_path: Path) -> None:
    """Version 0.1 wrote ``experience``; a replay drives the recorded attempt and does not need it."""
    folder = tmp_path / "stored"
    shutil.copytree(crossing.folder, folder)
    table = json.loads((folder / "manifest.json").read_text())
    table["settings"]["experience"] = "on"
    (folder / "manifest.json").write_text(json.dumps(table))
    assert read_manifest(folder).settings == read_manifest(crossing.folder).settings
