"""Make the replay page of a run: one HTML file that needs nothing else.

The page draws all attempts on one grid of frames: the one that counts, the first one, further successful ones, and the
unattacked run. It shows their time series and the road around them.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import FAILED_ENDINGS, Floats, Role, Track
from sumo_adv.drivers.protocol import DriverInside
from sumo_adv.metrics.criticality import series
from sumo_adv.metrics.gates import GATES
from sumo_adv.report.document import WholeNumbers, asset, document, packed, whole
from sumo_adv.report.page_road import DrawnRoad, lane_changes, lights_of, network, road_near
from sumo_adv.report.read import RunRead, read_run, reading
from sumo_adv.simulation.layers import covers
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.signals import SignalLog

MAX_HISTORY_S = 60.0  # maximum time shown before the trigger
AFTER_ATTEMPTS_S = 2.0  # the unattacked run is shown this long after the attempts' end
NEARBY_RADIUS_M = 200.0  # other vehicles are shown within this distance of the ego
CENTIMETRE_M, MILLIRADIAN_RAD, HUNDREDTH = 0.01, 0.001, 0.01
SERIES_CAP = 9_000.0  # in the unit of the series
SCENE_NAMES = {"best": "attacked", "first": "first attempt", "raw": "unattacked"}
MAX_COMPARED_LINES = 2000  # longer planner sources are not compared
MAX_NOTES_SHOWN = 4  # number of series of the driver's notes
PAGE_SCHEMA = 1
PAGE_SCRIPTS = ("common.js", "decode.js", "model.js", "map.js", "charts.js", "words.js", "replay.js")
PAGE_STYLES = ("common.css", "replay.css")
REACTIONS = {"braked": "begins to brake", "steered": "begins to steer away"}  # actions of a cause


@dataclass(frozen=True, slots=True)
class Segment:
    """The frames of a vehicle, without a gap.

    Attributes:
        first: The first frame.
        x: x of the box's centre from the grid's origin [cm].
        y: y of the box's centre from the grid's origin [cm].
        heading: The heading, unwrapped [mrad].
    """

    first: int
    x: WholeNumbers
    y: WholeNumbers
    heading: WholeNumbers


@dataclass(frozen=True, slots=True)
class ShownAttempt:
    """One attempt on the page.

    Attributes:
        key: ``best``, ``first``, ``raw`` (the unattacked run), or the name of a further attack.
        ego: The ego's id.
        adversary: The collider's id; '' if there is none.
        trigger: When the attack begins [s]; None if unknown.
        frm: The attempt's first frame. Before this frame, the page shows the attempt that counts.
        to: The attempt's last frame.
        vehicles: The vehicles with their segments.
        curves_from: The first frame of ``curves``.
        curves: Six series in hundredths: TTC [s], distance [m], ego speed [m/s], ego acceleration [m/s2], adversary
            speed [m/s] and adversary acceleration [m/s2].
        closest: Time [s] and distance [m] of the closest approach after the trigger; None if unknown.
    """

    key: str
    ego: str
    adversary: str
    trigger: float | None
    frm: int
    to: int
    vehicles: Sequence[tuple[Track, Sequence[Segment]]]
    curves_from: int = 0
    curves: Sequence[WholeNumbers] = field(default=())
    closest: tuple[float, float] | None = None  # time and distance of the closest approach after the trigger


@dataclass(frozen=True, slots=True)
class Grid:
    """The frames of a page; frame ``k`` is at ``start + k * step``.

    Attributes:
        start: The time of frame 0 [s].
        step: The time between frames [s].
        frames: The number of frames.
        origin: The point from which positions are counted [m].
    """

    start: float
    step: float
    frames: int
    origin: tuple[float, float]

    def frame(self, time: float) -> int:
        """Return the frame that is nearest to a time [s]."""
        return round((time - self.start) / self.step)


def make_scene(
    road: DrawnRoad, grid: Grid, attempts: Sequence[ShownAttempt], lights: SignalLog,
    inside: Sequence[DriverInside] = (),
) -> dict[str, Any]:  # fmt: skip
    """Assemble the scene as JSON. Positions, series, plans and the road are packed in ``blob``.

    Args:
        road: The road around the vehicles.
        grid: The frames.
        attempts: The attempts, the one that counts first.
        lights: The recorded states of traffic lights.
        inside: Plans and notes of the ego's driver in the attempt that counts.

    Returns:
        The scene.
    """
    end = grid.start + (grid.frames - 0.5) * grid.step
    inside = [each for each in inside if grid.start - grid.step / 2 <= each.time < end]
    notes = sorted({name for each in inside for name in each.notes})[:MAX_NOTES_SHOWN]
    names = lights_of(road.stops)
    shown = [lights.lights.get(name, ((), ())) for name in names]
    return {
        "start": round(grid.start, 3), "step": grid.step, "frames": grid.frames, "origin": list(grid.origin),
        "attempts": [_described(a) for a in attempts],
        "lanes": [[len(s.line), round(s.width, 2), s.kind] for s in road.strips],
        "markings": [[len(m.line), m.kind] for m in road.markings],
        "stops": [[s.kind, names.index(s.light) if s.light else -1, list(s.links)] for s in road.stops],
        "lights": [[[grid.frame(time) for time in times], list(states)] for times, states in shown],
        "plans": [[grid.frame(each.time), len(each.plan)] for each in inside],
        "notes": [[name, [each.notes.get(name) for each in inside]] for name in notes],
        "blob": packed(list(_columns(attempts, road, grid, inside))),
    }  # fmt: skip


def _described(a: ShownAttempt) -> dict[str, Any]:
    vehicles = [
        [t.id, str(t.role), t.length, t.width, [[s.first, len(s.x)] for s in segments]] for t, segments in a.vehicles
    ]
    return {
        "key": a.key, "name": SCENE_NAMES.get(a.key, a.key), "ego": a.ego, "adversary": a.adversary,
        "trigger": a.trigger, "from": a.frm, "to": a.to, "vehicles": vehicles,
        "curves": [a.curves_from, len(a.curves[0])] if a.curves else None,
    }  # fmt: skip


def _columns(
    attempts: Sequence[ShownAttempt], road: DrawnRoad, grid: Grid, inside: Sequence[DriverInside]
) -> Iterator[tuple[int, WholeNumbers]]:
    """Yield the columns in the order in which the script reads them; similar ones are adjacent, which packs best."""
    for name in ("x", "y", "heading"):
        for attempt in attempts:
            for _, segments in attempt.vehicles:
                for segment in segments:
                    yield 2, getattr(segment, name)
    for attempt in attempts:
        for curve in attempt.curves:
            yield 1, curve
    for lines in (road.strips, road.markings, road.stops):
        for axis in (0, 1):
            for each in lines:
                yield 1, whole(each.line[:, axis] - grid.origin[axis], CENTIMETRE_M)
    for axis in (0, 1):
        for answer in inside:
            plan = np.array(answer.plan).reshape(-1, 2)
            yield 1, whole(plan[:, axis] - grid.origin[axis], CENTIMETRE_M)


def make_attempts(run: RunRead, road: RoadMap | None = None) -> tuple[Grid, list[ShownAttempt]] | None:
    """Select the attempts to show.

    Args:
        run: The run.
        road: The run's network. If it has heights, the states of vehicles under another lane are left out, except those
            of ego and adversaries.

    Returns:
        The grid, and the attempts, the one that counts first. None if nothing was recorded.
    """
    ego = (run.outcome.get("ego") or {}).get("id")
    pivot = _pivot(run.outcome)
    played = [t for t in run.best if len(t.time)]
    if not played:
        return None
    tracks = {t.id: t for t in played}
    lead = tracks.get(str(ego), played[0])
    step, first, last = _step(run, played), min(t.time[0] for t in played), max(t.time[-1] for t in played)
    pivot = last if pivot is None else pivot
    end = max([last, *(t.time[-1] for t in run.first), *(t.time[-1] for _, tracks in run.attacks for t in tracks)])
    if run.raw:
        end = max(end, min(max(t.time[-1] for t in run.raw), end + AFTER_ATTEMPTS_S))
    start = max(first, pivot - MAX_HISTORY_S)
    part = lead.between(start, pivot + step)
    centre = part if len(part.time) else lead
    grid = Grid(start, step, round((end - start) / step) + 1, (round(float(centre.x[-1])), round(float(centre.y[-1]))))
    if road is not None and road.heights is not None:
        best, raw = ([_uncovered(track, road) for track in tracks] for tracks in (run.best, run.raw))
        run = replace(run, best=best, raw=raw)
    return grid, _attempts(run, grid, lead)


def _uncovered(track: Track, road: RoadMap) -> Track:
    """Keep the states of a vehicle that no lane passes over; keep all states of ego and adversaries."""
    if track.role in (Role.EGO, Role.ADVERSARY):
        return track
    covered = np.zeros(len(track.time), bool)
    for lane in road.lanes.values():
        covered |= covers(road.line(lane), lane.width, track.x, track.y, track.z)
    return track.picked(np.flatnonzero(~covered))


def _pivot(outcome: Mapping[str, Any]) -> float | None:
    """Return when the encounter was found, up to which all attempts are the same [s]."""
    encounter = (outcome.get("encounter") or {}).get("time")
    time = outcome.get("trigger_time") if encounter is None else encounter
    return None if time is None else float(time)


def _step(run: RunRead, tracks: Sequence[Track]) -> float:
    """Return the step length of a run [s]; older manifests lack it, so it may be taken from the tracks."""
    given = (run.manifest.get("settings") or {}).get("step_length")
    if isinstance(given, int | float) and given > 0:
        return float(given)
    return min((round(float(np.diff(t.time).min()), 3) for t in tracks if len(t.time) > 1), default=0.1)


def _attempts(run: RunRead, grid: Grid, lead: Track) -> list[ShownAttempt]:
    outcome, pivot = run.outcome, _pivot(run.outcome)
    listed, begun = outcome.get("attempts") or [], outcome.get("trigger_time")
    names = [str(a["id"]) for a in outcome.get("adversaries") or []]
    foe = names[0] if names else ""
    common = grid.start if pivot is None else pivot
    whole_run = "raw" if outcome.get("best") is None and not names else "best"
    shown = [_shown(whole_run, run.best, grid, lead.id, foe, begun, None)]
    others = [("first", listed[0], run.first)] if run.first and listed else []
    others += [(f"attack {k + 1}: {listed[k]['kind']}", listed[k], tracks) for k, tracks in run.attacks]
    for key, attempt, tracks in others:
        adversary, trigger = str(attempt["adversaries"][0]), attempt["trigger_time"]
        shown.append(_shown(key, tracks, grid, lead.id, adversary, trigger, common))
    if run.raw and whole_run == "best":
        shown.append(_shown("raw", run.raw, grid, lead.id, foe, begun, common))
    return shown


def _shown(
    key: str, tracks: Sequence[Track], grid: Grid, ego: str, adversary: str, trigger: float | None,
    common: float | None,
) -> ShownAttempt:  # fmt: skip
    """Make an attempt that begins after ``common`` [s], or at the grid's start if that is None."""
    start = grid.start if common is None else common + grid.step / 2
    end = grid.start + (grid.frames - 1) * grid.step
    cut = [t.between(start, end) for t in tracks]
    cut = [t for t in cut if len(t.time)]
    lead = next((t for t in cut if t.id == ego), None)
    vehicles = [(t, s) for t in cut if (s := _segments(t, grid, None if t.id in (ego, adversary) else lead))]
    frm = 0 if common is None else grid.frame(common)
    to = max((grid.frame(float(t.time[-1])) for t in cut), default=frm)
    foe = next((t for t in cut if t.id == adversary), None)
    if lead is None:
        return ShownAttempt(key, ego, adversary, trigger, frm, to, vehicles)
    measures = {} if foe is None else series(lead, [foe])
    curves = _curves(lead, foe, measures, grid)
    closest = None
    if foe is not None:
        after = measures["time"] >= (start if trigger is None else trigger) - 1e-3
        gap = np.where(after, measures["gap"][0], math.inf)
        k = int(np.argmin(gap))
        closest = (float(measures["time"][k]), float(gap[k])) if math.isfinite(gap[k]) else None
    return ShownAttempt(
        key, ego, adversary, trigger, frm, to, vehicles, grid.frame(float(lead.time[0])), curves, closest
    )


