"""How often a run ends critical, with a collision, with a valid one: over scenarios and egos, or networks and seeds.

    python benchmarks/rates.py                                     the shipped scenarios, --until valid, four egos
    python benchmarks/rates.py --networks networks/*.net.xml --seeds 5 --egos idm --until ttc

Every run is the real command line with a fresh bank; a run that fails stays in the denominator.  Two at a time.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.metrics.statistics import wilson

ROOT = Path(__file__).resolve().parent.parent


def main() -> None:
    """Run, then print a row a run and a table an ego."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--networks", nargs="*", type=Path, help="networks or configurations instead of scenarios")
    parser.add_argument("--scenarios", nargs="*", type=Path, default=sorted((ROOT / "scenarios").glob("*.toml")))
    parser.add_argument("--egos", default="krauss,idm,careful,replay")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--until", default="valid")
    parser.add_argument("--attempts", type=int, default=25)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    inputs = args.networks or args.scenarios
    jobs = [(ego, file, seed) for ego in args.egos.split(",") for file in inputs for seed in range(args.seeds)]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(args.workers) as pool:
        rows = list(pool.map(lambda job: _run(job[0], job[1], job[2], args.until, args.attempts, Path(folder)), jobs))
    for row in rows:
        print(_line(row))
    for ego in args.egos.split(","):
        _table(ego, [r for r in rows if r["ego"] == ego])


def _run(ego: str, file: Path, seed: int, until: str, attempts: int, folder: Path) -> dict[str, Any]:
    name = f"{ego}-{file.name}-{seed}"
    command = [
        sys.executable, "-m", "sumo_adv", "run", str(file), "--ego", ego, "--seed", str(seed), "--until", until,
        "--attempts", str(attempts), "--json", "--memory", str(folder / f"{name}.sqlite"), "--out", str(folder / name),
    ]  # fmt: skip
    began = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    row: dict[str, Any] = {"ego": ego, "input": file.name, "seed": seed, "seconds": time.perf_counter() - began}
    row |= {"status": done.returncode, "stderr": done.stderr.strip()[:200]}
    row["result"] = json.loads(done.stdout) if done.stdout.startswith("{") else {}
    return row


def _line(row: dict[str, Any]) -> str:
    r = row["result"]
    raw, best, intent = r.get("raw") or {}, r.get("outcome") or {}, r.get("intent") or {}
    return (
        f"{row['ego']:8s} {row['input']:40s} seed {row['seed']} status {row['status']} {row['seconds']:5.1f} s  "
        f"{r.get('ending', 'none'):18s} raw {_ttc(raw)} best {_ttc(best)} critical {best.get('critical')!s:5s} "
        f"collided {best.get('collided')!s:5s} valid {best.get('valid')!s:5s} strict {best.get('strict')!s:5s} "
        f"attempts {len(r.get('attempts', [])):2d}  {intent.get('label', '-')} {row['stderr']}"
    )


def _ttc(verdict: dict[str, Any]) -> str:
    value = verdict.get("min_ttc")
    return "never" if value is None else f"{value:5.2f}"


def _table(ego: str, rows: list[dict[str, Any]]) -> None:
    verdicts = [r["result"].get("outcome") or {} for r in rows]
    print(f"\n{ego}: {len(rows)} runs, {sum(r['status'] != 0 for r in rows)} failed")
    honest = [v for v in verdicts if v.get("feasible") and not v.get("rear_end")]
    counts = {
        "critical": sum(bool(v.get("critical")) for v in honest),
        "collision": sum(bool(v.get("collided")) for v in honest),
        "valid": sum(bool(v.get("valid")) for v in verdicts),
        "strict": sum(bool(v.get("valid") and v.get("strict")) for v in verdicts),
    }
    for limit in (1, 5):
        firsts = [next((a["index"] for a in r["result"].get("attempts", []) if a["valid"]), 10**9) for r in rows]
        counts[f"valid after {limit}"] = sum(f < limit for f in firsts)
    for name, count in counts.items():
        rate = wilson(count, len(rows))
        print(f"  {name:14s} {count:3d}/{len(rows)}  {rate.value:.2f}  [{rate.low:.2f}, {rate.high:.2f}]")
    seconds = np.array([r["seconds"] for r in rows])
    print(f"  seconds a run: median {np.median(seconds):.1f}, {seconds.min():.1f} to {seconds.max():.1f}")


if __name__ == "__main__":
    main()
