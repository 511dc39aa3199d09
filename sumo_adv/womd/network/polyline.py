"""Lines as point arrays ``(n, 2)`` or ``(n, 3)`` [m] with stations along the ground: cutting, sampling, turning."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import wrap

SAME = 1e-3  # m, points nearer than this are one


def stations(points: Floats) -> Floats:
    """Distance of each point from the first along the ground ``(n,)`` [m]."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points[:, :2], axis=0).T))])


def distinct(points: Floats) -> Floats:
    """The points without those that repeat the one before."""
    step = np.hypot(*np.diff(points[:, :2], axis=0).T)
    return points[np.concatenate([[True], step > SAME])]


def at(points: Floats, along: Floats, where: Floats | float) -> Floats:
    """Points at stations ``where``; ``along`` are the stations of ``points``."""
    return np.stack([np.interp(where, along, points[:, k]) for k in range(points.shape[1])], axis=-1)


def part(points: Floats, along: Floats, start: float, end: float) -> Floats:
    """The line from station ``start`` to ``end``, with its own points between."""
    inner = points[(along > start + SAME) & (along < end - SAME)]
    ends = at(points, along, np.array([start, end]))
    return np.vstack([ends[:1], inner, ends[1:]])


def headings(points: Floats, along: Floats, where: Floats) -> Floats:
    """Directions [rad] at stations ``where``, from points 0.5 m before and after."""
    behind, ahead = at(points, along, where - 0.5), at(points, along, where + 0.5)
    return np.arctan2(ahead[..., 1] - behind[..., 1], ahead[..., 0] - behind[..., 0])


def turned(points: Floats) -> float:
    """Heading at the end less heading at the start [rad], added up along the line (left positive)."""
    step = np.diff(points[:, :2], axis=0)
    step = step[np.hypot(*step.T) > SAME]
    heading = np.arctan2(step[:, 1], step[:, 0])
    return float(np.sum(wrap(np.diff(heading))))


def joined(parts: Sequence[Floats]) -> Floats:
    """One line through all parts, doubled points left out."""
    return distinct(np.vstack(list(parts)))
