"""Play the same attacks against each ego, in encounters that nothing was trained with.

    python replay_attacks.py --out results                      a quarter of an hour on two cores

The attacks are those that are predicted to collide with SUMO's IDM; no ego was trained with them. The egos are the rows
of ``experiment.py``. They decide as often as the trained ones, and each also drives once without an attack. What comes
out is in ``attacks.csv``; the table has it by ego, over the encounters that all of them finished.
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing as mp
import os
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from encounters import held_out
from experiment import BASE, NAMES, NEEDLESS, TRAINED, VALID, mixed
from trained_ego import ENVIRONMENT, OWN, Network

import sumo_adv.gym  # registers the environment
from sumo_adv.gym.actions import PEDAL_BRAKING_M_S2
from sumo_adv.gym.views import DANGER_MAXIMA, MAX_VIEWED_SPEED_M_S
from sumo_adv.metrics.statistics import bootstrap

FILE = "attacks.csv"
COLUMNS = ("encounter", "row", "attack", "contact", "level", "delta_v", "driven", "behind", "braking")


def policy(row: str, out: Path) -> Callable[[Any], Any]:
    """What drives in a row. ``careful`` brakes as the careful driver would, from the observation."""
    if row in TRAINED:
        with np.load(out / f"{row}.npz") as weights:
            return Network(dict(weights))
    if row == "idm":
        return lambda seen: np.ones(1, np.float32)

    def careful(seen: Any) -> Any:
        braking = seen[OWN + 1] * DANGER_MAXIMA[1]
        return np.array([-braking / PEDAL_BRAKING_M_S2 if braking > 0 else 1.0], np.float32)

    return careful


def episode(env: gymnasium.Env[Any, Any], drive: Callable[[Any], Any], seed: int | None) -> dict[str, Any]:
    """One episode."""
    seen, info = env.reset(seed=seed)
    driven, braking, over, interval = 0.0, 0.0, False, ENVIRONMENT["interval"]
    while not over:
        speed = float(seen[0]) * MAX_VIEWED_SPEED_M_S
        seen, _, terminated, truncated, info = env.step(drive(seen))
        after, over = float(seen[0]) * MAX_VIEWED_SPEED_M_S, terminated or truncated
        driven += (speed + after) / 2 * interval
        braking += interval * ((speed - after) / interval > NEEDLESS)
    verdict = info.get("verdict")
    return {
        "attack": info["attack"], "contact": info["ending"] == "contact", "level": info.get("level", ""),
        "delta_v": 0.0 if verdict is None else verdict.delta_v or 0.0, "driven": driven, "behind": info["behind"],
        "braking": braking,
    }  # fmt: skip


def measure(task: tuple[Path, Sequence[str], Path, int, float]) -> list[dict[str, Any]]:
    """All rows in one encounter; nothing where the time is over, or where it cannot be opened."""
    encounter, rows, out, attacks, until = task
    if time.time() > until:
        return []
    told = []
    try:
        for attacker, count in (("expert", attacks), (None, 1)):
            env = gymnasium.make(
                "sumo_adv/Ego-v0", scenario=encounter, attacker=attacker, unattacked=0.0, **ENVIRONMENT
            )
            for row in rows:
                drive = policy(row, out)
                for k in range(count):  # a seed begins the same attacks anew
                    told.append({"encounter": encounter.stem, "row": row, **episode(env, drive, None if k else 0)})
            env.close()
    except sumo_adv.errors.SumoAdvError as error:
        print(f"{encounter.stem}: {error}", flush=True)
        return []
    return told


FIGURES: Mapping[str, Callable[[Mapping[str, str]], float]] = {
    "contact": lambda r: r["contact"] == "True",
    **{level: partial(lambda k, r: r["level"] in VALID[k:], k) for k, level in enumerate(VALID)},
    "delta-v [m/s]": lambda r: float(r["delta_v"]),
}  # fmt: skip


def table(rows: Sequence[Mapping[str, str]]) -> str:
    """By ego: figures of its attacks, and the differences to the ego that was trained without attacks. The attacks of
    one encounter are alike, so all intervals are bootstrapped over encounters."""
    titles = "ego", "attacks", *FIGURES, "progress", "needless braking unattacked [s]"
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    differences = []
    means = {(row, name): _by_encounter(rows, row, of) for row in NAMES for name, of in FIGURES.items()}
    for row, name in NAMES.items():
        attacked = [r for r in rows if r["row"] == row and r["attack"]]
        alone = [r for r in rows if r["row"] == row and not r["attack"]]
        if not attacked or not alone:
            continue
        figures = [bootstrap(means[row, figure]).text() for figure in FIGURES]
        driven, behind = (sum(float(r[key]) for r in alone) for key in ("driven", "behind"))
        braking = sum(float(r["braking"]) for r in alone) / len(alone)
        lines.append(
            f"| {name} | {len(attacked)} | {' | '.join(figures)} | {driven / (driven + behind):.2f} | {braking:.2f} |"
        )
        if row != BASE and means[BASE, "valid"]:
            estimates = {f: bootstrap(np.subtract(means[row, f], means[BASE, f])) for f in FIGURES}
            shown = [f"{f} {e.value:+.2f} [{e.low:+.2f}, {e.high:+.2f}]" for f, e in estimates.items()]
            differences.append(f"- {name}: {', '.join(shown)}")
    return "\n".join([*lines, "", f"Against the ego {NAMES[BASE]}:", "", *differences])


def _by_encounter(
    rows: Sequence[Mapping[str, str]], row: str, of: Callable[[Mapping[str, str]], float]
) -> list[float]:  # fmt: skip
    """The mean of a figure over the attacks of each encounter."""
    values: dict[str, list[float]] = {}
    for r in rows:
        if r["row"] == row and r["attack"]:
            values.setdefault(r["encounter"], []).append(of(r))
    return [float(np.mean(each)) for _, each in sorted(values.items())]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=15.0, help="after which no encounter is begun")
    parser.add_argument("--attacks", type=int, default=8, help="in an encounter")
    parser.add_argument("--cores", type=int, default=os.cpu_count() or 2)
    parser.add_argument("--out", type=Path, default=Path("results"), help="the folder of experiment.py")
    parser.add_argument("--table", action="store_true", help="measure nothing")
    given = parser.parse_args()
    file = given.out / FILE
    if not given.table:
        rows = [row for row in NAMES if row not in TRAINED or (given.out / f"{row}.npz").is_file()]
        until = time.time() + 60 * given.minutes
        tasks = [(e, rows, given.out, given.attacks, until) for e in mixed(held_out())]
        with (
            file.open("w", newline="") as opened,
            mp.get_context("spawn").Pool(given.cores, maxtasksperchild=4) as pool,
        ):
            written = csv.DictWriter(opened, COLUMNS)
            written.writeheader()
            for told in pool.imap_unordered(measure, tasks):
                written.writerows(told)
                opened.flush()
    with file.open(newline="") as opened:
        print(table(list(csv.DictReader(opened))))


if __name__ == "__main__":
    main()
