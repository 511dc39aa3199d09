"""How faithful converted Waymo records are: a row a record, all together, and the targets.

    python benchmarks/womd.py DIR                      every *.tfrecord below DIR, random traffic included
    python benchmarks/womd.py DIR --seeds 0 1 2 3      the same, traffic of four seeds
    python benchmarks/womd.py DIR --no-traffic --json rows.json

After the table it says what each record falls short of. Needs records (they are not part of the project); without DIR
it says so and ends. Status 1 if a record cannot be converted or a target is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.cli.convert import show
from sumo_adv.errors import SumoAdvError
from sumo_adv.simulation.scenario import NETWORK_FILE
from sumo_adv.womd.convert import convert_record, random_traffic
from sumo_adv.womd.reader import read_records

TARGETS = {  # name in the totals: least or most
    "within_0.5": (">=", 0.999), "within_0.1": (">=", 0.99), "connectivity": (">=", 0.995), "in_junctions": ("<", 0.30),
    "median_seconds": ("<", 0.5), "disturbed": ("<=", 0.10),
}  # fmt: skip


def main() -> int:
    """Convert, then print the table, the totals and the targets."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="where the .tfrecord files are")
    parser.add_argument("--no-traffic", action="store_true", help="do not try random traffic")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="of random traffic; the table has the first")
    parser.add_argument("--workers", type=int, default=1, help="records at once; times are fair with 1 only")
    parser.add_argument("--json", type=Path, help="also write all reports to this file")
    args = parser.parse_args()
    if args.folder is None:
        print("no folder of Waymo records given: nothing to do")
        return 0
    files = sorted(args.folder.rglob("*.tfrecord*"))
    with ProcessPoolExecutor(args.workers) as pool:
        converted = list(pool.map(_convert, files, [[] if args.no_traffic else args.seeds] * len(files)))
    reports = [r for of_file, _ in converted for r in of_file]
    failed = [sentence for _, of_file in converted for sentence in of_file]
    for sentence in failed:
        print(f"FAILED {sentence}")
    if args.json:
        args.json.write_text(json.dumps(reports))
    if not reports:
        return 1
    show(reports)
    for report in reports:
        for phrase in shortfalls(report):
            print(f"{report['scenario_id']:17} {phrase}")
    missed = _targets(totals(reports))
    for seed in [] if args.no_traffic else args.seeds[1:]:
        print(f"\nrandom traffic of seed {seed}:")
        for report in reports:
            for event in report["trials"][seed]["events"]:
                print(f"{report['scenario_id']:17} {event}")
        total = totals([{**report, "traffic": report["trials"][seed]} for report in reports])
        missed += _met("disturbed", total["disturbed"], *TARGETS["disturbed"])
    return 1 if failed or missed else 0


def _convert(file: Path, seeds: list[int]) -> tuple[list[dict[str, Any]], list[str]]:
    """The reports of a file's records with ``trials`` (traffic by seed), and what went wrong with the others."""
    reports: list[dict[str, Any]] = []
    failed: list[str] = []
    for record in read_records(file, told=lambda error: failed.append(str(error))):
        try:
            with tempfile.TemporaryDirectory() as folder:
                report = convert_record(record, Path(folder), traffic=False)
                trials = {seed: random_traffic(Path(folder) / NETWORK_FILE, seed=seed) for seed in seeds}
            reports.append({**report, "traffic": trials[seeds[0]] if seeds else None, "trials": trials})
        except SumoAdvError as error:
            failed.append(f"{record.scenario_id}: {error}")
    return reports, failed


