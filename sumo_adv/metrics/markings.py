"""Find the road markings that a vehicle's box centre crossed, from the geometry of lanes alone.

SUMO networks contain no markings, so they are assumed: a broken line between lanes of one direction, a centre line
towards a lane of the other direction, and an edge at the end of the drivable area. Junctions have none inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Bools, Floats, LaneStrip, Track
from sumo_adv.geometry import same_layer, wrap_below_pi
from sumo_adv.metrics.avoidance import OnRoad
from sumo_adv.metrics.contact import OPPOSITE_DIRECTION, SAME_DIRECTION

LANE_END_M = 1e-6  # a point farther than this beyond a lane's end lies before or past the lane


class Marking(StrEnum):
    """The kind of marking that was crossed."""

    LANE_LINE = "lane_line"
    CENTRE_LINE = "centre_line"
    ROAD_EDGE = "road_edge"


@dataclass(frozen=True, slots=True)
class Crossing:
    """A crossed marking.

    Attributes:
        time: The first step at which the box centre is past the marking [s].
        kind: The kind of marking.
    """

    time: float
    kind: Marking


def markings_crossed(track: Track, strips: Sequence[LaneStrip], on_road: OnRoad | None = None) -> list[Crossing]:
    """Return all markings that the box centre crossed, in order.

    A line between lanes is crossed if the centre is in another lane while it is still abreast of its last lane. Driving
    on into the next lane of a road, or through a junction, therefore crosses no line.

    Args:
        track: The vehicle's track.
        strips: The lanes near the track.
        on_road: Returns which points are drivable; None leaves out road edges.
    """
    open_road = [s for s in strips if not s.internal]
    abreast, offset, heading = _project(track, open_road)
    lane = _lane_of(abreast, offset, open_road)
    in_junctions = [s for s in strips if s.internal]
    inside = _lane_of(*_project(track, in_junctions)[:2], in_junctions) >= 0
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


def _project(track: Track, strips: Sequence[LaneStrip]) -> tuple[Bools, Floats, Floats]:
    """Project a track on strips; return, for each strip and step ``(k, n)``, how the track lies to it.

    Returns:
        Whether the track is neither before nor past the strip's ends, the lateral offset [m], and the strip's direction
        [rad].
    """
    shape = (len(strips), len(track.time))
    abreast, offset, heading = np.zeros(shape, dtype=bool), np.full(shape, np.inf), np.zeros(shape)
    for row, strip in enumerate(strips):
        a, step = strip.shape[:-1], np.diff(strip.shape, axis=0)
        length = np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)
        ux, uy = step[:, 0] / length, step[:, 1] / length
        px, py = track.x[:, None] - a[:, 0], track.y[:, None] - a[:, 1]
        along, across = px * ux + py * uy, py * ux - px * uy
        past = along - np.clip(along, 0.0, length)
        away = np.hypot(past, across)
        nearest = np.argmin(away, axis=1)
        at = (np.arange(len(nearest)), nearest)
        before = (nearest == 0) & (past[at] < -LANE_END_M)
        beyond = (nearest == len(length) - 1) & (past[at] > LANE_END_M)
        abreast[row] = ~(before | beyond)
        if strip.shape.shape[1] > 2:
            abreast[row] &= same_layer(strip.shape[nearest, 2], track.z)
        offset[row] = np.where(past[at] == 0, across[at], away[at])  # outside a bend: the distance to the corner
        heading[row] = np.arctan2(uy, ux)[nearest]
    return abreast, offset, heading


def _lane_of(abreast: Bools, offset: Floats, strips: Sequence[LaneStrip]) -> NDArray[np.intp]:
    """Return the strip with the nearest centre line, in its widths, at each step ``(n,)``; -1 if no strip holds it."""
    if not strips:
        return np.full(abreast.shape[1], -1)
    width = np.array([[s.width] for s in strips])
    share = np.where(abreast & (np.abs(offset) <= width / 2), np.abs(offset) / width, np.inf)
    best = np.asarray(share.argmin(axis=0))
    return np.where(np.isfinite(share.min(axis=0)), best, -1)
