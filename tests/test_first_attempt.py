"""The first attempt and the analysis agree, or the run says why not; shares are counts."""

from __future__ import annotations

from dataclasses import replace

import pytest
from cli_samples import Program

from sumo_adv.datatypes import Intent, Level, Planner, Prediction, Proposal
from sumo_adv.goal import Goal
from sumo_adv.search.first_attempt import why_first
from sumo_adv.search.ranking import ranked_intents
from sumo_adv.search.settings import PriceSettings, SearchSettings

PLANNER = Planner("Shift", "side", "", (), "seed")
TOP = Intent("v1", "Shift", "", "high", 0.0)
SERIOUS = Prediction(hit=True, min_ttc=0.0, level=Level.SERIOUS, delta_v=5.0, time=4.0)


def candidate(bv: str, label: str, score: float, made: Prediction, nominal: float | None = None) -> Proposal:
    return Proposal(bv, label, PLANNER, {}, 0.0, 0.0, score=score, prediction=made, nominal=nominal)


def said(first: Proposal, best: Proposal, goal: Goal | None = None) -> str:
    return why_first(first, TOP, [best], lambda p: p.score, goal or Goal(), PriceSettings())


def test_nothing_is_said_where_both_agree() -> None:
    assert said(candidate("v1", "Shift", 0.0, SERIOUS), candidate("v1", "Shift", 0.1, SERIOUS)) == ""


@pytest.mark.parametrize(
    ("first", "best", "says"),
    [
        (candidate("v2", "Brake", 0.0, SERIOUS), candidate("v1", "Shift", 0.6, replace(SERIOUS, level=Level.VALID)),
         "Attempt 1 tries Brake by v2: it is predicted to reach serious, Shift only valid."),
        (candidate("v2", "Shift", 0.0, SERIOUS), candidate("v1", "Shift", 2.0, Prediction(min_ttc=1.0)),
         "Attempt 1 tries Shift by v2: it is predicted to reach serious, that by v1 no collision that counts."),
        (candidate("v2", "Brake", 0.0, SERIOUS, 0.0), candidate("v1", "Shift", 0.5, SERIOUS, 0.0),
         "Attempt 1 tries Brake by v2: its neighbours with slightly different parameters keep the level, those of "
         "Shift do not all."),
        (candidate("v2", "Brake", 0.0, SERIOUS), candidate("v1", "Shift", 0.0, replace(SERIOUS, time=9.0)),
         "Attempt 1 tries Brake by v2: it is predicted to collide after 4.0 s, Shift only after 9.0 s."),
        (candidate("v2", "Brake", 0.3, replace(SERIOUS, level=Level.STRICT, delta_v=2.0)),
         candidate("v1", "Shift", 0.4, replace(SERIOUS, level=Level.STRICT, delta_v=1.0)),
         "Attempt 1 tries Brake by v2: its predicted delta-v is 2.0 m/s, that of Shift 1.0 m/s."),
        (candidate("v2", "Brake", 0.0, SERIOUS), candidate("v1", "Cut", 0.0, SERIOUS),
         "Attempt 1 tries Brake by v2: nothing could be predicted of Shift."),
    ],
)  # fmt: skip
def test_the_reason_is_what_the_first_candidate_does_better(first: Proposal, best: Proposal, says: str) -> None:
    assert said(first, best) == says


def test_a_near_miss_is_compared_by_its_ttc() -> None:
    goal = Goal(Level.CRITICAL, ttc=(0.5, 1.5))
    first, best = (candidate(bv, label, 0.0, Prediction(min_ttc=t)) for bv, label, t in
                   (("v2", "Brake", 1.0), ("v1", "Shift", 1.9)))  # fmt: skip
    assert said(first, best, goal).endswith("its predicted min TTC is 1.00 s, that of Shift 1.90 s.")


def test_one_of_258_is_not_nought_percent() -> None:
    """Of 258 candidates one collides, avoidably."""
    pool = [candidate("v1", "Shift", 2.0, Prediction(min_ttc=3.0)) for _ in range(257)]
    pool.append(candidate("v1", "Shift", 0.1, SERIOUS))
    (intent,), _ = ranked_intents(pool, {"Shift": ""}, lambda p: p.score, SearchSettings(), Goal())
    assert intent.reason == "predicted: 1 of 258 candidates collide, 1 of them avoidably; least TTC 0.00 s"


def test_a_run_says_why_it_begins_with_another_intent(program: Program) -> None:
    """A cut-in by the vehicle ahead has the larger share of collisions, a shift by the one behind the better one."""
    done = program("run", "neighbour_ahead_left", "--until", "valid", "--attempts", "1", "--learn", "off")
    assert done.status == 0, done.err
    lines = done.out.splitlines()
    top = next(line for line in lines if line.startswith("Most dangerous: "))
    reason, attempt = (
        next(line for line in lines if line.startswith(s)) for s in ("  Attempt 1 tries", "  attempt  1")
    )
    assert "left_ahead — Aggressive Cut-in" in top and "left_behind: Straight Lane Shift" in attempt
    assert reason == (
        "  Attempt 1 tries Straight Lane Shift by left_behind: it is predicted to reach strict, Aggressive Cut-in only "
        "valid."
    )
    assert "Result: STRICT after 1 of 1 attempts (criterion: valid)." in lines
