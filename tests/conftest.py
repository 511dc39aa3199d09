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


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """With pytest-xdist, a file's tests share a worker, and so do all tests that look at ``runs``.

    Each worker has its own fixtures, so a module's or a session's runs would otherwise be done once per worker.
    """
    if config.pluginmanager.hasplugin("xdist"):
        for item in items:
            group = "runs" if "runs" in getattr(item, "fixturenames", ()) else item.path.stem
            item.add_marker(pytest.mark.xdist_group(group))


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
def runs(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> Iterator[Runs]:
    """The runs of ``cli_samples``, each done once for all tests, as many at a time as there are processors."""
    shared = Runs(tmp_path_factory.mktemp("runs"), caches, at_once=min(4, os.cpu_count() or 1))
    yield shared
    shared.close()


@pytest.fixture(scope="session")
def sandbox() -> Iterator[Sandbox]:
    """A sandbox with its usual limits, started once."""
    with Sandbox() as opened:
        yield opened


@pytest.fixture(scope="session")
def networks() -> Path:
    """The shipped networks."""
    return ROOT / "networks"