def totals(reports: list[dict[str, Any]]) -> dict[str, float]:
    """All records together: shares weighted by their wholes, counts summed, the median time.

    disturbed: share of the networks tried that had a collision or a teleport in random traffic.
    """
    km = np.array([r["lane_length"] for r in reports]) / 1000.0
    samples = [r["deviation"]["samples"] for r in reports]
    states = [r["vehicles"]["states"] for r in reports]
    tried = [r["traffic"] for r in reports if r["traffic"] is not None]
    connections = sum(r["connectivity"]["wanted"] for r in reports)
    return {
        "records": len(reports), "km": float(km.sum()),
        "represented": _mean([r["represented"] for r in reports], km),
        **{
            f"within_{d}": _mean([r["deviation"][f"within_{d}"] for r in reports], samples)
            for d in ("0.1", "0.5")
        },
        "median_p99": float(np.median([r["deviation"]["p99"] for r in reports])),
        "connectivity": sum(r["connectivity"]["kept"] for r in reports) / connections if connections else 1.0,
        "signal_lanes": sum(r["signals"]["lanes"] for r in reports),
        "signals_mapped": sum(r["signals"]["mapped"] for r in reports),
        "inside": _mean([r["vehicles"]["inside"] for r in reports], states),
        "near_centre": _mean([r["vehicles"]["near_centre"] for r in reports], states),
        "driven": sum(r["routes"]["driven"] for r in reports),
        "broken": sum(len(r["routes"]["broken"]) for r in reports),
        "own_broken": sum(len(r["routes"]["own_broken"]) for r in reports),
        "in_junctions": _mean([r["in_junctions"] for r in reports], km),
        "median_seconds": float(np.median([r["seconds"]["network"] for r in reports])),
        "median_cpu_seconds": float(np.median([r["seconds"]["network_cpu"] for r in reports])),
        "traffic_tried": len(tried), "collisions": sum(t["collisions"] for t in tried),
        "teleports": sum(t["teleports"] for t in tried),
        "disturbed": sum(t["collisions"] + t["teleports"] > 0 for t in tried) / len(tried) if tried else 0.0,
    }  # fmt: skip


def shortfalls(report: dict[str, Any]) -> list[str]:
    """What a record's network does not show as the record has it, a phrase each; empty if there is nothing."""
    d, c, s, v, r = (report[k] for k in ("deviation", "connectivity", "signals", "vehicles", "routes"))
    lost, beyond = c["wanted"] - c["kept"], round((1.0 - d["within_0.5"]) * d["samples"])
    more = [track for track in r["broken"] if track not in r["own_broken"]]
    phrases = {
        f"{100 * (1.0 - report['represented']):.2f} % of lane length": report["represented"] < 0.9999,
        f"{beyond} samples beyond 0.5 m (at most {d['max']:.1f} m)": beyond > 0,
        f"{lost} connections": lost > 0,
        f"{s['lanes'] - s['mapped']} signal lanes without a link": s["mapped"] < s["lanes"],
        f"{100 * (v['near_centre'] - v['inside']):.1f} points fewer vehicles inside lanes than near a centre line":
            v["inside"] < v["near_centre"] - 0.01,
        f"tracks {more} break, in the record they do not": bool(more),
        report["sampling"]["note"]: report["sampling"]["resampled"],
    }  # fmt: skip
    events = report["traffic"]["events"] if report["traffic"] is not None else []
    return [phrase for phrase, holds in phrases.items() if holds] + list(events)


def _mean(values: list[float], weights: Any) -> float:
    weights = np.asarray(weights, float)
    return float(np.average(values, weights=weights)) if weights.sum() > 0 else 1.0


def _targets(total: dict[str, float]) -> list[str]:
    """Print the totals and each target; the names of those that were missed."""
    for name, value in total.items():
        print(f"{name:18} {value:.5g}")
    checks = {name: (total[name], *target) for name, target in TARGETS.items()}
    if not total["traffic_tried"]:
        del checks["disturbed"]
    checks["inside"] = (total["inside"], ">=", total["near_centre"] - 0.01)
    checks["broken"] = (total["broken"], "<=", 2 * total["own_broken"])
    return [name for name, check in checks.items() if _met(name, *check)]


def _met(name: str, value: float, sign: str, bound: float) -> list[str]:
    """Print a target; its name if it was missed."""
    met = value >= bound if sign == ">=" else value <= bound if sign == "<=" else value < bound
    print(f"{'met   ' if met else 'MISSED'} {name}: {value:.5g} {sign} {bound:.5g}")
    return [] if met else [name]


if __name__ == "__main__":
    sys.exit(main())
