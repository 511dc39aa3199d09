"""Braking and steering within a friction circle, begun 0.8 s after the hazard shows.

The hazard is that of :class:`~sumo_adv.metrics.reference.cc_human.CcHuman`: it shows when the driver begins to perceive
it, 0.4 s before the driver is alarmed.  Some combination of braking (up to 8 m/s2) and a lateral shift (up to 3.2 m at
a peak of 4.5 m/s2, with at most 6 m/s2 of braking) must touch no vehicle and stay on the road.  Source of the tier: ISO
34502's "reasonably foreseeable and preventable"; the friction circle of 8 m/s2 is that of a dry road.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Ints
from sumo_adv.metrics.avoidance import (
    Manoeuvre,
    OnRoad,
    Poses,
    manoeuvres,
    poses_of,
    stays_on_road,
    window,
)
from sumo_adv.metrics.boxes import touches
from sumo_adv.metrics.reference.cc_human import PERCEPTION

DELAY = 0.8  # s after the hazard shows
TABLE: tuple[Manoeuvre, ...] = manoeuvres(DELAY - PERCEPTION)
"""The combinations tried, with their delay after the alarm."""


def manoeuvre_poses(ego: Boxes, alarm: Ints, steps: int, dt: float) -> tuple[Boxes, Boxes]:
    """The ego from the alarm on, ``(N, steps + 1)``, and where ``TABLE`` takes it, ``(len(TABLE), N, steps + 1)``.

    ``ego`` ``(N, T)``: its unchanged motion.
    """
    own = window(ego, alarm, steps, dt)
    poses = poses_of(own, TABLE, dt)
    return own, _boxes(poses, own, dt)


def _boxes(poses: Poses, own: Boxes, dt: float) -> Boxes:
    moved = np.hypot(np.diff(poses.x, axis=-1), np.diff(poses.y, axis=-1)) / dt
    speed = np.concatenate([moved, moved[..., -1:]], axis=-1)
    return Boxes(poses.x, poses.y, np.arctan2(poses.sin, poses.cos), speed, own.length, own.width)


def escapes(
    ego: Boxes, adversary: Boxes, alarm: Ints, steps: Ints, dt: float, on_road: OnRoad | None = None
) -> tuple[Boxes, Bools]:
    """The poses of :func:`manoeuvre_poses`, and which of them touch the adversary nowhere (swept) within ``steps``
    ``(N,)`` after the alarm and stay on the road, ``(len(TABLE), N)``."""
    longest = int(steps.max())
    own, poses = manoeuvre_poses(ego, alarm, longest, dt)
    foe = window(adversary, alarm, longest, dt)
    foe = replace(foe, x=np.where(np.arange(longest + 1) > steps[:, None], np.nan, foe.x))  # absent afterwards
    clear = ~touches(poses, foe)
    if on_road is not None:
        flat = Poses(poses.x, poses.y, np.cos(poses.heading), np.sin(poses.heading))
        clear &= stays_on_road(flat, own, TABLE, clear, on_road, dt)
    return poses, clear
