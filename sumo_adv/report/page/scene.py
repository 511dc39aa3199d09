"""What the page draws: up to three attempts on one grid of frames, the series under them, the road around them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats, Track
from sumo_adv.metrics.criticality import series
from sumo_adv.report.page.encode import Ints, packed, whole
from sumo_adv.report.page.markings import lights_of
from sumo_adv.report.page.read import RunRead
from sumo_adv.report.page.road import RoadNear
from sumo_adv.simulation.signals import SignalLog

BEFORE = 60.0  # s, shown before the trigger at most
AFTER = 2.0  # s of the unattacked run after the attempts' end
NEAR = 200.0  # m around the ego: other vehicles are shown
CENTIMETRE, MILLIRADIAN, HUNDREDTH = 0.01, 0.001, 0.01
MOST = 9_000.0  # a series' cap, in its unit
NAMES = {"best": "attacked", "first": "first attempt", "raw": "unattacked"}


@dataclass(frozen=True, slots=True)
class Segment:
    """A vehicle's frames without a gap. ``x``, ``y``: centimetres from the origin; ``heading``: milliradians."""

    first: int
    x: Ints
    y: Ints
    heading: Ints


@dataclass(frozen=True, slots=True)
class Shown:
    """One attempt. ``frm``, ``to``: its frames; before them the attempt that counts is shown.

    ``curves``: TTC, distance, then speed and acceleration of ego and adversary, from frame ``curves_from`` on, in
    hundredths.
    """

    key: str
    ego: str
    adversary: str
    trigger: float | None
    frm: int
    to: int
    vehicles: Sequence[tuple[Track, Sequence[Segment]]]
    curves_from: int = 0
    curves: Sequence[Ints] = field(default=())
    closest: tuple[float, float] | None = None  # time and distance of the closest approach after the trigger


@dataclass(frozen=True, slots=True)
class Grid:
    """Frames: number ``k`` is at ``start + k * step`` seconds; ``origin`` [m] is what positions are counted from."""

    start: float
    step: float
    frames: int
    origin: tuple[float, float]

    def frame(self, time: float) -> int:
        """The frame nearest to a time."""
        return round((time - self.start) / self.step)


def make_scene(road: RoadNear, grid: Grid, attempts: Sequence[Shown], lights: SignalLog) -> dict[str, Any]:
    """The scene as JSON: figures as they are, positions, series and the road packed in ``blob``."""
    names = lights_of(road.stops)
    shown = [lights.lights.get(name, ((), ())) for name in names]
    return {
        "start": round(grid.start, 3), "step": grid.step, "frames": grid.frames, "origin": list(grid.origin),
        "attempts": [_described(a) for a in attempts],
        "lanes": [[len(s.line), round(s.width, 2), s.kind] for s in road.strips],
        "markings": [[len(m.line), m.kind] for m in road.markings],
        "stops": [[s.kind, names.index(s.light) if s.light else -1, list(s.links)] for s in road.stops],
        "lights": [[[grid.frame(time) for time in times], list(states)] for times, states in shown],
        "blob": packed(list(_columns(attempts, road, grid))),
    }  # fmt: skip


def _described(a: Shown) -> dict[str, Any]:
    vehicles = [
        [t.id, str(t.role), t.length, t.width, [[s.first, len(s.x)] for s in segments]] for t, segments in a.vehicles
    ]
    return {
        "key": a.key, "name": NAMES.get(a.key, a.key), "ego": a.ego, "adversary": a.adversary, "trigger": a.trigger,
        "from": a.frm, "to": a.to, "vehicles": vehicles,
        "curves": [a.curves_from, len(a.curves[0])] if a.curves else None,
    }  # fmt: skip


def _columns(attempts: Sequence[Shown], road: RoadNear, grid: Grid) -> Iterator[tuple[int, Ints]]:
    """In the order in which the script reads them; alike beside alike packs best."""
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
                yield 1, whole(each.line[:, axis] - grid.origin[axis], CENTIMETRE)


def make_attempts(run: RunRead) -> tuple[Grid, list[Shown]] | None:
    """The grid, and the attempts to show: first the attempt that counts. None where nothing was recorded."""
    ego = (run.outcome.get("ego") or {}).get("id")
    pivot = _pivot(run.outcome)
    played = [t for t in run.best if len(t.time)]
    if not played:
        return None
    tracks = {t.id: t for t in played}
    lead = tracks.get(str(ego), played[0])
    step = _step(run, played)
    first = min(t.time[0] for t in played)
    last = max(t.time[-1] for t in played)
    pivot = last if pivot is None else pivot
    ends = [last, *(t.time[-1] for t in run.first), *(t.time[-1] for _, tracks in run.attacks for t in tracks)]
    end = max(ends)
    if run.raw:
        end = max(end, min(max(t.time[-1] for t in run.raw), end + AFTER))
    start = max(first, pivot - BEFORE)
    part = lead.between(start, pivot + step)
    centre = part if len(part.time) else lead
    grid = Grid(start, step, round((end - start) / step) + 1, (round(float(centre.x[-1])), round(float(centre.y[-1]))))
    return grid, _attempts(run, grid, lead)


