"""A thousand random cut-ins: which driver prevents what, as a table and a picture.

Ego 20 to 60 km/h, the other vehicle 5 km/h to the ego's speed, gap 1 to 60 m, lateral speed 0.2 to 1.8 m/s; geometry
as in ``sumo_adv/metrics/own_data.py``.

    python benchmarks/cut_ins.py [--cases 1000] [--seed 0] [--out runs/cut-ins]
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.metrics.own_data import ANSWERING_DRIVERS, CASE_COLUMNS, judge_cut_ins


def drawn(count: int, seed: int) -> Floats:
    """Cases ``(count, 4)``, rows of ``CASE_COLUMNS``."""
    random = np.random.default_rng(seed)
    ego = random.uniform(20.0, 60.0, count)
    return np.column_stack(
        [ego, random.uniform(5.0, ego), random.uniform(1.0, 60.0, count), random.uniform(0.2, 1.8, count)]
    )


def draw(target: Path, cases: Floats, answers: list[dict[str, str]]) -> None:
    """A panel for each driver: gap against closing speed; prevented or not."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    names = ANSWERING_DRIVERS[1:]
    figure, panels = pyplot.subplots(1, len(names), figsize=(3.2 * len(names), 3.4), sharey=True, layout="constrained")
    closing = cases[:, 0] - cases[:, 1]
    hit = np.array([a["unchanged"] != "none" for a in answers])
    for panel, name in zip(panels, names, strict=True):
        avoided = np.array([a[name] == "none" for a in answers])
        for rows, colour, label in ((hit & avoided, "#2a7", "prevented"), (hit & ~avoided, "#c33", "not prevented")):
            panel.scatter(cases[rows, 2], closing[rows], s=6, color=colour, label=f"{label} ({int(rows.sum())})")
        panel.set_title(name)
        panel.set_xlabel("gap [m]")
        panel.legend(loc="upper left", fontsize=7)
    panels[0].set_ylabel("closing speed [km/h]")
    figure.savefig(target, dpi=110)


def main() -> None:
    """Print the table; with ``--out`` write cases, answers and the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    cases = drawn(args.cases, args.seed)
    answers = judge_cut_ins(cases)
    hit = [a for a in answers if a["unchanged"] != "none"]
    print(f"{len(cases)} cut-ins, {len(hit)} collisions of the unchanged ego")
    for name in ANSWERING_DRIVERS[1:]:
        kinds = [a[name] for a in hit]
        print(
            f"{name:10s} prevents {kinds.count('none'):4d} ({kinds.count('none') / max(len(hit), 1):.2f}); "
            f"left: front_to_rear {kinds.count('front_to_rear')}, side {kinds.count('side')}"
        )
    new = sum(a["unchanged"] == "none" and any(a[n] != "none" for n in ANSWERING_DRIVERS[1:]) for a in answers)
    print(f"a driver collides where the unchanged ego does not: {new}")
    if args.out:
        args.out.mkdir(parents=True, exist_ok=True)
        with (args.out / "cut-ins.csv").open("w", newline="", encoding="utf-8") as text:
            writer = csv.writer(text)
            writer.writerow([*CASE_COLUMNS, *ANSWERING_DRIVERS])
            writer.writerows(
                [*(f"{v:.4f}" for v in c), *(a[n] for n in ANSWERING_DRIVERS)]
                for c, a in zip(cases, answers, strict=True)
            )
        draw(args.out / "cut-ins.png", cases, answers)


if __name__ == "__main__":
    main()
