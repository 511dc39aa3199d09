"""Compute what the files say of the attempt that counts beyond its verdict: figures, cause, realism and time series.

All of it follows from the recording. Nothing is simulated again.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Floats, Role, Track, Verdict
from sumo_adv.episode.rules_broken import RulesBroken, rules_broken
from sumo_adv.episode.run import EncounterRecord, Run
from sumo_adv.episode.task import AttemptResult, FoundEncounter, Prefix, Task
from sumo_adv.episode.verdict import first_judged, recorded_case
from sumo_adv.metrics.cause import Cause, cause_of
from sumo_adv.metrics.further import PAPER_EPSILON_M, FurtherFigures, further_figures
from sumo_adv.metrics.markings import Crossing, markings_crossed
from sumo_adv.metrics.realism import PAPER_BINS, WOSAC_BINS, distances, own_figures, realism, wosac_features
from sumo_adv.metrics.reference.cc_human import CcHuman
from sumo_adv.parsing import MAX_SUMO_FILE_BYTES, read_bytes
from sumo_adv.report.outcome import number
from sumo_adv.report.tables import series_rows
from sumo_adv.simulation.network import Drivable
from sumo_adv.simulation.tracks import tracks_of

MIN_OWN_STEPS, MIN_REFERENCE_STEPS = 10, 100  # with fewer steps, a distance of distributions says nothing
MAX_MAPPED_VEHICLES = 40  # maximum number of reference vehicles measured against the road's edge
WOSAC_FEATURES = (
    "linear_speed", "linear_acceleration", "angular_speed", "angular_acceleration", "distance_to_road_edge",
)  # fmt: skip
DISTANCES = ("kl", "js", "wasserstein")
SHARES = (
    "abnormal_lateral_share", "reference_abnormal_lateral_share", "off_road_share", "lateral_acceleration_max",
    "jerk_max", "yaw_rate_max", "curvature_max",
)  # fmt: skip
FURTHER_KEYS = (
    "collision_class", "impact", "rss", "tet", "tit", "min_headway", "max_btn", "max_required_lateral",
    "conflict_point", "paper_centre_distance", "cause", "warning", "red_light", "right_of_way",
)  # fmt: skip
DEFAULT_SIGMA = 0.5  # SUMO's default if a vehicle type declares none
TYPE, SIGMA = re.compile(rb"<vType\b[^>]*>"), re.compile(rb"\bsigma\s*=\s*[\"']([^\"']*)[\"']")


@dataclass(frozen=True, slots=True)
class Findings:
    """What is found on the attempt that counts, beyond its verdict.

    Attributes:
        figures: Further figures; None if the ego or the adversary disappeared at once. The cause and the broken rules
            are None then, too.
        cause: Why a contact or a near miss happened.
        rules: Who broke a red light or the right of way.
        warning: The time from the alarm of ``cc_human`` to the contact [s].
        markings: The lane markings that the adversary crossed.
        realism: The content of the key ``realism``.
        rows: The rows of ``criticality.csv.gz``, without the header.
    """

    figures: FurtherFigures | None = None
    cause: Cause | None = None
    rules: RulesBroken | None = None
    warning: float | None = None
    markings: Sequence[Crossing] = ()
    realism: Mapping[str, Any] = field(default_factory=dict)
    rows: Sequence[str] = ()


def findings_on(run: Run, record: EncounterRecord) -> Findings | None:
    """Compute the findings on the attempt that counts.

    Args:
        run: The run.
        record: The record.

    Returns:
        The findings; None without an attempt.
    """
    best, result, encounter, prefix = record.best, record.best_result, record.found, record.prefix
    if best is None or result is None or prefix is None:
        return None
    settings, task, bv = run.settings, run.task, best.proposal.bv
    tracks = _tracks(settings, task, best, encounter, prefix, result)
    played = task.playback
    case = recorded_case(
        tracks, encounter, settings, best.proposal.bvs, result.start, result.driven.beyond,
        follows_log=played is not None and played.follows_log,
    )  # fmt: skip
    if case is None:
        return Findings()
    recorded, contact = next(t for t in tracks if t.id == bv), best.verdict.contact_time
    end = float(min(case.ego.time[-1], recorded.time[-1])) if contact is None else contact
    moved = recorded.between(result.start + settings.step_length / 2, end)
    if case.unattacked is None:
        case = replace(case, unattacked=_foreseen(settings, best, encounter))
    return Findings(
        further_figures(case),
        cause_of(case, best.verdict),
        rules_broken(best, result, encounter),
        warning_of(best.verdict),
        markings_crossed(moved, record.lanes, encounter.drivable),
        _realism(settings, task, moved, encounter, prefix),
        series_rows(case.ego.between(result.start, np.inf), tracks, bv),
    )


def _foreseen(settings: Settings, best: Attempt, encounter: FoundEncounter) -> Track | None:
    """Return the predicted motion of the ego without the attack; None if there is none."""
    situation = encounter.situations.get(best.proposal.delay)
    if situation is None or len(situation.baseline.s) < 2:
        return None
    b = situation.baseline
    x, y, heading = b.path.at(b.s)
    time = np.asarray(best.trigger_time + settings.step_length * np.arange(len(b.s)), dtype=np.float64)
    return Track(encounter.ego, Role.EGO, time, x, y, heading, b.v, b.a, 0.0, 0.0)


def _tracks(
    settings: Settings, task: Task, best: Attempt, encounter: FoundEncounter, prefix: Prefix, result: AttemptResult
) -> list[Track]:
    """Return the recording that the engine judged, which begins a little before the attempt's start."""
    first = first_judged(encounter, settings, len(prefix.snapshots), result.start)
    snapshots = [*prefix.snapshots, *result.snapshots][first:]
    roles = task.roles(encounter.ego, *best.proposal.bvs)
    return tracks_of(snapshots, {**prefix.sizes, **result.sizes}, roles, settings.step_length)


