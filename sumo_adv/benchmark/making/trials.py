"""Runs a drawn encounter unattacked in SUMO, with each driver under test, and says what is wrong with it.

The drive is the one of ``run`` (``Worker.open``, ``Worker.seek``), so ``run`` finds the same encounters.  Each trial is
a fork of a process that has imported everything and run nothing.
"""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from sumo_adv.config import load_settings
from sumo_adv.episode.encounter_detector import FASTEST_START, LATEST
from sumo_adv.episode.task import FoundEncounter, NoEncounter, Task, make_task
from sumo_adv.episode.worker import Worker
from sumo_adv.errors import UsageError
from sumo_adv.simulation.engine import in_forks
from sumo_adv.simulation.inputs import load_input
from sumo_adv.simulation.programs import load_libsumo
from sumo_adv.situation import Target

EGOS = ("idm", "krauss", "eidm", "careful")
"""The drivers that an encounter must be calm with; a replayed ego plays back what ``idm`` drives."""

TTC = 1.0  # s: at or below this an encounter is critical by itself
STAYS = 15.0  # s after the trigger that the ego must still be there: an attack begun 3 s late lasts 12 s
BV_STAYS = 8.0  # s
RELATIONS = {
    "leader": "leader", "neighbour_ahead": "neighbour", "neighbour_behind": "neighbour", "oncoming": "oncoming",
    "follower": "follower",
}  # fmt: skip
MEETING = ("crossing", "merging", "oncoming")


@dataclass(frozen=True, slots=True)
class Trial:
    """An encounter with one driver. ``bv``: the intended adversary, ``kind``: as what; ``first``: whether it
    must be the most dangerous one."""

    task: Task
    bv: str
    kind: str
    first: bool


def trial(scenario: Path, ego: str, bv: str, kind: str, seed: int = 0) -> Trial:
    """The trial of a scenario file with the driver ``ego`` and SUMO's ``seed``."""
    source = load_input(scenario)
    settings = load_settings(None, ego=ego, seed=seed, critical_ttc=TTC, horizon=source.horizon)
    task = make_task(source, settings, Path(tempfile.gettempdir()))
    return Trial(task, bv, kind, kind in RELATIONS and ego == EGOS[0])


def tried(candidate: Trial) -> str:
    """What is wrong with an encounter, in words without figures; empty if it is good."""
    worker = Worker([])
    worker.open(candidate.task)
    try:
        outcome = worker.seek()
    except UsageError:  # SUMO found no room for the ego in all the time given
        return "the ego is not inserted"
    return _not_found(outcome) if isinstance(outcome, NoEncounter) else _fault(candidate, outcome)


def _not_found(outcome: NoEncounter) -> str:
    words = re.sub(r"^At the trigger given, [\d.]+ s, ", "", outcome.reason)
    return re.sub(r":.*", "", words).rstrip(".")


def _fault(candidate: Trial, encounter: FoundEncounter) -> str:
    present = {
        name: sum(name in snapshot.raw for snapshot in encounter.baseline) for name in (encounter.ego, candidate.bv)
    }
    dt = candidate.task.settings.step_length
    if present[encounter.ego] * dt < STAYS:
        return "the ego stays too short"
    if present[candidate.bv] * dt < BV_STAYS:
        return "the vehicle meant stays too short"
    relations = {name: relation for name, relation, _ in encounter.ranking}
    target = encounter.first.targets.get(candidate.bv)
    if candidate.bv not in relations or target is None:
        return "the vehicle meant is no candidate"
    if candidate.first and encounter.ranking[0][0] != candidate.bv:
        return "another vehicle is more dangerous than the one meant"
    if candidate.kind not in RELATIONS:
        ok = relations[candidate.bv] in MEETING and in_time(target, encounter.first.ego.speed)
        return "" if ok else "the vehicle meant cannot be at the conflict in time"
    ahead = encounter.first.frame.to_local(target.state.x, target.state.y, target.state.heading)[0] > 0
    sided = {"neighbour_ahead": ahead, "neighbour_behind": not ahead}.get(candidate.kind, True)
    as_meant = relations[candidate.bv] == RELATIONS[candidate.kind] and sided
    return "" if as_meant else "the vehicle meant stands otherwise by then"


def in_time(target: Target, ego_speed: float) -> bool:
    """Whether a vehicle that accelerates at once is at a conflict no later than 0.2 s after the ego."""
    for way in target.ways:
        if way.conflict is None or way.conflict.bv_s < 1.0 or way.conflict.ego_s < 1.0:
            continue
        v = max(target.state.speed, 0.1)
        earliest = (-v + math.sqrt(v * v + 2 * FASTEST_START * way.conflict.bv_s)) / FASTEST_START
        if earliest <= way.conflict.ego_s / max(ego_speed, 1.0) + LATEST:
            return True
    return False


def _each(trials: Sequence[Trial]) -> list[str]:
    """What is wrong with each, all at the same time."""
    return in_forks([partial(tried, candidate) for candidate in trials])


def body(slots: list[Connection]) -> dict[str, Callable[..., Any]]:
    """The command of the process that forks the trials."""
    import shapely.geometry  # noqa: F401 - what every trial needs is there before the first fork

    load_libsumo()

    return {"trials": _each}
