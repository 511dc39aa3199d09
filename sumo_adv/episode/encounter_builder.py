"""Describes the encounter that begins now, for ``run`` and for ``serve``.

They differ in the baseline: ``run`` simulates it in a fork, ``serve`` foresees it (``traffic_forecast``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import Track
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.encounter_detector import RankedVehicle, vehicles_of
from sumo_adv.episode.encounter_filter import danger
from sumo_adv.episode.encounter_place import place_of
from sumo_adv.episode.situation_builder import build_situations, trigger_state
from sumo_adv.episode.start_times import MOST_SHIFT
from sumo_adv.episode.task import FoundEncounter
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.simulation import Snapshot

ROAD_MARGIN = 150.0  # m around the unattacked ego's path within which the drivable area is known


@dataclass(frozen=True, slots=True)
class UnattackedMotion:
    """The motion without an attack, simulated or foreseen.

    tracks: by id, from the history before the trigger to the end; snapshots: the simulated states from the trigger on,
    empty if the motion is foreseen; sizes: length and width [m] by id.
    """

    tracks: Mapping[str, Track]
    snapshots: Sequence[Snapshot]
    sizes: Mapping[str, tuple[float, float]]


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
    if not ranking or drive.ego is None:
        within = " within the ODD" if settings.odd is not None else ""
        return f"no {vehicles_of(settings.kind)} near could endanger the ego{within}"
    trigger, place = trigger_state(drive, ranking), place_of(road, drive)
    late = MOST_SHIFT if all(c.meets_ahead for c in ranking) else 0.0
    baseline = baseline_for(settings.duration + max(max(settings.delays) + late, delay or 0.0))
    tracks = {name: t.between(-math.inf, trigger.time + checked) for name, t in baseline.tracks.items()}
    why, critical = danger(tracks, drive, trigger.time, settings.harmless_ttc, [c.id for c in ranking])
    if why:
        return why
    ranking = [c for c in ranking if c.id not in critical]
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


def _area_around(ego: Track) -> tuple[float, float, float]:
    """A circle (x, y, radius) [m] around the unattacked ego's path, with a margin."""
    x, y = float(ego.x.min() + ego.x.max()) / 2, float(ego.y.min() + ego.y.max()) / 2
    return x, y, float(np.hypot(ego.x - x, ego.y - y).max()) + ROAD_MARGIN
