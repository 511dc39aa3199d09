"""Is the adversary's motion like traffic's: distributions of kinematic features against a reference.

The reference is sigma 0.5 traffic or a log (sigma 0 traffic has 84 % of its steps at |a| < 0.05: a KL against it means
nothing).  Only motion before contact counts.  Bins are fixed and smoothed, so figures of different runs compare.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Track
from sumo_adv.errors import UsageError
from sumo_adv.metrics.boxes import corners, gap, on_grid
from sumo_adv.metrics.criticality import ttc
from sumo_adv.metrics.gates import motion

ABNORMAL_LATERAL = 4.0  # m/s2, the paper's threshold of abnormal lateral acceleration
PSEUDOCOUNT = 0.1  # added to every bin, WOSAC's


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
        return smoothed(self.counts(values))


def smoothed(counts: Floats) -> Floats:
    """Probabilities of bins: counts + 0.1, normalised."""
    return np.asarray((counts + PSEUDOCOUNT) / (counts + PSEUDOCOUNT).sum())


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


def features(tracks: Sequence[Track], end: float | None = None) -> dict[str, Floats]:
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
    attacked, unattacked = features(adversarial, end), features(reference)
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
    values = features(tracks, end)
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
    return float((values["lateral_acceleration"] > ABNORMAL_LATERAL).mean())
