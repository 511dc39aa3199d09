"""Golden runs: hashes of what a fixed set of runs comes to, to prove that a change of the code changes no result.

    python benchmarks/golden.py record FILE [--scenario NAME ...] [--ego NAME ...] [--records FOLDER]
    python benchmarks/golden.py compare FILE

Each run has three hashes: of its attempts (vehicle, intent, mode, parameters, start, credit), of their verdicts, and of
the states of the attempt that counts. Without ``--scenario`` all shipped scenarios run. ``--records`` adds the first
ten records of a folder of .tfrecord files. ``compare`` repeats the runs that FILE names and exits with status 1 if a
hash differs. Floats depend on the processor's vector instructions, so FILE names them, and ``compare`` says when they
differ.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import json
import os
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
EGOS = ("idm", "careful", "lattice", "cautious_ego:CautiousEgo")
RECORDS = 10
PARTS = ("attempts", "verdicts", "states")
CHOICE = (
    "index",
    "by",
    "phase",
    "adversaries",
    "intent",
    "parameters",
    "acceleration",
    "trigger_time",
    "predicted_score",
    "predicted_level",
)
"""What an attempt was; the other keys of an attempt in ``outcome.json`` say what came of it."""
NAMES = ("named_scenario",)
"""Keys of an attempt that only name what is in the others."""


def instructions() -> list[str]:
    """The vector instructions that numpy uses on this machine."""
    from numpy._core._multiarray_umath import __cpu_features__ as features  # type: ignore[import-not-found]

    return sorted(name for name in ("AVX2", "FMA3", "AVX512F", "AVX512_SKX", "NEON", "SVE") if features.get(name))


def hashed(value: Any) -> str:
    """A short hash of JSON data or bytes."""
    raw = value if isinstance(value, bytes) else json.dumps(value, sort_keys=True).encode()
    return hashlib.sha256(raw).hexdigest()[:16]


def run_one(case: tuple[str, str]) -> dict[str, str]:
    """The hashes of one run; ``case``: what to run and the ego."""
    sys.path.insert(0, str(ROOT / "examples"))
    import sumo_adv

    source, ego = case
    with tempfile.TemporaryDirectory() as folder:
        result = sumo_adv.run(
            source, ego=ego, out=Path(folder) / "run", memory=str(Path(folder) / "bank.sqlite"), learn="off",
            until="valid", attempts=10, seed=0, fork=True,
        )  # fmt: skip
        document = result.outcome.document
        states = result.folder / "states.csv.gz"
        content = gzip.decompress(states.read_bytes()) if states.is_file() else b""
    attempts = [{**{key: a[key] for key in CHOICE}, "mode": a["planner"]["mode"]} for a in document["attempts"]]
    verdicts = [{key: a[key] for key in a.keys() - {*CHOICE, *NAMES, "planner"}} for a in document["attempts"]]
    return {
        "attempts": hashed([document["ending"], attempts]), "verdicts": hashed([verdicts, document["outcome"]]),
        "states": hashed(content),
    }  # fmt: skip


def run_all(cases: list[tuple[str, str]], workers: int) -> dict[str, dict[str, str]]:
    """The hashes by run, in order; a run that fails has its error's."""
    hashes: dict[str, dict[str, str]] = {}
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for case, future in [(case, pool.submit(run_one, case)) for case in cases]:
            name = f"{Path(case[0]).stem} {case[1]}"
            try:
                hashes[name] = future.result()
            except Exception as error:
                hashes[name] = dict.fromkeys(PARTS, f"{type(error).__name__}: {error}"[:80])
    return hashes


def differences(before: Mapping[str, Mapping[str, str]], now: Mapping[str, Mapping[str, str]]) -> list[str]:
    """A line for each run with other hashes."""
    lines = []
    for name, hashes in before.items():
        changed = [part for part in PARTS if hashes[part] != now[name][part]]
        lines += [f"{name}: {', '.join(changed)} differ"] if changed else []
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("record", "compare"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--scenario", action="append", help="a shipped scenario's name; repeatable")
    parser.add_argument("--ego", action="append", help=f"repeatable (default: {', '.join(EGOS)})")
    parser.add_argument("--records", type=Path, help="a folder of .tfrecord files")
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    given = parser.parse_args()
    if given.action == "record":
        sources = given.scenario or sorted(p.stem for p in (ROOT / "scenarios").glob("*.toml"))
        records = sorted(given.records.glob("*.tfrecord"))[:RECORDS] if given.records else []
        egos = given.ego or EGOS
        cases = [(s, e) for s in sources for e in egos] + [(str(r), e) for r in records for e in ("replay", "idm")]
        runs = run_all(cases, given.workers)
        table = {"numpy": np.__version__, "instructions": instructions(), "cases": cases, "runs": runs}
        lines = ",\n ".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in table.items())
        given.file.write_text("{" + lines.replace("}, ", "},\n  ") + "}\n")
        print(f"{len(runs)} runs kept in {given.file}.")
        return 0
    table = json.loads(given.file.read_text())
    if (table["numpy"], table["instructions"]) != (np.__version__, instructions()):
        print("The file was made with another numpy or another processor, so the last bits of floats may differ.")
    other = differences(table["runs"], run_all([(s, e) for s, e in table["cases"]], given.workers))
    print("\n".join([*other, f"{len(table['runs']) - len(other)} of {len(table['runs'])} runs are the same."]))
    return 1 if other else 0


if __name__ == "__main__":
    sys.exit(main())
