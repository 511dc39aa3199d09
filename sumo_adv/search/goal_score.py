"""Scores of candidates for a goal that is more than a level: a near miss in a band of TTC, or a hard collision.

The scores stay in the ranges of ``ScoreSettings``: an attack that is predicted to meet the goal is below ``valid``.
What counts but does not meet it is a miss.
"""

from __future__ import annotations

from sumo_adv.datatypes import Level, Prediction
from sumo_adv.goal import Goal
from sumo_adv.search.settings import ScoreSettings

MOST_TTC, MOST_GAP = 10.0, 30.0  # s, m: what is farther off counts as this


def goal_score(goal: Goal, score: float, made: Prediction, weights: ScoreSettings) -> float:
    """The score of a prediction for the goal; ``score``: by its level alone.

    What fails whatever the ego does keeps its score, and so does a run into the ego's back.
    """
    if goal.ttc is not None:
        spoilt = made.hopeless or (made.hit and made.level < Level.COLLISION)
        return score if spoilt else _near_miss(goal.ttc, made, weights)
    if goal.min_delta_v > 0 and made.level >= Level.COLLISION and made.delta_v < goal.min_delta_v:
        return weights.miss + weights.too_mild * (1.0 - made.delta_v / goal.min_delta_v)
    return score


def _near_miss(band: tuple[float, float], made: Prediction, weights: ScoreSettings) -> float:
    """In the band the better the nearer to its middle; else the better the nearer to the band, a contact last."""
    low, high = band
    if made.hit:
        return weights.miss + weights.miss_by_ttc * low + weights.contact
    if low <= made.min_ttc <= high:
        return weights.strict * abs(2.0 * made.min_ttc - low - high) / (high - low)
    off = low - made.min_ttc if made.min_ttc < low else min(made.min_ttc - high, MOST_TTC)
    far = weights.miss_by_gap * min(made.gap, MOST_GAP) if made.min_ttc > high else 0.0
    return weights.miss + weights.miss_by_ttc * off + far
