"""What a reference driver sees: other vehicles in the frame of the ego's path, over all steps of a counterfactual."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.contact import SAME_DIRECTION
from sumo_adv.metrics.paths import EgoPaths

HISTORY = 0.5  # s over which yaw rates are measured


class View(NamedTuple):
    """Other vehicles in one step, arrays ``(N, M)``; the egos' arrays ``(N, 1)``.  Units m, rad, m/s, m/s2.

    An absent vehicle is not ``ahead`` and has infinite gaps.
    """

    ahead: Bools  # its centre is ahead of the ego's along the path
    away: Floats  # between the centres, along the path
    left: Floats  # of its centre, from the path
    heading: Floats  # against the path's there
    gap: Floats  # along the path, between the boxes; negative where they overlap lengthwise
    side_gap: Floats  # across the path, between the boxes; negative inside the ego's corridor
    near_edge: Floats  # from the path to its box
    speed: Floats
    along: Floats  # speed along the path
    towards: Floats  # sideways towards the path, from its last two positions
    crossing: Floats  # sideways towards the path, from its heading and speed
    acceleration: Floats
    yaw_rate: Floats
    length: Floats
    width: Floats
    ego_speed: Floats
    ego_acceleration: Floats
    ego_length: float
    ego_width: float
    lane_half_width: float

    @property
    def closing(self) -> Floats:
        """How fast the ego comes nearer along the path [m/s]."""
        return self.ego_speed - self.along

    @property
    def time_to_reach(self) -> Floats:
        """Gap over closing speed [s], 0 where the boxes overlap lengthwise, ``inf`` where the ego does not close in."""
        closing = self.closing
        time = np.where(closing > 1e-9, np.maximum(self.gap, 0.0) / np.where(closing > 1e-9, closing, 1.0), np.inf)
        return np.where(self.gap <= 0.0, 0.0, time)

    @property
    def same_direction(self) -> Bools:
        """Whether it goes the ego's way (within 45 degrees)."""
        return np.abs(self.heading) < SAME_DIRECTION

    @property
    def in_corridor(self) -> Bools:
        """Whether its box lies in the strip that the ego's box sweeps."""
        return self.side_gap <= 0.0


def located_on(paths: EgoPaths, others: Boxes) -> tuple[Floats, Floats, Floats]:
    """Stations [m], offsets [m] and path headings [rad] of vehicles ``(N, M, T)`` on the paths of N egos."""
    n, m, steps = others.x.shape
    located = paths.locate(*(v.reshape((n, m * steps)) for v in (others.x, others.y)))
    station, left, heading = (v.reshape(others.x.shape) for v in located)
    return station, left, heading


class Views:
    """The views of all steps: M vehicles ``(N, M, T)`` seen from N egos that are on their paths."""

    def __init__(
        self, others: Boxes, located: tuple[Floats, Floats, Floats], ego_size: tuple[float, float], dt: float,
        lane_half_width: float,
    ) -> None:  # fmt: skip
        """``located``: what ``located_on`` says of the others."""
        n, m, steps = others.x.shape
        station, left, path_heading = located
        self._station, self._left = station, left
        self._heading = wrap_below_pi(others.heading - path_heading)
        self._length = np.broadcast_to(np.asarray(others.length, float), (n, m, 1))[..., 0]
        self._width = np.broadcast_to(np.asarray(others.width, float), (n, m, 1))[..., 0]
        cos, sin = np.abs(np.cos(self._heading)), np.abs(np.sin(self._heading))
        half_along = (cos * self._length[..., None] + sin * self._width[..., None]) / 2
        half_across = (sin * self._length[..., None] + cos * self._width[..., None]) / 2
        back = max(1, round(HISTORY / dt))
        turned = np.unwrap(np.where(np.isfinite(self._heading), others.heading, 0.0), axis=-1)
        index = np.arange(steps)
        before = np.maximum(index - back, 0)
        span = np.maximum(index - before, 1) * dt
        there = np.isfinite(station)
        side = np.where(there & (left < 0.0), -1.0, 1.0)
        speed, near_edge = others.speed, np.where(there, np.abs(left) - half_across, np.inf)
        by_vehicle = (
            there, np.where(there, station, np.inf), np.where(there, half_along, 0.0), np.where(there, left, np.inf),
            np.where(there, self._heading, 0.0), near_edge - ego_size[1] / 2, near_edge, _known(speed),
            _known(speed * np.cos(self._heading)), _known(-side * _change(left, dt)),
            _known(-side * speed * np.sin(self._heading)), _known(_change(speed, dt)),
            _known((turned - turned[..., before]) / span),
        )  # fmt: skip
        # what does not depend on the ego's motion, by step
        self._steps = [np.ascontiguousarray(values.transpose(2, 0, 1)) for values in by_vehicle]
        self._size, self._half = ego_size, lane_half_width

    def at(self, step: int, station: Floats, speed: Floats, acceleration: Floats) -> View:
        """What egos at ``station`` [m], ``speed`` and ``acceleration`` ``(N,)`` see in a step."""
        (
            there, here, half_along, left, heading, side_gap, near_edge,
            pace, along, towards, crossing, change, yaw_rate,
        ) = (values[step] for values in self._steps)  # fmt: skip
        away, (ego_length, ego_width) = here - station[:, None], self._size
        return View(
            there & (away > 0), away, left, heading, np.abs(away) - half_along - ego_length / 2, side_gap, near_edge,
            pace, along, towards, crossing, change, yaw_rate, self._length, self._width, speed[:, None],
            acceleration[:, None], ego_length, ego_width, self._half,
        )  # fmt: skip

    def in_lane_ahead(self, ego_station: Floats) -> Bools:
        """In which steps each vehicle is in the lane of an ego at ``ego_station`` ``(N, T)`` [m], ahead of it, and goes
        its way, ``(N, M, T)``."""
        ahead = self._station > ego_station[:, None, :]
        return np.asarray(ahead & (np.abs(self._left) < self._half) & (np.abs(self._heading) < SAME_DIRECTION))

    def place(self, row: Any, vehicle: Any, step: Any) -> tuple[Floats, Floats, Floats]:
        """Station and offset [m] of vehicles in steps, and their heading against the path's there [rad], 0 if they are
        absent; indices of one shape."""
        k = (row, vehicle, step)
        heading = self._heading[k]
        return self._station[k], self._left[k], np.where(np.isfinite(self._station[k]), heading, 0.0)


def _change(values: Floats, dt: float) -> Floats:
    """The backward difference over a step, 0 in the first one and after an absence."""
    rates = np.zeros(values.shape)
    rates[..., 1:] = np.diff(values, axis=-1) / dt
    return np.where(np.isfinite(rates), rates, 0.0)


def _known(values: Floats) -> Floats:
    return np.where(np.isfinite(values), values, 0.0)
