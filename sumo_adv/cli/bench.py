"""Define ``bench``: make tables of methods over a suite of encounters, with intervals, and resume them."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv.app import bench_parts
from sumo_adv.cli.groups import grouped
from sumo_adv.cli.options import set_values, words
from sumo_adv.config import BUILTIN, Settings, load_settings
from sumo_adv.errors import UsageError
from sumo_adv.files import sentences

if TYPE_CHECKING:
    from sumo_adv.benchmark.bench import BenchResources, TableRequest
    from sumo_adv.benchmark.nouns import Cell

EXAMPLE = "Example: sumo-adv bench table --suite smoke --ego idm --row expert+learn=off --row random --out runs/bench"
DEFAULT_ROWS = ("raw", "llm-f", "expert+learn=off", "random")  # no bank changes between encounters
SAID_ELSEWHERE = {
    "ego": "--ego", "seed": "--seed", "until": "--until", "attempts": "--attempts", "memory": "--memory",
    "learn": "a row, expert+learn=off", "trigger": "a row, expert+shift=-1.5", "llm": "a row, llm-a:MODEL",
    "analyzer": "a row, llm-a:MODEL", "generator": "a row, llm-a:MODEL", "modifier": "a row, llm-a:MODEL",
}  # fmt: skip
"""Settings that ``--set`` cannot give to all rows, and what to use instead."""

app = typer.Typer(
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
    help="Tables over suites of encounters: the paper's rows, stronger opponents, honest intervals.",
)  # fmt: skip
SuiteOption = Annotated[
    list[str], typer.Option("--suite", help="smoke, suite81, a folder, scenario files (repeatable), womd:FOLDER.")
]
Egos = Annotated[str, typer.Option("--ego", help="One or several: krauss,idm,careful,lattice,module:Class.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of the simulations and of all sampling.")]
BENCH_ATTEMPTS = 25  # attempts of a row in an encounter, unless told otherwise
DEFAULT_SECONDS: float = Settings.model_fields["seconds"].default
Attempts = Annotated[int, typer.Option(min=1, help="Budget of every row, per encounter.")]
Until = Annotated[str, typer.Option(help="Level of success: critical (ttc), collision, valid, strict or serious.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Processes (default: one per core).")]
Out = Annotated[
    Path | None,
    typer.Option(help="Folder of results (default: runs/bench-<suite>); the same folder continues a bench."),
]
Memory = Annotated[
    Path | None, typer.Option(help="Memory bank of all rows (default: the shipped one); it is only read.")
]
Setting = Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="A setting of all rows.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")]


@dataclass(frozen=True)
class EncounterOptions:
    """Options of a table's encounters and of a row's budget in each."""

    suite: SuiteOption
    ego: Egos = "idm"
    seed: Seed = 0
    attempts: Attempts = BENCH_ATTEMPTS
    until: Until = "valid"


@dataclass(frozen=True)
class RunningOptions:
    """Options that say how the rows are run and where their table is written."""

    setting: Setting = None
    memory: Memory = None
    workers: Workers = None
    out: Out = None
    as_json: Json = False


@app.command("table", epilog=EXAMPLE)
def table(
    suite: SuiteOption,
    ego: Egos = "idm",
    row: Annotated[
        list[str] | None,
        typer.Option(
            help="raw, expert, llm-f, llm-a:MODEL, expert+NAME=VALUE, random, oracle, "
            "resampling, transformer, transformer:FILE, module:Class; "
            f"repeatable (default: {', '.join(DEFAULT_ROWS)})."
        ),
    ] = None,
    seed: Seed = 0,
    attempts: Annotated[
        int | None, typer.Option(min=1, help="Budget of every row, per encounter (default: 25; 400 with --seconds).")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="Budget of every row, per encounter, s (default: 60).")
    ] = None,
    until: Until = "valid",
    reference: Annotated[
        str | None, typer.Option(help="Row that the others are compared with (default: the first expert).")
    ] = None,
    setting: Setting = None,
    memory: Memory = None,
    workers: Workers = None,
    keep_runs: Annotated[bool, typer.Option("--keep-runs", help="Keep the folder of each run, for report.")] = False,
    out: Out = None,
    as_json: Json = False,
) -> None:
    """Run every row on every encounter of a suite, and write table.md, .csv, .json and figures."""
    rows = _unique(row or DEFAULT_ROWS)
    if reference is not None and reference not in rows:
        raise UsageError(f"--reference '{reference}' is not a row of the table; choose one of: {', '.join(rows)}.")
    most = attempts or (BENCH_ATTEMPTS if seconds is None else Settings.model_fields["attempts"].default)
    encounters = EncounterOptions(suite, ego, seed, most, until)
    running = RunningOptions(setting, memory, workers, out, as_json)
    ran = _run(encounters, rows, running, keep_runs=keep_runs, seconds=seconds)
    ran.write("table", reference or next((r for r in rows if r.startswith("expert")), None), {})


@app.command("ablations", epilog="Example: sumo-adv bench ablations --suite suite81 --ego idm --out runs/bench")
@grouped
def ablations(
    encounters: EncounterOptions,
    llm: Annotated[
        str | None, typer.Option(help="Also compare this model with 1, 3 and 5 samples of the analyzer.")
    ] = None,
    *,
    running: RunningOptions,
) -> None:
    """Measure what each part is worth: the expert without memory, tuner, replanning or ego model, or at other times."""
    from sumo_adv.benchmark.jobs import ABLATIONS, REFERENCE, sampled

    words = {**ABLATIONS, **(sampled(llm) if llm else {})}
    ran = _run(encounters, list(words), running)
    ran.write("ablations", REFERENCE, words)


@app.command("analyzer", epilog="Example: sumo-adv bench analyzer --suite smoke --ego idm --out runs/bench")
@grouped
def analyzer(
    encounters: EncounterOptions,
    llm: Annotated[
        list[str] | None, typer.Option(help="A model as analyzer, with and without the evidence table; repeatable.")
    ] = None,
    *,
    running: RunningOptions,
) -> None:
    """Measure how often analyzers name the most dangerous intent, beside oracle, chance, best constant and ceiling."""
    from sumo_adv.benchmark.analysis import analysis_text, analyze, labels_hash, write_analysis
    from sumo_adv.benchmark.jobs import REFERENCE
    from sumo_adv.benchmark.plots import draw_confusions

    answering = [REFERENCE, *(f"llm-a:{m}+learn=off{more}" for m in llm or () for more in ("", "+evidence=off"))]
    rows = ["oracle", *answering]
    ran = _run(encounters, rows, running)
    title = f"Analyzers on {ran.request.suite.name}"
    analysis = analyze(ran.cells, ran.request.suite.cases, title=title, analyzers=answering, reference=REFERENCE)
    about = {**ran.about, "labels_hash": labels_hash(ran.request.suite)}
    files = write_analysis(analysis, ran.cells, ran.folder, about)
    files += draw_confusions(analysis, ran.folder / "figures")
    ran.say(files, analysis_text(analysis, files[0]))


@app.command("growth", epilog="Example: sumo-adv bench growth --suite suite81 --ego idm --out runs/bench")
@grouped
def growth(
    encounters: EncounterOptions,
    llm: Annotated[str | None, typer.Option(help="Also measure this model in all parts.")] = None,
    *,
    running: RunningOptions,
) -> None:
    """Measure how a growing bank changes hits, seconds and model calls, compared with a fixed bank."""
    from sumo_adv.benchmark.jobs import GROWING
    from sumo_adv.benchmark.league import growth as growing
    from sumo_adv.benchmark.league import write_growth
    from sumo_adv.benchmark.plots import draw_growth

    rows = [f"{who}{more}" for who in ("expert", *([f"llm-a:{llm}"] if llm else [])) for more in GROWING]
    ran = _run(encounters, rows, running)
    steps = growing(ran.cells, ran.request.suite.cases)
    files = write_growth(steps, ran.cells, ran.folder, ran.about)
    files.append(draw_growth(ran.folder / "figures" / "growth.png", steps, f"Growth over {ran.request.suite.name}"))
    ran.say(files, files[0].read_text(encoding="utf-8"))


@app.command("label", epilog="Example: sumo-adv bench label --suite suite81 --ego idm,krauss --out runs/bench")
@grouped
def label(encounters: EncounterOptions, running: RunningOptions) -> None:
    """Write what the oracle finds most dangerous to labels.json; put this file beside a suite's suite.toml."""
    from sumo_adv.benchmark.rows import oracle_labels
    from sumo_adv.benchmark.write import as_json as text_of
    from sumo_adv.benchmark.write import write_files

    ran = _run(encounters, ["oracle"], running)
    labels: dict[str, dict[str, Any]] = {}
    for cell in ran.cells:
        if cell["attempts"]:
            labels.setdefault(cell["case"], {})[cell["ego"]] = oracle_labels(cell)
    files = write_files(ran.folder, "labels", {".json": text_of(labels)}, ran.cells, ran.about)
    ran.say(files, f"{len(labels)} of {len(ran.request.suite.cases)} encounters labelled.")


