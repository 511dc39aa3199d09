"""Batches from Python: ``campaign = sumo_adv.batch("plan.toml", out="campaigns/first")``, and what its folder holds."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sumo_adv.api import Result, Table
from sumo_adv.errors import UsageError

if TYPE_CHECKING:
    from sumo_adv.campaigns.nouns import Job
    from sumo_adv.config_odd import Odd
    from sumo_adv.report.coverage import Coverage

RESULTS, RUNS, PLAN = "results.csv", "runs", "plan.json"
RECYCLE = 200  # episodes after which a worker is replaced, as on the command line
Finished = Callable[[Mapping[str, Any]], None]


class Campaign:
    """The folder of a batch, which may be unfinished. Raises UsageError: it is none."""

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        if not (self.folder / PLAN).is_file():
            raise UsageError(f"{folder} is not the folder of a batch: it has no {PLAN}.")

    @cached_property
    def table(self) -> Table:
        """``results.csv``: columns by name, a row an episode, failed ones included. Raises UsageError: it is damaged.

        Numbers are arrays of float (nan where nothing is said, as in ``min_ttc`` for never) or int; texts and truth
        values are arrays of objects (None where nothing is said).
        """
        from sumo_adv.campaigns.results import NUMBERS, WHOLES, read_csv

        kinds = {**dict.fromkeys(NUMBERS, np.float64), **dict.fromkeys(WHOLES, np.int64)}
        columns = read_csv(self.folder / RESULTS)
        return {name: np.array(values, dtype=kinds.get(name, np.object_)) for name, values in columns.items()}

    def run(self, name: str) -> Result:
        """The result of the episode of that id. Its attributes raise UsageError if the episode is packed."""
        return Result(self.folder / RUNS / name)

    def coverage(self) -> Coverage:
        """Encounters and failures by intent, relation, road class and speed. Raises UsageError or BankError."""
        from sumo_adv.app import shipped_bank
        from sumo_adv.campaigns.pack import packed_texts
        from sumo_adv.report.coverage import OUTCOME, campaign_coverage

        runs = [self.folder / RUNS / str(name) for name in self.table["id"]]
        return campaign_coverage(self.folder, runs, packed_texts(self.folder, OUTCOME), shipped_bank())

    def __repr__(self) -> str:
        return f"<sumo_adv.Campaign of {len(self.table['id'])} episodes: {self.folder}>"


def batch(
    inputs: str | Path | Sequence[str | Path],
    *,
    out: str | Path,
    egos: Sequence[str] = (),
    seeds: int | Sequence[int] | None = None,
    records: Sequence[int | str] = (),
    vary: Mapping[str, Sequence[Any]] | None = None,
    odd: str | Path | Mapping[str, Any] | Odd | None = None,
    learn: str | None = None,
    memory: str | Path | None = None,
    figures: bool | None = None,
    parquet: bool = False,
    states: bool = False,
    workers: int | None = None,
    deadline: float = 600.0,
    force: bool = False,
    retry_failed: bool = False,
    settings_file: str | Path | None = None,
    tell: Finished | None = None,
    **settings: Any,
) -> Campaign:
    """Run inputs x egos x varied settings x seeds, as ``sumo-adv batch``. Episodes that are finished are kept.

    inputs: a plan's .toml, or networks, scenarios, records, folders and shipped names. egos: names of drivers
    (``module:Class`` for a driver of yours). vary: lists of values of settings. odd: a file or its keys: attack only
    within this operational design domain. states: write ``states.parquet`` as well. deadline: seconds after which an
    episode is stuck. settings: of every episode, as for ``sumo_adv.run``; arguments replace what a plan says.
    tell: called with the row of each episode that has finished.

    Ctrl-C finishes the episodes that run; the same call again does the rest.

    Raises:
        UsageError: bad input or settings, or the folder ``out`` holds another plan's results.
        BankError: the bank cannot be opened. SumoAdvError: no episode can be run.
    """
    from sumo_adv.app import batch_parts, run_campaign
    from sumo_adv.campaigns.campaign import Orders
    from sumo_adv.campaigns.local import Pace
    from sumo_adv.campaigns.plan import is_plan, make_plan, read_plan
    from sumo_adv.memory.paths import default_bank_path
    from sumo_adv.report.outcome import versions

    named = [inputs] if isinstance(inputs, str | Path) else list(inputs)
    first = Path(named[0]) if named else Path()
    planned = len(named) == 1 and is_plan(first)
    table: dict[str, Any] = read_plan(first) if planned else {"inputs": [str(each) for each in named]}
    if any(not isinstance(ego, str) for ego in egos):
        raise UsageError("Give the egos of a batch as names (module:Class): its workers import them.")
    given = {
        "egos": list(egos) or None, "seeds": seeds, "records": list(records) or None, "vary": vary, "learn": learn,
        "memory": None if memory is None else str(memory), "figures": figures,
    }  # fmt: skip
    table |= {key: value for key, value in given.items() if value is not None}
    table["settings"] = {**table.get("settings", {}), **settings, **_domain(odd)}
    subject, folder = (f"The plan {first}", first.parent) if planned else ("The batch", Path())
    plan = make_plan(table, folder, subject, batch_parts(), None if settings_file is None else Path(settings_file))
    pace = Pace(workers or os.cpu_count() or 1, deadline, RECYCLE)
    bank = plan.memory or default_bank_path()
    orders = Orders(Path(out), bank, versions(), pace, force, retry_failed, parquet)
    run_campaign(plan, orders, _Teller(tell), states=states)
    return Campaign(out)


def _domain(odd: str | Path | Mapping[str, Any] | Odd | None) -> dict[str, Any]:
    """The setting ``odd``; empty where none is given."""
    from sumo_adv.config_odd import Odd, read_odd

    if odd is None:
        return {}
    domain = read_odd(Path(odd)) if isinstance(odd, str | Path) else odd
    return {"odd": domain.model_dump(mode="json", exclude_unset=True) if isinstance(domain, Odd) else dict(domain)}


class _Teller:
    """Passes on the rows of finished episodes."""

    def __init__(self, tell: Finished | None) -> None:
        self._tell = tell

    def begin(self, total: int, before: Sequence[Mapping[str, Any]]) -> None:
        """Nothing is said at the beginning."""

    def finished(self, job: Job, row: Mapping[str, Any]) -> None:
        """One more episode."""
        if self._tell is not None:
            self._tell(row)

    def stopping(self, now: bool) -> None:
        """Nothing is said: the caller sees it by the rows that are missing."""
