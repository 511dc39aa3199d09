"""The coverage of a campaign: which cells there are, what counts as an encounter and as a failure in one."""

from __future__ import annotations

import csv
import io
from typing import Any

import pytest
from page_samples import attempt, outcome

from sumo_adv.config_odd import Odd
from sumo_adv.datatypes import RoadClass
from sumo_adv.memory.records import IntentRecord
from sumo_adv.report.coverage import ALL_EGOS, CoverageCell, band_of, cells_of, coverage_csv, make_coverage, pairs_of

CUT_IN = IntentRecord("Cut-in", "It cuts in.", ("neighbour", "leader"))
CUT_IN_BESIDE = IntentRecord("Cut-in", "It cuts in.", ("neighbour",))
TURN = IntentRecord("Turn", "It turns.", ("crossing_left", "crossing_right"))
SEEN = CoverageCell("Cut-in", "neighbour", "motorway", 3)


def met(*attempts: tuple[str, str], ego: str = "idm", road: str | None = "motorway", speed: float = 25.0) -> Any:
    """An episode with attempts of these intents and levels by a vehicle beside the ego."""
    listed = [attempt(k, "a", intent=intent, level=level) for k, (intent, level) in enumerate(attempts)]
    episode = outcome(attempts=listed)
    episode["ego"]["controller"] = ego
    episode["encounter"] |= {"road": road, "ego_speed": speed}
    return episode


def counts(documents: list[Any], ego: str = ALL_EGOS) -> dict[CoverageCell, tuple[int, int]]:
    """Encounters and failures of the cells that have any."""
    rows = make_coverage(documents, [CUT_IN]).rows[ego]
    return {row.cell: (row.encounters, row.failures) for row in rows if row.encounters}


@pytest.mark.parametrize(("speed", "band"), [(0.0, 0), (7.99, 0), (8.0, 1), (21.9, 2), (22.0, 3), (60.0, 3)])
def test_the_band_of_a_speed(speed: float, band: int) -> None:
    assert band_of(speed) == band


def test_an_encounter_counts_once_in_a_cell_and_fails_by_its_best_attempt() -> None:
    episode = met(("Cut-in", "collision"), ("Cut-in", "valid"), ("Brake", "critical"))
    assert cells_of(episode) == {SEEN: True, CoverageCell("Brake", "neighbour", "motorway", 3): False}


def test_what_was_met_is_counted_for_all_egos_and_for_each() -> None:
    documents = [met(("Cut-in", "serious")), met(("Cut-in", "collision")), met(("Cut-in", "none"), ego="careful")]
    assert counts(documents) == {SEEN: (3, 1)}
    assert counts(documents, "idm") == {SEEN: (2, 1)} and counts(documents, "careful") == {SEEN: (1, 0)}


def test_an_episode_without_an_attempt_or_a_place_is_in_no_cell() -> None:
    nothing = outcome(attempts=[], encounter=None, best=None)
    covered = make_coverage([nothing, met(("Cut-in", "valid"), road=None), met(("Cut-in", "valid"))], [CUT_IN])
    assert covered.unplaced == 2 and covered.covered()[0] == 1


def test_cells_are_what_the_bank_can_try_and_empty_ones_come_first() -> None:
    assert pairs_of([CUT_IN, TURN]) == {("Cut-in", "neighbour"), ("Cut-in", "leader"), ("Turn", "crossing")}
    covered = make_coverage([met(("Cut-in", "valid")), met(("Cut-in", "none"))], [CUT_IN, TURN])
    assert covered.covered() == (1, 3 * 4 * 4)  # pairs x road classes x speed bands
    rows = covered.rows[ALL_EGOS]
    assert rows[0].encounters == 0 and rows[-1].cell == SEEN
    # Wilson's interval of one of two: centre 0.5, half width 1.96 sqrt(1/8 + 1.96^2/16) / (1 + 1.96^2/2) = 0.4054
    assert (rows[-1].rate.low, rows[-1].rate.high) == pytest.approx((0.0945, 0.9055), abs=1e-4)
    assert (rows[0].rate.low, rows[0].rate.high) == (0.0, 1.0)


def test_an_intent_that_is_retired_makes_no_cells() -> None:
    assert pairs_of([IntentRecord("Old", "It was.", ("leader",), "retired")]) == set()


def test_pedestrians_and_cyclists_have_cells_of_the_relations_that_encounters_give_them() -> None:
    child = IntentRecord("Child", "It runs out.", ("pedestrian", "pedestrian_hidden"))
    rider = IntentRecord("Rider", "It rides on.", ("cyclist_straight",))
    assert pairs_of([child, rider]) == {("Child", "crossing"), ("Rider", "crossing"), ("Rider", "oncoming")}


def test_no_vehicle_is_oncoming_on_a_motorway() -> None:
    covered = make_coverage([], [IntentRecord("Intrude", "It intrudes.", ("oncoming",))])
    assert {row.cell.road for row in covered.rows[ALL_EGOS]} == {"rural", "urban", "junction"}


def test_an_odd_limits_the_cells_but_hides_none_that_was_met() -> None:
    odd = Odd(roads=(RoadClass.URBAN,), relations=("leader",), speed=(0.0, 13.0))
    covered = make_coverage([met(("Cut-in", "valid"))], [CUT_IN], [odd])
    assert {(row.cell.relation, row.cell.road, row.cell.band) for row in covered.rows[ALL_EGOS]} == {
        ("leader", "urban", 0), ("leader", "urban", 1), ("neighbour", "motorway", 3),
    }  # fmt: skip


def test_the_table_as_csv() -> None:
    text = coverage_csv(make_coverage([met(("Cut-in", "valid"))], [CUT_IN]))
    rows = list(csv.DictReader(io.StringIO(text)))
    last = [row for row in rows if row["ego"] == ALL_EGOS][-1]
    assert (last["intent"], last["relation"], last["road"]) == ("Cut-in", "neighbour", "motorway")
    assert (last["speed_from"], last["speed_to"], last["encounters"], last["failures"]) == ("22", "", "1", "1")
    assert (last["rate"], last["low"], last["high"]) == ("1.0000", "0.2065", "1.0000")  # 1 / (1 + 1.96^2)
    assert (rows[0]["encounters"], rows[0]["rate"], rows[0]["high"]) == ("0", "", "1.0000")