def _segments(track: Track, grid: Grid, lead: Track | None) -> list[Segment]:
    """Cut a track at its gaps; if ``lead`` is given, keep only the parts near it."""
    frames = np.rint((track.time - grid.start) / grid.step).astype(np.int64)
    keep = np.ones(len(frames), dtype=bool)
    if lead is not None:
        x, y = (np.interp(track.time, lead.time, v) for v in (lead.x, lead.y))
        keep = np.hypot(track.x - x, track.y - y) <= NEARBY_RADIUS_M
    heading = np.unwrap(track.heading)
    places = np.flatnonzero(keep)
    pieces = np.split(places, np.flatnonzero(np.diff(frames[places]) != 1) + 1) if len(places) else []
    return [
        Segment(
            int(frames[piece[0]]), whole(track.x[piece] - grid.origin[0], CENTIMETRE_M),
            whole(track.y[piece] - grid.origin[1], CENTIMETRE_M), whole(heading[piece], MILLIRADIAN_RAD),
        )
        for piece in pieces
    ]  # fmt: skip


def _curves(ego: Track, foe: Track | None, measures: Mapping[str, Floats], grid: Grid) -> list[WholeNumbers]:
    """Sample the six series on every frame from the ego's first to its last."""
    frames = np.rint((ego.time - grid.start) / grid.step).astype(np.int64)
    empty = np.full(len(ego.time), np.nan)
    rows = [empty, empty, ego.speed, ego.acceleration, empty, empty]
    if foe is not None:
        on = np.isfinite(measures["centre_distance"][0])
        rows[0], rows[1] = measures["ttc"][0], measures["gap"][0]
        for k, values in ((4, foe.speed), (5, foe.acceleration)):
            rows[k] = np.where(on, np.interp(ego.time, foe.time, values), np.nan)
    curves = []
    for row in rows:
        full = np.full(int(frames[-1] - frames[0]) + 1, np.nan)
        full[frames - frames[0]] = np.where(np.isfinite(row), np.clip(row, -SERIES_CAP, SERIES_CAP), np.nan)
        curves.append(whole(full, HUNDREDTH))
    return curves


