"""``convert`` and ``run`` on Waymo records: real netconvert, real SUMO, the real command line; the cache."""

from __future__ import annotations

import ast
import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from cli_samples import ROOT, Program, files_of, lacking
from womd_samples import WITH_MAP, empty, four_way, frame, no_map, straight, write

from sumo_adv.errors import UsageError
from sumo_adv.simulation.inputs import load_input
from sumo_adv.womd.convert import _teleports, cache_folder, conversion, random_traffic
from sumo_adv.womd.fidelity import FIDELITY_COLUMNS, row
from sumo_adv.womd.reader import RecordChoice, choice_of, read_records
from sumo_adv.womd.record import Record

SHARED = Path(__file__).parents[2] / "shared" / "womd"
FILES = {
    "network.net.xml",
    "scenario.toml",
    "tracks.csv.gz",
    "routes.rou.xml",
    "fidelity.json",
    "fidelity.png",
    "crosswalks.add.xml",
}


@pytest.fixture(scope="module")
def bench() -> Any:
    """The benchmark as a module."""
    spec = importlib.util.spec_from_file_location("womd", ROOT / "benchmarks" / "womd.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def read(path: Path) -> Record:
    return next(read_records(path))


@pytest.mark.parametrize("build", WITH_MAP, ids=lambda build: build.__name__)
def test_every_sample_becomes_a_scenario_that_loads(tmp_path: Path, build: object) -> None:
    record = read(write(tmp_path / "a.tfrecord", build()))  # type: ignore[operator]
    with conversion(record, traffic=False, cache=tmp_path / "cache") as made:
        assert lacking(made.folder, FILES) == set()
        run_input = load_input(made.scenario)
        assert (run_input.name, run_input.ego, run_input.warm_up) == (record.scenario_id, "1", 1.0)
        report = made.report
        assert report["represented"] > 0.99
        assert report["deviation"]["within_0.1"] > 0.99
        assert report["connectivity"]["share"] == 1.0
        assert report["vehicles"]["inside"] >= report["vehicles"]["near_centre"] - 0.01
        assert report["routes"]["broken"] == [] or report["routes"]["own_broken"] != []


def test_the_report_of_the_four_way_junction(tmp_path: Path, bench: Any) -> None:
    """4 arms in and 4 out of 76 m each; all 24 connections and 12 signal lanes kept; two vehicles drive, one waits."""
    record = read(write(tmp_path / "a.tfrecord", four_way()))
    with conversion(record, traffic=True, cache=tmp_path / "cache") as made:
        report = made.report
    assert report["connectivity"]["wanted"] == report["connectivity"]["kept"] == 24
    assert report["signals"] == {"lanes": 12, "known": 12, "mapped": 12}
    turns = report["lane_length"] - 8 * 76.0
    assert report["in_junctions"] == pytest.approx(turns / report["lane_length"], abs=0.02)
    assert (report["routes"]["driven"], report["routes"]["broken"]) == (2, [])
    assert report["scenario"]["ego"] == 1
    assert report["traffic"]["vehicles"] > 10 and report["traffic"]["collisions"] == 0
    assert len(row(report)) == len(FIDELITY_COLUMNS)
    total = bench.totals([report, report])
    assert (total["records"], total["signals_mapped"], total["connectivity"]) == (2, 24, 1.0)
    assert total["disturbed"] == float(report["traffic"]["teleports"] > 0)
    assert len(report["traffic"]["events"]) == report["traffic"]["teleports"]
    assert bench.shortfalls({**report, "traffic": None}) == []
    lost = {**report["connectivity"], "kept": 23}
    broken = {**report["routes"], "broken": [1, 2], "own_broken": [2]}
    traffic = {**report["traffic"], "events": ["collision (junction) on :n0_0_0 at 3.0 s"]}
    assert bench.shortfalls({**report, "connectivity": lost, "routes": broken, "traffic": traffic}) == [
        "1 connections", "tracks [1] break, in the record they do not", "collision (junction) on :n0_0_0 at 3.0 s",
    ]  # fmt: skip


def test_crosswalks_are_polygons_that_sumo_loads(tmp_path: Path) -> None:
    """The four-way junction has one, 7 m by 3 m; ``run`` loads it with the network, from the cache too."""
    record = read(write(tmp_path / "a.tfrecord", four_way()))
    ask = (
        "import libsumo, sys\nlibsumo.start(['sumo', '-n', sys.argv[1], '-a', sys.argv[2], '--no-step-log'])\n"
        "print({n: (libsumo.polygon.getType(n), libsumo.polygon.getShape(n)) for n in libsumo.polygon.getIDList()})"
    )
    for cached in (False, True):
        with conversion(record, traffic=False, cache=tmp_path / "cache") as made:
            assert made.cached == cached and made.report["converter"]["crosswalks"] == 1
            run_input = load_input(made.scenario)
    assert run_input.additional == (made.folder / "crosswalks.add.xml",) and run_input.additional[0] in run_input.files
    command = [sys.executable, "-c", ask, str(run_input.network), str(run_input.additional[0])]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    corners = ((-3.5, -14.0), (3.5, -14.0), (3.5, -11.0), (-3.5, -11.0))
    assert ast.literal_eval(done.stdout.splitlines()[-1]) == {"crosswalk401": ("crosswalk", corners)}


def test_nothing_is_converted_twice(tmp_path: Path) -> None:
    """The second time the same folder is given, with the same bytes; asked for traffic, only that is added."""
    path, cache = write(tmp_path / "a.tfrecord", straight()), tmp_path / "cache"
    with conversion(read(path), traffic=False, cache=cache) as first:
        before = files_of(first.folder)
    with conversion(read(path), traffic=False, cache=cache) as second:
        assert (first.cached, second.cached) == (False, True)
        assert second.folder == first.folder and files_of(second.folder) == before
    with conversion(read(path), traffic=True, cache=cache) as third:
        assert third.cached and third.report["traffic"]["vehicles"] > 0
        after = files_of(third.folder)
    assert {name for name in after if after[name] != before[name]} == {"fidelity.json"}
    assert [p.name for p in cache.iterdir()] == [first.folder.parent.name]


def test_another_record_of_the_same_id_is_converted(tmp_path: Path) -> None:
    cache, changed = tmp_path / "cache", straight()
    changed.map_features[0].lane.speed_limit_mph = 20.0
    folders = []
    for name, message in (("a", straight()), ("b", changed)):
        with conversion(read(write(tmp_path / name, message)), traffic=False, cache=cache) as made:
            assert not made.cached
            folders.append(made.folder)
    assert folders[0] != folders[1]


def test_a_cache_that_cannot_be_written_is_done_without(tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file, no folder")
    record = read(write(tmp_path / "a.tfrecord", straight()))
    with conversion(record, traffic=False, cache=tmp_path / "cache") as made:
        assert lacking(made.folder, FILES) == set()
    assert not made.folder.exists()


def test_a_record_of_another_rate_is_resampled_and_reported(tmp_path: Path, bench: Any) -> None:
    """91 steps of 0.05 s are 4.5 s: 46 steps of 0.1 s. The current step, 10, is at 0.5 s."""
    fast = straight()
    for i in range(91):
        fast.timestamps_seconds[i] = 0.05 * i
    record = read(write(tmp_path / "a.tfrecord", fast))
    with conversion(record, traffic=False, cache=tmp_path / "cache") as made:
        sampling = made.report["sampling"]
        assert made.report["steps"] == 46 and made.report["current"] == 5
        assert load_input(made.scenario).warm_up == 0.5
    assert sampling["resampled"] and sampling["step"] == pytest.approx(0.05)
    assert sampling["note"].startswith("resampled to 10 Hz: steps 0.050 s apart")
    assert sampling["note"] in bench.shortfalls(made.report)


def test_what_fails_leaves_nothing_in_the_cache(tmp_path: Path) -> None:
    unseen = straight()
    for state in unseen.tracks[0].states:
        state.valid = False
    record = read(write(tmp_path / "a.tfrecord", unseen))
    with (
        pytest.raises(UsageError, match="never sees its ego"),
        conversion(record, traffic=False, cache=tmp_path / "cache"),
    ):
        pass
    assert [p for p in (tmp_path / "cache").rglob("*") if p.is_file()] == []


def test_the_cache_is_where_the_platform_says() -> None:
    home = Path("home")
    assert cache_folder({}, "linux", home) == home / ".cache" / "sumo_adv" / "womd"
    assert cache_folder({"XDG_CACHE_HOME": "relative"}, "linux", home) == home / ".cache" / "sumo_adv" / "womd"
    absolute = str(Path.cwd())
    assert cache_folder({"XDG_CACHE_HOME": absolute}, "linux", home) == Path(absolute) / "sumo_adv" / "womd"
    assert cache_folder({}, "darwin", home) == home / "Library" / "Caches" / "sumo_adv" / "womd"
    assert cache_folder({"LOCALAPPDATA": "local"}, "win32", home) == Path("local") / "sumo_adv" / "womd"


def test_random_traffic_counts(tmp_path: Path) -> None:
    """A straight road of three lanes has no collision; one of bike lanes has no traffic at all."""
    from sumo_adv.simulation.inputs import data_folder

    counts = random_traffic(data_folder("networks") / "straight_3lane.net.xml", duration=30.0)
    assert counts["collisions"] == counts["teleports"] == 0 and counts["events"] == [] and counts["vehicles"] > 5
    bikes = straight("bikes")
    for feature in bikes.map_features:
        if feature.HasField("lane"):
            feature.lane.type = 3
    with conversion(read(write(tmp_path / "a", bikes)), traffic=True, cache=tmp_path / "cache") as made:
        assert made.report["traffic"]["vehicles"] == 0 and "No route" in made.report["traffic"]["note"]


def test_teleports_are_read_from_the_warnings() -> None:
    """As SUMO 1.28 words them, between others."""
    warnings = (
        "Warning: Vehicle 'bv9' performs emergency braking on lane 'w1_0' with decel=9.00, wished=4.50, time=40.00.\n"
        "Warning: Teleporting vehicle 'bv23'; waited too long (yield), lane='w207_0', time=115.90.\n"
        "Warning: Teleporting vehicle 'bv2'; collision with vehicle 'bv3', lane=':n1_0_0', time=7.00.\n"
    )
    assert _teleports(warnings)[0] == "teleport (waited too long (yield)) from w207_0 at 115.9 s"


@pytest.mark.parametrize(
    ("name", "choice"),
    [(None, RecordChoice(index=0)), ("7", RecordChoice(index=7)),
     ("0f1e2d3c4b5a6978", RecordChoice(id="0f1e2d3c4b5a6978")),
     ("1081039300000000", RecordChoice(id="1081039300000000"))],
)  # fmt: skip
def test_what_record_means(name: str | None, choice: RecordChoice) -> None:
    assert choice_of(name) == choice


@pytest.mark.skipif(not SHARED.is_dir(), reason="the Waymo records (shared/womd) are not here")
@pytest.mark.parametrize("name", ["10810393add927f8", "1663adf01133d82", "4d320edc9cb801a3"])
def test_real_records_are_kept(tmp_path: Path, name: str) -> None:
    (path,) = SHARED.glob(f"{name}*.tfrecord")
    with conversion(read(path), traffic=False, cache=tmp_path / "cache") as made:
        report = made.report
        assert load_input(made.scenario).name == name
    assert report["deviation"]["within_0.5"] >= 0.999 and report["deviation"]["within_0.1"] >= 0.99
    assert report["connectivity"]["share"] >= 0.995
    assert report["vehicles"]["inside"] >= report["vehicles"]["near_centre"] - 0.01
    assert len(report["routes"]["broken"]) <= 2 * len(report["routes"]["own_broken"])


# -- the command line ------------------------------------------------------------------------------------------------


def test_convert_writes_a_folder_a_record(program: Program) -> None:
    write(program.folder / "two.tfrecord", straight(), four_way())
    done = program.here("convert", "two.tfrecord", "--out", "scenes", "--json", "--no-traffic")
    assert (done.status, done.err) == (0, "")
    report = json.loads(done.out)
    assert [(r["scenario_id"], r["folder"], r["cached"]) for r in report["records"]] == [
        ("straight", "scenes/straight", False), ("four_way", "scenes/four_way", False),
    ]  # fmt: skip
    assert report["failed"] == []
    for name in ("straight", "four_way"):
        assert lacking(program.folder / "scenes" / name, FILES) == set()
    assert program.leftovers() == ["scenes", "two.tfrecord"]
    refused = program.here("convert", "two.tfrecord", "--out", "scenes", "--id", "straight", "--no-traffic")
    assert refused.status == 2 and "scenes/straight already exists" in refused.err
    again = program.here("convert", "two.tfrecord", "--out", "scenes", "--id", "straight", "--force", "--no-traffic")
    assert again.status == 0 and "straight: scenes/straight" in again.out and "signals" in again.out


def test_convert_keeps_going_or_stops(program: Program) -> None:
    """A record without a map between two good ones."""
    messages = [straight(), no_map("nowhere"), four_way()]
    write(program.folder / "three.tfrecord", *messages)
    stopped = program.here("convert", "three.tfrecord", "--out", "a", "--no-traffic")
    assert stopped.status == 2 and stopped.err.startswith("sumo-adv: Record 1 of three.tfrecord ('nowhere') has no map")
    assert "Traceback" not in stopped.err and len(stopped.err.splitlines()) == 1
    going = program.here("convert", "three.tfrecord", "--out", "b", "--keep-going", "--json", "--no-traffic")
    report = json.loads(going.out)
    assert going.status == 0 and [r["scenario_id"] for r in report["records"]] == ["straight", "four_way"]
    assert [s.split(":")[0] for s in report["failed"]] == ["Record 1 of three.tfrecord ('nowhere') has no map"]
    assert sorted(p.name for p in (program.folder / "b").iterdir()) == ["four_way", "straight"]


def test_a_coordinate_at_10_000_km_costs_nothing_and_does_not_stop_the_next_record(program: Program) -> None:
    far = straight()
    far.scenario_id, far.map_features[0].lane.polyline[3].x = "far", 1e8
    write(program.folder / "two.tfrecord", far, four_way())
    going = program.here("convert", "two.tfrecord", "--out", "b", "--keep-going", "--json", "--no-traffic")
    report = json.loads(going.out)
    assert going.status == 0 and [r["scenario_id"] for r in report["records"]] == ["four_way"]
    assert "1e+08 m from the origin" in report["failed"][0] and len(going.err.splitlines()) == 1


def test_convert_of_nothing_good_fails(program: Program) -> None:
    (program.folder / "bad.tfrecord").write_bytes(frame(empty("bad").SerializeToString()) + b"cut")
    done = program.here("convert", "bad.tfrecord", "--out", "scenes", "--keep-going")
    assert done.status == 1 and len(done.err.splitlines()) == 2 and "Traceback" not in done.err
    assert program.leftovers() == ["bad.tfrecord"]
    both = program.here("convert", "bad.tfrecord", "--out", "scenes", "--id", "a", "--first", "2")
    assert both.status == 2 and "not both" in both.err


def test_run_on_a_record(program: Program) -> None:
    """The whole job on a file of records; the second run finds the conversion."""
    write(program.folder / "two.tfrecord", four_way(), straight())
    done = program.here("run", "two.tfrecord", "--record", "straight", "--attempts", "2", "--json", "--out", "out")
    assert done.status == 0, done.err
    assert done.outcome["ego"]["id"] == "1" and done.outcome["ending"] in ("critical", "attempts_exhausted")
    cache = program.home / ".cache" / "sumo_adv" / "womd"
    (kept,) = list(cache.rglob("fidelity.json"))
    stamp = kept.stat().st_mtime_ns
    again = program.here("run", "two.tfrecord", "--record", "1", "--attempts", "2", "--json", "--out", "again")
    assert again.status == 0 and list(cache.rglob("fidelity.json")) == [kept]
    assert kept.stat().st_mtime_ns == stamp
    wrong = program.here("run", "straight_3lane", "--record", "1")
    assert wrong.status == 2 and "--record chooses a record of a TFRecord file" in wrong.err
