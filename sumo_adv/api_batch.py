"""Run batches, hunts and crash rates from Python.

Examples:
    campaign = sumo_adv.batch("plan.toml", out="campaigns/first")
    found = sumo_adv.hunt("motorway", ego="my_package.driver:MyDriver", minutes=30)
    found = sumo_adv.crash_rate("straight_2lane", ego="idm", out="runs/rate-idm")
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sumo_adv.api import Result, Table
from sumo_adv.app import batch_parts, cluster_processors, estimate_rate, run_campaign, shipped_bank
from sumo_adv.campaigns.results import INTEGER_COLUMNS, NUMERIC_COLUMNS, OUTCOME_FILE, read_csv, read_row
from sumo_adv.config import load_settings
from sumo_adv.config_odd import Odd, read_odd
from sumo_adv.datatypes import Level
from sumo_adv.errors import UsageError
from sumo_adv.files import refuse_links, scratch_prefix
from sumo_adv.goal import Goal
from sumo_adv.memory.store import default_bank_path
from sumo_adv.report.staging import PLAN_FILE, RESULTS_FILE

if TYPE_CHECKING:
    from sumo_adv.campaigns.campaign import Orders, Summary
    from sumo_adv.campaigns.plan import CampaignPlan
    from sumo_adv.hunting.hunt import Found, HuntProgress
    from sumo_adv.rate.estimate import RateEstimate
    from sumo_adv.report.coverage import Coverage

RUNS_FOLDER = "runs"
EPISODES_PER_WORKER = 200  # episodes after which a worker is replaced, as on the command line
Finished = Callable[[Mapping[str, Any]], None]


class Campaign:
    """A batch, finished or not, in its folder.

    Attributes:
        folder: The folder of the batch.

    Raises:
        UsageError: The folder is not that of a batch.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        if not (self.folder / PLAN_FILE).is_file():
            raise UsageError(f"{folder} is not the folder of a batch: it has no {PLAN_FILE}.")
        refuse_links(self.folder)

    @cached_property
    def table(self) -> Table:
        """The columns of ``results.csv`` by name, with one row per episode, including failed ones.

        Numbers are arrays of float or int. A missing float is nan; ``min_ttc`` is nan if there never was a conflict.
        Texts and truth values are arrays of objects; a missing one is None.

        Raises:
            UsageError: The file is damaged.
        """
        kinds = {**dict.fromkeys(NUMERIC_COLUMNS, np.float64), **dict.fromkeys(INTEGER_COLUMNS, np.int64)}
        columns = read_csv(self.folder / RESULTS_FILE)
        return {name: np.array(values, dtype=kinds.get(name, np.object_)) for name, values in columns.items()}

    def run(self, name: str) -> Result:
        """Return the result of an episode.

        Args:
            name: The id of the episode.

        Returns:
            The result. Its attributes raise UsageError if the episode is packed.
        """
        return Result(self.folder / RUNS_FOLDER / name)

    def coverage(self) -> Coverage:
        """Count encounters and failures by intent, relation, road class and speed.

        Raises:
            UsageError: The table or the plan of the batch is damaged.
            BankError: The bank cannot be read.
        """
        from sumo_adv.campaigns.store import packed_texts
        from sumo_adv.report.coverage import campaign_coverage

        runs = [self.folder / RUNS_FOLDER / str(name) for name in self.table["id"]]
        return campaign_coverage(self.folder, runs, packed_texts(self.folder, OUTCOME_FILE), shipped_bank())

    def __repr__(self) -> str:
        return f"<sumo_adv.Campaign of {len(self.table['id'])} episodes: {self.folder}>"


