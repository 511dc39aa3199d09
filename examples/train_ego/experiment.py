"""Train an ego in five ways and measure it beside others, on encounters and networks that it never saw.

    python experiment.py --out results                          three hours on two cores
    python experiment.py --out results --minutes 5 --measuring 15 --cores 16
    python experiment.py --out results --minutes 1 --measuring 1 --encounters 2      a try
    python experiment.py --out results --table                  the table again, of what was measured

The rows are trained one after the other on all cores (``train_ego.py``). Then the full search attacks each row in each
encounter of ``encounters.held_out``; it is told nothing about any of the drivers. An encounter is measured with all
rows before the next one, so that rows stay comparable where the time is over. ``measured.csv`` has all measurements,
from which the table is made; with ``--minutes 0`` the rows are measured as they are.
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing as mp
import os
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from encounters import NEVER_SEEN, held_out, network_of, training
from idm import Idm
from trained_ego import TrainedEgo

import sumo_adv
from sumo_adv.benchmark.unknown import CarefulAsUnknown
from sumo_adv.metrics.statistics import bootstrap, wilson

TRAINED = {
    "untrained": (None, "nothing"), "no_attacks": ("none", "idm"), "fixed_set": ("fixed", "idm"),
    "keep_up": ("keep_up", "idm"), "from_nothing": ("keep_up", "nothing"), "braking": (None, "braking"),
    "braking_fixed": ("fixed", "braking"),
}  # fmt: skip
"""Row -> the attacks that it is trained against, None for one that is not trained; and how it drives before."""
NAMES = {
    "untrained": "untrained", "no_attacks": "trained without attacks", "fixed_set": "trained against a fixed set",
    "keep_up": "trained against attacks that keep up", "from_nothing": "the same, from scratch",
    "braking": "untrained, brakes at a danger",
    "braking_fixed": "brakes at a danger at first, trained against a fixed set",
    "idm": "`idm`", "careful": "`careful`",
}  # fmt: skip
BASE = "no_attacks"  # the row that the others are compared with
COLUMNS = (
    "encounter",
    "row",
    "network",
    "level",
    "delta_v",
    "attempts",
    "seconds",
    "metres",
    "time",
    "braking",
    "ending",
    "why",
)
GRACE = 300.0  # s: for opening all encounters, and for the last update
VALID = ("valid", "strict", "serious")
NEEDLESS = 2.0  # m/s2: braking harder is needless where nothing happens
FILE = "measured.csv"


# -- training -----------------------------------------------------------------------------------------------------


def train(
    out: Path, rows: Sequence[str], encounters: Sequence[Path], minutes: float, decisions: int, cores: int, seed: int
) -> None:  # fmt: skip
    """Train those rows that are not there yet. A log has what a row prints. A row that fails is not measured."""
    scenarios = [argument for e in encounters for argument in ("--scenario", str(e))]
    for row, (attacks, start) in TRAINED.items():
        if row not in rows or (out / f"{row}.npz").is_file():
            continue
        spent = "0" if attacks is None else str(minutes)
        command = [
            sys.executable, str(Path(__file__).with_name("train_ego.py")), "--attacks", attacks or "none",
            "--minutes", spent, "--decisions", str(decisions), "--start", start, "--actors", str(cores),
            "--seed", str(seed), "--out", str(out / f"{row}.npz"), *scenarios,
        ]  # fmt: skip
        with (out / f"{row}.log").open("w") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, start_new_session=True)
        try:
            process.wait(60 * minutes + GRACE)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)  # with its actors
            process.wait()
        print(f"trained {row}: status {process.returncode}", flush=True)


# -- measuring ----------------------------------------------------------------------------------------------------


def driver(row: str, out: Path) -> object:
    """The driver of a row."""
    return {"idm": Idm, "careful": CarefulAsUnknown}.get(row) or TrainedEgo(out / f"{row}.npz")


def measure(task: tuple[Path, str, Path, int, float]) -> dict[str, Any] | None:
    """Attack a row in an encounter; None where the time is over."""
    encounter, row, out, attempts, until = task
    if time.time() > until:
        return None
    began, told = time.perf_counter(), {"encounter": encounter.stem, "row": row, "network": network_of(encounter)}
    try:
        result = sumo_adv.run(encounter, ego=driver(row, out), until="serious", learn="off", attempts=attempts)
        outcome, raw = result.outcome, result.raw
        verdict = outcome.verdict
        hit = verdict is not None and verdict.collided and verdict.counts
        told |= {
            "level": str(outcome.level), "delta_v": (verdict.delta_v or 0.0) if hit else 0.0, "why": "",
            "ending": f"{outcome.ending} {outcome.reason}".strip(),
            "attempts": len(outcome.attempts), **unattacked(raw, outcome.ego),
        }  # fmt: skip
    except Exception as error:  # one encounter must not end the measuring
        traceback.print_exc()
        told["why"] = f"{type(error).__name__}: {error}"
    return {**told, "seconds": round(time.perf_counter() - began, 1)}


def unattacked(raw: Mapping[str, Any], ego: str | None) -> dict[str, float]:
    """How far the ego drove without the attack [m], in which time [s], and how long it braked hard [s]."""
    mine = raw["id"] == ego
    time_, speed = raw["time"][mine], raw["speed"][mine]
    if len(time_) < 2:
        return {}
    steps = np.diff(time_)
    braking = -np.diff(speed) / steps > NEEDLESS
    return {
        "metres": float((speed[1:] * steps).sum()), "time": float(steps.sum()), "braking": float(steps[braking].sum())
    }  # fmt: skip


def measure_all(
    out: Path, rows: Sequence[str], encounters: Sequence[Path], minutes: float, attempts: int, cores: int
) -> None:  # fmt: skip
    """Measure those of the rows that are there; results are written as they come."""
    rows = [row for row in rows if row not in TRAINED or (out / f"{row}.npz").is_file()]
    known = {(r["encounter"], r["row"]) for r in read(out)} if (out / FILE).is_file() else set()
    until = time.time() + 60 * minutes
    tasks = [(e, row, out, attempts, until) for e in encounters for row in rows if (e.stem, row) not in known]
    with (out / FILE).open("a", newline="") as file, mp.get_context("spawn").Pool(cores, maxtasksperchild=20) as pool:
        table = csv.DictWriter(file, COLUMNS, restval="")
        if not file.tell():
            table.writeheader()
        for told in pool.imap_unordered(measure, tasks):
            if told is not None:
                table.writerow(told)
                file.flush()


# -- the table ----------------------------------------------------------------------------------------------------


def read(out: Path) -> list[dict[str, str]]:
    """What was measured."""
    with (out / FILE).open(newline="") as file:
        return list(csv.DictReader(file))


def tables(rows: Sequence[Mapping[str, str]]) -> Iterator[str]:
    """The table of all encounters with which every row was measured, and that of networks never seen."""
    good = [r for r in rows if not r["why"]]
    names = [row for row in NAMES if any(r["row"] == row for r in good)]
    by = {(r["encounter"], r["row"]): r for r in good}
    common = sorted({r["encounter"] for r in good if all((r["encounter"], row) in by for row in names)})
    new = [e for e in common if by[e, names[0]]["network"] in NEVER_SEEN] if names else []
    for title, encounters in (("All encounters", common), ("On networks never seen", new)):
        yield f"{title}: {len(encounters)}.\n"
        yield "| ego | valid | serious | delta-v [m/s] | progress | hard braking unattacked [s/min] |"
        yield "|---|---|---|---|---|---|"
        for row in names if encounters else ():
            mine = [by[e, row] for e in encounters]
            yield f"| {NAMES[row]} | {_cells(mine, [by.get((e, 'idm')) for e in encounters])} |"
        yield ""
        if encounters and BASE in names:
            yield f"Against the ego {NAMES[BASE]}, over the same encounters:\n"
            base = [by[e, BASE] for e in encounters]
            yield from (
                f"- {NAMES[row]}: {_differences([by[e, row] for e in encounters], base)}"
                for row in names if row != BASE
            )  # fmt: skip
            yield ""
    for row in names:
        yield f"{row}: without an attempt {sum(by[e, row]['attempts'] == '0' for e in common)}."
    yield f"Failed: {sum(bool(r['why']) for r in rows)}."


def _cells(mine: Sequence[Mapping[str, str]], idm: Sequence[Mapping[str, str] | None]) -> str:
    valid, serious = sum(r["level"] in VALID for r in mine), sum(r["level"] == "serious" for r in mine)
    harm = np.mean([float(r["delta_v"] or 0.0) for r in mine])
    both = [(r, other) for r, other in zip(mine, idm, strict=True) if r["metres"] and other and other["metres"]]
    metres = sum(float(r["metres"]) / max(float(r["time"]), 0.1) for r, _ in both)
    usual = sum(float(other["metres"]) / max(float(other["time"]), 0.1) for _, other in both)
    minutes = sum(float(r["time"] or 0.0) for r in mine) / 60
    braking = sum(float(r["braking"] or 0.0) for r in mine) / max(minutes, 1e-9)
    cells = wilson(valid, len(mine)).text(), wilson(serious, len(mine)).text(), f"{harm:.2f}"
    return " | ".join([*cells, f"{metres / usual:.2f}" if usual else "-", f"{braking:.2f}"])


def _differences(mine: Sequence[Mapping[str, str]], base: Sequence[Mapping[str, str]]) -> str:
    figures = {
        "serious": lambda r: float(r["level"] == "serious"), "delta-v [m/s]": lambda r: float(r["delta_v"] or 0.0)
    }  # fmt: skip
    told = ((name, bootstrap([of(a) - of(b) for a, b in zip(mine, base, strict=True)])) for name, of in figures.items())
    return ", ".join(f"{name} {e.value:+.2f} [{e.low:+.2f}, {e.high:+.2f}]" for name, e in told)


def mixed(encounters: Sequence[Path]) -> list[Path]:
    """The encounters in an order in which the first ones are of all kinds."""
    order = np.random.default_rng(0).permutation(len(encounters))
    return [encounters[k] for k in order]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--row", action="append", choices=NAMES, help="repeatable (default: all)")
    parser.add_argument("--minutes", type=float, default=30.0, help="of training, for each row")
    parser.add_argument("--decisions", type=int, default=sys.maxsize, help="of a row, after which its training ends")
    parser.add_argument("--measuring", type=float, default=60.0, help="minutes, after which no encounter is begun")
    parser.add_argument("--attempts", type=int, default=400, help="of the search in an encounter, within 60 s")
    parser.add_argument("--encounters", type=int, default=1000, help="to train with, and to measure, at most")
    parser.add_argument("--cores", type=int, default=os.cpu_count() or 2)
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    parser.add_argument("--out", type=Path, default=Path("results"))
    parser.add_argument("--table", action="store_true", help="measure nothing")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    rows = given.row or list(NAMES)
    if not given.table:
        if given.minutes > 0:
            learnt = mixed(training())[: given.encounters]
            train(given.out, rows, learnt, given.minutes, given.decisions, given.cores, given.seed)
        measured = mixed(held_out())[: given.encounters]
        measure_all(given.out, rows, measured, given.measuring, given.attempts, given.cores)
    text = "\n".join(tables(read(given.out)))
    (given.out / "table.md").write_text(text + "\n")
    print(text)


if __name__ == "__main__":
    main()
