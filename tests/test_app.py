"""Composition: what goes to other processes, and which bank a run opens."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from sumo_adv import app
from sumo_adv.config import load_settings
from sumo_adv.errors import BankError, UsageError


def test_the_functions_for_workers_are_importable_by_name() -> None:
    for parts in (app.batch_parts(), app.bench_parts()):
        assert pickle.loads(pickle.dumps(parts)) == parts


def test_a_run_makes_its_bank_from_the_shipped_one(tmp_path: Path) -> None:
    target = tmp_path / "bank.sqlite"
    with pytest.raises(BankError, match="There is no memory bank"):
        app.open_bank(target)
    with app.open_for_run(load_settings(None, memory=target)) as bank:
        assert len(bank.intents()) == 7
    with app.open_bank(target) as again:
        assert len(again.intents()) == 7


def test_the_engine_of_a_run_serves_the_next_one_unless_it_failed() -> None:
    with app.new_engine() as first, app.new_engine() as beside:
        assert beside is not first
    with app.new_engine() as second:
        assert second is beside  # it was there first; the other one ended with its run
    with pytest.raises(UsageError), app.new_engine() as failed:
        assert failed is beside
        raise UsageError("The run stops here.")
    with app.new_engine() as third:
        assert third is not beside


def test_a_record_can_only_be_chosen_from_a_file_of_records(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--record chooses a record of a TFRecord file"):
        app.load(tmp_path / "network.net.xml", "3")
