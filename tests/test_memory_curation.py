"""Retiring, merging, evidence of failure, what is proposed, and parts of a bank."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from bank_samples import BRAKE_PLANNER, BRAKING, CUT_IN, CUT_PLANNER, evidence

from sumo_adv.datatypes import Planner
from sumo_adv.errors import BankError
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.build import write_part
from sumo_adv.memory.curate import hopeless, near_duplicates, planner_counts, statistics
from sumo_adv.memory.records import IntentRecord

HARD_STOP = IntentRecord("Hard Stop", "The vehicle in front of the ego brakes hard.", ("leader",))
STOP_PLANNER = Planner(HARD_STOP.label, "plain", "# another text\n", (), "some-model")
LATE = replace(BRAKE_PLANNER, mode="late", text="# late\n")
FAILED = {"critical": False, "collided": False, "valid": None, "strict": None, "min_ttc": 4.0}


def test_a_retired_mode_is_kept_but_not_driven_and_with_the_last_one_the_intent_goes(tmp_path: Path) -> None:
    path = tmp_path / "bank.sqlite"
    with MemoryBank.open(path) as bank:
        bank.add(BRAKING, [BRAKE_PLANNER, LATE])
        bank.record(evidence())
        bank.retire("emergency braking", "plain")
        assert bank.planners("Emergency Braking") == [LATE]
        assert bank.retrieve("Emergency Braking").hit == "Emergency Braking"
        bank.retire("Emergency Braking", "late")
        assert bank.retrieve("Emergency Braking").hit is None
    with MemoryBank.open(path) as bank:
        assert (statistics(bank)["active"], statistics(bank)["planners"], len(bank.evidence())) == (0, 2, 1)
        with pytest.raises(BankError, match="no active planner"):
            bank.retire("Emergency Braking", back=True)
        bank.retire("Emergency Braking", "plain", back=True)
        assert bank.planners("Emergency Braking") == [BRAKE_PLANNER]
        assert bank.retrieve("Emergency Braking").hit == "Emergency Braking"
        with pytest.raises(BankError, match="no planner of the mode 'fast'; its modes: late, plain"):
            bank.retire("Emergency Braking", "fast")
        with pytest.raises(BankError, match="no intent 'Flying'"):
            bank.retire("Flying")


def test_merging_moves_planners_and_evidence_and_the_old_label_finds_the_other(tmp_path: Path) -> None:
    path = tmp_path / "bank.sqlite"
    with MemoryBank.open(path) as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
        bank.add(HARD_STOP, [STOP_PLANNER, replace(BRAKE_PLANNER, label=HARD_STOP.label, mode="same text")])
        bank.record(evidence())
        bank.record(evidence(label=HARD_STOP.label, planner_hash=STOP_PLANNER.hash, seed=1))
        bank.record(evidence(label=HARD_STOP.label, seed=2))
        bank.merge("hard-stop", BRAKING.label)
        moved = replace(STOP_PLANNER, label=BRAKING.label, mode="plain-2")
        assert bank.planners(BRAKING.label) == [BRAKE_PLANNER, moved]
        assert sorted(e.seed for e in bank.evidence(BRAKING.label)) == [1, 2, 7]
        assert bank.evidence(HARD_STOP.label) == []
        recalled = bank.retrieve("Hard Stop", "xylophone")
        assert (recalled.hit, recalled.distance) == (BRAKING.label, 0.0)
        assert [label for label, _ in recalled.nearest] == [BRAKING.label]
    with MemoryBank.open(path) as bank:  # a bank without the merger does not bring the old intent back
        bank.record(evidence(label=HARD_STOP.label, planner_hash=LATE.hash, seed=3), intent=HARD_STOP, planner=LATE)
        assert bank.intent(HARD_STOP.label) == replace(HARD_STOP, status="retired")
        assert [planner.mode for planner in bank.planners(BRAKING.label)] == ["late", "plain", "plain-2"]
        assert len(bank.evidence(BRAKING.label)) == 4
        for label, into, sentence in (
            (BRAKING.label, "hard stop", "is retired; merge into an active one"),
            (BRAKING.label, "emergency BRAKING", "the same intent"),
            ("Flying", BRAKING.label, "no intent 'Flying'"),
        ):
            with pytest.raises(BankError, match=sentence):
                bank.merge(label, into)
        with pytest.raises(BankError, match="is merged into 'Emergency Braking'"):
            bank.retire(HARD_STOP.label, back=True)


def test_a_writer_that_opened_before_a_merger_writes_to_the_right_intent(tmp_path: Path) -> None:
    path = tmp_path / "bank.sqlite"
    with MemoryBank.open(path) as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
        bank.add(HARD_STOP, [STOP_PLANNER])
    with MemoryBank.open(path) as early, MemoryBank.open(path) as merging:
        merging.merge(HARD_STOP.label, BRAKING.label)
        early.record(evidence(label=HARD_STOP.label, planner_hash=STOP_PLANNER.hash))
        merging.refresh()
        assert [e.label for e in merging.evidence()] == [BRAKING.label]


def test_what_only_failed_begins_as_retired_and_success_brings_it_in(tmp_path: Path) -> None:
    path = tmp_path / "bank.sqlite"
    novel = {"label": HARD_STOP.label, "planner_hash": STOP_PLANNER.hash}
    with MemoryBank.open(path) as bank:
        bank.record(evidence(**novel, **FAILED), intent=HARD_STOP, planner=STOP_PLANNER)
        assert bank.planners(HARD_STOP.label) == []
        assert bank.retrieve("Hard Stop").hit is None
        counts = statistics(bank)["by_label"]["Hard Stop"]
        assert (counts["evidence"], counts["successes"], counts["failures"]) == (1, 0, 1)
    with MemoryBank.open(path) as bank:
        assert bank.planners(HARD_STOP.label) == []
        bank.record(evidence(**novel, seed=8), intent=HARD_STOP, planner=STOP_PLANNER)
        assert bank.planners(HARD_STOP.label) == [STOP_PLANNER]
        assert bank.retrieve("Hard Stop").hit == "Hard Stop"
        bank.record(evidence(**novel, **FAILED, seed=9))
        assert bank.planners(HARD_STOP.label) == [STOP_PLANNER]
        assert [(c.successes, c.failures) for c in planner_counts(bank)] == [(1, 2)]


def test_duplicates_and_the_hopeless_are_proposed_and_nothing_is_changed(tmp_path: Path) -> None:
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
        bank.add(CUT_IN, [CUT_PLANNER])
        assert near_duplicates(bank) == []
        bank.add(HARD_STOP, [STOP_PLANNER])
        bank.add(replace(HARD_STOP, label="Hard Stop Behind", applies=("follower",)), [LATE])
        bank.add(IntentRecord("Copied", "Something with a zebra.", ("oncoming",)), [replace(CUT_PLANNER, mode="m")])
        before = bank.content_hash()
        proposed = [(p.label, p.into) for p in near_duplicates(bank)]
        assert proposed == [("Copied", "Aggressive Cut-in"), ("Hard Stop", "Emergency Braking")]
        for seed in range(3):
            bank.record(evidence(**FAILED, seed=seed))
        assert [(p.label, p.failures) for p in hopeless(bank, 3)] == [("Emergency Braking", 3)]
        assert hopeless(bank, 4) == []
        bank.record(evidence(seed=4))
        assert hopeless(bank, 3) == []
        assert before != bank.content_hash()
        assert statistics(bank)["active"] == 5


def test_the_band_around_epsilon(tmp_path: Path) -> None:
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        bank.add(BRAKING, [BRAKE_PLANNER])
        distance = bank.retrieve("sudden stop in front", "of the zebra").distance
        assert 0.0 < distance < 1.0
        # |d - eps| <= eps / 10: eps from d / 1.1 to d / 0.9
        for factor, hit, band in ((1 / 1.12, False, False), (1 / 1.09, False, True), (1 / 0.91, True, True),
                                  (1 / 0.88, True, False)):  # fmt: skip
            bank.set_epsilon(distance * factor, "by hand")
            recalled = bank.retrieve("sudden stop in front", "of the zebra")
            assert (recalled.hit is not None, recalled.band) == (hit, band)


def test_a_part_of_a_bank(tmp_path: Path) -> None:
    with MemoryBank.open(tmp_path / "bank.sqlite") as bank:
        bank.add(BRAKING, [BRAKE_PLANNER, LATE])
        bank.add(CUT_IN, [CUT_PLANNER])
        bank.record(evidence())
        bank.retire(BRAKING.label, "late")
        bank.set_epsilon(0.5, "by hand")
        with pytest.raises(BankError, match="no intent 'Flying'"):
            write_part(bank, tmp_path / "part.sqlite", ["Flying", CUT_IN.label], lambda: "now")
        assert write_part(bank, tmp_path / "part.sqlite", ["emergency braking"], lambda: "now") == [BRAKING.label]
        with pytest.raises(BankError, match="exists"):
            write_part(bank, tmp_path / "part.sqlite", [CUT_IN.label], lambda: "now")
        whole = bank.stored_intents()
    with MemoryBank.open(tmp_path / "part.sqlite") as part:
        assert part.stored_intents() == [source for source in whole if source.intent == BRAKING]
        assert part.epsilon() == (0.5, "by hand")
    assert {file.name for file in tmp_path.iterdir()} == {"bank.sqlite", "part.sqlite"}