# -- the outcome's further keys -------------------------------------------------------------------------------------


def further_keys(found: Findings | None) -> dict[str, Any]:
    """Return the further keys of ``outcome``.

    Args:
        found: The findings; None without an attempt.

    Returns:
        The keys. A value is None if its question does not arise.
    """
    markings = [] if found is None else _plain(list(found.markings))
    if found is None or found.figures is None:
        return {**dict.fromkeys(FURTHER_KEYS), "markings_crossed": markings}
    f, rules = found.figures, found.rules
    return {
        "collision_class": _plain(f.collision_class), "impact": _plain(f.impact), "rss": _plain(f.rss),
        "tet": number(f.tet), "tit": number(f.tit), "min_headway": number(f.min_headway), "max_btn": number(f.max_btn),
        "max_required_lateral": number(f.max_required_lateral), "conflict_point": _plain(f.conflict_point),
        "paper_centre_distance": {
            "minimum": number(f.min_centre_distance), "epsilon": PAPER_EPSILON_M,
            "within": f.min_centre_distance <= PAPER_EPSILON_M,
        },
        "cause": _plain(found.cause), "warning": number(found.warning), "markings_crossed": markings,
        "red_light": None if rules is None else rules.red_light,
        "right_of_way": None if rules is None else rules.right_of_way,
    }  # fmt: skip


def warning_of(verdict: Verdict) -> float | None:
    """Return the time from the alarm of ``cc_human`` to the contact.

    Args:
        verdict: The verdict.

    Returns:
        The time [s]: 0 if no alarm preceded the contact, None without a contact.
    """
    p, contact = verdict.preventability, verdict.contact_time
    if p is None or contact is None:
        return None
    return max(contact - p.alarms.get(CcHuman.name, contact), 0.0)


