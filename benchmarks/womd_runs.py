"""What ``run`` makes of Waymo records: ``python benchmarks/womd_runs.py DIR [--out OUT]``, DIR with a manifest.csv.

First each record of the suites is converted (into OUT, where an earlier conversion is taken as it is) and its log is
played back through SUMO: the worst distance between SUMO's box centres and the record's over all its vehicles, and the
least TTC of the ego to anyone, from SUMO's states and from the record (0.1 s steps from the second one on, one size an
object: the median).  Then ``run`` attacks the recorded ego as ``replay``, ``idm`` and ``careful``, each a process that
learns nothing; with the ego as ``replay`` the others are replayed as well, since a recorded ego would drive into those
that go otherwise than recorded.  Status 1 if a bound of the issue is broken, a run fails or its files are not whole.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Boxes, Floats, Track
from sumo_adv.drivers import ReplayEgo
from sumo_adv.episode.drive import Drive, ego_type_file
from sumo_adv.metrics.boxes import on_grid
from sumo_adv.metrics.criticality import ttc
from sumo_adv.report.folder import RUN_FILES
from sumo_adv.simulation.inputs import load_input
from sumo_adv.simulation.network import read_network
from sumo_adv.simulation.playback import Playback
from sumo_adv.simulation.playback_spec import with_background
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.womd.reader import read_records
from sumo_adv.womd.record import Record

SUITES = ("straight", "intersection")
EGOS = ("replay", "idm", "careful")
STEP = 0.1  # s
MOST_OFF, MOST_TTC_OFF = 0.05, 0.05  # m, s
NEVER = 99.0  # s, for the differences of two that are never


@dataclass(frozen=True, slots=True)
class Run:
    """One row of the table."""

    record: str
    suite: str
    ego: str
    status: int
    seconds: float
    outcome: dict[str, Any]
    missing: tuple[str, ...]
    words: str


def main() -> int:
    """Everything, as a table on stdout; the status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help="records and their manifest.csv")
    parser.add_argument("--out", type=Path, default=Path("womd_runs"), help="conversions and runs are kept here")
    parser.add_argument("--only", nargs="*", help="ids of records [default: all of the suites]")
    parser.add_argument("--egos", nargs="*", default=EGOS)
    parser.add_argument("--background", choices=("log", "sumo"), help="[default: sumo, for the ego replay log]")
    parser.add_argument("--attempts", type=int, help="budget of a run [default: run's own]")
    parser.add_argument("--jobs", type=int, default=1)
    given = parser.parse_args()
    if given.folder is None:
        print("no folder of Waymo records given: nothing to do")
        return 0
    with (given.folder / "manifest.csv").open(newline="") as file:
        rows = [r for r in csv.DictReader(file) if r["suite"] in SUITES and (not given.only or r["id"] in given.only)]
    records = {r["id"]: r["suite"] for r in rows}
    files = {name: next(given.folder.glob(f"{name}.*tfrecord")) for name in records}
    scenarios = {name: converted(file, given.out) for name, file in files.items()}
    broken = sum(not checked(name, scenarios[name], next(iter(read_records(files[name])))) for name in records)
    with ThreadPoolExecutor(given.jobs) as pool:
        works = [
            pool.submit(run, scenarios[name], name, suite, ego, given.out, given.background, given.attempts)
            for name, suite in records.items() for ego in given.egos
        ]  # fmt: skip
        print(f"\n{'record':17s} {'suite':12s} {'ego':8s} {'unattacked':>10s} {'attacked':>9s} {'valid':>5s}  ending")
        runs = [told(work.result()) for work in works]
    for ego in given.egos:
        summary(ego, [r for r in runs if r.ego == ego])
    return 0 if not broken and all(r.status == 0 and not r.missing for r in runs) else 1


def converted(record: Path, out: Path) -> Path:
    """The scenario of a record, converted unless it is there."""
    scenario = out / "scenarios" / record.name.split(".")[0] / "scenario.toml"
    if not scenario.is_file():
        command = ["convert", str(record), "--no-traffic", "--force", "--json", "--out", str(out / "scenarios")]
        subprocess.run([sys.executable, "-m", "sumo_adv", *command], check=True, stdout=subprocess.DEVNULL)
    return scenario


# -- the log through SUMO -------------------------------------------------------------------------------------------


def checked(name: str, scenario: Path, record: Record) -> bool:
    """Play the log back and compare with the record; whether the bounds hold."""
    ego, tracks = played(scenario)
    grid = tracks[ego].time
    recorded = {str(t.id): t for t in record.tracks}
    worst, vehicles = 0.0, 0
    steps = np.rint(grid / STEP).astype(int)
    for track in tracks.values():
        source = recorded.get(track.id)
        if source is None or source.kind != 1:
            continue
        k = np.rint(track.time / STEP).astype(int)
        vehicles += 1
        worst = max(worst, float(np.hypot(track.x - source.x[k], track.y - source.y[k]).max()))
    replayed_ttc = least_ttc(on_grid([tracks[ego]], grid), on_grid([t for t in tracks.values() if t.id != ego], grid))
    recorded_ttc = least_ttc(boxes(record, steps, [record.sdc]), boxes(record, steps, [
        i for i in range(len(record.tracks)) if i != record.sdc]))  # fmt: skip
    off = abs(min(replayed_ttc, NEVER) - min(recorded_ttc, NEVER))
    good = worst <= MOST_OFF and off <= MOST_TTC_OFF
    print(
        f"{name:17s} {vehicles:4d} vehicles, worst centre {worst:.4f} m; min TTC {replayed_ttc:6.3f} s in SUMO, "
        f"{recorded_ttc:6.3f} s in the record{'' if good else '   BROKEN'}", flush=True,
    )  # fmt: skip
    return good


