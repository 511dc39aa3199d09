"""From a run's folder to the text of its page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import FAILED_ENDINGS, Track
from sumo_adv.metrics.gates import GATES
from sumo_adv.report.page.document import asset, document
from sumo_adv.report.page.markings import lane_changes
from sumo_adv.report.page.read import RunRead, read_run, reading
from sumo_adv.report.page.road import RoadNear, network, road_near
from sumo_adv.report.page.scene import Shown, make_attempts, make_scene
from sumo_adv.report.page.words import planner_versions

SCHEMA = 1
SCRIPTS = ("common.js", "decode.js", "model.js", "map.js", "charts.js", "words.js", "replay.js")
STYLES = ("common.css", "replay.css")
REACTIONS = {"braked": "begins to brake", "steered": "begins to steer away"}  # actions of the cause, in words


@dataclass(frozen=True, slots=True)
class Page:
    """A run's page: its text, where the encounter came to its point (the ego's centre [m], None if nowhere), and the
    name of the network's copy in ``inputs/`` ('' if there is none)."""

    html: str
    place: tuple[float, float] | None
    network: str


def make_page(folder: Path) -> str:
    """The page of a run as HTML, in one file. Raises UsageError: no run's folder, or a file in it is damaged."""
    return page_of(folder).html


def page_of(folder: Path, back: str | None = None) -> Page:
    """The page of a run. ``back``: where its index lies, as a link. Raises UsageError."""
    with reading(folder):
        run = read_run(folder)
        made = make_attempts(run)
        scene, moments, place = None, [], None
        if made is not None:
            grid, attempts = made
            scene = make_scene(_road(run, attempts), grid, attempts, run.lights)
            moments = _moments(run.outcome, attempts)
            place = _place(run, attempts)
        data = {
            "schema": SCHEMA, "outcome": run.outcome, "scene": scene, "moments": moments, "gates": list(GATES),
            "planners": planner_versions(run.outcome, run.manifest), "about": _about(run.manifest), "back": back,
            "failed": run.outcome["ending"] in FAILED_ENDINGS,
        }  # fmt: skip
        page = document("Replay", asset("replay.html"), STYLES, SCRIPTS, data)
        return Page(page, place, network_name(run.manifest))


def _road(run: RunRead, attempts: Sequence[Shown]) -> RoadNear:
    name = network_name(run.manifest)
    file = run.folder / "inputs" / name
    if not name or not file.is_file():
        return RoadNear()
    paths = [t for a in attempts for t, _ in a.vehicles if t.id in (a.ego, a.adversary)]
    return road_near(network(file), lane_changes(file), paths) if paths else RoadNear()


def network_name(manifest: Mapping[str, Any]) -> str:
    """The name of the network's copy, a plain file name; '' where none is told."""
    return Path(str(manifest.get("network") or "")).name


def _about(manifest: Mapping[str, Any]) -> dict[str, Any]:
    return {k: manifest.get(k) for k in ("name", "versions", "seed", "settings")}


def _moments(outcome: Mapping[str, Any], attempts: Sequence[Shown]) -> list[dict[str, Any]]:
    """Links into the time line, by time: a key for the address, words, and the time [s]."""
    verdict = outcome.get("outcome") or {}
    shown = {a.key: a for a in attempts}
    best, cause = shown.get("best"), verdict.get("cause") or {}
    reacts = REACTIONS.get(str(cause.get("action")), "reacts")
    moments = [
        ("trigger", "trigger", outcome.get("trigger_time")),
        ("hazard", "hazard shows", verdict.get("hazard_time")),
        ("alarm", "the careful driver is alarmed", cause.get("alarm")),
        ("began", f"the ego {reacts}", cause.get("began")),
        ("contact", "contact", verdict.get("contact_time")),
    ]
    if best is not None and best.closest is not None and verdict.get("contact_time") is None:
        moments.append(("closest", "closest approach", best.closest[0]))
    if best is not None and verdict.get("contact_time") is None and verdict.get("min_ttc_time") is not None:
        moments.append(("min_ttc", "least TTC", verdict["min_ttc_time"]))
    raw = shown.get("raw")
    if best is not None and raw is not None and raw.closest is not None:
        moments.append(("raw_closest", "closest approach, unattacked", raw.closest[0]))
    rows = [{"key": key, "name": name, "time": float(t)} for key, name, t in moments if t is not None]
    return sorted(rows, key=lambda m: m["time"])


def _place(run: RunRead, attempts: Sequence[Shown]) -> tuple[float, float] | None:
    """The ego's centre at contact, else at the closest approach, else at the end."""
    if not attempts:
        return None
    verdict, shown = run.outcome.get("outcome") or {}, attempts[0]
    ego = next((t for t, _ in shown.vehicles if t.id == shown.ego), None)
    if ego is None:
        return None
    time = verdict.get("contact_time")
    if time is None:
        time = shown.closest[0] if shown.closest else float(ego.time[-1])
    return _at(ego, float(time))


def _at(track: Track, time: float) -> tuple[float, float]:
    x, y = (round(float(np.interp(time, track.time, values)), 1) for values in (track.x, track.y))
    return x, y
