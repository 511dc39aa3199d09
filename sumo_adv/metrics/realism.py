"""Is the adversary's motion like a person's, and like traffic's.

Like a person's: the human envelope, by speed. Bounds, at 5 m/s and below, and at 20 m/s and above, linear between:

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

Like traffic's: distributions of kinematic features against a reference. The reference is sigma 0.5 traffic or a log
(sigma 0 traffic has 84 % of its steps at |a| < 0.05: a KL against it means nothing).  Only motion before contact
counts.  Bins are fixed and smoothed, so figures of different runs compare.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sumo_adv.datatypes import Bools, Boxes, Floats, Track
from sumo_adv.errors import UsageError
from sumo_adv.metrics.boxes import corners, gap, on_grid, row_of
from sumo_adv.metrics.criticality import ttc
from sumo_adv.metrics.gates import derivatives, motion

SLOW_BOUND_SPEED_M_S, FAST_BOUND_SPEED_M_S = 5.0, 20.0
HUMAN_BOUNDS = {
    "acceleration": (4.0, 2.0), "braking": (5.0, 3.5), "jerk": (7.6, 7.6), "lateral": (4.0, 3.0),
    "yaw_rate": (0.8, 0.15),
}  # fmt: skip
MAX_OUTSIDE_BOUNDS_S = 0.3  # in total
BRAKING_SPAN_S, JERK_SPAN_S = 0.5, 1.0  # over which means are taken


def outside(track: Track, start: float, end: float, excused: Bools | None = None) -> tuple[str, ...]:
    """Names of the signals that leave the envelope for more than ``MAX_OUTSIDE_BOUNDS_S`` between ``start`` and ``end``
    [s].

    ``excused``: the steps of the track in which braking is not judged, ``(n,)``.
    """
    if len(track.time) < 3:
        return ()
    judged = (track.time >= start - 5e-4) & (track.time <= end + 5e-4)
    free = np.zeros(len(track.time), bool) if excused is None else excused
    left_by_signal = envelope_left(row_of(track), track.time, judged[None], free[None])
    return tuple(name for name, left in left_by_signal.items() if left[0])


def envelope_left(b: Boxes, time: Floats, judged: Bools, excused: Bools) -> dict[str, Bools]:
    """Which motions ``(n, steps)`` leave the envelope for more than ``MAX_OUTSIDE_BOUNDS_S`` in the ``judged`` steps,
    by signal.

    ``time`` ``(steps,)`` [s], evenly spaced; ``excused`` ``(n, steps)``: where braking is not judged.
    """
    dt = float(np.diff(time).min())
    change = np.diff(b.speed, axis=-1, prepend=b.speed[..., :1]) / dt
    m, along = derivatives(b, change, time), _span_mean(change, dt)
    jerk = _span_change(along, dt)
    signals = {
        "acceleration": along, "braking": np.where(excused, 0.0, -along),
        "jerk": np.where(excused, 0.0, np.abs(jerk)), "lateral": m.lateral, "yaw_rate": np.abs(m.yaw_rate),
    }  # fmt: skip
    left_by_signal = {}
    for name, values in signals.items():
        bound = np.interp(b.speed, (SLOW_BOUND_SPEED_M_S, FAST_BOUND_SPEED_M_S), HUMAN_BOUNDS[name])
        left_by_signal[name] = (judged & (values > bound + 1e-6)).sum(axis=-1) * dt > MAX_OUTSIDE_BOUNDS_S + 1e-9
    return left_by_signal


def _span_mean(values: Floats, dt: float) -> Floats:
    """The mean over the last ``BRAKING_SPAN_S`` [s]."""
    count = max(1, round(BRAKING_SPAN_S / dt))
    padded = np.concatenate([np.repeat(values[..., :1], count - 1, axis=-1), values], axis=-1)
    return np.asarray(sliding_window_view(padded, count, axis=-1).mean(axis=-1))


def _span_change(values: Floats, dt: float) -> Floats:
    """The change over ``JERK_SPAN_S`` [s], per second."""
    back = np.maximum(np.arange(values.shape[-1]) - max(1, round(JERK_SPAN_S / dt)), 0)
    return np.asarray((values - values[..., back]) / JERK_SPAN_S)


ABNORMAL_LATERAL_M_S2 = 4.0  # the paper's threshold of abnormal lateral acceleration
BIN_PSEUDOCOUNT = 0.1  # added to every bin, WOSAC's


@dataclass(frozen=True, slots=True)
class Bins:
    """``count`` equal bins from ``low`` to ``high`` (SI units); what lies outside goes to the end bins."""

    low: float
    high: float
    count: int

    def counts(self, values: Floats) -> Floats:
        """How many finite values lie in each bin ``(count,)``."""
        edges = np.linspace(self.low, self.high, self.count + 1)
        finite = values[np.isfinite(values)]
        return np.asarray(np.histogram(np.clip(finite, self.low, self.high), edges)[0], dtype=float)

    def histogram(self, values: Floats) -> Floats:
        """Smoothed probabilities ``(count,)`` of finite values."""
        return smoothed_probabilities(self.counts(values))


def smoothed_probabilities(counts: Floats) -> Floats:
    """Probabilities of bins: counts + 0.1, normalised."""
    return np.asarray((counts + BIN_PSEUDOCOUNT) / (counts + BIN_PSEUDOCOUNT).sum())


PAPER_BINS: Mapping[str, Bins] = {
    "speed": Bins(0.0, 40.0, 40),  # m/s
    "acceleration": Bins(-8.0, 8.0, 32),  # m/s2
    "lateral_acceleration": Bins(0.0, 8.0, 32),  # m/s2
    "jerk": Bins(-20.0, 20.0, 40),  # m/s3
    "yaw_rate": Bins(-1.0, 1.0, 40),  # rad/s
    "curvature": Bins(0.0, 0.25, 25),  # 1/m
}
"""The paper gives KL of speed and acceleration and not its bins: these are ours, fixed."""

WOSAC_BINS: Mapping[str, Bins] = {
    "linear_speed": Bins(0.0, 25.0, 10),  # m/s
    "linear_acceleration": Bins(-12.0, 12.0, 11),  # m/s2
    "angular_speed": Bins(-0.628, 0.628, 11),  # rad/s
    "angular_acceleration": Bins(-3.14, 3.14, 11),  # rad/s2
    "distance_to_nearest_object": Bins(-5.0, 40.0, 10),  # m
    "time_to_collision": Bins(0.0, 5.0, 10),  # s
    "distance_to_road_edge": Bins(-20.0, 40.0, 10),  # m, negative off the road
}
"""Waymo Open Sim Agents Challenge 2024 config: bins as published, pseudocount 0.1."""


def kl(p: Floats, q: Floats) -> float:
    """Kullback-Leibler divergence sum p ln(p/q) [nat] of two smoothed histograms (adversarial, reference)."""
    return float(np.sum(p * np.log(p / q)))


def jensen_shannon(p: Floats, q: Floats) -> float:
    """Jensen-Shannon divergence [nat], symmetric, at most ln 2."""
    middle = (p + q) / 2
    return (kl(p, middle) + kl(q, middle)) / 2


def wasserstein(a: Floats, b: Floats) -> float:
    """Wasserstein-1 distance of two samples, in their own unit: the area between their distribution functions."""
    first, second = np.sort(a[np.isfinite(a)]), np.sort(b[np.isfinite(b)])
    if not first.size or not second.size:
        raise UsageError("A distance of distributions needs values on both sides; one of them has none.")
    every = np.sort(np.concatenate([first, second]))
    between = np.abs(
        np.searchsorted(first, every[:-1], "right") / first.size
        - np.searchsorted(second, every[:-1], "right") / second.size
    )
    return float(np.sum(between * np.diff(every)))


def pooled_features(tracks: Sequence[Track], end: float | None = None) -> dict[str, Floats]:
    """Pooled samples of every feature of ``PAPER_BINS`` (lateral as magnitude) before ``end`` [s]."""
    pooled: dict[str, list[Floats]] = {name: [] for name in PAPER_BINS}
    for track in tracks:
        part = track if end is None else track.between(-np.inf, end)
        if len(part.time) < 2:
            continue
        m = motion(part)
        samples = (m.speed, m.acceleration, m.lateral, m.jerk[1:], m.yaw_rate, m.curvature)
        for name, values in zip(PAPER_BINS, samples, strict=True):
            pooled[name].append(values)
    return {name: np.concatenate(values) if values else np.zeros(0) for name, values in pooled.items()}


def wosac_features(
    track: Track, others: Sequence[Track] = (), road_distance: Callable[[Floats, Floats], Floats] | None = None
) -> dict[str, Floats]:
    """WOSAC's kinematic, interaction and map features of one track, each ``(n,)`` or shorter where differenced.

    ``road_distance(x, y)``: signed distance [m] to the road's edge, positive on the road; the least of the corners.
    """
    dt = float(track.time[1] - track.time[0])
    speed = np.hypot(np.gradient(track.x, dt), np.gradient(track.y, dt))
    turning = np.gradient(np.unwrap(track.heading), dt)
    by_name = {
        "linear_speed": speed,
        "linear_acceleration": np.gradient(speed, dt),
        "angular_speed": turning,
        "angular_acceleration": np.gradient(turning, dt),
    }
    if others:
        surrounding = on_grid(others, track.time)
        by_name["distance_to_nearest_object"] = np.fmin.reduce(gap(track.boxes(), surrounding), axis=0)
        by_name["time_to_collision"] = np.minimum(ttc(track.boxes(), surrounding).min(axis=0), 5.0)
    if road_distance is not None:
        points = corners(track.boxes())
        by_name["distance_to_road_edge"] = np.asarray(road_distance(points[..., 0], points[..., 1])).min(axis=-1)
    return by_name


def distances(
    sample: Mapping[str, Floats], reference: Mapping[str, Floats], bins: Mapping[str, Bins]
) -> dict[str, float]:
    """``<feature>_kl``, ``_js``, ``_wasserstein`` for every feature that both sides have samples of."""
    out: dict[str, float] = {}
    for name, b in bins.items():
        samples, references = sample.get(name, np.zeros(0)), reference.get(name, np.zeros(0))
        if not np.isfinite(samples).any() or not np.isfinite(references).any():
            continue
        p, q = b.histogram(samples), b.histogram(references)
        out |= {
            f"{name}_kl": kl(p, q),
            f"{name}_js": jensen_shannon(p, q),
            f"{name}_wasserstein": wasserstein(samples, references),
        }
    return out


def realism(
    adversarial: Sequence[Track],
    reference: Sequence[Track],
    *,
    end: float | None = None,
    on_road: Callable[[Floats, Floats], Bools] | None = None,
) -> dict[str, float]:
    """The realism block of an outcome: distances of every feature, share of |a_lat| > 4 m/s2, off-road share.

    ``end``: the contact, after which the adversary's motion does not count.  Raises UsageError without a reference.
    """
    attacked, unattacked = pooled_features(adversarial, end), pooled_features(reference)
    if not unattacked["speed"].size or not attacked["speed"].size:
        raise UsageError("Realism needs moving vehicles on both sides; give reference tracks of at least two steps.")
    out = distances(attacked, unattacked, PAPER_BINS) | own_figures(adversarial, end=end, on_road=on_road)
    out["reference_abnormal_lateral_share"] = _abnormal(unattacked)
    return out


def own_figures(
    tracks: Sequence[Track], *, end: float | None = None, on_road: Callable[[Floats, Floats], Bools] | None = None
) -> dict[str, float]:
    """What needs no reference: share of |a_lat| > 4 m/s2, largest magnitudes, off-road share of the box centres.

    Raises UsageError where no track has two steps before ``end``.
    """
    values = pooled_features(tracks, end)
    if not values["speed"].size:
        raise UsageError("Realism needs a vehicle that moves; give tracks of at least two steps before the contact.")
    out = {"abnormal_lateral_share": _abnormal(values)}
    for name in ("lateral_acceleration", "jerk", "yaw_rate", "curvature"):
        out[f"{name}_max"] = float(np.abs(values[name]).max())
    if on_road is not None:
        parts = [t if end is None else t.between(-np.inf, end) for t in tracks]
        off = [~np.asarray(on_road(t.x, t.y)) for t in parts]
        out["off_road_share"] = float(np.concatenate(off).mean())
    return out


def _abnormal(values: Mapping[str, Floats]) -> float:
    return float((values["lateral_acceleration"] > ABNORMAL_LATERAL_M_S2).mean())
