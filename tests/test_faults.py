"""What a run says when something breaks unexpectedly: memory that ran out is not a fault of ours."""

from __future__ import annotations

import errno
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from engine_samples import Errands

from sumo_adv import app
from sumo_adv.config import Settings
from sumo_adv.datatypes import Ending
from sumo_adv.errors import OUT_OF_MEMORY, SimulationError, fault_sentence
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import load_input

SHORT_OF_MEMORY = [MemoryError(), OSError(errno.ENOMEM, "Cannot allocate memory")]


@pytest.fixture
def engine() -> Iterator[Engine[Errands]]:
    with Engine(Errands) as made:
        yield made


@pytest.mark.parametrize("method", [Errands.hoard, Errands.hoard_in_forks])
def test_an_engine_without_memory_says_so(engine: Engine[Errands], method: Callable[[Errands], object]) -> None:
    with pytest.raises(SimulationError, match="Memory ran out"):
        engine.call(method)
    assert engine.call(Errands.add, 1, 2) == 3


@pytest.mark.parametrize("error", [*SHORT_OF_MEMORY, ZeroDivisionError("one by none")])
def test_an_episode_ends_with_the_sentence(tmp_path: Path, error: Exception) -> None:
    """A listener of an episode runs within it."""

    def tell(kind: str, value: Any) -> None:
        raise error

    settings = Settings(memory=tmp_path / "bank.sqlite")
    episode = app.play(load_input(Path("leader_two_lanes")), settings, tmp_path, tmp_path, tell)
    assert episode.ending is Ending.SIMULATION_FAILED
    assert ("please report it" in episode.reason) == isinstance(error, ZeroDivisionError)
    assert (episode.reason == OUT_OF_MEMORY) != isinstance(error, ZeroDivisionError)


def test_an_error_that_came_of_missing_memory_is_told_from_one_of_ours() -> None:
    later = KeyError("nothing there")
    later.__cause__ = MemoryError()
    assert fault_sentence(later) == OUT_OF_MEMORY
    assert fault_sentence(KeyError("x")) == "A fault of sumo_adv itself (KeyError: 'x'); please report it."
