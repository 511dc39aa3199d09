"""The benchmark's opponents over the library, and what the oracle's cell says is the most dangerous intent."""

from __future__ import annotations

from collections import Counter

import pytest
from bench_rows_samples import LIBRARY, encounter, first_proposals
from situation_samples import leader, neighbour

from sumo_adv.app import shipped_bank
from sumo_adv.benchmark.rows import (
    BEHAVIOUR_LABELS,
    MAX_ORACLE_SIMULATIONS,
    Oracle,
    RandomIntent,
    make_row,
    oracle_labels,
    split_half,
)
from sumo_adv.errors import UsageError
from sumo_adv.memory.bank import MemoryBank

BOUNDS = (-3.0, 4.0)  # of the only number of the samples' planners


# -- random intent


def test_random_draws_every_family_about_as_often_and_numbers_within_bounds() -> None:
    row = RandomIntent()
    row.begin(encounter([neighbour()], delays=(0.0, 1.5)))
    plans = first_proposals(row, 600)
    often = Counter((p.delay, p.label, p.planner.mode) for p in plans)
    # A neighbour: lane shift in two modes and cut-in in one, at two moments: 6 templates, 100 draws each; 4 sigma = 36.
    assert len(often) == 6
    assert all(64 <= n <= 136 for n in often.values())
    gaps = [p.parameters["gap"] for p in plans]
    assert all(BOUNDS[0] <= g <= BOUNDS[1] for g in gaps)
    assert abs(sum(gaps) / len(gaps) - 0.5) < 0.35  # uniform: mean 0.5, 4 sigma of 600 = 0.33
    assert {p.by for p in plans} == {"random"}


def test_random_is_the_same_for_a_seed_and_another_for_another() -> None:
    def drawn(seed: int) -> list[object]:
        row = RandomIntent()
        row.begin(encounter([neighbour()], seed=seed))
        return [(p.label, p.planner.mode, p.parameters["gap"]) for p in first_proposals(row, 10)]

    assert drawn(3) == drawn(3) != drawn(4)


def test_where_nothing_applies_nothing_is_proposed() -> None:
    for row in (RandomIntent(), Oracle()):
        row.begin(encounter([neighbour()], library=[e for e in LIBRARY if e.label == "Emergency Braking"]))
        assert row.propose([]) is None


def test_the_labels_are_those_of_the_shipped_library() -> None:
    with MemoryBank.open(shipped_bank(), read_only=True) as bank:
        assert sorted(r.label for r in bank.intents() if r.status == "active") == sorted(BEHAVIOUR_LABELS)


# -- oracle


def test_the_oracle_drives_every_family_first_and_then_evens_the_labels_out() -> None:
    row = Oracle()
    row.begin(encounter([leader()], delays=(0.0, 1.5, 3.0)))
    plans = first_proposals(row, 1000)
    assert (len(plans), row.exhaustive) == (MAX_ORACLE_SIMULATIONS, True)
    # Lane shift has 2 modes x 3 delays, braking 1 x 3.
    first = Counter((p.label, p.planner.mode, p.delay) for p in plans[:9])
    assert len(first) == 9
    assert [p.parameters["gap"] for p in plans[:9]] == [2.0] * 9
    assert Counter(p.label for p in plans) == {"Straight Lane Shift": 30, "Emergency Braking": 30}
    braking = Counter(p.acceleration for p in plans if p.label == "Emergency Braking")
    assert braking == {-8.0: 10, -6.5: 10, -5.0: 10}


def candidate(intent: str, collided: bool, min_ttc: float | None, *, valid: bool = False, **changed: bool) -> dict:
    return {
        "intent": intent, "collided": collided, "feasible": True, "rear_end": False, "min_ttc": min_ttc,
        "valid": valid if collided else None, **changed,
    }  # fmt: skip


def cell(*candidates: dict) -> dict:
    return {"attempts": list(candidates)}


HIT, MISS = (True, 0.0), (False, 4.0)


def test_the_label_is_the_share_of_collisions_that_count() -> None:
    labels = oracle_labels(
        cell(
            candidate("A", *HIT, valid=True), candidate("A", *MISS),  # 1/2 collide, 1/2 valid
            candidate("B", *HIT), candidate("B", *HIT), candidate("B", *MISS),  # 2/3 collide, none valid
            candidate("C", *HIT, feasible=False), candidate("C", *HIT, rear_end=True),  # none of them counts
        )
    )  # fmt: skip
    assert labels == {"collision": ("B",), "valid": ("A",)}


def test_equal_shares_are_told_apart_by_mean_ttc_and_else_are_a_tie() -> None:
    near = [candidate("A", False, 1.0), candidate("A", False, 3.0)]  # mean 2
    same = [candidate("B", False, 1.9), candidate("B", False, 2.4)]  # mean 2.15: within 0.2 s
    far = [candidate("C", False, 1.0), candidate("C", False, None)]  # mean (1 + 10) / 2
    never = [candidate("D", True, 0.0, feasible=False)]  # counts as 10 s
    assert oracle_labels(cell(*near, *same, *far, *never))["collision"] == ("A", "B")
    assert oracle_labels(cell()) == {"collision": (), "valid": ()}


def test_shares_that_differ_by_little_are_not_told_apart() -> None:
    def row(label: str, hits: int, ttc: float) -> list[dict]:
        return [candidate(label, *HIT) for _ in range(hits)] + [candidate(label, False, ttc) for _ in range(25 - hits)]

    # 10/25 and 9/25 differ by 0.04: by mean TTC then, 15/25 x 4 = 2.4 s against 16/25 x 1 = 0.64 s.
    assert oracle_labels(cell(*row("A", 10, 4.0), *row("B", 9, 1.0)))["collision"] == ("B",)
    assert oracle_labels(cell(*row("A", 10, 4.0), *row("B", 8, 1.0)))["collision"] == ("A",)


def test_halves_agree_where_one_label_always_wins_and_not_where_there_is_only_luck() -> None:
    clear = cell(*[candidate("A", *HIT, valid=True)] * 10, *[candidate("B", *MISS)] * 10)
    assert split_half(clear) == {"collision": 1.0, "valid": 1.0}
    lucky = cell(candidate("A", *HIT), *[candidate("A", *MISS)] * 9, candidate("B", *HIT), *[candidate("B", *MISS)] * 9)
    # Each half holds either label's only hit with 1/2: they agree in no split in which A's and B's go different ways.
    assert 0.0 <= split_half(lucky)["collision"] < 0.9
    assert split_half(cell(*[candidate("A", *HIT)] * 4)) == {"collision": None, "valid": None}


# -- names


def test_rows_are_made_by_name() -> None:
    assert make_row("random").name == "random"
    assert make_row("oracle").name == "oracle"


@pytest.mark.parametrize(("text", "named"), [("expertt", "oracle"), ("cma", "resampling")])
def test_a_name_that_is_unknown_is_answered_with_those_there_are(text: str, named: str) -> None:
    with pytest.raises(UsageError, match=named) as error:
        make_row(text)
    assert str(error.value).count(".") == 1
