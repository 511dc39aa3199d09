"""Realism over many encounters: the adversaries' steps pooled against those of unattacked vehicles near by.

Intervals resample encounters, not steps: the steps of one motion are not independent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sumo_adv.benchmark.nouns import Cell
from sumo_adv.benchmark.tables.cells import failed
from sumo_adv.datatypes import Floats
from sumo_adv.metrics.realism import PAPER_BINS, Bins, jensen_shannon, kl, smoothed
from sumo_adv.metrics.statistics import Estimate

RESAMPLES = 1000

Pooled = Callable[[Sequence[Cell]], Estimate | None]
Sides = Sequence[Floats]
OfWeights = Callable[[Floats], float]


def samples(cells: Sequence[Cell], feature: str) -> tuple[list[Floats], list[Floats]]:
    """Values of ``speed`` [m/s] or ``acceleration`` [m/s2] of each encounter that has both: adversary, unattacked."""
    ours, theirs = [], []
    for cell in cells:
        motion = cell.get("motion") or {}
        a, b = (np.asarray((motion.get(who) or {}).get(feature) or (), dtype=float) for who in ("adversary", "raw"))
        if not failed(cell) and a.size and b.size:
            ours.append(a)
            theirs.append(b)
    return ours, theirs


def distance(feature: str, measure: str) -> Pooled:
    """The distance ``kl``, ``js`` or ``wasserstein`` of a feature's distributions, over encounters."""
    of_weights = (
        _wasserstein
        if measure == "wasserstein"
        else _binned(PAPER_BINS[feature], kl if measure == "kl" else jensen_shannon)
    )

    def of(cells: Sequence[Cell]) -> Estimate | None:
        ours, theirs = samples(cells, feature)
        if not ours:
            return None
        at = of_weights(ours, theirs)
        found = np.array([at(w) for w in _weights(len(ours))])
        return _interval(at(np.ones(len(ours))), found, len(ours))

    return of


def _binned(bins: Bins, measure: Callable[[Floats, Floats], float]) -> Callable[[Sides, Sides], OfWeights]:
    """A distance of smoothed histograms, of encounters that count so often."""

    def of(ours: Sides, theirs: Sides) -> OfWeights:
        one, two = (np.array([bins.counts(v) for v in side]) for side in (ours, theirs))
        return lambda w: measure(smoothed(w @ one), smoothed(w @ two))

    return of


def _wasserstein(ours: Sides, theirs: Sides) -> OfWeights:
    """W1 of the values themselves: the area between the two distribution functions."""
    values = np.concatenate([*ours, *theirs])
    order = np.argsort(values)
    steps = np.diff(values[order])
    place = np.concatenate([np.full(len(v), k) for side in (ours, theirs) for k, v in enumerate(side)])[order]
    mine = (np.arange(len(values)) < sum(map(len, ours)))[order]

    def of(weights: Floats) -> float:
        each = weights[place]
        one, two = (np.cumsum(np.where(side, each, 0.0)) for side in (mine, ~mine))
        return float(np.abs(one[:-1] / one[-1] - two[:-1] / two[-1]) @ steps)

    return of


def step_share(name: str) -> Pooled:
    """A share of steps of the cells' ``realism`` block, over all steps of all encounters."""

    def of(cells: Sequence[Cell]) -> Estimate | None:
        blocks = [cell.get("realism") or {} for cell in cells if not failed(cell)]
        known = [(b[name], b["steps"]) for b in blocks if b.get(name) is not None and b.get("steps")]
        if not known:
            return None
        share, steps = np.array(known, dtype=float).T
        weights = _weights(len(known))
        return _interval(float(share @ steps / steps.sum()), weights @ (share * steps) / (weights @ steps), len(known))

    return of


def _weights(count: int) -> Floats:
    """How often each of ``count`` encounters is in each resample ``(RESAMPLES, count)``."""
    drawn = np.random.default_rng(0).integers(0, count, (RESAMPLES, count))
    return np.array([np.bincount(row, minlength=count) for row in drawn], dtype=float)


def _interval(value: float, found: Floats, n: int) -> Estimate:
    low, high = np.quantile(found, [0.025, 0.975])
    return Estimate(value, float(low), float(high), n)
