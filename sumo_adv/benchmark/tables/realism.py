"""Realism over many encounters: the adversaries' steps pooled against those of unattacked vehicles near by.

Intervals resample encounters, not steps: the steps of one motion are not independent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sumo_adv.benchmark.nouns import Cell
from sumo_adv.benchmark.tables.cells import failed
from sumo_adv.datatypes import Floats
from sumo_adv.metrics.realism import PAPER_BINS, Bins, jensen_shannon, kl, smoothed, wasserstein
from sumo_adv.metrics.statistics import Estimate

RESAMPLES = 1000
FINE = 2000  # bins of W1 in resamples

Pooled = Callable[[Sequence[Cell]], Estimate | None]


def samples(cells: Sequence[Cell], feature: str) -> tuple[list[Floats], list[Floats]]:
    """Values of ``speed`` [m/s] or ``acceleration`` [m/s2] of each encounter that has both: adversary, unattacked."""
    attacked, raw = [], []
    for cell in cells:
        motion = cell.get("motion") or {}
        a, b = (np.asarray((motion.get(who) or {}).get(feature) or (), dtype=float) for who in ("adversary", "raw"))
        if not failed(cell) and a.size and b.size:
            attacked.append(a)
            raw.append(b)
    return attacked, raw


def distance(feature: str, measure: str) -> Pooled:
    """The distance ``kl``, ``js`` or ``wasserstein`` of a feature's distributions, over encounters."""

    def of(cells: Sequence[Cell]) -> Estimate | None:
        attacked, raw = samples(cells, feature)
        if not attacked:
            return None
        a, b = np.concatenate(attacked), np.concatenate(raw)
        exact = measure == "wasserstein"
        bins = _over(np.concatenate([a, b])) if exact else PAPER_BINS[feature]
        own, reference = (np.array([bins.counts(v) for v in side]) for side in (attacked, raw))
        weights = _weights(len(attacked))
        resampled = [_of_counts(measure, p, q, bins) for p, q in zip(weights @ own, weights @ reference, strict=True)]
        value = wasserstein(a, b) if exact else _of_counts(measure, bins.counts(a), bins.counts(b), bins)
        return _interval(value, np.array(resampled), len(attacked))

    return of


def _over(values: Floats) -> Bins:
    """Bins over all there is, ``FINE`` of them: W1 must not stop where a histogram of usual values ends."""
    finite = values[np.isfinite(values)]
    return Bins(float(finite.min()), float(finite.max()) + 1e-6, FINE)


def _of_counts(measure: str, p: Floats, q: Floats, bins: Bins) -> float:
    """The distance of two distributions from their counts on the same bins."""
    if measure == "wasserstein":
        width = (bins.high - bins.low) / bins.count
        return float(np.abs(np.cumsum(p) / p.sum() - np.cumsum(q) / q.sum()).sum() * width)
    return (kl if measure == "kl" else jensen_shannon)(smoothed(p), smoothed(q))


def step_share(name: str) -> Pooled:
    """A share of steps of the cells' ``realism`` block, over all steps of all encounters."""

    def of(cells: Sequence[Cell]) -> Estimate | None:
        blocks = [cell.get("realism") or {} for cell in cells if not failed(cell)]
        counted = [(b[name], b["steps"]) for b in blocks if b.get(name) is not None and b.get("steps")]
        if not counted:
            return None
        share, steps = np.array(counted, dtype=float).T
        weights = _weights(len(counted))
        return _interval(
            float(share @ steps / steps.sum()), weights @ (share * steps) / (weights @ steps), len(counted)
        )

    return of


def _weights(count: int) -> Floats:
    """How often each of ``count`` encounters is in each resample ``(RESAMPLES, count)``."""
    drawn = np.random.default_rng(0).integers(0, count, (RESAMPLES, count))
    return np.array([np.bincount(row, minlength=count) for row in drawn], dtype=float)


def _interval(value: float, resampled: Floats, n: int) -> Estimate:
    low, high = np.quantile(resampled, [0.025, 0.975])
    return Estimate(value, float(low), float(high), n)
