"""What candidates cost: every along-motion with every sideways motion, a matrix ``(along, aside)``.

A contact weighs by how soon and how fast it is, so that a far one asks for gentle braking and a near one for anything
that avoids it.  Boxes are compared along the path's axes, which for a box at an angle to them is the larger box: the
overlaps along and across are found separately, and met by one product of matrices for each time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.drivers.lattice_frame import Others
from sumo_adv.drivers.lattice_sample import Along, Aside

CONTACT, CONTACT_SOON, CONTACT_FADES = 1000.0, 1.5, 0.8  # -, s, s
NEAR, NEAR_FADES = 60.0, 1.5  # 1/s, s: within a margin of contact
CLOSE = 6.0  # 1/s: within the wider margin
CONTACT_MARGIN = (0.3, 0.15)  # m along, m across
NEAR_MARGIN = (1.0, 0.3)
CLOSE_MARGIN, CLOSE_HEADWAY = (1.5, 0.6), 0.2  # m, s: the margin along grows with speed
OFF_ROAD = 800.0  # 1/m
SLOWER, FASTER = 0.5, 4.0  # 1/(m/s)2, mean square deviation from the reference
BRAKING, JERK_ASIDE, ACCELERATION_ASIDE = 0.2, 0.02, 0.05
ASIDE, STRAYING, CHANGE = 0.5, 4.0, 0.5  # 1/m2: aim, mean place off the centre, another aim than before
OTHER_LANE = 8.0
SLOPE, STEEP = 0.3, 20.0  # -, (s/m)2: a car moves sideways at most by that share of its way
GRIP, SLIDING = 8.5, 40.0  # m/s2, 1/(m/s2): beyond the friction circle


@dataclass(frozen=True, slots=True)
class Body:
    """The ego's length and width [m], and where it may be: right and left edge [m] by time, ``(time,)``."""

    length: float
    width: float
    right: Floats
    left: Floats


def costs(
    on: Along, off: Aside, others: Others, body: Body, bend: Floats, kept: float, lane: float, times: Floats
) -> Floats:
    """The matrix. ``bend``: curvature [1/m] by along-candidate and time; ``kept``: the aim [m] until now; ``lane``:
    half its width [m]."""
    total = _comfort(on, off, kept, lane, times)[None, :] + _pace(on)[:, None]
    total += _off_road(off, body, on.v[0])[None, :]
    slope = np.abs(off.rate)[None] - SLOPE * on.v[:, None] - 0.1
    total += STEEP * np.maximum(slope, 0.0).max(axis=2) ** 2
    sideways = off.second[None] + (bend * on.v**2)[:, None]
    moving = (on.v > 0.5)[:, None]
    grip = np.where(moving, np.hypot(sideways, on.a[:, None]), 0.0).max(axis=2)
    total += SLIDING * np.maximum(grip - GRIP, 0.0)
    return np.asarray(total + _meetings(on, off, others, body, times))


def _comfort(on: Along, off: Aside, kept: float, lane: float, times: Floats) -> Floats:
    here = np.abs(off.target) < lane
    away = np.where(here, ASIDE * off.target**2 + STRAYING * (off.d**2).mean(axis=1), OTHER_LANE)
    change = CHANGE * np.minimum((off.target - kept) ** 2, 4.0)
    return np.asarray(away + change + JERK_ASIDE * off.jerk + ACCELERATION_ASIDE * (off.second**2).mean(axis=1))


def _pace(on: Along) -> Floats:
    slower, faster = np.maximum(on.v[0] - on.v, 0.0), np.maximum(on.v - on.v[0], 0.0)
    braking = BRAKING * np.minimum(on.a, 0.0) ** 2
    own = np.arange(len(on.v)) > 0  # what the reference itself brakes is no choice
    return np.asarray((SLOWER * slower**2 + FASTER * faster**2 + braking * own[:, None]).mean(axis=1))


def _off_road(off: Aside, body: Body, speed: Floats) -> Floats:
    """By the metres that the box sticks out over the road's edges, more than it does now."""
    corner = body.width / 2 + body.length / 2 * np.minimum(np.abs(off.rate) / np.maximum(speed, 3.0), 0.4)
    out = np.maximum(np.maximum(off.d + corner - body.left, body.right - off.d + corner), 0.0)
    return np.asarray(OFF_ROAD * np.maximum(out.max(axis=1) - out[:, 0], 0.0))


def _meetings(on: Along, off: Aside, others: Others, body: Body, times: Floats) -> Floats:
    if others.s.shape[0] == 0:
        return np.zeros((len(on.s), len(off.d)))
    apart_s = np.abs(others.s[None] - on.s[:, None]) - others.half_s[None] - body.length / 2
    turned = np.minimum(np.abs(off.rate) / np.maximum(on.v[0], 3.0), 0.4)[:, None]
    apart_d = np.abs(others.d[None] - off.d[:, None]) - others.half_d[None] - body.width / 2 - turned * body.length / 2
    hit = _overlap(apart_s, CONTACT_MARGIN[0], apart_d, CONTACT_MARGIN[1])
    first = np.argmax(hit, axis=0)
    pace = np.take_along_axis(on.v, first, axis=1)
    weight = CONTACT * np.exp(-np.maximum(times[first] - CONTACT_SOON, 0.0) / CONTACT_FADES) * (0.5 + pace / 20.0)
    found = np.where(hit.any(axis=0), weight, 0.0)
    fades = np.exp(-times / NEAR_FADES) * (times[1] - times[0])
    near = _overlap(apart_s, NEAR_MARGIN[0], apart_d, NEAR_MARGIN[1])
    long = CLOSE_MARGIN[0] + CLOSE_HEADWAY * on.v[:, None]
    close = _overlap(apart_s, long, apart_d, CLOSE_MARGIN[1])
    return np.asarray(found + np.tensordot(fades, NEAR * near + CLOSE * close, axes=1))


def _overlap(apart_s: Floats, along: float | Floats, apart_d: Floats, across: float) -> Bools:
    """Whether any other is within the margins, ``(time, along, aside)``, from gaps ``(candidate, other, time)``."""
    a = (apart_s < along).astype(np.float32).transpose(2, 0, 1)
    b = (apart_d < across).astype(np.float32).transpose(2, 1, 0)
    return np.asarray(a @ b > 0.5)
