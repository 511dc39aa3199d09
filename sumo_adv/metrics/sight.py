"""When the ego's driver can see a road user: the line of sight past other boxes, over all steps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sumo_adv.datatypes import Bools, Boxes
from sumo_adv.geometry import crosses_box
from sumo_adv.metrics.boxes import corners
from sumo_adv.road_users import unprotected


def hidden(ego: Boxes, other: Boxes, screens: Boxes) -> Bools:
    """In which steps another box is hidden from the ego's centre, ``(N, T)``: its centre and all corners are.

    ego, other: ``(N, T)``; screens: the boxes that may be in the way, ``(N, K, T)``, NaN = absent.
    """
    points = np.concatenate([np.stack([other.x, other.y], -1)[..., None, :], corners(other)], axis=-2)
    length, width = (np.asarray(v)[..., None] / 2 for v in (screens.length, screens.width))
    eye = ego.x[:, None, :, None], ego.y[:, None, :, None]
    point = points[:, None, ..., 0], points[:, None, ..., 1]
    box = screens.x[..., None], screens.y[..., None], screens.heading[..., None]
    with np.errstate(invalid="ignore"):
        blocked = crosses_box(eye, point, box, (length, width))
    return np.asarray(blocked.any(axis=1).all(axis=-1))


def seen(ego: Boxes, other: Boxes, screens: Boxes | None) -> Boxes:
    """The other boxes ``(N, T)`` as a driver sees them: a pedestrian or cyclist that is hidden is absent (NaN).

    Vehicles are taken to be seen always: the standards that the reference drivers follow know no occlusion.
    """
    small = np.broadcast_to(unprotected(other.length, other.width), other.x.shape)
    if screens is None or not small.any():
        return other
    away = small & hidden(ego, other, screens)
    x, y, heading, speed = (np.where(away, np.nan, v) for v in (other.x, other.y, other.heading, other.speed))
    return replace(other, x=x, y=y, heading=heading, speed=speed)