@app.command("league", epilog="Example: sumo-adv bench league --suite suite81 --ego idm,careful,my_driver:Mine")
@grouped
def league(
    suite: SuiteOption, ego: Egos, seed: Seed = 0, attempts: Attempts = BENCH_ATTEMPTS, until: Until = "serious",
    *, running: RunningOptions,
) -> None:  # fmt: skip
    """Find which of several drivers is hardest to hit: the expert attacks each of them in the same encounters."""
    from sumo_adv.benchmark.jobs import REFERENCE
    from sumo_adv.benchmark.league import league as ranked
    from sumo_adv.benchmark.league import league_text, write_league

    ran = _run(EncounterOptions(suite, ego, seed, attempts, until), [REFERENCE], running)
    places, duels = ranked(ran.cells, attempts)
    files = write_league(places, duels, ran.title, ran.cells, ran.folder, ran.about)
    ran.say(files, league_text(places, ran.title, files[0]))


@app.command("make", epilog="Example: sumo-adv bench make --seed 2 --out suites/other")
def make(
    seed: Annotated[int, typer.Option(min=0, help="Another seed: other encounters of the same kinds.")],
    out: Annotated[Path, typer.Option(help="A new folder.")],
    as_json: Json = False,
) -> None:
    """Make a fresh copy of suite81: 50 straight and 31 intersection encounters."""
    from sumo_adv.benchmark.making import make_suite

    def print_candidate(case: str, wrong: str) -> None:
        if not as_json and not wrong:
            typer.echo(case, err=True)

    with sentences(out):
        made = make_suite(seed, out, name=out.name, report=print_candidate)
    if as_json:
        typer.echo(json.dumps(asdict(made), default=str))
        return
    typer.echo(f"{made.file}: {made.drawn} candidates sampled, {sum(made.rejected.values())} rejected.")


