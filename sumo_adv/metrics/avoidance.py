"""Avoid a collision by braking and steering: the reference driver ``manoeuvre``, for many encounters at once.

The hazard shows when :class:`~sumo_adv.metrics.reference.cc_human.CcHuman` begins to perceive it, which is 0.4 s before
that driver is alarmed. The manoeuvre begins 0.8 s after the hazard shows. It combines braking (up to 8 m/s2) with a
lateral shift (up to 3.2 m at a peak of 4.5 m/s2, with at most 6 m/s2 of braking). A collision is avoided if one
combination touches no vehicle (swept between the steps) and stays on the road.

Source: ISO 34502's "reasonably foreseeable and preventable"; the friction circle of 8 m/s2 is that of a dry road.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Bools, Boxes, Floats, Ints
from sumo_adv.metrics.boxes import corners, height_as, touches
from sumo_adv.metrics.reference.cc_human import PERCEPTION_S

RAMP_S = 0.3  # time in which braking rises to its full value
PEAK_LATERAL_M_S2 = 4.5  # of a shift; with 6 m/s2 of braking inside the friction circle of 8
BRAKING_WITH_SHIFT_M_S2 = (0.0, 3.0, 6.0)
BRAKING_ALONE_M_S2 = (8.0, 4.0)
SHIFTS_M = (1.0, -1.0, 2.0, -2.0, 3.2, -3.2)  # left positive
STEEPEST_SHIFT = 0.4  # -, lateral per longitudinal motion
ROAD_TOLERANCE_M = 0.15  # how far a corner may be off the road
OnRoad = Callable[..., Bools]
"""Whether points (x, y) of any common shape lie on the drivable area. It gets (x, y, z) if roads have heights."""


@dataclass(frozen=True, slots=True)
class Manoeuvre:
    """One combination of braking and a lateral shift.

    Attributes:
        delay: When the manoeuvre begins, counted from the first step of the ego's motion (in ``TABLE``: the alarm) [s].
        braking: Full deceleration, positive [m/s2].
        ramp: Time in which the braking rises linearly to ``braking`` [s].
        shift: Lateral shift, left positive [m].
    """

    delay: float
    braking: float
    ramp: float = RAMP_S
    shift: float = 0.0


def manoeuvres(delay: float) -> tuple[Manoeuvre, ...]:
    """Return the combinations that are tried at one delay.

    Args:
        delay: When the manoeuvres begin [s].

    Returns:
        The manoeuvres. Those that only brake come first.
    """
    steer = tuple(Manoeuvre(delay, b, RAMP_S, d) for b in BRAKING_WITH_SHIFT_M_S2 for d in SHIFTS_M)
    return tuple(Manoeuvre(delay, b) for b in BRAKING_ALONE_M_S2) + steer


def window(b: Boxes, index: NDArray[np.integer], steps: int, dt: float, last: Ints | None = None) -> Boxes:
    """Cut ``steps + 1`` states out of each motion.

    Args:
        b: N motions, arrays ``(N, T)``.
        index: The first step of each window ``(N,)``. Windows may reach past the end of the motion.
        steps: Length of the windows, in steps.
        dt: Step [s].
        last: The last step of each motion that counts ``(N,)``; by default the last one there is.

    Returns:
        The states ``(N, steps + 1)``. Past the last step, a vehicle goes straight on at constant speed.
    """
    n, end = b.x.shape[0], b.x.shape[1] - 1 if last is None else last[:, None]
    indices = np.asarray(index)[:, None] + np.arange(steps + 1)
    rows = np.arange(n)[:, None]
    taken = np.clip(indices, 0, end)
    x, y, heading, speed = (np.broadcast_to(v, b.x.shape)[rows, taken] for v in (b.x, b.y, b.heading, b.speed))
    beyond = speed * (np.maximum(indices - end, 0) * dt)
    size = [np.broadcast_to(np.asarray(v, dtype=float), b.x.shape)[:, :1] for v in (b.length, b.width)]
    z = height_as(b, lambda z: z[rows, taken])
    return Boxes(x + beyond * np.cos(heading), y + beyond * np.sin(heading), heading, speed, size[0], size[1], z)


@dataclass(frozen=True, slots=True)
class Poses:
    """Poses of the ego in many manoeuvres. The arrays broadcast to ``(manoeuvres, N, steps + 1)``.

    Attributes:
        x: Box centre [m].
        y: Box centre [m].
        cos: Cosine of the heading.
        sin: Sine of the heading.
    """

    x: Floats
    y: Floats
    cos: Floats
    sin: Floats


def poses_of(own: Boxes, table: Sequence[Manoeuvre], dt: float) -> Poses:
    """Apply manoeuvres to motions: brake along the vehicle's own path, then shift across it.

    Args:
        own: The unchanged motions ``(N, steps + 1)``.
        table: The manoeuvres.
        dt: Step [s].

    Returns:
        The poses ``(manoeuvres, N, steps + 1)``.
    """
    step = np.hypot(np.diff(own.x), np.diff(own.y))
    travelled = np.concatenate([np.zeros((len(own.x), 1)), np.cumsum(step, axis=1)], axis=1)
    plans = list(dict.fromkeys((m.delay, m.braking, m.ramp) for m in table))
    progress = np.stack([_progress(travelled, own.speed, *plan, dt) for plan in plans])
    along = _along(own, travelled, progress)
    plan_of = np.array([plans.index((m.delay, m.braking, m.ramp)) for m in table])
    shift, slope = _shift(table, progress[plan_of], dt)
    x, y, cos, sin = (v[plan_of] for v in (along.x, along.y, along.cos, along.sin))
    turn = 1.0 / np.sqrt(1.0 + slope * slope)
    return Poses(x - shift * sin, y + shift * cos, (cos - sin * slope) * turn, (sin + cos * slope) * turn)


def _progress(travelled: Floats, speed: Floats, delay: float, braking: float, ramp: float, dt: float) -> Floats:
    """Return the distance along the path ``(N, steps + 1)`` [m]: unchanged until ``delay``, then braked.

    The distance never exceeds the unchanged one. Braking rises linearly to b within r: v = v0 - b t^2 / 2r until r,
    then v0 - b (t - r/2). It is integrated in closed form and ends at standstill.
    """
    if braking == 0:
        return travelled
    low = min(int(delay / dt + 1e-9), travelled.shape[1] - 2)
    part = max(delay / dt - low, 0.0)
    v0 = (speed[:, low] * (1 - part) + speed[:, low + 1] * part)[:, None]
    s0 = (travelled[:, low] * (1 - part) + travelled[:, low + 1] * part)[:, None]
    stop = np.where(v0 <= braking * ramp / 2, np.sqrt(2 * ramp * v0 / braking), v0 / braking + ramp / 2)
    t = np.clip(np.arange(travelled.shape[1]) * dt - delay, 0.0, stop)
    early, late = np.minimum(t, ramp), np.maximum(t - ramp, 0.0)
    lost = braking * (early**3 / (6 * ramp) + late * ramp / 2 + late * late / 2)
    return np.minimum(travelled, s0 + v0 * t - lost)


def _along(own: Boxes, travelled: Floats, progress: Floats) -> Poses:
    """Return the poses at the distances ``progress`` ``(plans, N, steps + 1)`` [m] along each vehicle's own path."""
    n, count = travelled.shape
    spread = float(travelled[:, -1].max()) + 1.0
    rows = np.arange(n)[:, None]
    index = np.searchsorted((travelled + rows * spread).ravel(), progress + rows * spread, side="right") - 1
    index = np.clip(index, rows * count, rows * count + count - 2)
    start, step = travelled.ravel()[index], np.diff(travelled, append=travelled[:, -1:]).ravel()[index]
    part = np.clip((progress - start) / np.where(step > 0, step, 1.0), 0.0, 1.0)
    x, y = own.x.ravel(), own.y.ravel()
    cos, sin = np.cos(own.heading).ravel(), np.sin(own.heading).ravel()
    c, s, x, y = (v[index] + part * (v[index + 1] - v[index]) for v in (cos, sin, x, y))
    norm = np.sqrt(c * c + s * s)
    return Poses(x, y, c / norm, s / norm)


