"""Stored runs driven again: which egos avoid the same motion, and how both forms of the counterfactual agree.

For each run the attempt that counts is replayed.  Its reference drivers answer kinematically and in the simulation;
then other egos drive the same encounter (same trigger, same vehicle) against the adversary's motion exactly as it was
recorded and planned, while other traffic reacts.

    sumo-adv bench table --suite suite81 --ego idm --row expert --keep-runs --out runs/table
    python benchmarks/same_motion.py runs/table/runs/idm [--egos idm,careful,lattice] [--out FILE.json]
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.app import new_engine
from sumo_adv.datatypes import PrescribedMotion
from sumo_adv.episode.loop import replay_episode
from sumo_adv.episode.run import EncounterRecord
from sumo_adv.errors import SumoAdvError
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.report.judging import run_folders
from sumo_adv.report.manifest import RecordedRun, read_manifest
from sumo_adv.simulation.tracks import tracks_of

EGOS = "krauss,idm,eidm,careful,lattice,replay"


def played(recorded: RecordedRun) -> EncounterRecord | None:
    """The attempt of a manifest, simulated again; None if its encounter does not come."""
    with Sandbox() as sandbox, new_engine() as engine:
        return replay_episode(
            recorded.run_input, recorded.settings, recorded.task, engine, sandbox, recorded.proposal, recorded.skips
        ).best


def course_of(record: EncounterRecord, step: float) -> PrescribedMotion:
    """The adversary's motion from the takeover on, as recorded and planned."""
    result, bv = record.results[0], record.attempts[0].proposal.bv
    track = tracks_of(result.snapshots, result.sizes, {}, step, (bv,))[0]
    track = track.between(result.start + 1e-3, np.inf)
    more = result.driven.beyond.get(bv)
    parts = [track] if more is None else [track, more]
    x, y, heading, speed = (np.concatenate([getattr(t, n) for t in parts]) for n in ("x", "y", "heading", "speed"))
    return PrescribedMotion(x, y, heading, speed)


def row_of(folder: Path, egos: Iterable[str]) -> dict[str, Any] | None:
    """One run: answers in both forms, and by ego whether it avoids the adversary (None: another encounter)."""
    recorded = read_manifest(folder)
    try:
        record = played(recorded)
    except SumoAdvError:
        return None
    if record is None or record.best is None or not record.best.verdict.collided:
        return None
    kinematic = record.results[0].verdict
    simulated = record.best.verdict.preventability
    row: dict[str, Any] = {
        "run": str(folder), "level": str(record.best.verdict.level),
        "kinematic": dict(kinematic.preventability.answers) if kinematic and kinematic.preventability else None,
        "simulated": None if simulated is None else dict(simulated.answers),
        "kinematic_level": None if kinematic is None else str(kinematic.level), "egos": {},
    }  # fmt: skip
    proposal = replace(recorded.proposal, course=course_of(record, recorded.settings.step_length))
    for ego in egos:
        settings = recorded.settings.model_copy(update={"ego": ego, "ego_parameters": {}})
        task = replace(
            recorded.task, settings=settings, ego=record.found.ego, ego_driver=ego, ego_parameters={},
            trigger=record.found.time,
        )  # fmt: skip
        try:
            repeated = played(replace(recorded, settings=settings, task=task, proposal=proposal, skips=0))
        except SumoAdvError:
            repeated = None
        same = repeated is not None and repeated.best is not None
        row["egos"][ego] = (not repeated.best.verdict.collided) if same and repeated and repeated.best else None
    return row


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--egos", default=EGOS)
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    if not args.folders:
        print("Give folders of runs; without them there is nothing to do.")
        return
    egos = [name for name in args.egos.split(",") if name]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        rows = [r for r in pool.map(lambda f: row_of(f, egos), run_folders(args.folders)) if r is not None]
    if args.out:
        args.out.write_text(json.dumps(rows, indent=1))
    print(f"{len(rows)} collisions")
    both = [r for r in rows if r["kinematic"] and r["simulated"]]
    for name in ("cc_human", "manoeuvre", "reg157", "rss", "fsm"):
        pairs = [(r["kinematic"][name], r["simulated"][name]) for r in both if r["kinematic"][name] != "not_applicable"]
        agree = sum(a == b for a, b in pairs)
        yes = (sum(a == "avoids" for a, _ in pairs), sum(b == "avoids" for _, b in pairs))
        print(f"{name:10s} avoids: kinematic {yes[0]}, simulated {yes[1]} of {len(pairs)}; agree in {agree}")
    agree = sum(r["kinematic_level"] == r["level"] for r in both)
    print(f"level      agree in {agree} of {len(both)}")
    for ego in egos:
        avoided = [r["egos"][ego] for r in rows if r["egos"][ego] is not None]
        print(f"{ego:10s} avoids the same motion in {sum(avoided)} of {len(avoided)}")


if __name__ == "__main__":
    main()
