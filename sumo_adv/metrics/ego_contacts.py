"""Contacts of the ego with any other vehicle or object, the adversary aside."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sumo_adv.datatypes import Track
from sumo_adv.metrics.boxes import at_time, first_contact, on_grid
from sumo_adv.metrics.contact import rear_end


def first_other_contact(ego: Track, others: Sequence[Track], start: float) -> tuple[str, float] | None:
    """The first vehicle or object that the ego touches from ``start`` [s] on, and when [s]; None if there is none.

    All tracks lie on one regular grid. Boxes that overlap at ``start`` already are left out (errors of a log), and so
    is a vehicle that runs into the ego's back.
    """
    driven = ego.between(start, np.inf)
    near = [t for t in others if len(t.between(start, np.inf).time) > 1]
    if len(driven.time) < 2 or not near:
        return None
    me, them = on_grid([driven], driven.time), on_grid(near, driven.time)
    times = first_contact(me, them, driven.time)
    for k in np.argsort(times):
        when, vehicle = float(times[k]), near[int(k)]
        if not np.isfinite(when):
            return None
        if when > driven.time[0] and not rear_end(at_time(driven, when), at_time(vehicle, when)):
            return vehicle.id, when
    return None
