"""Which markings a vehicle's box centre crossed, from the geometry of lanes alone.

SUMO networks hold no paint: between lanes of one direction there is taken to be a broken line, towards a lane of the
other direction a centre line, and where the drivable area ends an edge.  Inside junctions there are none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Bools, Floats, Track
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.contact import OPPOSITE_DIRECTION, SAME_DIRECTION

END = 1e-6  # m: a point nearest to a lane's very end lies before or past it


class Marking(StrEnum):
    """What was crossed."""

    LANE_LINE = "lane_line"
    CENTRE_LINE = "centre_line"
    ROAD_EDGE = "road_edge"


@dataclass(frozen=True, slots=True)
class Strip:
    """One lane: ``shape`` ``(n, 2)`` [m] in the direction of traffic, width [m], inside a junction or not."""

    shape: Floats
    width: float
    internal: bool


@dataclass(frozen=True, slots=True)
class Crossing:
    """The first step [s] at which the box centre is past a marking."""

    time: float
    kind: Marking


def markings_crossed(
    track: Track, strips: Sequence[Strip], on_road: Callable[[Floats, Floats], Bools] | None = None
) -> list[Crossing]:
    """All markings that the box centre crossed over a track, in order.

    A line between lanes is crossed where the centre is in another lane while it is still abreast of the one it was in
    last: driving on into the next lane of a road, or through a junction, crosses none.
    """
    open_road = [s for s in strips if not s.internal]
    abreast, offset, heading = _project(track, open_road)
    lane = _lane_of(abreast, offset, open_road)
    inside = _inside_junction(track, [s for s in strips if s.internal])
    off = np.zeros(len(track.time), dtype=bool) if on_road is None else ~np.asarray(on_road(track.x, track.y))
    crossings: list[Crossing] = []
    held = -1
    for k, (time, place) in enumerate(zip(track.time.tolist(), lane.tolist(), strict=True)):
        if k and off[k] and not off[k - 1]:
            crossings.append(Crossing(time, Marking.ROAD_EDGE))
        if place < 0:
            held = -1 if inside[k] else held
            continue
        if held >= 0 and place != held and abreast[held, k]:
            turn = abs(float(wrap_below_pi(heading[place, k] - heading[held, k])))
            if turn < SAME_DIRECTION or turn > OPPOSITE_DIRECTION:
                crossings.append(Crossing(time, Marking.LANE_LINE if turn < SAME_DIRECTION else Marking.CENTRE_LINE))
        held = place
    return crossings


def _project(track: Track, strips: Sequence[Strip]) -> tuple[Bools, Floats, Floats]:
    """For each strip and step ``(k, n)``: neither before nor past its ends, lateral offset [m], its direction [rad]."""
    shape = (len(strips), len(track.time))
    abreast, offset, heading = np.zeros(shape, dtype=bool), np.full(shape, np.inf), np.zeros(shape)
    for row, strip in enumerate(strips):
        a, step = strip.shape[:-1], np.diff(strip.shape, axis=0)
        length = np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)
        ux, uy = step[:, 0] / length, step[:, 1] / length
        px, py = track.x[:, None] - a[:, 0], track.y[:, None] - a[:, 1]
        along, across = px * ux + py * uy, py * ux - px * uy
        past = along - np.clip(along, 0.0, length)
        nearest = np.argmin(np.hypot(past, across), axis=1)
        steps = np.arange(len(nearest))
        abreast[row] = ~(
            ((nearest == 0) & (past[steps, nearest] < -END))
            | ((nearest == len(length) - 1) & (past[steps, nearest] > END))
        )
        offset[row] = np.where(past[steps, nearest] == 0, across[steps, nearest], 0.0)
        heading[row] = np.arctan2(uy, ux)[nearest]
        corner = past[steps, nearest] != 0  # outside a bend's corner the distance is to the corner itself
        offset[row, corner] = np.hypot(past, across)[steps, nearest][corner]
    return abreast, offset, heading


def _lane_of(abreast: Bools, offset: Floats, strips: Sequence[Strip]) -> NDArray[np.intp]:
    """The strip with the nearest centre line, in its widths, at each step ``(n,)``; -1 where no strip holds it."""
    if not strips:
        return np.full(abreast.shape[1], -1)
    width = np.array([[s.width] for s in strips])
    share = np.where(abreast & (np.abs(offset) <= width / 2), np.abs(offset) / width, np.inf)
    best = np.asarray(share.argmin(axis=0))
    return np.where(np.isfinite(share.min(axis=0)), best, -1)


def _inside_junction(track: Track, strips: Sequence[Strip]) -> Bools:
    """Whether a lane inside a junction holds the centre, at each step ``(n,)``."""
    abreast, offset, _ = _project(track, strips)
    return _lane_of(abreast, offset, strips) >= 0
