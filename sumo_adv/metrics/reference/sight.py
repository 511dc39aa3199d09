"""How far the road lets the ego see, as before a crest: what is farther along its way is not seen.

Unlike other boxes, which hide only pedestrians and cyclists from the reference drivers, a crest hides every road user.
A road user is seen once the nearest end of its box is within the limit, counted from the centre of the ego.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats, Track, VehicleState
from sumo_adv.ego_way import SightStretch
from sumo_adv.metrics.reference.view import EgoPaths


@dataclass(frozen=True, slots=True)
class SightLimits:
    """The limits of sight on the way of one ego.

    Attributes:
        stretches: The stretches of its way with a limit.
        time: A time [s].
        come: How far the ego has come at that time since its departure [m].
    """

    stretches: tuple[SightStretch, ...]
    time: float
    come: float

    def along(self, ego: Track) -> Floats:
        """Return how far the ego sees along its way in each state of a track.

        Args:
            ego: The ego's track, with a state at ``self.time``.

        Returns:
            The limits ``(n,)`` [m]; inf if there is none.
        """
        gone = _gone(ego)
        return np.array([limit_at(self.stretches, s) for s in self.come + gone - np.interp(self.time, ego.time, gone)])

    def later(self, ego: Track, time: float) -> SightLimits:
        """Return the same limits, with the place of the ego at a later time.

        Args:
            ego: The ego's track from ``self.time`` on.
            time: The later time [s].
        """
        moved = np.interp([self.time, time], ego.time, _gone(ego))
        return SightLimits(self.stretches, time, self.come + float(moved[1] - moved[0]))


def _gone(ego: Track) -> Floats:
    """Return how far an ego has gone since the first state of its track ``(n,)`` [m]."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(ego.x), np.diff(ego.y)))])


def limit_at(stretches: Sequence[SightStretch], come: float) -> float:
    """Return how far an ego sees along its way [m]; inf if there is no limit.

    Args:
        stretches: The stretches of its way with a limit.
        come: How far it has come since its departure [m].
    """
    return min((each.limit for each in stretches if each.begin <= come < each.to), default=np.inf)


def path_through(points: Sequence[tuple[float, float]]) -> EgoPaths:
    """Return the path through points (x, y) [m] of one ego."""
    x, y = np.asarray(points, dtype=np.float64).T
    headings = np.arctan2(np.diff(y), np.diff(x))
    turns = np.append(headings, headings[-1])
    return EgoPaths(Boxes(x[None], y[None], turns[None], np.zeros((1, len(x))), 0.0, 0.0))


def in_reach(path: EgoPaths, ego: VehicleState, others: Sequence[VehicleState], limit: float) -> Bools:
    """Return which road users are within a limit of sight.

    Args:
        path: The ego's path, of one ego.
        ego: The ego.
        others: The road users.
        limit: The limit along the path [m].

    Returns:
        A flag for each of them ``(n,)``.
    """
    if np.isinf(limit) or not others:
        return np.ones(len(others), bool)
    states = np.array([(ego.x, ego.y, 0.0, 0.0, 0.0), *((o.x, o.y, o.heading, o.length, o.width) for o in others)])
    x, y, heading, length, width = states.T
    station, _, direction = (values[0] for values in path.locate(x[None], y[None]))
    return np.asarray(station[1:] - station[0] - half_along(heading - direction, length, width)[1:] <= limit)


def half_along(turned: Floats, length: Floats, width: Floats) -> Floats:
    """Return half the extent of boxes along a path [m].

    Args:
        turned: The headings against that of the path [rad].
        length: The lengths [m].
        width: The widths [m].
    """
    return np.asarray((np.abs(np.cos(turned)) * length + np.abs(np.sin(turned)) * width) / 2)


def beyond(located: tuple[Floats, Floats, Floats], headings: Floats, sizes: tuple[Floats, Floats], ego: Floats,
           limit: Floats) -> Bools:  # fmt: skip
    """Return which vehicles are beyond the limit of sight of N egos.

    Args:
        located: Stations [m], offsets [m] and path headings [rad] of the vehicles ``(N, M, T)``.
        headings: Their headings ``(N, M, T)`` [rad].
        sizes: Their lengths and widths ``(N, M, 1)`` [m].
        ego: The stations of the egos ``(N, T)`` [m].
        limit: How far the egos see ``(N, T)`` [m].

    Returns:
        A flag for each vehicle and step ``(N, M, T)``; False for vehicles that are absent.
    """
    station, _, direction = located
    with np.errstate(invalid="ignore"):
        near_end = station - ego[:, None, :] - half_along(headings - direction, *sizes)
        return np.asarray(near_end > limit[:, None, :])
