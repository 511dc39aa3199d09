"""A run as the records of its encounters: which one counts, and what the run says of itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from bench_rows_samples import LIBRARY, attempt, everywhere
from situation_samples import neighbour, situation

from sumo_adv.asked import Asked, Event
from sumo_adv.config import load_settings
from sumo_adv.datatypes import Ending, Intent, Level, Proposal
from sumo_adv.episode.neighbours import Robustness
from sumo_adv.episode.run import EncounterRecord, Request, Run, Stop, best_record, seconds_by_part
from sumo_adv.episode.task import FoundEncounter, make_task
from sumo_adv.simulation.inputs import load_input

PLAN = Proposal("bv", "Aggressive Cut-in", LIBRARY[1].planners[0], {}, "accelerate", 0.0)
EXHAUSTED = Ending.ATTEMPTS_EXHAUSTED
NONE_LEFT = Stop(Ending.NO_ENCOUNTER, "The search ended at 300 s.")


def found(time: float) -> FoundEncounter:
    """An encounter with one neighbour."""
    here = situation([neighbour()])
    return FoundEncounter("ego", time, (), {0.0: here}, (), (), everywhere(), {}, (0.0, 0.0, 9.0))


def record(time: float, *min_ttc: float, **changes: Any) -> EncounterRecord:
    """An encounter at ``time`` [s] that was attacked, with an attempt for each minimum TTC [s]; none succeeded."""
    attempts = [attempt(PLAN, k, min_ttc=ttc) for k, ttc in enumerate(min_ttc)]
    made = EncounterRecord(found(time), attacked=True, attempts=attempts, ending=EXHAUSTED, reason=f"At {time:g} s.")
    return replace(made, **changes)


def passed(time: float) -> EncounterRecord:
    """An encounter that was passed over."""
    return EncounterRecord(found(time), left="no intent reaches the ego, by prediction", ending=Ending.NO_ENCOUNTER)


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """A run without an encounter so far."""
    run_input, settings = load_input(Path("motorway_cut_in_left")), load_settings(None)
    return Run(run_input, settings, make_task(run_input, settings, tmp_path))


# -- the record that counts


def test_the_record_with_the_nearest_attempt_counts_and_the_first_of_equals() -> None:
    near, far = record(10.0, 4.0, 1.5), record(20.0, 2.0)
    assert best_record([far, near]) is near
    assert best_record([near, replace(near, found=found(30.0))]) is near
    assert best_record([record(5.0), far]) is far  # an encounter without an attempt comes last
    assert best_record([]) is None


def test_a_success_comes_before_a_nearer_attempt() -> None:
    """A near miss of 1.2 s was asked for, and a later encounter gave it; an earlier one came to 0.3 s."""
    assert best_record([record(10.0, 0.3), wanted := record(20.0, 1.2, ending=Ending.GOAL_MET)]) is wanted


def test_what_was_passed_over_does_not_count() -> None:
    assert best_record([passed(10.0), passed(20.0)]) is None
    assert best_record([passed(10.0), last := record(20.0)]) is last


def test_a_run_writes_the_request_of_the_record_that_counts(run: Run) -> None:
    """The words meant a turn in the first encounter, a stop in the second; the first one gave the better attempt."""
    turn, stop = (Request(Asked(events=[event]), "As I said.") for event in (Event.TURNS_LEFT, Event.STOPS))
    first, second = record(10.0, 1.0, request=turn), record(20.0, 3.0, request=stop)
    two = replace(run, records=(passed(5.0), first, second), stop=NONE_LEFT)
    assert two.best is first and two.request is turn
    assert two.encounters_before(first) == 1
    assert (two.ending, two.reason) == (EXHAUSTED, "At 10 s.")


def test_without_a_record_that_counts_the_run_ends_as_its_search_did(run: Run) -> None:
    none = replace(run, records=(passed(5.0), passed(9.0)), stop=NONE_LEFT)
    assert (none.ending, none.reason) == (Ending.NO_ENCOUNTER, "The search ended at 300 s.")
    assert none.encounters_before(none.best) == 2


def test_what_breaks_a_run_off_is_its_ending_and_no_attempt_is_lost(run: Run) -> None:
    interrupted = Stop(Ending.INTERRUPTED, "Ctrl-C.", failed=True)
    broken = replace(run, records=(record(10.0, 1.0), record(20.0)), stop=interrupted)
    assert broken.best is broken.records[0]
    assert (broken.ending, broken.reason) == (Ending.INTERRUPTED, "Ctrl-C.")


def test_a_run_was_declined_if_nothing_was_tried_and_a_request_could_not_be_played(run: Run) -> None:
    no = replace(passed(10.0), request=Request(Asked(), "Fly.", "Vehicles do not fly."))
    assert replace(run, records=(no,)).declined
    assert not replace(run, records=(no, record(20.0, 3.0))).declined


# -- the attempt that counts


def test_of_equal_successes_the_most_robust_one_counts() -> None:
    level = {"level": Level.SERIOUS, "collided": True, "min_ttc": 0.0}
    attempts = [attempt(PLAN, k, **level) for k in range(3)]
    made = record(10.0, attempts=attempts, robust={0: Robustness(1, 6), 1: Robustness(5, 6), 2: Robustness(5, 6)})
    assert made.best is attempts[1] and made.robustness == Robustness(5, 6)
    other = made.of_attempt(2)
    assert other.best is attempts[2] and made.best is attempts[1]


def test_the_intent_is_that_of_the_attempt_that_counts() -> None:
    """The analyzer ranked a braking vehicle first; the cut-in with full acceleration came nearest."""
    brake = Intent("bv", "Emergency Braking", "It brakes.", "high", "brake")
    cut_in = Intent("other", "Aggressive Cut-in", "It cuts in.", "low", "keep")
    made = record(10.0, 2.0, intents=(brake, cut_in), known_labels=frozenset({"Emergency Braking"}))
    assert made.intent == replace(cut_in, bv="bv", acceleration="accelerate", source="generated")
    assert record(10.0, intents=(brake, cut_in)).intent is brake
    assert replace(made, attacked=False).intent is None


def test_times_of_a_part_are_added() -> None:
    took = record(10.0).took({"seek": 1.0}).took({"seek": 0.5, "attempts": 4.0})
    assert took.timing == {"seek": 1.5, "attempts": 4.0}
    assert seconds_by_part({"start": 2.0}, took.timing, {"seek": 1.0}) == {"start": 2.0, "seek": 2.5, "attempts": 4.0}
