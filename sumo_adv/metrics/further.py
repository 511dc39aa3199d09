"""Compute further figures of the attempt that counts: the impact, exposure to small TTCs, extremes, and RSS."""

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
PAPER_EPSILON_M = 5.0  # collision threshold on the centres; the paper gives no number, so a car's length is taken


@dataclass(frozen=True, slots=True)
class FurtherFigures:
    """Figures of one attempt in addition to its verdict. ``inf`` means never; None means that there was no collision.

    Attributes:
        collision_class: nuPlan's class of the collision.
        impact: How fast and where the ego and the adversary met.
        rss: The opinion of RSS on the fault; also None if the vehicles do not go the same way.
        tet: Time with a TTC up to ``EXPOSURE_TTC_S`` [s].
        tit: Integral of ``EXPOSURE_TTC_S`` minus TTC over that time [s2].
        min_headway: Minimum time headway [s].
        max_btn: Largest DRAC as a share of the available braking.
        max_required_lateral: Largest required lateral acceleration [m/s2].
        min_centre_distance: Minimum distance between the box centres [m].
        conflict_point: Where the vehicles met, or where their swept boxes came nearest in time (x, y) [m]; None if the
            swept boxes do not meet.
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
    """Compute the figures that only the attempt that counts needs.

    They come in addition to :func:`sumo_adv.metrics.verdict.judge_attempt`.

    Args:
        case: The recorded attempt.

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
    """Return where the vehicles met or, without a contact, where their swept boxes came nearest in time."""
    if contact is None:
        return pet(ego.between(start, stop), adversary.between(start, stop)).point
    return contact_point(at_time(ego, contact), at_time(adversary, contact))


def _nearest_centres(ego: Track, adversary: Track, distances: Floats, contact: float | None) -> float:
    """Return the minimum distance of the centres [m] over the steps and, if the vehicles met, at the first contact."""
    least = float(distances.min())
    if contact is None:
        return least
    a, b = at_time(ego, contact), at_time(adversary, contact)
    return min(least, float(np.hypot(b.x - a.x, b.y - a.y)))


def _largest(values: Floats) -> float:
    return float(np.minimum(values, LARGEST_DRAC_M_S2).max())