def batch(
    inputs: str | Path | Sequence[str | Path],
    *,
    out: str | Path,
    egos: Sequence[str | type] = (),
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
    """Run inputs x egos x varied settings x seeds, as ``sumo-adv batch`` does.

    Finished episodes are kept. Ctrl-C finishes the running episodes; the same call runs the rest later.

    Args:
        inputs: A plan's .toml, or networks, scenarios, records, folders and shipped names.
        out: The folder of the results.
        egos: Names of drivers (``module:Class`` for your own), or classes that workers can import.
        seeds: The number of seeds, from 0, or a list of seeds.
        records: Ids or places of the records to take from .tfrecord files; empty for all.
        vary: Lists of values of settings. Every combination is run.
        odd: The file of an operational design domain, or its keys. Encounters outside the domain are not attacked.
        learn: When the bank learns: ``off``, ``after`` or ``during``.
        memory: The memory bank; None for the user's own.
        figures: Whether ``encounter.png`` is drawn for each run.
        parquet: Whether ``results.parquet`` is written as well.
        states: Whether ``states.parquet`` is written as well.
        workers: The number of processes; None for one per core.
        deadline: The time after which an episode counts as stuck [s].
        force: Whether the folder of another plan's results may be continued.
        retry_failed: Whether failed episodes are run again.
        settings_file: A TOML file of settings, which ``settings`` and those of the plan override.
        tell: Called with the row of each episode that has finished.
        **settings: Settings of every episode, as for ``sumo_adv.run``. Arguments override the plan.

    Returns:
        The batch, which is unfinished after Ctrl-C.

    Raises:
        UsageError: The input or a setting is bad, or the folder ``out`` holds another plan's results.
        BankError: The bank cannot be opened.
        SumoAdvError: No episode can be run.
    """
    given = {
        "egos": [_ego_name(ego) for ego in egos] or None, "seeds": seeds,
        "records": list(records) or None, "vary": vary, "learn": learn,
        "memory": None if memory is None else str(memory), "figures": figures,
    }  # fmt: skip
    plan = planned(inputs, given, settings, odd, settings_file)
    orders = orders_of(plan, out, workers, deadline, force=force, retry_failed=retry_failed, parquet=parquet)
    watcher = Teller(None if tell is None else lambda _, job, row: tell(row))
    run_campaign(plan, orders, watcher, states=states)
    return Campaign(out)


def planned(
    inputs: str | Path | Sequence[str | Path], given: Mapping[str, Any], settings: Mapping[str, Any],
    odd: str | Path | Mapping[str, Any] | Odd | None = None, settings_file: str | Path | None = None,
) -> CampaignPlan:  # fmt: skip
    """Make the plan of a batch.

    Args:
        inputs: The file of a plan, or inputs.
        given: Keys of a plan that override the file; None means that a key is not given.
        settings: Settings that override those of the file.
        odd: The operational design domain: a file, its keys, or the model; None for no domain.
        settings_file: A TOML file of settings, which all other settings override.

    Returns:
        The plan.

    Raises:
        UsageError: The plan, an input or a setting is bad, or the domain is given twice.
    """
    from sumo_adv.campaigns.plan import is_plan, make_plan, read_plan

    named = [inputs] if isinstance(inputs, str | Path) else list(inputs)
    first = Path(named[0]) if named else Path()
    is_file = len(named) == 1 and is_plan(first)
    table: dict[str, Any] = read_plan(first) if is_file else {"inputs": [str(each) for each in named]}
    table |= {key: value for key, value in given.items() if value is not None}
    own = table.get("settings", {})
    if not isinstance(own, dict):
        raise UsageError("'settings' in a plan must be a table: write [settings].")
    if odd is not None and "odd" in {**own, **settings}:
        raise UsageError(f"The plan has [settings.odd], and the domain {odd} is given as well; keep one.")
    table["settings"] = {**own, **settings, **_domain(odd)}
    subject, folder = (f"The plan {first}", first.parent) if is_file else ("The batch", Path())
    return make_plan(table, folder, subject, batch_parts(), None if settings_file is None else Path(settings_file))


def _domain(odd: str | Path | Mapping[str, Any] | Odd | None) -> dict[str, Any]:
    """Return the setting ``odd``; empty if no domain is given."""
    if odd is None:
        return {}
    domain = read_odd(Path(odd)) if isinstance(odd, str | Path) else odd
    return {"odd": domain.model_dump(mode="json", exclude_unset=True) if isinstance(domain, Odd) else dict(domain)}


def orders_of(
    plan: CampaignPlan,
    out: str | Path,
    workers: int | None,
    deadline: float,
    recycle: int = EPISODES_PER_WORKER,
    **how: Any,
) -> Orders:
    """Return the orders for a plan.

    Args:
        plan: The plan.
        out: The folder of the results.
        workers: The number of processes; None for one per core.
        deadline: The time after which an episode counts as stuck [s].
        recycle: The number of episodes after which a worker is replaced.
        **how: Further fields of ``Orders``.
    """
    from sumo_adv.campaigns.campaign import Orders
    from sumo_adv.campaigns.local import WorkerPace
    from sumo_adv.report.outcome import versions

    pace = WorkerPace(workers or os.cpu_count() or 1, deadline, recycle)
    return Orders(Path(out), plan.memory or default_bank_path(), versions(), pace, **how)


class Teller:
    """Watches a batch, a hunt or an estimate, and calls the given functions.

    Attributes:
        total: The number of episodes, or of blocks of a phase.
        done: The number that have finished.
    """

    def __init__(
        self,
        finished: Callable[[Teller, Any, Any], None] | None,
        stopping: Callable[[bool], None] | None = None,
        begun: Callable[[], None] | None = None,
    ) -> None:
        self._finished, self._stopping, self._begun = finished, stopping, begun
        self.total = self.done = 0

    def begin(self, total: int, before: Sequence[Any]) -> None:
        self.total, self.done = total, len(before)
        if self._begun is not None:
            self._begun()

    def finished(self, job: Any, row: Any) -> None:
        self.done += 1
        if self._finished is not None:
            self._finished(self, job, row)

    def stopping(self, now: bool) -> None:
        """Report that Ctrl-C was pressed. Without a function, callers notice it by the missing results."""
        if self._stopping is not None:
            self._stopping(now)


def _ego_name(ego: str | type) -> str:
    """Return the name of a driver.

    Raises:
        UsageError: It is an object, not a driver, or a class that workers cannot import.
    """
    from sumo_adv.drivers.registry import spec_of

    if isinstance(ego, str):
        return ego
    if not isinstance(ego, type):
        raise UsageError("Give egos as names (module:Class) or classes: each worker makes its own object.")
    return spec_of(ego)


# -- hunts


MAX_PAGES_AT_ONCE = 60  # replay pages made by one call


@dataclass(frozen=True, repr=False)
class HuntResult:
    """The result of a hunt.

    Attributes:
        found: What the hunt found.
        rows: A dictionary for each distinct failure, the most serious first.
        index: The page of all failures; None if no page was made.
    """

    found: Found
    rows: list[dict[str, Any]]
    index: Path | None

    def __repr__(self) -> str:
        some = f"{len(self.rows)} distinct failures in {self.found.episodes} episodes"
        return f"<sumo_adv.HuntResult of {some}: {self.folder}>"

    @property
    def folder(self) -> Path:
        """The folder of the hunt."""
        return self.found.folder

    @property
    def table(self) -> Table:
        """Columns by name, with one row per distinct failure: ``pandas.DataFrame(result.table)``."""
        from sumo_adv.hunting.failures import FAILURE_COLUMNS

        return {name: np.array([row[name] for row in self.rows]) for name in FAILURE_COLUMNS}


def hunt(
    inputs: str | Path | Sequence[str | Path],
    *,
    ego: str | type | None = None,
    minutes: float = 30.0,
    distinct: int | None = None,
    out: str | Path = Path("runs") / "hunt",
    seed: int = 0,
    memory: str | Path | None = None,
    workers: int | None = None,
    deadline: float = 600.0,
    ray: str | None = None,
    cover: bool = False,
    settings_file: str | Path | None = None,
    pages: bool = True,
    tell: Callable[[HuntProgress], None] | None = None,
    stopping: Callable[[bool], None] | None = None,
    note: Callable[[str], None] | None = None,
    begun: Callable[[], None] | None = None,
    **settings: Any,
) -> HuntResult:
    """Find the worst distinct failures of a driver within ``minutes``, as ``sumo-adv hunt`` does.

    The same call continues the hunt.

    Args:
        inputs: Networks, .sumocfg files, scenarios, records, folders and shipped names.
        ego: The name of a driver, or a class that workers can import; None for the driver of each input.
        minutes: The time of the whole hunt, over all calls [min].
        distinct: The number of distinct failures at which the hunt ends early; None for no limit.
        out: The folder of the hunt.
        seed: The first seed of traffic and search.
        memory: The memory bank, which is only read; None for the user's own.
        workers: The number of processes; None for one per core.
        deadline: The time after which an episode counts as stuck [s].
        ray: The address of a Ray cluster; None for this machine.
        cover: Whether time goes to the named scenarios that were met least, instead of to inputs that bring new
            failures.
        settings_file: A TOML file of settings.
        pages: Whether an index page with replays is made.
        tell: Called as episodes end.
        stopping: Called when Ctrl-C is pressed, with True if it is pressed again.
        note: Called at the start with a sentence for each part of the inputs that is not kept, such as an option of a
            .sumocfg.
        begun: Called before the first episode, once the inputs, the ego, the settings and the folder are checked.
        **settings: Settings of every encounter, as for ``sumo_adv.run``. An encounter ends at the level ``until``, by
            default ``serious``, or ``valid`` for the ego careful. If ``until`` is given, only collisions of this level
            or a higher one are failures.

    Returns:
        The failures and the page.

    Raises:
        UsageError: The input or a setting is bad, or the folder ``out`` holds something else.
        BankError: The bank cannot be opened.
        SumoAdvError: No episode can be run.
    """
    from sumo_adv.campaigns.local import Crew
    from sumo_adv.campaigns.plan import make_plan
    from sumo_adv.drivers.registry import find_class
    from sumo_adv.hunting.failures import table
    from sumo_adv.hunting.hunt import Hunt

    first = [begun] if begun is not None else []

    def campaign(plan: CampaignPlan, orders: Orders, finished: Finished) -> Summary:
        watcher = Teller(lambda _, job, row: finished(row), stopping, lambda: first.pop()() if first else None)
        return run_campaign(plan, orders, watcher)

    file = None if settings_file is None else Path(settings_file)
    loaded = load_settings(file, **settings)
    asked = loaded.until if "until" in loaded.model_fields_set else None
    if asked is None:
        settings["until"] = "valid" if "careful" in (ego, loaded.ego) else "serious"
    named = [str(each) for each in ([inputs] if isinstance(inputs, str | Path) else inputs)]
    given: dict[str, Any] = {"inputs": named, "seeds": [seed], "settings": settings}
    given |= {} if ego is None else {"egos": [_ego_name(ego)]}
    given |= {} if memory is None else {"memory": str(memory)}
    plan = make_plan(given, Path(), "The hunt", batch_parts(), file)
    if ego is not None and ray is None and ":" in (name := _ego_name(ego)):
        find_class("ego", name)
    least = Level.VALID if asked is None else max(asked.level, Level.VALID)
    goal = Goal(least, loaded.min_delta_v or 0.0)
    if note is not None:
        for sentence in (each for given in plan.inputs for each in given.notes):
            note(sentence)
    orders = orders_of(plan, out, workers, deadline, ray=ray)
    at_once = orders.pace if ray is None else replace(orders.pace, workers=cluster_processors(ray))
    longest = loaded.seconds if "seconds" in loaded.model_fields_set else None
    with Crew() as crew:
        orders = replace(orders, pace=at_once, crew=crew if ray is None else None)
        hunted = Hunt(plan, orders, campaign, minutes, distinct, goal, cover=cover, longest=longest)
        found = hunted.run(tell or (lambda _: None))
    rows = table(found.failures, found.folder)
    return HuntResult(found, rows, _index(found, orders.pace.workers) if pages and rows else None)


def _index(found: Found, workers: int) -> Path:
    """Make the page of all failures, with a picture and a replay of each, and return its path.

    Its coverage and its rates count all episodes of the hunt.
    """
    from sumo_adv.report.coverage import campaign_coverage, write_coverage
    from sumo_adv.report.index import Packs, table_of, write_report

    runs = sorted(run for run in found.folder.glob("rounds/*/runs/*") if not run.name.startswith("."))
    target = found.folder / "report"
    coverage = campaign_coverage(found.folder, runs, {}, shipped_bank())
    failures, every = (
        table_of(row for run in some if (row := read_row(run)) is not None)
        for some in ([failure.run for failure in found.failures], runs)
    )
    made = write_report(
        found.folder / "failures", target, f"Failures of {found.folder.resolve().name}", failures, Packs(), coverage,
        found.scenarios, every=every, most=MAX_PAGES_AT_ONCE, workers=workers, again=True,
    )  # fmt: skip
    write_coverage(target, coverage)
    return made.index


# -- crash rates


TellProgress = Callable[[str, int, int], None]


def crash_rate(
    source: str | Path,
    *,
    ego: str | None = None,
    runs: int = 1000,
    pilot: int = 200,
    plain: bool = False,
    seed: int = 0,
    duration: float = 60.0,
    warm_up: float = 20.0,
    density: float | None = None,
    errors: float = 1.0,
    out: str | Path | None = None,
    workers: int | None = None,
    ray: str | None = None,
    ego_parameters: Mapping[str, Any] | None = None,
    tell: TellProgress | None = None,
) -> RateEstimate | None:
    """Estimate how often the ego crashes in normal traffic, as ``sumo-adv rate`` does.

    Args:
        source: A net.xml, a .sumocfg, a scenario or a shipped name, but not a recording.
        ego: The name of a driver (``module:Class`` for your own); None for the driver of the input, or idm if it names
            none.
        runs: The number of runs that the estimate uses.
        pilot: The number of pilot runs, from which the proposal distribution is learned.
        plain: Whether all runs are drawn from the model (plain Monte Carlo).
        seed: The seed of traffic and errors.
        duration: The longest time that the ego drives in a run [s].
        warm_up: The time that generated traffic runs before the ego enters [s].
        density: Departures per minute of generated traffic; None for the default of the input.
        errors: The factor on the rates of all human errors.
        out: The folder of the runs, in which the same call continues; None for a temporary folder.
        workers: The number of processes; None for one per core.
        ray: The address of a Ray cluster; None for this machine.
        ego_parameters: Parameters of the driver.
        tell: Called with the phase (``pilot``, ``runs`` or ``plain``), the number of finished blocks of 20 runs, and
            the number of all blocks of the phase.

    Returns:
        The estimate; None if Ctrl-C stopped it. ``found.per_hour["collision"]`` has ``.value``, ``.low``, ``.high`` and
            ``.half_width``. ``found.per_km`` is built alike. The other levels are ``contact``, ``valid``, ``strict``
            and ``serious``. ``found.document()`` is the content of ``rate.json``.

    Raises:
        UsageError: The input is bad, or ``out`` holds the runs of another estimate.
        SimulationError: A run failed twice.
    """
    from sumo_adv.rate.blocks import RatePlan

    if ego is not None and not isinstance(ego, str):
        raise UsageError("Give the ego of a crash rate as a name (module:Class): its workers import it.")
    if min(runs, pilot) < 1:
        raise UsageError("A crash rate needs at least one run and one pilot run.")
    plan = RatePlan(
        Path(source), ego, dict(ego_parameters or {}), density, warm_up, duration, errors, pilot, plain, seed
    )
    watcher = Teller(None if tell is None else lambda told, job, _: tell(job.phase, told.done, told.total))
    with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch:
        folder = Path(scratch) if out is None else Path(out)
        return estimate_rate(plan, folder, runs, workers, watcher, ray)