def played(scenario: Path) -> tuple[str, dict[str, Track]]:
    """The ego's id, and all vehicles' states, moved by the log."""
    run_input = load_input(scenario)
    spec = with_background(run_input.playback, "log")
    assert spec is not None and isinstance(run_input.ego, str)
    driver = ReplayEgo()
    types = ego_type_file(driver, scenario.parent)
    log = Playback(
        spec, read_network(run_input.network), begin=0.0, step=STEP, ego=run_input.ego, warm_up=run_input.warm_up
    )
    drive = Drive(SimulationSpec(run_input.network, run_input.routes, (types,), 0.0, 0, STEP), driver, 0, playback=log)
    try:
        for _ in range(round(spec.end / STEP)):
            drive.tick()
            if drive.ego is None and run_input.ego in drive.snapshot.raw and drive.may_take_over(run_input.ego):
                drive.take_over(run_input.ego)
        return run_input.ego, {t.id: t for t in drive.tracks()}
    finally:
        drive.simulation.close()
        types.unlink()


def boxes(record: Record, steps: Any, which: list[int]) -> Boxes:
    """Objects of a record at some steps, NaN where not valid, each with its median size."""

    def values(name: str) -> Floats:
        return np.array([np.where(t.valid, getattr(t, name), np.nan)[steps] for t in tracks])

    def size(name: str) -> Floats:
        return np.array([[np.median(getattr(t, name)[t.valid])] for t in tracks])

    tracks = [record.tracks[i] for i in which if record.tracks[i].valid.any()]
    speed = np.hypot(values("vx"), values("vy"))
    return Boxes(values("x"), values("y"), values("heading"), speed, size("length"), size("width"))


def least_ttc(ego: Boxes, others: Boxes) -> float:
    """The least TTC [s] of the ego with anyone, inf if never."""
    return float(np.nanmin(ttc(ego, others), initial=np.inf))


# -- runs -----------------------------------------------------------------------------------------------------------


def run(
    scenario: Path, name: str, suite: str, ego: str, out: Path, background: str | None, attempts: int | None
) -> Run:
    """One run in a process of its own."""
    background = background or ("log" if ego == "replay" else "sumo")
    folder = out / "runs" / f"{name}-{ego}-{background}"
    command = [sys.executable, "-m", "sumo_adv", "run", str(scenario), "--ego", ego, "--learn", "off", "--json"]
    command += ["--force", "--out", str(folder), "--memory", str(out / f"bank-{ego}.sqlite")]
    command += ["--background", background]
    command += ["--attempts", str(attempts)] if attempts else []
    began = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, "COLUMNS": "200"})
    seconds = time.perf_counter() - began
    outcome = json.loads((folder / "outcome.json").read_text()) if (folder / "outcome.json").is_file() else {}
    expected = RUN_FILES if outcome.get("attempts") else ("outcome.json", "manifest.json")
    missing = tuple(n for n in expected if not (folder / n).is_file())
    return Run(name, suite, ego, done.returncode, seconds, outcome, missing, done.stderr.strip()[-300:])


def told(r: Run) -> Run:
    """Print a row."""
    raw, best = r.outcome.get("raw") or {}, r.outcome.get("outcome") or {}
    trouble = f"  STATUS {r.status} {r.words}" if r.status else ""
    trouble += f"  MISSING {', '.join(r.missing)}" if r.missing else ""
    ending = r.outcome.get("ending", "none")
    reason = "" if r.outcome.get("attempts") else r.outcome.get("reason", "")[:160]
    print(
        f"{r.record:17s} {r.suite:12s} {r.ego:8s} {shown(raw):>10s} {shown(best):>9s} {best.get('valid')!s:>5s}  "
        f"{ending}, {len(r.outcome.get('attempts', []))} attempts, {r.seconds:.1f} s{trouble}  {reason}", flush=True,
    )  # fmt: skip
    return r


def shown(figures: dict[str, Any]) -> str:
    """A least TTC."""
    if not figures:
        return "-"
    if figures.get("collided"):
        return "hit"
    value = figures.get("min_ttc")
    return "never" if value is None else f"{value:.2f}"


def summary(ego: str, runs: list[Run]) -> None:
    """One line over all records: endings, and the mean of min TTC with a contact as 0 and never as 10 s."""
    endings: dict[str, int] = {}
    for r in runs:
        endings[r.outcome.get("ending", "none")] = endings.get(r.outcome.get("ending", "none"), 0) + 1
    attacked = [r for r in runs if r.outcome.get("outcome")]
    before, after = ([capped(r.outcome[k]) for r in attacked] for k in ("raw", "outcome"))
    hits = sum(bool(r.outcome["outcome"]["collided"]) for r in attacked)
    valid = sum(bool(r.outcome["outcome"]["valid"]) for r in attacked)
    means = f"mean min TTC {np.mean(before):.2f} -> {np.mean(after):.2f} s" if attacked else ""
    print(f"{ego:8s} {len(runs)} runs, {endings}; attacked {len(attacked)}: {hits} hits, {valid} valid; {means}; "
          f"median {np.median([r.seconds for r in runs]):.1f} s")  # fmt: skip


def capped(figures: dict[str, Any] | None) -> float:
    """A min TTC for means."""
    if not figures or (figures["min_ttc"] is None and not figures["collided"]):
        return 10.0
    return 0.0 if figures["collided"] else min(float(figures["min_ttc"]), 10.0)


if __name__ == "__main__":
    sys.exit(main())
