"""Further figures of the attempt that counts: the impact, exposure to small TTCs, extremes, and RSS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Floats, Track
from sumo_adv.metrics.boxes import at_time
from sumo_adv.metrics.case import Case
from sumo_adv.metrics.contact import CollisionClass, Impact, collision_class, contact_point, impact
from sumo_adv.metrics.criticality import AVAILABLE_BRAKING_M_S2, exposure, pet, series
from sumo_adv.metrics.fault import SecondOpinion, rss_opinion
from sumo_adv.metrics.verdict import LARGEST_DRAC_M_S2, on_common_grid

EXPOSURE_TTC_S = 1.5  # threshold of TET and TIT
PAPER_EPSILON_M = 5.0  # the paper's collision threshold on centres, which it does not give: a car's length


@dataclass(frozen=True, slots=True)
class FurtherFigures:
    """Figures of one attempt beside its verdict. Never = ``inf``; None = there was no collision.

    Attributes:
        collision_class: nuPlan's class of the collision.
        impact: How fast and where ego and adversary met.
        rss: What RSS says about the fault.
        tet: Time with a TTC up to ``EXPOSURE_TTC_S`` [s].
        tit: Integral of ``EXPOSURE_TTC_S`` minus TTC over that time [s2].
        min_headway: [s]
        max_btn: Largest DRAC as a share of the available braking.
        max_required_lateral: [m/s2]
        min_centre_distance: Between the box centres [m].
        conflict_point: Where they met, or where their swept boxes came nearest in time (x, y) [m].
    """

    collision_class: CollisionClass | None
    impact: Impact | None
    rss: SecondOpinion | None
    tet: float
    tit: float
    min_headway: float
    max_btn: float
    max_required_lateral: float
    min_centre_distance: float
    conflict_point: tuple[float, float] | None


def further_figures(case: Case) -> FurtherFigures:
    """Return what only the attempt that counts needs beside :func:`sumo_adv.metrics.verdict.judge`.

    Raises:
        UsageError: The tracks have no step in common after the attack begins.
    """
    ego, adversary, pair = case.ego, case.adversary, on_common_grid(case)
    stop, contact = float(pair.time[-1]), pair.contact_time
    measures = series(ego.between(case.start, stop), [adversary])
    tet, tit = exposure(measures["ttc"][0], EXPOSURE_TTC_S, pair.dt)
    return FurtherFigures(
        collision_class=None if contact is None else collision_class(ego, adversary, contact),
        impact=None if contact is None else impact(ego, adversary, contact),
        rss=None if contact is None else rss_opinion(ego, adversary, contact),
        tet=float(tet),
        tit=float(tit),
        min_headway=float(measures["headway"].min()),
        max_btn=_largest(measures["drac"]) / AVAILABLE_BRAKING_M_S2,
        max_required_lateral=_largest(measures["required_lateral"]),
        min_centre_distance=_nearest_centres(ego, adversary, measures["centre_distance"], contact),
        conflict_point=_conflict(ego, adversary, case.start, stop, contact),
    )


def _conflict(
    ego: Track, adversary: Track, start: float, stop: float, contact: float | None
) -> tuple[float, float] | None:
    """Where they met, or where their swept boxes came nearest in time."""
    if contact is None:
        return pet(ego.between(start, stop), adversary.between(start, stop)).point
    return contact_point(at_time(ego, contact), at_time(adversary, contact))


def _nearest_centres(ego: Track, adversary: Track, distances: Floats, contact: float | None) -> float:
    """Least distance of the centres [m] over the steps and, where they met, at the first contact."""
    least = float(distances.min())
    if contact is None:
        return least
    a, b = at_time(ego, contact), at_time(adversary, contact)
    return min(least, float(np.hypot(b.x - a.x, b.y - a.y)))


def _largest(values: Floats) -> float:
    return float(np.minimum(values, LARGEST_DRAC_M_S2).max())
