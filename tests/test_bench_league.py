"""The league of drivers: attempts until valid, pairs on the same encounters, known and unknown ones apart."""

import pytest
from bench_cells import Cell, attempt, cell

from sumo_adv.benchmark.league import WARNING, league, to_markdown

MISS, VALID = attempt(min_ttc=3.0, predicted_level="strict"), attempt(valid=True, predicted_level="valid")
UNCALLED = attempt(min_ttc=3.0, predicted_level="collision")


def cells(ego: str, driver_known: bool, *tries: int | None) -> list[Cell]:
    """Encounters in which the given attempt was the first valid one; None: three attempts missed."""
    tried = [[MISS] * 3 if k is None else [MISS] * (k - 1) + [VALID] for k in tries]
    return [cell(f"straight-{i}", "expert", *a, ego=ego, driver_known=driver_known) for i, a in enumerate(tried)]


def test_the_driver_that_takes_more_attempts_stands_first_and_a_failure_counts_as_one_more_than_the_budget() -> None:
    places, duels = league([*cells("soft", True, 1, 1, 2), *cells("hard", True, 2, None, None)], budget=3)
    assert [(p.ego, p.attempts.value) for p in places] == [
        ("hard", pytest.approx(10 / 3)),
        ("soft", pytest.approx(4 / 3)),
    ]
    (duel,) = duels
    assert (duel.more, duel.fewer) == ("hard", "soft")
    assert duel.attempts.difference == pytest.approx(2.0)  # 1, 3 and 2 more
    assert duel.valid.difference == pytest.approx(-2 / 3)
    assert (places[0].called, places[0].right) == (8, pytest.approx(1 / 8))  # called valid: 1 + 1, 3 and 3


def test_an_attempt_that_was_predicted_to_be_a_collision_only_was_not_called_valid() -> None:
    (place,), _ = league([cell("straight-0", "expert", UNCALLED, VALID, ego="soft", driver_known=True)], budget=3)
    assert (place.called, place.right) == (1, 1.0)


def test_known_and_unknown_drivers_are_no_pair_and_a_warning_says_why() -> None:
    nothing = cell("straight-9", "expert", ego="ours", driver_known=None)  # no encounter
    places, duels = league([*cells("ours", True, 1), nothing, *cells("yours", False, 3)], budget=3)
    assert [(p.ego, p.known) for p in places] == [("ours", True), ("yours", False)] and not duels
    assert WARNING in to_markdown(places, duels, "Made")
    assert WARNING not in to_markdown(places[:1], duels, "Made")
