"""Could a person have driven so: the human envelope, by speed.

Bounds, at 5 m/s and below, and at 20 m/s and above, linear between:

================== ============= ============= ====================================================================
signal             5 m/s         20 m/s        source
================== ============= ============= ====================================================================
acceleration       4.0 m/s2      2.0 m/s2      ISO 15622:2018 (adaptive cruise control)
braking            5.0 m/s2      3.5 m/s2      ISO 15622:2018, mean over 2 s; here over 0.5 s, which is stricter
jerk               7.6 m/s3      7.6 m/s3      UN R157's human driver: 0.774 g within a second
lateral            4.0 m/s2      3.0 m/s2      UN R79 (3 m/s2 for steering functions); 4 m/s2 at the speeds of turns
yaw rate           0.8 rad/s     0.15 rad/s    the lateral bound over the speed
================== ============= ============= ====================================================================

The standards take their numbers from what drivers do and accept.  A published table of 99.9th percentiles of
naturalistic driving by speed was not at hand; replace these bounds where you have one.  A signal may be outside for at
most 0.3 s in total.  Braking up to the gate counts as human while the adversary is ahead in the ego's lane: people
brake hard for what is before them, and the ego behind them has to cope.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sumo_adv.datatypes import Bools, Boxes, Floats, Track
from sumo_adv.metrics.boxes import row_of
from sumo_adv.metrics.gates import derivatives

SLOW, FAST = 5.0, 20.0  # m/s
BOUNDS = {
    "acceleration": (4.0, 2.0), "braking": (5.0, 3.5), "jerk": (7.6, 7.6), "lateral": (4.0, 3.0),
    "yaw_rate": (0.8, 0.15),
}  # fmt: skip
ALLOWED = 0.3  # s outside, in total
BRAKING_SPAN, JERK_SPAN = 0.5, 1.0  # s over which means are taken


def outside(track: Track, start: float, end: float, excused: Bools | None = None) -> tuple[str, ...]:
    """Names of the signals that leave the envelope for more than ``ALLOWED`` between ``start`` and ``end`` [s].

    ``excused``: the steps of the track in which braking is not judged, ``(n,)``.
    """
    if len(track.time) < 3:
        return ()
    judged = (track.time >= start - 5e-4) & (track.time <= end + 5e-4)
    free = np.zeros(len(track.time), bool) if excused is None else excused
    left_by_signal = envelope_left(row_of(track), track.time, judged[None], free[None])
    return tuple(name for name, left in left_by_signal.items() if left[0])


def envelope_left(b: Boxes, time: Floats, judged: Bools, excused: Bools) -> dict[str, Bools]:
    """Which motions ``(n, steps)`` leave the envelope for more than ``ALLOWED`` in the ``judged`` steps, by signal.

    ``time`` ``(steps,)`` [s], evenly spaced; ``excused`` ``(n, steps)``: where braking is not judged.
    """
    dt = float(np.diff(time).min())
    change = np.diff(b.speed, axis=-1, prepend=b.speed[..., :1]) / dt
    m, along = derivatives(b, change, time), _mean(change, dt, BRAKING_SPAN)
    jerk = _span_change(along, dt)
    signals = {
        "acceleration": along, "braking": np.where(excused, 0.0, -along),
        "jerk": np.where(excused, 0.0, np.abs(jerk)), "lateral": m.lateral, "yaw_rate": np.abs(m.yaw_rate),
    }  # fmt: skip
    left_by_signal = {}
    for name, values in signals.items():
        bound = np.interp(b.speed, (SLOW, FAST), BOUNDS[name])
        left_by_signal[name] = (judged & (values > bound + 1e-6)).sum(axis=-1) * dt > ALLOWED + 1e-9
    return left_by_signal


def _mean(values: Floats, dt: float, span: float) -> Floats:
    """The mean over the last ``span`` [s]."""
    count = max(1, round(span / dt))
    padded = np.concatenate([np.repeat(values[..., :1], count - 1, axis=-1), values], axis=-1)
    return np.asarray(sliding_window_view(padded, count, axis=-1).mean(axis=-1))


def _span_change(values: Floats, dt: float) -> Floats:
    """The change over ``JERK_SPAN`` [s], per second."""
    back = np.maximum(np.arange(values.shape[-1]) - max(1, round(JERK_SPAN / dt)), 0)
    return np.asarray((values - values[..., back]) / JERK_SPAN)