def _shift(table: Sequence[Manoeuvre], progress: Floats, dt: float) -> tuple[Floats, Floats]:
    """Return the lateral offset [m] and its slope over the path: a quintic, never steeper than ``STEEPEST_SHIFT``."""
    time = np.arange(progress.shape[-1]) * dt
    duration = np.array([[_duration(m.shift)] for m in table])
    u = np.clip((time - np.array([[m.delay] for m in table])) / duration, 0.0, 1.0)
    profile = np.array([[m.shift] for m in table]) * (u**3 * (10 + u * (6 * u - 15)))
    full_steps = np.diff(profile)[:, None, :]
    moved = np.diff(progress)
    steps = np.sign(full_steps) * np.minimum(np.abs(full_steps), STEEPEST_SHIFT * moved)
    slope = steps / np.maximum(moved, 1e-6)
    zero = np.zeros((*steps.shape[:-1], 1))
    return np.concatenate([zero, np.cumsum(steps, axis=-1)], axis=-1), np.concatenate([zero, slope], axis=-1)


def stays_on_road(poses: Boxes, clear: Bools, on_road: OnRoad, dt: float) -> Bools:
    """Check that shifts keep the box's corners on the road until 0.5 s after the shift is complete.

    Only shifts that matter are checked: those that touch no vehicle although every braking alone with the same delay
    does.

    Args:
        poses: The ego in each manoeuvre of ``TABLE``, ``(len(TABLE), N, steps + 1)``.
        clear: Which manoeuvres touch no vehicle ``(len(TABLE), N)``.
        on_road: Returns which points are drivable.
        dt: Step [s].

    Returns:
        Whether each manoeuvre stays on the road ``(len(TABLE), N)``; True for those that are not checked.
    """
    ok = np.ones(clear.shape, dtype=bool)
    steer, delay = np.array([m.shift != 0 for m in TABLE]), np.array([m.delay for m in TABLE])
    needed = clear & steer[:, None]
    for value in np.unique(delay[steer]):
        needed[delay == value] &= ~clear[(delay == value) & ~steer].any(axis=0)
    m, n = np.nonzero(needed)
    if not len(m):
        return ok
    ends = np.array([t.delay + _duration(t.shift) + 0.5 for t in TABLE])[m]
    time = np.arange(poses.x.shape[-1]) * dt
    steps = np.flatnonzero((time > delay[m].min()) & (time <= ends.max()))[::3]
    pick = (m[:, None], n[:, None], steps[None])
    heading = poses.heading[pick]
    length, width = (np.asarray(v)[n] - 2 * ROAD_TOLERANCE_M for v in (poses.length, poses.width))
    points = corners(Boxes(poses.x[pick], poses.y[pick], heading, heading, length, width))
    inside = np.asarray(on_road(points[..., 0], points[..., 1])).all(axis=-1)
    ok[m, n] = (inside | (time[steps] > ends[:, None])).all(axis=1)
    return ok