def _unique(rows: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(rows))


@dataclass(frozen=True, slots=True)
class _Ran:
    """The cells of a table that was run.

    Attributes:
        request: The table that was requested.
        means: The folder and the resources of the run.
        cells: The cells.
        as_json: Whether the output is JSON.
    """

    request: TableRequest
    means: BenchResources
    cells: list[Cell]
    as_json: bool

    @property
    def folder(self) -> Path:
        return self.means.folder

    @property
    def title(self) -> str:
        return f"{self.request.suite.name}, {len(self.request.suite.cases)} encounters"

    @property
    def about(self) -> dict[str, Any]:
        from sumo_adv.benchmark.bench import manifest

        return {"command": " ".join(["sumo-adv", *sys.argv[1:]]), **manifest(self.request, self.means)}

    def write(self, name: str, reference: str | None, words: Mapping[str, str]) -> None:
        """Write the table's files, and print its main columns.

        Args:
            name: The name of the table, for the files.
            reference: The row that the others are compared with; None for no comparison.
            words: Explanations of rows, by row.
        """
        from sumo_adv.benchmark.jobs import growing_banks
        from sumo_adv.benchmark.plots import draw_all
        from sumo_adv.benchmark.table import make_table
        from sumo_adv.benchmark.write import table_text, write_table

        request = self.request
        made = make_table(
            self.cells, title=self.title, cases=request.suite.cases, egos=request.egos, rows=request.rows,
            reference=reference, words=words, notes=growing_banks(request.rows),
        )  # fmt: skip
        files = write_table(made, self.cells, self.folder, self.about, name)
        files += draw_all(self.cells, self.folder / "figures", request.rows)
        self.say(files, table_text(made, files[0]))

    def say(self, files: Sequence[Path], text: str) -> None:
        """Print the outcome.

        Args:
            files: The files that were written.
            text: The text for people.

        Raises:
            typer.Exit: Every cell failed; the exit status is 1.
        """
        from sumo_adv.benchmark.cells import failed

        cells = self.cells
        broken = [c for c in cells if failed(c)]
        if self.as_json:
            count = {"cells": len(cells), "failed": len(broken)}
            typer.echo(json.dumps({"folder": str(self.folder), **count, "files": [str(f) for f in files]}))
        else:
            typer.echo(text)
            others = sorted({str(f.parent) for f in files})
            typer.echo(f"{len(files)} files in {', '.join(others)}", err=True)
        if broken:
            why, *_ = broken[0]["reason"].split("\n")
            first = f"{broken[0]['case']} ({broken[0]['row']}): {why}"
            typer.echo(f"sumo-adv: {len(broken)} of {len(cells)} cells failed, for instance {first}", err=True)
        if len(broken) == len(cells):
            raise typer.Exit(1)


