"""Order attempts by their quality.

The search compares attempts by a finer number (``search/evolution.py:badness``), which also rates how near a miss was.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sumo_adv.datatypes import Attempt, Level, Verdict
from sumo_adv.episode.neighbours import Robustness
from sumo_adv.goal import Goal

FEASIBLE_MISS, INFEASIBLE_COLLISION, INFEASIBLE_MISS = 4.0, 5.0, 6.0  # after feasible collisions, which have 0 to 3


def rank(verdict: Verdict) -> tuple[float, float]:
    """Return a key that sorts attempts, the best first.

    Feasible collisions come first, by level. Then come feasible attempts by minimum TTC, and then infeasible attempts,
    collisions first. A rear-end counts as infeasible.

    Args:
        verdict: The verdict on an attempt.
    """
    if verdict.collided:
        return (float(Level.SERIOUS - verdict.level), 0.0) if verdict.counts else (INFEASIBLE_COLLISION, 0.0)
    return (FEASIBLE_MISS if verdict.counts else INFEASIBLE_MISS, verdict.min_ttc)


def worth(attempt: Attempt, goal: Goal, *, asked: bool) -> tuple[float, ...]:
    """Return a key that sorts attempts, the best first: successes, then attempts that fit the request.

    Args:
        attempt: The attempt.
        goal: What an attempt must reach.
        asked: Whether an attack was requested. Then an attempt fits only if it meets the goal or is at least critical.
    """
    verdict = attempt.verdict
    met = goal.met(verdict)
    fits = not verdict.misfits and (not asked or met or verdict.level >= Level.CRITICAL)
    return (not met, not fits, *rank(verdict))


def best_index(attempts: Sequence[Attempt], goal: Goal, robust: Mapping[int, Robustness], *, asked: bool) -> int | None:
    """Return the index of the best attempt; of equals, the most robust one, then the first one.

    Args:
        attempts: The attempts.
        goal: What an attempt must reach.
        robust: By index of an attempt, in how many of its neighbours it holds.
        asked: Whether an attack was requested.

    Returns:
        The index; None without attempts.
    """
    if not attempts:
        return None

    def order(k: int) -> tuple[float, ...]:
        seen = robust.get(k)
        share = 0.0 if seen is None or not seen.of else seen.held / seen.of
        return (*worth(attempts[k], goal, asked=asked), -share, k)

    return min(range(len(attempts)), key=order)
