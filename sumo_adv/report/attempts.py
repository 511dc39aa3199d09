"""``attempts.csv.gz``: a row for each attempt of a run, of encounters that gave nothing, too."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sumo_adv.datatypes import Attempt, plain_acceleration
from sumo_adv.episode.episode import Episode
from sumo_adv.report.outcome import number
from sumo_adv.report.tables import write_gzip

ATTEMPTS = "attempts.csv.gz"
COLUMNS = (
    "encounter", "attempt", "by", "phase", "adversaries", "intent", "mode", "planner", "parameters", "acceleration",
    "delay", "level", "min_ttc", "min_distance", "delta_v", "contact_time", "contact_side", "preventable_by",
    "failed_gates", "ending",
)  # fmt: skip


def write_attempts(target: Path, episode: Episode) -> None:
    """The table, if an attempt was made. Times in s, distances in m, speeds in m/s; never = empty.

    encounter: its time; attempt: its number in the encounter, from 1; parameters: of the planner, as JSON; delay: from
    the encounter to the start.
    """
    rows = list(_rows(episode))
    if not rows:
        return
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_gzip(target, text.getvalue())


def _rows(episode: Episode) -> Iterator[dict[str, Any]]:
    now = getattr(episode.found, "time", None)
    encounters = {t.time: t.made for t in episode.tried}
    if now is not None:
        encounters[now] = episode.refinement.attempts
    for time, made in sorted(encounters.items()):
        for attempt in made:
            yield _row(time, attempt)


def _row(encounter: float, a: Attempt) -> dict[str, Any]:
    v, p = a.verdict, a.proposal
    return {
        "encounter": number(encounter), "attempt": a.index + 1, "by": p.by, "phase": a.phase,
        "adversaries": " ".join(p.bvs), "intent": p.composition or p.label, "mode": p.planner.mode,
        "planner": p.planner.hash, "parameters": json.dumps({k: number(q) for k, q in p.parameters.items()}),
        "acceleration": plain_acceleration(p.acceleration), "delay": number(p.delay), "level": str(v.level),
        "min_ttc": number(v.min_ttc), "min_distance": number(v.min_distance), "delta_v": number(v.delta_v),
        "contact_time": number(v.contact_time), "contact_side": v.contact_side,
        "preventable_by": None if v.preventability is None else " ".join(v.preventability.by),
        "failed_gates": " ".join(v.failed_gates), "ending": a.ending,
    }  # fmt: skip
