"""What an encounter shows of an unknown driver stays in the bank; a frozen one is not changed."""

from __future__ import annotations

from pathlib import Path

from sumo_adv.app import shipped_bank
from sumo_adv.benchmark.unknown import CarefulAsUnknown
from sumo_adv.drivers import make_ego
from sumo_adv.episode.memory_access import weights_of_driver
from sumo_adv.memory.bank import MemoryBank

NAME = f"{CarefulAsUnknown.__module__}:{CarefulAsUnknown.__name__}"


def test_weights_of_another_kind_of_setting_are_nothing(tmp_path: Path) -> None:
    file = tmp_path / "bank.sqlite"
    file.write_bytes(shipped_bank().read_bytes())
    with MemoryBank.open(file) as bank:
        assert weights_of_driver(bank, NAME) == {}
        bank.keep(f"driver.{NAME}", {"swerves": 0.75, "foresight": 0.25, "odd": "text", "large": 7})
        assert weights_of_driver(bank, NAME) == {"swerves": 0.75, "foresight": 0.25}
        bank.keep(f"driver.{NAME}", [1, 2])
        assert weights_of_driver(bank, NAME) == {}
    with MemoryBank.open(file, read_only=True) as bank:
        assert bank.settings("driver.") == {f"driver.{NAME}": [1, 2]}


def test_a_driver_as_unknown_drives_as_the_driver_does_and_has_no_model() -> None:
    ego = make_ego(NAME, {})
    assert ego.name == "careful as unknown" and ego.forkable
    assert dict(ego.sumo_type) == dict(make_ego("careful", {}).sumo_type)
    assert not hasattr(CarefulAsUnknown, "model_of")
