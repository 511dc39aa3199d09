"""Hunts from Python: ``found = sumo_adv.hunt("motorway", ego="my_package.driver:MyDriver", minutes=30)``."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from sumo_adv.api import Table
    from sumo_adv.campaigns.campaign import Orders, Summary, Watcher
    from sumo_adv.campaigns.plan import Plan
    from sumo_adv.hunting.hunt import Found, HuntProgress

RECYCLE = 200  # episodes after which a worker is replaced
PAGES = 60  # replay pages that are made at once


@dataclass(frozen=True)
class HuntResult:
    """What a hunt found. rows: a dictionary for each distinct failure, most serious first; index: the page of all."""

    found: Found
    rows: list[dict[str, Any]]
    index: Path | None

    @property
    def folder(self) -> Path:
        """Of the hunt."""
        return self.found.folder

    @property
    def table(self) -> Table:
        """Columns by name, a row for each distinct failure: ``pandas.DataFrame(result.table)``."""
        from sumo_adv.hunting.failures import COLUMNS

        return {name: np.array([row[name] for row in self.rows]) for name in COLUMNS}


def hunt(
    inputs: str | Path | Sequence[str | Path],
    *,
    ego: str | None = None,
    minutes: float = 30.0,
    distinct: int | None = None,
    out: str | Path = Path("runs") / "hunt",
    seed: int = 0,
    memory: str | Path | None = None,
    workers: int | None = None,
    deadline: float = 600.0,
    cluster: str | None = None,
    settings_file: str | Path | None = None,
    pages: bool = True,
    tell: Callable[[HuntProgress], None] | None = None,
    stopping: Callable[[bool], None] | None = None,
    note: Callable[[str], None] | None = None,
    **settings: Any,
) -> HuntResult:
    """The worst distinct failures that ``minutes`` are enough for, as ``sumo-adv hunt``. The same call again goes on.

    inputs: networks, .sumocfg files, scenarios, records, folders and shipped names. distinct: end sooner with this many
    failures. until: the level at which an encounter ends, ``serious`` by default (``valid`` for the ego careful).
    deadline: seconds after which an episode is stuck. pages: make an index page with replays. tell: called after each
    round. stopping: called when Ctrl-C is pressed, with True where it is pressed again. note: called at the start with
    each sentence on what of the inputs is not kept, as options of a .sumocfg.

    Raises:
        UsageError: bad input or settings, or the folder ``out`` holds something else.
        BankError: the bank cannot be opened. SumoAdvError: no episode can be run.
    """
    from sumo_adv.app import batch_parts
    from sumo_adv.campaigns.campaign import Orders
    from sumo_adv.campaigns.local import Pace
    from sumo_adv.campaigns.plan import make_plan
    from sumo_adv.hunting.failures import table
    from sumo_adv.hunting.hunt import Hunt
    from sumo_adv.memory.paths import default_bank_path
    from sumo_adv.report.outcome import versions

    named = [str(each) for each in ([inputs] if isinstance(inputs, str | Path) else inputs)]
    settings.setdefault("until", "valid" if ego == "careful" else "serious")
    given: dict[str, Any] = {"inputs": named, "seeds": [seed], "settings": settings}
    given |= {} if ego is None else {"egos": [ego]}
    given |= {} if memory is None else {"memory": str(memory)}
    plan = make_plan(given, Path(), "The hunt", batch_parts(), None if settings_file is None else Path(settings_file))
    if note is not None:
        for sentence in (each for source in plan.inputs for each in source.notes):
            note(sentence)
    pace = Pace(workers or os.cpu_count() or 1, deadline, RECYCLE)
    orders = Orders(Path(out), plan.memory or default_bank_path(), versions(), pace, ray=cluster)
    found = Hunt(plan, orders, partial(_campaign, _Unseen(stopping)), minutes, distinct).run(tell or (lambda _: None))
    rows = table(found.failures, found.folder)
    return HuntResult(found, rows, _index(found, pace.workers) if pages and rows else None)


def _campaign(watcher: Watcher, plan: Plan, orders: Orders) -> Summary:
    from sumo_adv.app import run_campaign

    return run_campaign(plan, orders, watcher)


@dataclass(frozen=True)
class _Unseen:
    """Shows nothing of a round but Ctrl-C."""

    tell: Callable[[bool], None] | None

    def begin(self, total: int, before: Sequence[Any]) -> None:
        """Nothing."""

    def finished(self, job: Any, row: Any) -> None:
        """Nothing."""

    def stopping(self, now: bool) -> None:
        """Say that Ctrl-C was pressed."""
        if self.tell is not None:
            self.tell(now)


def _index(found: Found, workers: int) -> Path:
    """The page of all failures, with a picture and a replay of each."""
    from sumo_adv.app import shipped_bank
    from sumo_adv.campaigns.results import read_row
    from sumo_adv.report.coverage import campaign_coverage, write_coverage
    from sumo_adv.report.index import Packs, table_of, write_report

    runs = [failure.run for failure in found.failures]
    target = found.folder / "report"
    coverage = campaign_coverage(found.folder, runs, {}, shipped_bank())
    made = write_report(
        found.folder / "failures", target, found.folder.resolve().name,
        table_of(row for run in runs if (row := read_row(run)) is not None), Packs(), coverage, most=PAGES,
        workers=workers, again=True, tell=_silent,
    )  # fmt: skip
    write_coverage(target, coverage)
    return made.index


def _silent(done: int, of: int) -> None:
    """How far the pages are is not shown."""
