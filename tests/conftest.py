"""The program as a user has it: a process of its own in a folder of its own, with an unused home."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from cli_samples import ROOT, Program, Runs
from hypothesis import settings

from sumo_adv.errors import SimulationError
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.simulation.programs import load_libsumo

settings.register_profile("patient", deadline=None)  # a busy machine fails no test
settings.load_profile("patient")


def pytest_sessionstart() -> None:
    """Where SUMO does not load, the program's own sentence, once, instead of a traceback or a thousand failures."""
    try:
        load_libsumo()
    except SimulationError as error:
        raise pytest.UsageError(str(error)) from error


@pytest.fixture(scope="session")
def caches() -> Iterator[Path]:
    """What matplotlib keeps for a user; shared, because building it takes a second."""
    folder = Path(tempfile.mkdtemp(prefix="sumo_adv-tests-"))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def program(tmp_path: Path, caches: Path) -> Program:
    """The program in an empty folder."""
    return Program(tmp_path, caches)


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> Runs:
    """The runs of ``cli_samples``, each done once for all tests of all workers of pytest-xdist."""
    base = tmp_path_factory.getbasetemp()
    return Runs((base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "runs", caches)


@pytest.fixture(scope="session")
def sandbox() -> Iterator[Sandbox]:
    """A sandbox with its usual limits, started once."""
    with Sandbox() as opened:
        yield opened


@pytest.fixture(scope="session")
def networks() -> Path:
    """The shipped networks."""
    return ROOT / "networks"
