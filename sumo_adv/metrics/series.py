"""Every measure, every step, every pair: what ``criticality.csv.gz`` holds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sumo_adv.datatypes import Floats, Track
from sumo_adv.metrics.boxes import gap, on_grid
from sumo_adv.metrics.criticality import btn, drac, headway, required_lateral, ttc

COLUMNS = ("ttc", "gap", "centre_distance", "drac", "btn", "headway", "required_lateral")


def series(ego: Track, others: Sequence[Track]) -> dict[str, Floats]:
    """Measures of the ego against every other vehicle over the ego's steps: each of ``COLUMNS`` as ``(n, steps)``.

    Plus ``time`` ``(steps,)`` [s].  Rows are in the order of ``others``; where a vehicle is not there TTC, gap, headway
    and centre distance are inf and the rates 0.
    """
    own, them = ego.boxes(), on_grid(others, ego.time)
    times = ttc(own, them)
    absent = np.isnan(them.x)
    return {
        "time": ego.time,
        "ttc": times,
        "gap": np.where(absent, np.inf, gap(own, them)),
        "centre_distance": np.where(absent, np.inf, np.hypot(them.x - own.x, them.y - own.y)),
        "drac": drac(own, them, times),
        "btn": btn(own, them, times=times),
        "headway": headway(own, them),
        "required_lateral": required_lateral(own, them, times),
    }