def planner_versions(outcome: Mapping[str, Any], manifest: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Describe the planners that the attempts used.

    Args:
        outcome: The content of ``outcome.json``.
        manifest: The content of ``manifest.json``.

    Returns:
        The planners in the order of first use, each with a unified diff from its parent if the parent is known.
    """
    planners: Mapping[str, Any] = manifest.get("planners") or {}
    used: dict[str, list[int]] = {}
    for attempt in outcome.get("attempts") or []:
        used.setdefault(attempt["planner"]["hash"], []).append(attempt["index"])
    counts = (manifest.get("attempt") or {}).get("planner")
    return [
        {
            "hash": name, "label": planners[name]["label"], "mode": planners[name]["mode"],
            "origin": planners[name]["origin"], "parent": planners[name]["parent"], "source": planners[name]["source"],
            "attempts": attempts, "counts": name == counts, "diff": _diff(planners, name),
        }
        for name, attempts in used.items() if name in planners
    ]  # fmt: skip


def _diff(planners: Mapping[str, Any], name: str) -> list[str] | None:
    """Return the lines of a unified diff without file names; None without a parent or for long sources."""
    parent = planners[name]["parent"]
    if parent not in planners:
        return None
    before, after = (planners[n]["source"].splitlines() for n in (parent, name))
    if max(len(before), len(after)) > MAX_COMPARED_LINES:
        return None
    return list(difflib.unified_diff(before, after, lineterm=""))[2:]


@dataclass(frozen=True, slots=True)
class Page:
    """A run's page.

    Attributes:
        html: The text.
        place: The ego's centre at the contact or, without one, at the closest approach [m]; None if unknown.
        network: The name of the network's copy in ``inputs/``; '' if there is none.
    """

    html: str
    place: tuple[float, float] | None
    network: str


def make_page(folder: Path) -> str:
    """Make the page of a run as HTML, in one file.

    Args:
        folder: The run's folder.

    Returns:
        The HTML.

    Raises:
        UsageError: The folder holds no run, or a file is damaged.
    """
    return page_of(folder).html


def page_of(folder: Path, back: str | None = None) -> Page:
    """Make the page of a run.

    Args:
        folder: The run's folder.
        back: A link to the index; None if there is no index.

    Returns:
        The page.

    Raises:
        UsageError: The folder holds no run, or a file is damaged.
    """
    with reading(folder):
        run = read_run(folder)
        file = run.folder / "inputs" / network_name(run.manifest)
        road = network(file) if file.is_file() else None
        made = make_attempts(run, road)
        scene, moments, place = None, [], None
        if made is not None:
            grid, attempts = made
            scene = make_scene(_road(road, file, attempts), grid, attempts, run.lights, run.inside)
            moments = _moments(run.outcome, attempts)
            place = _place(run, attempts)
        data = {
            "schema": PAGE_SCHEMA, "outcome": run.outcome, "scene": scene, "moments": moments, "gates": list(GATES),
            "planners": planner_versions(run.outcome, run.manifest),
            "about": {k: run.manifest.get(k) for k in ("name", "versions", "seed", "settings")}, "back": back,
            "failed": run.outcome["ending"] in FAILED_ENDINGS,
        }  # fmt: skip
        page = document("Replay", asset("replay.html"), PAGE_STYLES, PAGE_SCRIPTS, data)
        return Page(page, place, network_name(run.manifest))


def _road(road: RoadMap | None, file: Path, attempts: Sequence[ShownAttempt]) -> DrawnRoad:
    paths = [t for a in attempts for t, _ in a.vehicles if t.id in (a.ego, a.adversary)]
    return road_near(road, lane_changes(file), paths) if paths and road is not None else DrawnRoad()


def network_name(manifest: Mapping[str, Any]) -> str:
    """Return the name of the network's copy without its folder; '' if the manifest has none."""
    return Path(str(manifest.get("network") or "")).name


def _moments(outcome: Mapping[str, Any], attempts: Sequence[ShownAttempt]) -> list[dict[str, Any]]:
    """Return links into the time line, sorted by time: a key for the address, the words, and the time [s]."""
    verdict = outcome.get("outcome") or {}
    shown = {a.key: a for a in attempts}
    best, cause = shown.get("best"), verdict.get("cause") or {}
    reacts = REACTIONS.get(str(cause.get("action")), "reacts")
    moments = [
        ("trigger", "trigger", outcome.get("trigger_time")),
        ("alarm", "the careful driver is alarmed", cause.get("alarm")),
        ("began", f"the ego {reacts}", cause.get("began")),
        ("contact", "contact", verdict.get("contact_time")),
    ]
    if best is not None and best.closest is not None and verdict.get("contact_time") is None:
        moments.append(("closest", "closest approach", best.closest[0]))
    if best is not None and verdict.get("contact_time") is None and verdict.get("min_ttc_time") is not None:
        moments.append(("min_ttc", "minimum TTC", verdict["min_ttc_time"]))
    raw = shown.get("raw")
    if best is not None and raw is not None and raw.closest is not None:
        moments.append(("raw_closest", "closest approach, unattacked", raw.closest[0]))
    rows = [{"key": key, "name": name, "time": float(t)} for key, name, t in moments if t is not None]
    return sorted(rows, key=lambda m: m["time"])


def _place(run: RunRead, attempts: Sequence[ShownAttempt]) -> tuple[float, float] | None:
    """Return the ego's centre at the contact or, without one, at the closest approach, or at the end [m]."""
    verdict, shown = run.outcome.get("outcome") or {}, attempts[0]
    ego = next((t for t, _ in shown.vehicles if t.id == shown.ego), None)
    if ego is None:
        return None
    time = verdict.get("contact_time")
    if time is None:
        time = shown.closest[0] if shown.closest else float(ego.time[-1])
    x, y = (round(float(np.interp(float(time), ego.time, values)), 1) for values in (ego.x, ego.y))
    return x, y
