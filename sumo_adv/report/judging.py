"""Judge stored runs again, from their files.

A run's files hold the adversary's planned motion after the contact. That is enough for the kinematic check against
reference drivers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Level, Role, Track
from sumo_adv.drivers.careful import CarefulEgo
from sumo_adv.episode.encounter_builder import ROAD_MARGIN_M
from sumo_adv.episode.situation_builder import HISTORY_S
from sumo_adv.errors import UsageError
from sumo_adv.metrics.case import Case, make_case
from sumo_adv.metrics.verdict import judge_attempt, with_answers
from sumo_adv.report.folder import plan_names
from sumo_adv.report.outcome import level_figures
from sumo_adv.report.read import OUTCOME_FILE, RunRead, columns_of, damaged, read_run
from sumo_adv.report.run_outcome import level_named, verdict_of
from sumo_adv.report.tables import PLAN_HEADER
from sumo_adv.simulation.network import read_network

SHOWN = (
    "level", "preventable_by", "inconclusive", "ego_stationary", "ego_blocking", "humanlike", "delta_v", "severity",
    "impact_speed", "simulated",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Judgement:
    """A run that was judged again.

    Attributes:
        folder: The run's folder.
        ego: The name of the ego's driver.
        before: The verdict in the run's files.
        now: The new verdict.
        how: ``files`` if the run was judged from its files, ``replay`` if it was simulated again.
    """

    folder: Path
    ego: str
    before: Mapping[str, Any]
    now: Mapping[str, Any]
    how: str  # files | replay

    def row(self) -> dict[str, Any]:
        """Return the row of a table of judgements."""
        return {
            "run": str(self.folder), "ego": self.ego, "how": self.how, "collided": self.now.get("collided"),
            "level_before": self.before.get("level"),
            **{name: self.now.get(name) for name in SHOWN},
        }  # fmt: skip


def run_folders(given: Sequence[Path]) -> list[Path]:
    """Find the folders of runs.

    Args:
        given: Folders of runs, or folders that hold runs at any depth.

    Returns:
        The folders of the runs; those below one given folder are sorted.

    Raises:
        UsageError: A given path is no folder, or it holds no run.
    """
    folders: list[Path] = []
    for folder in given:
        if not folder.is_dir():
            raise UsageError(f"{folder} is not a folder: give the folder of a run, or a folder that holds runs.")
        inside = [folder] if (folder / OUTCOME_FILE).is_file() else sorted(p.parent for p in folder.rglob(OUTCOME_FILE))
        if not inside:
            raise UsageError(f"{folder} holds no run: there is no {OUTCOME_FILE} in it or below.")
        folders += inside
    return folders


def judge_files(folder: Path) -> Judgement:
    """Judge a run from its files, kinematically.

    The gates and the rear-end flag are those that the run recorded, because files hold rounded states. A run without a
    collision keeps its verdict, and so does one with a crest, since files do not tell what it hid.

    Args:
        folder: The run's folder.

    Returns:
        The judgement.

    Raises:
        UsageError: A file is damaged or missing.
    """
    run = read_run(folder)
    before = run.outcome.get("outcome") or {}
    ego = str((run.outcome.get("ego") or {}).get("controller"))
    case = _case(run) if before.get("collided") and not run.manifest.get("sight") else None
    own = CarefulEgo.reference if ego == CarefulEgo.name else None
    again = None if case is None else judge_attempt(case, driver=own)
    if again is None or again.preventability is None:
        return Judgement(folder, ego, before, before, "files")
    recorded = verdict_of(before)
    gates = {name: getattr(recorded, name) for name in ("feasible", "rear_end", "failed_gates")}
    verdict = with_answers(replace(again, **gates), again.preventability)
    after = {**before, **level_figures(verdict), "valid": verdict.valid, "strict": verdict.strict}
    return Judgement(folder, ego, before, after, "files")


def _case(run: RunRead) -> Case | None:
    """Rebuild the case that the run judged; return None if it has no attack or no states of it."""
    adversaries, start = run.outcome.get("adversaries") or [], run.outcome.get("trigger_time")
    ego = (run.outcome.get("ego") or {}).get("id")
    if not adversaries or start is None or ego is None or not run.best:
        return None
    tracks = [t.between(float(start) - HISTORY_S, np.inf) for t in run.best]
    kept = [t for t in tracks if len(t.time)]
    ids = [str(adversary["id"]) for adversary in adversaries]
    plans = [_read_plan(run.folder / file, bv, kept) for file, bv in zip(plan_names(), ids, strict=False)]
    beyond = {plan.id: plan for plan in plans if plan is not None}
    unattacked = next((t.between(float(start), np.inf) for t in run.raw if t.id == ego), None)
    case = make_case(kept, str(ego), ids, float(start), beyond, unattacked=unattacked)
    if case is None:
        return None
    lane_half_width, drivable = _road(run, case)
    return replace(case, lane_half_width=lane_half_width, on_road=drivable)


def _read_plan(file: Path, adversary: str, tracks: Sequence[Track]) -> Track | None:
    """Read the adversary's planned motion after the contact; None without a file. Raise UsageError if it is damaged."""
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


def _road(run: RunRead, case: Case) -> tuple[float, Any]:
    """Return half the width of the ego's lane at the start [m], and the drivable area around the ego's path."""
    file = run.folder / "inputs" / Path(str(run.manifest.get("network", ""))).name
    if not file.is_file():
        raise UsageError(f"{file} is missing, so the run in {run.folder} cannot be judged again.")
    road = read_network(file)
    k = int(np.argmin(np.abs(case.ego.time - case.start)))
    lane = road.lanes.get(case.ego.lane[k]) if case.ego.lane else None
    x, y = float(case.ego.x.mean()), float(case.ego.y.mean())
    radius = float(np.hypot(case.ego.x - x, case.ego.y - y).max()) + ROAD_MARGIN_M
    return (lane.width if lane is not None else 3.2) / 2, road.drivable(x, y, radius)


def counts(judgements: Sequence[Judgement]) -> dict[str, dict[str, int]]:
    """Count judgements by ego.

    Args:
        judgements: The judgements.

    Returns:
        For each ego the number of runs, of those that were valid or strict before, of those that reach each level or a
            higher one now, and of those that are inconclusive or hit a stationary ego.
    """
    by_ego: dict[str, dict[str, int]] = {}
    for j in judgements:
        level = level_named(j.now.get("level"))
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