def _plain(value: Any) -> Any:
    """Convert a value to plain data: numbers are rounded, enumerations become text, dataclasses become dicts."""
    if is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {name: _plain(v) for name, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return str(value) if isinstance(value, str) else value if isinstance(value, bool) else number(value)


# -- realism --------------------------------------------------------------------------------------------------------


def _realism(settings: Settings, task: Task, moved: Track, encounter: FoundEncounter, prefix: Prefix) -> dict[str, Any]:
    """Compare the adversary's motion up to the contact with the unattacked run's traffic in the same window."""
    step = settings.step_length
    start, end = (float(moved.time[0]), float(moved.time[-1])) if len(moved.time) else (encounter.time, encounter.time)
    sizes = {**prefix.sizes, **encounter.sizes}
    raw = tracks_of([*prefix.snapshots[-2:], *encounter.baseline], sizes, task.roles(encounter.ego), step)
    window = [t.between(start - step / 2, end + step / 2) for t in raw if t.role is Role.BACKGROUND]
    traffic = [t for t in window if len(t.time) > 1]
    played = task.playback
    who = "as recorded" if played is not None and played.follows_log else "driven by SUMO"
    sigmas = demand_sigmas([*task.spec.routes, *task.spec.additional])
    return {
        **_plain(realism_figures(moved, traffic, encounter.drivable)),
        "steps": len(moved.time),
        "reference": {
            "what": f"background vehicles of the unattacked run, {who}, in the same window",
            "vehicles": len(traffic), "steps": sum(len(t.time) for t in traffic), "from": number(start),
            "to": number(end), "sigma": sigmas,
        },
    }  # fmt: skip


def realism_figures(moved: Track, traffic: Sequence[Track], drivable: Drivable) -> dict[str, Any]:
    """Compute the figures of realism: the adversary's motion against that of other traffic.

    Args:
        moved: The adversary's motion.
        traffic: The other vehicles.
        drivable: The drivable area.

    Returns:
        Every figure. All are None if the adversary has fewer than 10 steps; those that compare with traffic are None if
            the traffic has fewer than 100 steps.
    """
    block: dict[str, Any] = dict.fromkeys([*(f"{n}_{d}" for n in PAPER_BINS for d in DISTANCES), *SHARES])
    block["wosac_js"] = dict.fromkeys(WOSAC_FEATURES)
    if len(moved.time) < MIN_OWN_STEPS:
        return block
    if sum(len(t.time) for t in traffic) < MIN_REFERENCE_STEPS:
        return block | own_figures([moved], on_road=drivable)
    block |= realism([moved], traffic, on_road=drivable)
    block["wosac_js"] |= _wosac(moved, traffic, drivable)
    return block


def _wosac(moved: Track, traffic: Sequence[Track], drivable: Drivable) -> dict[str, float]:
    """Compute Jensen-Shannon divergences over WOSAC's bins; only traffic on the known road has the map feature."""
    distance = edge_distance(drivable)
    on_map = [t for t in traffic if bool(np.asarray(drivable(t.x, t.y)).all())][:MAX_MAPPED_VEHICLES]
    reference: dict[str, list[Floats]] = {}
    for track in traffic:
        road_distance = distance if any(track is t for t in on_map) else None
        for name, values in wosac_features(track, road_distance=road_distance).items():
            reference.setdefault(name, []).append(values)
    pooled = {name: np.concatenate(values) for name, values in reference.items()}
    every = distances(wosac_features(moved, road_distance=distance), pooled, WOSAC_BINS)
    return {name.removesuffix("_js"): value for name, value in every.items() if name.endswith("_js")}


def edge_distance(drivable: Drivable) -> Callable[[Floats, Floats], Floats]:
    """Make a function that computes the signed distance of points to the edge of the drivable area.

    Args:
        drivable: The drivable area.

    Returns:
        A function of x and y [m], any shape, that returns distances [m] of the same shape; they are positive on the
            area.
    """
    from shapely import STRtree, get_coordinates, linestrings, points

    area = drivable.area.boundary
    lines = [get_coordinates(line) for line in getattr(area, "geoms", [area])]
    tree = STRtree(linestrings(np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines])))

    def signed(x: Floats, y: Floats) -> Floats:
        nearest, away = tree.query_nearest(points(np.ravel(x), np.ravel(y)), return_distance=True, all_matches=False)
        distance = np.empty(np.size(x))
        distance[nearest[0]] = away
        return np.where(drivable(x, y), 1.0, -1.0) * distance.reshape(np.shape(x))

    return signed


def demand_sigmas(files: Sequence[Path]) -> list[float]:
    """Read the driver imperfections ``sigma`` of the vehicle types that demand files declare.

    Args:
        files: The demand files.

    Returns:
        The distinct values, sorted. A type without a readable ``sigma`` counts as SUMO's default of 0.5. If there are
            no types, the only value is 0.5.
    """
    sigmas: set[float] = set()
    for file in files:
        for kind in TYPE.findall(read_bytes(file, MAX_SUMO_FILE_BYTES)):
            match = SIGMA.search(kind)
            try:
                sigmas.add(float(match.group(1)) if match else DEFAULT_SIGMA)
            except ValueError:
                sigmas.add(DEFAULT_SIGMA)
    return sorted(sigmas) or [DEFAULT_SIGMA]
