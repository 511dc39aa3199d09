"""What becomes of cells when a worker process dies, hangs, or a row breaks. No SUMO: opening an encounter ends it."""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from sumo_adv.benchmark.bench import Bench, read_cells
from sumo_adv.benchmark.jobs import BenchJob, BenchParts, BenchSetup, cell_path
from sumo_adv.benchmark.nouns import SuiteCase
from sumo_adv.benchmark.worker import note_of, noted
from sumo_adv.errors import UsageError
from sumo_adv.llm.chat import Ledger
from sumo_adv.simulation.inputs import data_folder

CALM = "It cannot be opened."


def load(path: Path, record: str | None) -> Any:
    """Ends as the file's name says; every way that is none is a row that broke by itself."""
    there = {file.stem for file in path.parent.glob(f"cells/idm/{path.stem}/*.json")}
    if path.stem == "killer" or (path.stem == "second" and there == {"raw"}):
        os._exit(9)
    if path.stem == "hangs":
        time.sleep(600)
    if path.stem == "asks":
        ledger, note = (
            Ledger(clock=lambda: 100.0 * time.monotonic()),
            note_of(Path(tempfile.gettempdir()), job(path.parent, "asks", "raw"), "raw"),
        )
        with noted(ledger, note), ledger.waiting():
            time.sleep(5)
    if path.stem == "slow":
        time.sleep(1)
    raise UsageError(CALM)


@contextmanager
def no_agents(*_: Any) -> Iterator[None]:
    yield None


def outcome(episode: Any) -> dict[str, Any]:
    return {}


def keep(path: Path, episode: Any) -> None:
    return None


class Watcher:
    """A watcher that counts."""

    def __init__(self) -> None:
        self.cells: list[tuple[str, str]] = []

    def begin(self, total: int, before: int) -> None:
        self.total, self.before = total, before

    def finished(self, job: BenchJob) -> None:
        self.cells += [(job.case.name, row) for row in job.rows]


def job(folder: Path, name: str, *rows: str, place: int | None = None) -> BenchJob:
    return BenchJob(SuiteCase(name, folder / f"{name}.toml", None, "leader", "straight"), "idm", 0, rows, place=place)


def bench(folder: Path, watcher: Watcher, deadline: float = 600.0) -> Bench:
    setup = BenchSetup(
        folder, "own", data_folder("memory_bank.sqlite"), {}, BenchParts(load, no_agents, outcome, keep, keep)
    )
    return Bench(setup, 2, watcher, deadline)


def reasons(folder: Path) -> dict[tuple[str, str], str]:
    cells = read_cells(folder)
    assert {c["ending"] for c in cells} == {"simulation_failed"}
    return {(c["case"], c["row"]): c["reason"] for c in cells}


def test_who_kills_a_process_has_failed_and_who_ran_beside_it_has_not(tmp_path: Path) -> None:
    """The killer has one row that dies, twice; the second row of another dies, and the rows around it do not."""
    watcher = Watcher()
    free = [
        job(tmp_path, "killer", "raw"), job(tmp_path, "slow", "raw"),
        job(tmp_path, "second", "raw", "random", "resampling"),
    ]  # fmt: skip
    chain = [job(tmp_path, name, "expert", place=k) for k, name in enumerate(("slow", "killer", "other"))]
    bench(tmp_path, watcher).run(free, [chain])
    died = "It failed 2 times: its worker process ended (exit status 9)."
    assert reasons(tmp_path) == {
        ("killer", "raw"): died, ("killer", "expert"): died, ("second", "random"): died, ("slow", "raw"): CALM,
        ("second", "raw"): CALM, ("second", "resampling"): CALM, ("slow", "expert"): CALM, ("other", "expert"): CALM,
    }  # fmt: skip
    assert sorted(watcher.cells) == sorted(reasons(tmp_path)) and (watcher.total, watcher.before) == (8, 0)


def test_a_row_that_hangs_has_failed(tmp_path: Path) -> None:
    bench(tmp_path, Watcher(), deadline=1.0).run([job(tmp_path, "hangs", "raw")], [])
    assert reasons(tmp_path) == {("hangs", "raw"): "The cell did not finish within 1 s; raise cell_seconds."}
    assert read_cells(tmp_path)[0]["timing"]["total"] >= 1  # it is no cheap row


def test_a_row_that_waits_for_a_model_is_not_stuck(tmp_path: Path) -> None:
    """Five seconds of waiting do not count against a limit of four. Its clock runs faster, so that the time that a
    process needs to start does not count either."""
    bench(tmp_path, Watcher(), deadline=4.0).run([job(tmp_path, "asks", "raw")], [])
    assert reasons(tmp_path) == {("asks", "raw"): CALM}


def test_what_is_there_is_not_run_again_and_a_chain_goes_on_where_it_can(tmp_path: Path) -> None:
    """Of three encounters in a line the second has no cell, and no bank is left: all three are done again."""
    watcher, kept = Watcher(), cell_path(tmp_path, "idm", "killer", "raw")
    chain = [job(tmp_path, name, "expert", place=k) for k, name in enumerate(("one", "two", "three"))]
    for file in (kept, *(cell_path(tmp_path, "idm", name, "expert") for name in ("one", "three"))):
        file.parent.mkdir(parents=True)
        file.write_text("{}")
    bench(tmp_path, watcher).run([job(tmp_path, "killer", "raw")], [chain])
    assert kept.read_text() == "{}" and (watcher.total, watcher.before) == (4, 1)
    assert sorted(watcher.cells) == [("one", "expert"), ("three", "expert"), ("two", "expert")]


@pytest.mark.parametrize("text", ["", "[]", '{"row": "raw"}', "\x00"])
def test_a_cell_that_is_none_is_named(tmp_path: Path, text: str) -> None:
    file = cell_path(tmp_path, "idm", "one", "raw")
    file.parent.mkdir(parents=True)
    file.write_text(text)
    with pytest.raises(UsageError, match=r"raw\.json .*delete it to rerun the cell\.$"):
        read_cells(tmp_path)
    file.write_text(json.dumps(dict.fromkeys(("case", "kind", "group", "ego", "row", "seed", "ending"), "x")))
    assert len(read_cells(tmp_path)) == 1