def _pivot(outcome: Mapping[str, Any]) -> float | None:
    """When the encounter was found, up to which all attempts are the same [s]."""
    encounter = (outcome.get("encounter") or {}).get("time")
    time = outcome.get("trigger_time") if encounter is None else encounter
    return None if time is None else float(time)


def _step(run: RunRead, tracks: Sequence[Track]) -> float:
    given = (run.manifest.get("settings") or {}).get("step_length")
    if isinstance(given, int | float) and given > 0:
        return float(given)
    return min((round(float(np.diff(t.time).min()), 3) for t in tracks if len(t.time) > 1), default=0.1)


def _attempts(run: RunRead, grid: Grid, lead: Track) -> list[Shown]:
    outcome = run.outcome
    listed = outcome.get("attempts") or []
    best = outcome.get("best")
    names = [str(a["id"]) for a in outcome.get("adversaries") or []]
    pivot = _pivot(outcome)
    common = grid.start if pivot is None else pivot
    whole_run = "raw" if best is None and not names else "best"
    shown = [_shown(whole_run, run.best, grid, lead.id, names[0] if names else "", outcome.get("trigger_time"), None)]
    if run.first and listed:
        attempt = listed[0]
        shown.append(
            _shown("first", run.first, grid, lead.id, str(attempt["adversaries"][0]), attempt["trigger_time"], common)
        )
    for k, tracks in run.attacks:
        attempt = listed[k]
        key = f"attack {k + 1}: {attempt['kind']}"
        shown.append(
            _shown(key, tracks, grid, lead.id, str(attempt["adversaries"][0]), attempt["trigger_time"], common)
        )
    if run.raw and whole_run == "best":
        trigger = outcome.get("trigger_time")
        shown.append(_shown("raw", run.raw, grid, lead.id, names[0] if names else "", trigger, common))
    return shown


def _shown(
    key: str, tracks: Sequence[Track], grid: Grid, ego: str, adversary: str, trigger: float | None,
    common: float | None,
) -> Shown:  # fmt: skip
    """An attempt from ``common`` [s] on (None: from the grid's start on)."""
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
        return Shown(key, ego, adversary, trigger, frm, to, vehicles)
    measures = {} if foe is None else series(lead, [foe])
    curves = _curves(lead, foe, measures, grid)
    closest = None
    if foe is not None:
        after = measures["time"] >= (start if trigger is None else trigger) - 1e-3
        gap = np.where(after, measures["gap"][0], math.inf)
        k = int(np.argmin(gap))
        closest = (float(measures["time"][k]), float(gap[k])) if math.isfinite(gap[k]) else None
    return Shown(key, ego, adversary, trigger, frm, to, vehicles, grid.frame(float(lead.time[0])), curves, closest)


def _segments(track: Track, grid: Grid, lead: Track | None) -> list[Segment]:
    """A track cut where it has gaps; only parts near ``lead`` at the time, if that is given."""
    frames = np.rint((track.time - grid.start) / grid.step).astype(np.int64)
    keep = np.ones(len(frames), dtype=bool)
    if lead is not None:
        x, y = (np.interp(track.time, lead.time, v) for v in (lead.x, lead.y))
        keep = np.hypot(track.x - x, track.y - y) <= NEAR
    heading = np.unwrap(track.heading)
    segments = []
    places = np.flatnonzero(keep)
    for piece in np.split(places, np.flatnonzero(np.diff(frames[places]) != 1) + 1) if len(places) else []:
        segments.append(
            Segment(
                int(frames[piece[0]]), whole(track.x[piece] - grid.origin[0], CENTIMETRE),
                whole(track.y[piece] - grid.origin[1], CENTIMETRE), whole(heading[piece], MILLIRADIAN),
            )
        )  # fmt: skip
    return segments


def _curves(ego: Track, foe: Track | None, measures: Mapping[str, Floats], grid: Grid) -> list[Ints]:
    """The six series on every frame from the ego's first to its last."""
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
        full[frames - frames[0]] = np.where(np.isfinite(row), np.clip(row, -MOST, MOST), np.nan)
        curves.append(whole(full, HUNDREDTH))
    return curves
