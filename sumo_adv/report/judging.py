"""Stored runs judged again with verdict version 2, from their files.

A run of version 2 stores what the adversary planned after the contact; its files are enough for the kinematic
counterfactual.  A run of version 1 does not: ``sumo-adv judge`` replays it (``cli/judge.py``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Level, Role, Track, Verdict
from sumo_adv.errors import UsageError
from sumo_adv.metrics.case import Case, make_case
from sumo_adv.metrics.levels import with_level
from sumo_adv.report.folder import plan_names
from sumo_adv.report.outcome import level_figures
from sumo_adv.report.read import OUTCOME, RunRead, columns_of, damaged, read_run
from sumo_adv.report.run_outcome import level_of
from sumo_adv.report.tables import PLAN_HEADER
from sumo_adv.simulation.network import read_network

ROAD_MARGIN = 150.0  # m around the ego's way within which the road is read
HISTORY = 1.1  # s before the trigger
SHOWN = (
    "level", "preventable_by", "inconclusive", "ego_stationary", "ego_blocking", "humanlike", "delta_v", "severity",
    "impact_speed", "simulated",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Judgement:
    """One run judged again.  ``before``: what its files said, ``now``: verdict version 2."""

    folder: Path
    ego: str
    before: Mapping[str, Any]
    now: Mapping[str, Any]
    how: str  # files | replay

    def row(self) -> dict[str, Any]:
        return {
            "run": str(self.folder), "ego": self.ego, "how": self.how, "collided": self.now.get("collided"),
            "valid_before": self.before.get("valid"), "strict_before": self.before.get("strict"),
            **{name: self.now.get(name) for name in SHOWN},
        }  # fmt: skip


def run_folders(given: Sequence[Path]) -> list[Path]:
    """The folders of runs among and below the given ones, sorted. Raises UsageError: there are none."""
    folders: list[Path] = []
    for folder in given:
        if not folder.is_dir():
            raise UsageError(f"{folder} is no folder: give the folder of a run, or a folder that holds runs.")
        inside = [folder] if (folder / OUTCOME).is_file() else sorted(p.parent for p in folder.rglob(OUTCOME))
        if not inside:
            raise UsageError(f"{folder} holds no run: there is no {OUTCOME} in it or below.")
        folders += inside
    return folders


def judge_files(folder: Path) -> Judgement:
    """A run of version 2 judged from its files, kinematically. Raises UsageError: a file is damaged or missing."""
    run = read_run(folder)
    before = run.outcome.get("outcome") or {}
    ego = str((run.outcome.get("ego") or {}).get("controller"))
    case, start = _case(run)
    contact = before.get("contact_time")
    if case is None or contact is None:
        return Judgement(folder, ego, before, before, "files")
    lane_half, drivable = _road(run, case, start)
    gate = Verdict(
        0.0, 0.0, True, True, bool(before.get("feasible")), bool(before.get("rear_end")), None, None,
        before.get("avoidable"), tuple(before.get("failed_gates") or ()), contact_time=float(contact),
    )  # fmt: skip
    verdict = with_level(
        gate, case.ego, case.adversary, case.others, trigger_time=start, on_road=drivable, lane_half_width=lane_half,
        unattacked=next((t.between(start, np.inf) for t in run.raw if t.id == case.ego.id), None),
    )  # fmt: skip
    after = {**before, **level_figures(verdict), "valid": verdict.valid, "strict": verdict.strict}
    return Judgement(folder, ego, before, after, "files")


def _case(run: RunRead) -> tuple[Case | None, float]:
    adversaries, start = run.outcome.get("adversaries") or [], run.outcome.get("trigger_time")
    ego = (run.outcome.get("ego") or {}).get("id")
    if not adversaries or start is None or ego is None or not run.best:
        return None, 0.0
    tracks = [t.between(float(start) - HISTORY, np.inf) for t in run.best]
    kept = [t for t in tracks if len(t.time)]
    ids = [str(adversary["id"]) for adversary in adversaries]
    plans = [_read_plan(run.folder / file, bv, kept) for file, bv in zip(plan_names(), ids, strict=False)]
    beyond = {plan.id: plan for plan in plans if plan is not None}
    return make_case(kept, str(ego), ids, float(start), beyond), float(start)


def _read_plan(file: Path, adversary: str, tracks: Sequence[Track]) -> Track | None:
    """The adversary's planned motion after the contact; None where there is no such file. Raises UsageError."""
    if not file.is_file():
        return None
    try:
        columns = columns_of(file, PLAN_HEADER).values()
        time, x, y, heading, speed, acceleration = (np.array(column, dtype=np.float64) for column in columns)
    except ValueError as error:
        raise damaged(file, error) from error
    own = next((t for t in tracks if t.id == adversary), None)
    size = (4.8, 1.8) if own is None else (own.length, own.width)
    z = float(np.ravel(own.z)[-1]) if own is not None else 0.0
    return Track(adversary, Role.ADVERSARY, time, x, y, heading, speed, acceleration, *size, z=z)


def _road(run: RunRead, case: Case, start: float) -> tuple[float, Any]:
    """Half the width of the ego's lane at the start [m], and the drivable area around its way."""
    file = run.folder / "inputs" / Path(str(run.manifest.get("network", ""))).name
    if not file.is_file():
        raise UsageError(f"{file} is missing, so the run in {run.folder} cannot be judged again.")
    road = read_network(file)
    k = int(np.argmin(np.abs(case.ego.time - start)))
    lane = road.lanes.get(case.ego.lane[k]) if case.ego.lane else None
    x, y = float(case.ego.x.mean()), float(case.ego.y.mean())
    radius = float(np.hypot(case.ego.x - x, case.ego.y - y).max()) + ROAD_MARGIN
    return (lane.width if lane is not None else 3.2) / 2, road.drivable(x, y, radius)


def counts(judgements: Sequence[Judgement]) -> dict[str, dict[str, int]]:
    """By ego: how many runs reach each level or a higher one, collide, are inconclusive, or hit a standing ego."""
    by_ego: dict[str, dict[str, int]] = {}
    for j in judgements:
        level = level_of(j.now.get("level"))
        holds = {
            "runs": True, "valid before": j.before.get("valid") is True,
            "strict before": j.before.get("strict") is True,
            **{str(least): level >= least for least in Level if least is not Level.NONE},
            "inconclusive": bool(j.now.get("inconclusive")), "stationary": bool(j.now.get("ego_stationary")),
        }  # fmt: skip
        row = by_ego.setdefault(j.ego, dict.fromkeys(holds, 0))
        for name, held in holds.items():
            row[name] += held
    return by_ego
