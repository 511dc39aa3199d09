"""Read what counts of a cell, in one place, so that all tables count alike.

A failure is a cell, too: it counts as neither a collision nor critical nor valid, with the largest minimum TTC.

Realism is computed over many cells: the steps of the adversaries are pooled and compared with those of unattacked
vehicles nearby. Its intervals resample encounters and not steps, because the steps of one motion are not independent.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sumo_adv.benchmark.nouns import GROUPS, MIN_TTC_CAP_S, RAW, Cell, counts
from sumo_adv.datatypes import Ending, Floats
from sumo_adv.metrics.realism import PAPER_BINS, Bins, jensen_shannon, kl, smoothed_probabilities, wasserstein
from sumo_adv.metrics.statistics import Estimate

ORACLE = "oracle"
CELL_FAILURES = frozenset(
    {
        Ending.SIMULATION_FAILED, Ending.PLANNER_FAILED, Ending.MODEL_FAILED, Ending.BUDGET_EXHAUSTED, Ending.EGO_LOST,
        Ending.INTERRUPTED,
    }
)  # fmt: skip

CellKey = tuple[str, int]
"""Case and seed, by which the cells of two rows are paired."""


def key(cell: Cell) -> CellKey:
    """Return the key by which a cell is paired."""
    return str(cell["case"]), int(cell["seed"])


def is_raw(cell: Cell) -> bool:
    """Return whether a cell belongs to the unattacked row."""
    return bool(cell["row"] == RAW)


def failed(cell: Cell) -> bool:
    """Return whether the work failed (a crash, a model, a budget); its results until then do not count."""
    return cell["ending"] in CELL_FAILURES


def without_attack(cell: Cell) -> bool:
    """Return whether no attempt was made although nothing failed: there was no encounter, or nothing to try."""
    return not failed(cell) and not is_raw(cell) and cell.get("best") is None


def counted_outcome(cell: Cell) -> Mapping[str, Any]:
    """Return the verdict that counts; empty for a failure or without an attempt."""
    return {} if failed(cell) else cell.get("outcome") or {}


def attempts(cell: Cell) -> Sequence[Mapping[str, Any]]:
    """Return the attempts that count; none for a failure."""
    return () if failed(cell) else cell.get("attempts") or ()


def no_rear(verdict: Mapping[str, Any]) -> bool:
    """Return whether a verdict is a collision that is feasible and not rear-end."""
    return bool(verdict.get("collided")) and counts(verdict)


def capped_ttc(verdict: Mapping[str, Any]) -> float:
    """Return the minimum TTC [s]: 0 for a collision, and at most 10, which is also the value for *never*."""
    if verdict.get("collided"):
        return 0.0
    given = verdict.get("min_ttc")
    return MIN_TTC_CAP_S if given is None or math.isinf(given) else min(float(given), MIN_TTC_CAP_S)


def first_valid(cell: Cell) -> int | None:
    """Return the number of attempts until one was valid, from 1; None if none was."""
    return next((k for k, a in enumerate(attempts(cell), 1) if a.get("valid")), None)


def remembered(cell: Cell) -> bool | None:
    """Return whether the bank had the attack.

    With ``recall = scene``, that is an attack in a similar scene, otherwise the intent.

    Args:
        cell: The cell.

    Returns:
        The answer; None if the bank was not asked.
    """
    intent, recall = cell.get("intent") or {}, cell.get("recall")
    if recall is None:
        return None
    if intent.get("recall") == "scene":
        return any(a.get("by") == "memory" for a in (cell.get("attempts") or ())[:1])
    return bool(recall == "hit")


def parts(cells: Iterable[Cell]) -> dict[str, list[Cell]]:
    """Group cells.

    Args:
        cells: The cells.

    Returns:
        All cells as ``all``, then by group, then by kind. Empty parts are left out.
    """
    every = list(cells)
    by_part = {"all": every} | {group: [c for c in every if c["group"] == group] for group in GROUPS}
    for kind in dict.fromkeys(str(c["kind"]) for c in every):
        if kind not in by_part:
            by_part[kind] = [c for c in every if c["kind"] == kind]
    return {name: part for name, part in by_part.items() if part}


def names(cells: Iterable[Cell], what: str) -> list[str]:
    """Return the values of a key (``ego``, ``row``, ``case``), in order of appearance."""
    return list(dict.fromkeys(str(c[what]) for c in cells))


# -- realism


DISTANCE_RESAMPLES = 1000
RESAMPLED_W1_BINS = 2000  # number of bins of W1 in resamples

Pooled = Callable[[Sequence[Cell]], Estimate | None]


def samples(cells: Sequence[Cell], feature: str) -> tuple[list[Floats], list[Floats]]:
    """Return the values of a feature for each encounter that has them for both the adversary and unattacked traffic.

    Args:
        cells: The cells.
        feature: ``speed`` [m/s] or ``acceleration`` [m/s2].

    Returns:
        The values of the adversary, and of unattacked traffic, each with one array for each encounter.
    """
    attacked, raw = [], []
    for cell in cells:
        motion = cell.get("motion") or {}
        a, b = (np.asarray((motion.get(who) or {}).get(feature) or (), dtype=float) for who in ("adversary", "raw"))
        if not failed(cell) and a.size and b.size:
            attacked.append(a)
            raw.append(b)
    return attacked, raw


def distance(feature: str, measure: str) -> Pooled:
    """Make a function that computes the distance between the adversary's and the traffic's distributions of a feature.

    Args:
        feature: ``speed`` or ``acceleration``.
        measure: ``kl``, ``js`` or ``wasserstein``.

    Returns:
        A function of cells that returns the distance with its interval, or None without samples.
    """

    def of(cells: Sequence[Cell]) -> Estimate | None:
        attacked, raw = samples(cells, feature)
        if not attacked:
            return None
        a, b = np.concatenate(attacked), np.concatenate(raw)
        exact = measure == "wasserstein"
        bins = _over(np.concatenate([a, b])) if exact else PAPER_BINS[feature]
        own, reference = (np.array([bins.counts(v) for v in side]) for side in (attacked, raw))
        weights = resamples(len(attacked), DISTANCE_RESAMPLES)
        resampled = [_of_counts(measure, p, q, bins) for p, q in zip(weights @ own, weights @ reference, strict=True)]
        value = wasserstein(a, b) if exact else _of_counts(measure, bins.counts(a), bins.counts(b), bins)
        return interval(value, np.array(resampled), len(attacked))

    return of


def _over(values: Floats) -> Bins:
    """Make ``RESAMPLED_W1_BINS`` bins over all values: W1 must not stop where a histogram of usual values ends."""
    finite = values[np.isfinite(values)]
    return Bins(float(finite.min()), float(finite.max()) + 1e-6, RESAMPLED_W1_BINS)


def _of_counts(measure: str, p: Floats, q: Floats, bins: Bins) -> float:
    """Return the distance of two distributions from their counts in the same bins."""
    if measure == "wasserstein":
        width = (bins.high - bins.low) / bins.count
        return float(np.abs(np.cumsum(p) / p.sum() - np.cumsum(q) / q.sum()).sum() * width)
    return (kl if measure == "kl" else jensen_shannon)(smoothed_probabilities(p), smoothed_probabilities(q))


def step_share(name: str) -> Pooled:
    """Make a function that computes a share of the adversary's steps, weighted by the steps of each encounter.

    Args:
        name: A share in the cells' ``realism``.

    Returns:
        A function of cells that returns the share with its interval, or None without values.
    """

    def of(cells: Sequence[Cell]) -> Estimate | None:
        blocks = [cell.get("realism") or {} for cell in cells if not failed(cell)]
        counted = [(b[name], b["steps"]) for b in blocks if b.get(name) is not None and b.get("steps")]
        if not counted:
            return None
        share, steps = np.array(counted, dtype=float).T
        weights = resamples(len(counted), DISTANCE_RESAMPLES)
        return interval(float(share @ steps / steps.sum()), weights @ (share * steps) / (weights @ steps), len(counted))

    return of


def resamples(count: int, times: int) -> Floats:
    """Draw bootstrap samples of encounters.

    Args:
        count: The number of encounters.
        times: The number of samples.

    Returns:
        How often each encounter is in each sample, ``(times, count)``.
    """
    drawn = np.random.default_rng(0).integers(0, count, (times, count))
    return np.array([np.bincount(row, minlength=count) for row in drawn], dtype=float)


def interval(value: float, resampled: Floats, n: int) -> Estimate:
    """Return an estimate with the 95 % interval of its resamples."""
    low, high = np.quantile(resampled, [0.025, 0.975])
    return Estimate(value, float(low), float(high), n)