def _duration(shift: float) -> float:
    """Return how long a quintic shift [m] takes at a peak of ``PEAK_LATERAL_M_S2`` [s]; 1 for no shift."""
    return float(np.sqrt(5.7735 * abs(shift) / PEAK_LATERAL_M_S2)) or 1.0


HAZARD_TO_MANOEUVRE_S = 0.8
TABLE: tuple[Manoeuvre, ...] = manoeuvres(HAZARD_TO_MANOEUVRE_S - PERCEPTION_S)
"""The combinations that are tried. Their delays count from the alarm."""


def manoeuvre_poses(ego: Boxes, alarm: Ints, steps: int, dt: float) -> Boxes:
    """Apply ``TABLE`` to the ego's motion.

    Args:
        ego: The ego's unchanged motion ``(N, T)``.
        alarm: The step of the alarm ``(N,)``.
        steps: How many steps after the alarm are returned.
        dt: Step [s].

    Returns:
        The ego in each manoeuvre, from the alarm on ``(len(TABLE), N, steps + 1)``.
    """
    own = window(ego, alarm, steps, dt)
    poses = poses_of(own, TABLE, dt)
    moved = np.hypot(np.diff(poses.x, axis=-1), np.diff(poses.y, axis=-1)) / dt
    speed = np.concatenate([moved, moved[..., -1:]], axis=-1)
    return Boxes(poses.x, poses.y, np.arctan2(poses.sin, poses.cos), speed, own.length, own.width, own.z)


def escapes(ego: Boxes, adversary: Boxes, alarm: Ints, steps: Ints, dt: float) -> tuple[Boxes, Bools]:
    """Find the manoeuvres that avoid the adversary.

    Args:
        ego: The ego's unchanged motion ``(N, T)``.
        adversary: The adversary's motion ``(N, T')``.
        alarm: The step of the alarm ``(N,)``.
        steps: For how many steps after the alarm a contact counts ``(N,)``.
        dt: Step [s].

    Returns:
        The poses of :func:`manoeuvre_poses`, and which of them touch the adversary nowhere (swept between the steps)
        ``(len(TABLE), N)``.
    """
    longest = int(steps.max())
    poses = manoeuvre_poses(ego, alarm, longest, dt)
    foe = window(adversary, alarm, longest, dt)
    foe = replace(foe, x=np.where(np.arange(longest + 1) > steps[:, None], np.nan, foe.x))  # absent afterwards
    return poses, ~touches(poses, foe)
