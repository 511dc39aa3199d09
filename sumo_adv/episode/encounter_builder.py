"""Describes the encounter that begins now, for ``run`` and for ``serve``.

They differ in the baseline: ``run`` simulates it in a fork, ``serve`` foresees it (``traffic_forecast``).

The encounter of a recording may be attacked from its beginning to shortly before its end, or before the log itself
becomes dangerous, by whatever vehicle could begin an attack at that moment.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import Track
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.encounter_detector import RankedVehicle, vehicles_of
from sumo_adv.episode.encounter_filter import LEAST, danger
from sumo_adv.episode.encounter_place import place_of
from sumo_adv.episode.reach import why_nobody
from sumo_adv.episode.situation_builder import build_situations, recorded_situations, trigger_state
from sumo_adv.episode.start_times import MOST_SHIFT
from sumo_adv.episode.task import FoundEncounter
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.simulation import Snapshot

SAFE = 0.3  # s before a log becomes dangerous by itself, at which attempts end
MOST_VEHICLES = 12  # of a recording, that may attack
ROAD_MARGIN = 150.0  # m around the unattacked ego's path within which the drivable area is known


@dataclass(frozen=True, slots=True)
class UnattackedMotion:
    """The motion without an attack, simulated or foreseen.

    tracks: by id, from the history before the trigger to the end; snapshots: the simulated states from the trigger on,
    empty if the motion is foreseen; sizes: length and width [m] by id; looks: in a recording the vehicles that could
    attack by seconds after the trigger, else empty.
    """

    tracks: Mapping[str, Track]
    snapshots: Sequence[Snapshot]
    sizes: Mapping[str, tuple[float, float]]
    looks: Mapping[float, Sequence[RankedVehicle]] = field(default_factory=dict)


def build_encounter(
    drive: Drive,
    road: RoadMap,
    settings: Settings,
    ranking: Sequence[RankedVehicle],
    baseline_for: Callable[[float], UnattackedMotion],
    *,
    checked: float = math.inf,
    passed_over: Sequence[str] = (),
    delay: float | None = None,
) -> tuple[FoundEncounter, UnattackedMotion] | str:
    """The encounter that begins now, and its baseline; or why it is passed over.

    Args:
        baseline_for: takes seconds from now and returns the baseline until then.
        checked: seconds from now within which the baseline must not be dangerous itself.
        passed_over: reasons why earlier encounters were passed over.
        delay: the only delay after the trigger [s] at which an attack may begin; None = those of ``start_times.py``.
    """
    nobody = f"no {vehicles_of(settings.kind)} near could endanger the ego"
    nobody += " within the ODD" if settings.odd is not None else ""
    if drive.ego is None or not (ranking or drive.recorded()):
        return nobody
    place, late = place_of(road, drive), MOST_SHIFT if all(c.meets_ahead for c in ranking) else 0.0
    baseline = baseline_for(settings.duration + max(max(settings.delays) + late, delay or 0.0))
    looks = dict(baseline.looks)
    if looks:
        ranking = _most_dangerous(looks)
    if not ranking and drive.recorded():
        return why_nobody(baseline.tracks, drive.ego, drive.now, settings.limits.limits().acceleration)
    names, limit = [c.id for c in ranking], settings.harmless_ttc
    tracks = {name: t.between(-math.inf, drive.now + checked) for name, t in baseline.tracks.items()}
    found = danger(tracks, drive, drive.now, limit, names)
    if drive.recorded() and found.why and found.since - SAFE >= drive.now + LEAST:
        drive.until = found.since - SAFE
        tracks = {name: t.between(-math.inf, drive.until) for name, t in tracks.items()}
        found, baseline = danger(tracks, drive, drive.now, limit, names), _cut(baseline, tracks, drive.until)
    if found.why:
        return found.why
    ranking = [c for c in ranking if c.id not in found.critical]
    trigger = trigger_state(drive, ranking)
    if looks:
        those = {c.id for c in ranking}
        looks = {d: [c for c in seen if c.id in those] for d, seen in looks.items()}
        situations = recorded_situations(road, baseline.tracks, trigger, looks, settings, delay)
    else:
        situations = build_situations(road, baseline.tracks, trigger, ranking, settings, delay)
    if not situations:
        return "the vehicles near it leave at once"
    order = tuple((c.id, c.relation, round(c.risk, 4)) for c in ranking)
    area = _area_around(baseline.tracks[trigger.ego].between(trigger.time, math.inf))
    encounter = FoundEncounter(
        trigger.ego, trigger.time, order, situations, baseline.snapshots, tuple(passed_over), road.drivable(*area),
        baseline.sizes, area, place=place,
    )  # fmt: skip
    return encounter, baseline


def _most_dangerous(looks: Mapping[float, Sequence[RankedVehicle]]) -> list[RankedVehicle]:
    """Each vehicle at its most dangerous moment, highest risk first, at most ``MOST_VEHICLES``."""
    best: dict[str, RankedVehicle] = {}
    for ranked in (c for delay in sorted(looks) for c in looks[delay]):
        if ranked.id not in best or ranked.risk > best[ranked.id].risk:
            best[ranked.id] = ranked
    return sorted(best.values(), key=lambda c: (-c.risk, c.id))[:MOST_VEHICLES]


def _cut(baseline: UnattackedMotion, tracks: Mapping[str, Track], until: float) -> UnattackedMotion:
    """The motion until then."""
    return replace(baseline, tracks=tracks, snapshots=[s for s in baseline.snapshots if s.time <= until + 1e-6])


def _area_around(ego: Track) -> tuple[float, float, float]:
    """A circle (x, y, radius) [m] around the unattacked ego's path, with a margin."""
    x, y = float(ego.x.min() + ego.x.max()) / 2, float(ego.y.min() + ego.y.max()) / 2
    return x, y, float(np.hypot(ego.x - x, ego.y - y).max()) + ROAD_MARGIN