def _run(
    encounters: EncounterOptions, rows: Sequence[str], running: RunningOptions, *, keep_runs: bool = False,
    seconds: float | None = None,
) -> _Ran:  # fmt: skip
    """Run the rows of a table, and keep the finished cells if the user interrupts it."""
    from sumo_adv.benchmark.bench import BenchResources, TableRequest, of_rows, run_table
    from sumo_adv.benchmark.suites import load_suite
    from sumo_adv.cli.progress import BenchProgress
    from sumo_adv.report.outcome import versions
    from sumo_adv.simulation.inputs import data_folder

    egos = _unique(words(encounters.ego))
    if not egos:
        raise UsageError("--ego names no driver; give for instance --ego idm,careful.")
    loaded = load_suite(*encounters.suite)
    budget = {"attempts": encounters.attempts, "until": encounters.until}
    settings = {"seconds": DEFAULT_SECONDS, **_settings(running.setting or ()), **budget}
    if seconds is not None:
        settings["seconds"] = seconds
    limit = load_settings(None, **settings).cell_seconds
    settings.pop("cell_seconds", None)  # it may change when a table is resumed
    memory = running.memory or data_folder("memory_bank.sqlite")
    request = TableRequest(loaded, egos, tuple(rows), encounters.seed, settings, memory)
    _check_models(request)
    folder = running.out or Path("runs") / f"bench-{loaded.name}"
    means = BenchResources(folder, running.workers or os.cpu_count() or 1, bench_parts(), versions(), keep_runs, limit)
    try:
        with BenchProgress(quiet=running.as_json) as watcher:
            cells = run_table(request, means, watcher)
    except KeyboardInterrupt:
        typer.echo("sumo-adv: interrupted; finished cells are kept. Rerun the same command to run the rest.", err=True)
        raise typer.Exit(1) from None
    return _Ran(request, means, of_rows(cells, rows, egos), running.as_json)


def _check_models(request: TableRequest) -> None:
    """Check the models of rows without asking them anything.

    Raises:
        UsageError: A model has no server or no key.
    """
    from sumo_adv.agents.agents import AGENT_ROLES
    from sumo_adv.benchmark.jobs import method_of
    from sumo_adv.llm.chat import Ledger
    from sumo_adv.llm.client import open_model

    for row in request.rows:
        given = method.settings if (method := method_of(row)) is not None else {}
        for name in (given[key] for key in ("llm", *AGENT_ROLES) if given.get(key, BUILTIN) != BUILTIN):
            settings = load_settings(None, **{**request.settings, **given})
            open_model(name, settings, Ledger.for_settings(settings))


def _settings(given: Sequence[str]) -> dict[str, Any]:
    """Return the settings of ``SUMO_ADV_*`` variables and of ``--set`` as data, without the key of a model's server.

    Variables for what a table gets from its own options or rows are left out.

    Raises:
        UsageError: ``--set`` names a setting that a table gets in another way.
    """
    values = set_values(given, "proposals=60")
    for name in values:
        if name in SAID_ELSEWHERE:
            raise UsageError(f"--set {name} cannot apply to all rows of a table; use {SAID_ELSEWHERE[name]}.")
    settings = load_settings()
    of_variables = settings.model_fields_set - SAID_ELSEWHERE.keys()
    return {**settings.model_dump(mode="json", include=of_variables), **values}
