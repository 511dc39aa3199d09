"""Why the first attempt does not try the intent that the analysis ranks first.

The ranking goes by the share of an intent's candidates that collide. The first attempt is the single candidate that
promises most, which may be of another intent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sumo_adv.datatypes import Intent, Level, Prediction, Proposal
from sumo_adv.goal import Goal
from sumo_adv.search.settings import PriceSettings

SEEN_APART = 0.005  # a smaller difference of scores is none: it would be 0.00 or 0.01 in the sentence


def why_first(
    first: Proposal, top: Intent, pool: Sequence[Proposal], price: Callable[[Proposal], float], goal: Goal,
    weights: PriceSettings,
) -> str:  # fmt: skip
    """Why ``first`` is tried before ``top``, in a sentence; empty if it is of that intent.

    pool: the candidates that are left; price: what the search chose ``first`` by.
    """
    if (first.bv, first.label) == (top.bv, top.label):
        return ""
    opening = f"Attempt 1 tries {first.label} by {first.bv}"
    own = [p for p in pool if (p.bv, p.label) == (top.bv, top.label)]
    best = min(own, key=price, default=None)
    if first.by == "memory":
        return f"{opening}: it succeeded in a similar scene."
    if best is None or best.prediction is None or best.prediction.failure or first.prediction is None:
        return f"{opening}: nothing could be predicted of {top.label}."
    top_name = top.label if top.label != first.label else f"that by {top.bv}"
    return f"{opening}: {_better(first, best, first.prediction, best.prediction, top_name, goal, weights)}."


def _better(
    first: Proposal, best: Proposal, seen: Prediction, other: Prediction, label: str, goal: Goal, weights: PriceSettings
) -> str:
    """What the first candidate is predicted to do better than the best one of the other intent, called ``label``."""
    if goal.ttc is not None:
        return f"its predicted min TTC is {_ttc(seen)}, that of {label} {_ttc(other)}"
    if goal.min_delta_v > 0 and other.delta_v < goal.min_delta_v <= seen.delta_v:
        return f"its predicted delta-v is {seen.delta_v:.1f} m/s, that of {label} only {other.delta_v:.1f} m/s"
    if seen.level > other.level:
        return f"it is predicted to reach {seen.level}, {label} {_only(other.level)}"
    parts = {
        "nominal": best.nominal_score - first.nominal_score,
        "robust": (best.score - best.nominal_score) - (first.score - first.nominal_score),
        "late": weights.late * (other.time - seen.time),
        "harsh": weights.harsh * (other.braking - seen.braking),
    }
    words = {
        "nominal": _severity(seen, other, label),
        "robust": f"its neighbours with slightly different parameters keep the level, those of {label} do not all",
        "late": f"it is predicted to collide after {seen.time:.1f} s, {label} only after {other.time:.1f} s",
        "harsh": f"its adversary brakes for {seen.braking:.0%} of the time, that of {label} for {other.braking:.0%}",
    }
    most = max(parts, key=lambda name: parts[name])
    if parts[most] < SEEN_APART:
        return f"both are predicted to reach {_level(seen.level)} alike"
    return words[most]


def _severity(seen: Prediction, other: Prediction, label: str) -> str:
    """What tells two predictions of one level apart."""
    if not seen.hit:
        return f"its predicted min TTC is {_ttc(seen)}, that of {label} {_ttc(other)}"
    if seen.human and not other.human:
        return f"a person could drive so, but not as {label} needs it"
    if seen.warning > other.warning and seen.level < Level.STRICT:
        return f"the danger shows {seen.warning:.1f} s before the contact, with {label} {other.warning:.1f} s"
    return f"its predicted delta-v is {seen.delta_v:.1f} m/s, that of {label} {other.delta_v:.1f} m/s"


def _level(level: Level) -> str:
    return "no collision that counts" if level < Level.COLLISION else str(level)


def _only(level: Level) -> str:
    return "no collision that counts" if level < Level.COLLISION else f"only {level}"


def _ttc(made: Prediction) -> str:
    return f"{made.min_ttc:.2f} s" if made.min_ttc < 10.0 else "over 10 s"
