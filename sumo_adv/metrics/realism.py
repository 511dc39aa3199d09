"""Measure whether the adversary's motion is like a person's, and like traffic's.

Like a person's: the motion stays within the human envelope, whose bounds depend on speed. The bounds hold at 5 m/s and
below, and at 20 m/s and above; between these speeds, they are linear:

================== ============= ============= ====================================================================
signal             5 m/s         20 m/s        source
================== ============= ============= ====================================================================
acceleration       4.0 m/s2      2.0 m/s2      ISO 15622:2018 (adaptive cruise control)
braking            5.0 m/s2      3.5 m/s2      ISO 15622:2018, mean over 2 s; here over 0.5 s, which is stricter
jerk               7.6 m/s3      7.6 m/s3      UN R157's human driver: 0.774 g within a second
lateral            4.0 m/s2      3.0 m/s2      UN R79 (3 m/s2 for steering functions); 4 m/s2 at the speeds of turns
yaw rate           0.8 rad/s     0.15 rad/s    the lateral bound over the speed
================== ============= ============= ====================================================================

The standards derive their numbers from the motions that drivers make and accept. A published table of 99.9th
percentiles of naturalistic driving by speed was not at hand; if you have one, replace these bounds. A signal may be
outside its bound for at most 0.3 s in total. Braking up to the gate counts as human while the adversary is ahead in the
ego's lane: people brake hard for what is before them, and the ego behind them has to cope.

Like traffic's: the distributions of kinematic features are compared with those of a reference, either traffic with
sigma 0.5 or a log. (In traffic with sigma 0, 84 % of the steps have |a| < 0.05, so a KL divergence from it means
nothing.) Only motion before the contact counts. Bins are fixed and smoothed, so the figures of different runs can be
compared.
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
BRAKING_SPAN_S, JERK_SPAN_S = 0.5, 1.0  # means are taken over these spans


def outside(track: Track, start: float, end: float, excused: Bools | None = None) -> tuple[str, ...]:
    """Return the signals that leave the human envelope for more than ``MAX_OUTSIDE_BOUNDS_S``.

    Args:
        track: The vehicle's track, n steps.
        start: When the judged motion begins [s].
        end: When the judged motion ends [s].
        excused: The steps in which braking is not judged ``(n,)``.

    Returns:
        The names of the signals.
    """
    if len(track.time) < 3:
        return ()
    judged = (track.time >= start - 5e-4) & (track.time <= end + 5e-4)
    free = np.zeros(len(track.time), bool) if excused is None else excused
    left_by_signal = envelope_left(row_of(track), track.time, judged[None], free[None])
    return tuple(name for name, left in left_by_signal.items() if left[0])


def envelope_left(b: Boxes, time: Floats, judged: Bools, excused: Bools) -> dict[str, Bools]:
    """Return the motions that leave the human envelope for more than ``MAX_OUTSIDE_BOUNDS_S``.

    Args:
        b: n motions, arrays ``(n, steps)``.
        time: Evenly spaced times ``(steps,)`` [s].
        judged: The steps that are judged ``(n, steps)``.
        excused: The steps in which braking is not judged ``(n, steps)``.

    Returns:
        For each signal, by name, whether each motion leaves the envelope ``(n,)``.
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
    """Return the mean over the last ``BRAKING_SPAN_S``, for steps of ``dt`` [s]."""
    count = max(1, round(BRAKING_SPAN_S / dt))
    padded = np.concatenate([np.repeat(values[..., :1], count - 1, axis=-1), values], axis=-1)
    return np.asarray(sliding_window_view(padded, count, axis=-1).mean(axis=-1))


def _span_change(values: Floats, dt: float) -> Floats:
    """Return the change over ``JERK_SPAN_S``, per second."""
    back = np.maximum(np.arange(values.shape[-1]) - max(1, round(JERK_SPAN_S / dt)), 0)
    return np.asarray((values - values[..., back]) / JERK_SPAN_S)


ABNORMAL_LATERAL_M_S2 = 4.0  # the paper's threshold of abnormal lateral acceleration
BIN_PSEUDOCOUNT = 0.1  # is added to every bin, as WOSAC does


