"""How faithful converted Waymo records are: a row a record, all together, and the targets.

    python benchmarks/womd.py DIR                      every *.tfrecord below DIR, random traffic included
    python benchmarks/womd.py DIR --no-traffic --json rows.json

Needs records (they are not part of the project); without DIR it says so and ends. Status 1 if a record cannot be
converted or a target is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from sumo_adv.cli.convert import show
from sumo_adv.errors import SumoAdvError
from sumo_adv.womd.convert import convert_record
from sumo_adv.womd.reader import read_records
from sumo_adv.womd.table import totals

TARGETS = {  # name in the totals: least or most
    "within_0.5": (">=", 0.999), "within_0.1": (">=", 0.99), "connectivity": (">=", 0.995), "in_junctions": ("<", 0.30),
    "median_seconds": ("<", 0.5), "disturbed": ("<=", 0.10),
}  # fmt: skip


def main() -> int:
    """Convert, then print the table, the totals and the targets."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="where the .tfrecord files are")
    parser.add_argument("--no-traffic", action="store_true", help="do not try random traffic")
    parser.add_argument("--workers", type=int, default=1, help="records at once; times are fair with 1 only")
    parser.add_argument("--json", type=Path, help="also write all reports to this file")
    args = parser.parse_args()
    if args.folder is None:
        print("no folder of Waymo records given: nothing to do")
        return 0
    files = sorted(args.folder.rglob("*.tfrecord*"))
    with ProcessPoolExecutor(args.workers) as pool:
        found = list(pool.map(_convert, files, [not args.no_traffic] * len(files)))
    reports = [r for of_file, _ in found for r in of_file]
    failed = [sentence for _, of_file in found for sentence in of_file]
    for sentence in failed:
        print(f"FAILED {sentence}")
    if args.json:
        args.json.write_text(json.dumps(reports))
    if not reports:
        return 1
    show(reports)
    missed = _targets(totals(reports))
    return 1 if failed or missed else 0


def _convert(file: Path, traffic: bool) -> tuple[list[dict[str, Any]], list[str]]:
    """The reports of a file's records, and what went wrong with the others."""
    reports: list[dict[str, Any]] = []
    failed: list[str] = []
    for record in read_records(file, told=lambda error: failed.append(str(error))):
        try:
            with tempfile.TemporaryDirectory() as folder:
                reports.append(convert_record(record, Path(folder), traffic=traffic))
        except SumoAdvError as error:
            failed.append(f"{record.scenario_id}: {error}")
    return reports, failed


def _targets(total: dict[str, float]) -> list[str]:
    """Print the totals and each target; the names of those that were missed."""
    for name, value in total.items():
        print(f"{name:18} {value:.5g}")
    checks = {name: (total[name], *target) for name, target in TARGETS.items()}
    if not total["traffic_tried"]:
        del checks["disturbed"]
    checks["inside"] = (total["inside"], ">=", total["near_centre"] - 0.01)
    checks["broken"] = (total["broken"], "<=", 2 * total["own_broken"])
    missed = []
    for name, (value, sign, bound) in checks.items():
        met = value >= bound if sign == ">=" else value <= bound if sign == "<=" else value < bound
        missed += [] if met else [name]
        print(f"{'met   ' if met else 'MISSED'} {name}: {value:.5g} {sign} {bound:.5g}")
    return missed


if __name__ == "__main__":
    sys.exit(main())