@dataclass(frozen=True, slots=True)
class Bins:
    """Equal bins of a feature. Values outside go to the end bins.

    Attributes:
        low: Lower edge of the first bin (SI units).
        high: Upper edge of the last bin (SI units).
        count: How many bins there are.
    """

    low: float
    high: float
    count: int

    def counts(self, values: Floats) -> Floats:
        """Count the finite values in each bin ``(count,)``."""
        edges = np.linspace(self.low, self.high, self.count + 1)
        finite = values[np.isfinite(values)]
        return np.asarray(np.histogram(np.clip(finite, self.low, self.high), edges)[0], dtype=float)

    def histogram(self, values: Floats) -> Floats:
        """Return the smoothed probabilities ``(count,)`` of finite values."""
        return smoothed_probabilities(self.counts(values))


def smoothed_probabilities(counts: Floats) -> Floats:
    """Return the probabilities of bins: counts + 0.1, normalised."""
    return np.asarray((counts + BIN_PSEUDOCOUNT) / (counts + BIN_PSEUDOCOUNT).sum())


PAPER_BINS: Mapping[str, Bins] = {
    "speed": Bins(0.0, 40.0, 40),  # m/s
    "acceleration": Bins(-8.0, 8.0, 32),  # m/s2
    "lateral_acceleration": Bins(0.0, 8.0, 32),  # m/s2
    "jerk": Bins(-20.0, 20.0, 40),  # m/s3
    "yaw_rate": Bins(-1.0, 1.0, 40),  # rad/s
    "curvature": Bins(0.0, 0.25, 25),  # 1/m
}
"""The paper gives the KL divergence of speed and acceleration, but not its bins. These are our own, fixed bins."""

WOSAC_BINS: Mapping[str, Bins] = {
    "linear_speed": Bins(0.0, 25.0, 10),  # m/s
    "linear_acceleration": Bins(-12.0, 12.0, 11),  # m/s2
    "angular_speed": Bins(-0.628, 0.628, 11),  # rad/s
    "angular_acceleration": Bins(-3.14, 3.14, 11),  # rad/s2
    "distance_to_nearest_object": Bins(-5.0, 40.0, 10),  # m
    "time_to_collision": Bins(0.0, 5.0, 10),  # s
    "distance_to_road_edge": Bins(-20.0, 40.0, 10),  # m, negative off the road
}
"""The bins of the Waymo Open Sim Agents Challenge 2024 as published in its config; the pseudocount is 0.1."""


def kl(p: Floats, q: Floats) -> float:
    """Return the Kullback-Leibler divergence of two smoothed histograms: sum p ln(p/q) [nat].

    Args:
        p: The adversarial histogram.
        q: The reference histogram.
    """
    return float(np.sum(p * np.log(p / q)))


def jensen_shannon(p: Floats, q: Floats) -> float:
    """Return the Jensen-Shannon divergence of two smoothed histograms [nat]. It is symmetric and at most ln 2."""
    middle = (p + q) / 2
    return (kl(p, middle) + kl(q, middle)) / 2


def wasserstein(a: Floats, b: Floats) -> float:
    """Return the Wasserstein-1 distance of two samples in their unit: the area between their distribution functions.

    Raises:
        UsageError: A sample has no finite value.
    """
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
    """Pool samples of every feature of ``PAPER_BINS`` (lateral acceleration as magnitude).

    Args:
        tracks: The tracks.
        end: Only motion up to this time counts [s].

    Returns:
        The samples of all tracks by feature.
    """
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
    """Return WOSAC's kinematic, interaction and map features of one track.

    Args:
        track: The track, n steps.
        others: The other vehicles.
        road_distance: Returns the signed distance [m] of points (x, y) to the road's edge, positive on the road. The
            feature is the minimum over the corners.

    Returns:
        The values ``(n,)`` of each feature that can be computed.
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
    """Compare two samples of features.

    Args:
        sample: The adversarial values by feature.
        reference: The reference values by feature.
        bins: The bins of the features.

    Returns:
        ``<feature>_kl``, ``<feature>_js`` and ``<feature>_wasserstein`` for every feature of which both have values.
    """
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
    """Return the realism block of an outcome.

    Args:
        adversarial: The adversaries' tracks.
        reference: The reference tracks.
        end: The contact, after which the adversary's motion does not count [s].
        on_road: Returns which points are drivable.

    Returns:
        The distances of every feature, the share of |a_lat| > 4 m/s2 in both, and the figures of ``own_figures``.

    Raises:
        UsageError: One side has no track of at least two steps.
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
    """Return the realism figures that need no reference.

    Args:
        tracks: The tracks.
        end: Only motion up to this time counts [s].
        on_road: Returns which points are drivable.

    Returns:
        The share of |a_lat| > 4 m/s2, the largest magnitudes and, with ``on_road``, the off-road share of the box
        centres.

    Raises:
        UsageError: No track has two steps before ``end``.
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
