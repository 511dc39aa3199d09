"""``bench``: tables of rows over a suite of encounters, with intervals; they resume where they stopped."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv.cli.set_option import set_values
from sumo_adv.config import BUILTIN, load_settings
from sumo_adv.errors import UsageError

if TYPE_CHECKING:
    from sumo_adv.benchmark.nouns import Cell, Suite
    from sumo_adv.benchmark.run import Means, TableRequest

EXAMPLE = "Example: sumo-adv bench table --suite smoke --ego idm --row expert+learn=off --row random --out runs/bench"
ROWS = ("raw", "llm-f", "expert+learn=off", "random")  # no bank changes from one encounter to the next
SAID_ELSEWHERE = {
    "ego": "--ego", "seed": "--seed", "until": "--until", "attempts": "--attempts", "memory": "--memory",
    "learn": "a row, expert+learn=off", "trigger": "a row, expert+shift=-1.5", "llm": "a row, llm-a:MODEL",
    "analyzer": "a row, llm-a:MODEL", "generator": "a row, llm-a:MODEL", "modifier": "a row, llm-a:MODEL",
}  # fmt: skip
"""What is no setting of all rows, and how a table says it."""

app = typer.Typer(
    no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
    help="Tables over suites of encounters: the paper's rows, stronger opponents, honest intervals.",
)  # fmt: skip
SuiteOption = Annotated[
    list[str], typer.Option("--suite", help="smoke, suite81, a folder, scenario files (repeatable), womd:FOLDER.")
]
Egos = Annotated[str, typer.Option("--ego", help="One or several: krauss,idm,careful,lattice,module:Class.")]
Seed = Annotated[int, typer.Option(min=0, help="Of the simulations and of every draw.")]
Attempts = Annotated[int, typer.Option(min=1, help="Budget of every row, per encounter.")]
Seconds = Annotated[float, typer.Option(min=0.1, help="Budget of every row, per encounter, s.")]
Until = Annotated[str, typer.Option(help="Level of success: critical (ttc), collision, valid, strict or serious.")]
Workers = Annotated[int | None, typer.Option(min=1, help="Processes (default: one a core).")]
Out = Annotated[Path | None, typer.Option(help="Folder (default: runs/bench-<suite>); the same one goes on.")]
Memory = Annotated[Path | None, typer.Option(help="Library of all rows (default: the shipped bank); only read.")]
Setting = Annotated[list[str] | None, typer.Option("--set", metavar="NAME=VALUE", help="A setting of all rows.")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")]


@app.command("table", epilog=EXAMPLE)
def table(
    suite: SuiteOption,
    ego: Egos = "idm",
    row: Annotated[
        list[str] | None,
        typer.Option(
            help="raw, expert, llm-f, llm-a:MODEL, expert+NAME=VALUE, random, fixed, fixed:LABEL, oracle, "
            "random_search, cma, bezier, resampling, transformer, transformer:FILE, module:Class; "
            f"repeatable (default: {', '.join(ROWS)})."
        ),
    ] = None,
    seed: Seed = 0,
    attempts: Attempts = 25,
    seconds: Seconds = 60.0,
    until: Until = "valid",
    reference: Annotated[
        str | None, typer.Option(help="Row the others are compared with (default: the first expert).")
    ] = None,
    setting: Setting = None,
    memory: Memory = None,
    workers: Workers = None,
    keep_runs: Annotated[bool, typer.Option("--keep-runs", help="Keep the folder of each run, for report.")] = False,
    out: Out = None,
    as_json: Json = False,
) -> None:
    """Run every row on every encounter of a suite, and write table.md, .csv, .json and figures."""
    from sumo_adv.benchmark.rows.registry import EVERY_FIXED
    from sumo_adv.benchmark.tables.compute import BEST_FIXED

    rows = _unique([r for given in row or ROWS for r in (EVERY_FIXED if given == "fixed" else (given,))])
    if reference is not None and reference not in (*rows, BEST_FIXED):
        raise UsageError(f"--reference '{reference}' is none of the table's rows: {', '.join(rows)}.")
    request, means = _order(suite, ego, rows, seed, attempts, until, setting, memory, workers, out, keep_runs, seconds)
    cells = _run(request, means, as_json=as_json)
    _write(
        request,
        means,
        cells,
        "table",
        reference or next((r for r in rows if r.startswith("expert")), None),
        as_json=as_json,
    )


@app.command("ablations", epilog="Example: sumo-adv bench ablations --suite suite81 --ego idm --out runs/bench")
def ablations(
    suite: SuiteOption, ego: Egos = "idm", seed: Seed = 0, attempts: Attempts = 25, until: Until = "valid",
    llm: Annotated[str | None, typer.Option(help="With a model also: 1, 3 and 5 samples of the analyzer.")] = None,
    setting: Setting = None, memory: Memory = None, workers: Workers = None, out: Out = None, as_json: Json = False,
) -> None:  # fmt: skip
    """What each part is worth: the expert without memory, tuner, replanning, ego model, at other times."""
    from sumo_adv.benchmark.methods import ABLATIONS, REFERENCE, sampled

    words = {**ABLATIONS, **(sampled(llm) if llm else {})}
    rows = list(words)
    request, means = _order(suite, ego, rows, seed, attempts, until, setting, memory, workers, out, False)
    cells = _run(request, means, as_json=as_json)
    _write(request, means, cells, "ablations", REFERENCE, words=words, as_json=as_json)


@app.command("analyzer", epilog="Example: sumo-adv bench analyzer --suite smoke --ego idm --out runs/bench")
def analyzer(
    suite: SuiteOption, ego: Egos = "idm", seed: Seed = 0, attempts: Attempts = 25, until: Until = "valid",
    llm: Annotated[
        list[str] | None, typer.Option(help="A model as analyzer, with and without the evidence table; repeatable.")
    ] = None,
    setting: Setting = None, memory: Memory = None, workers: Workers = None, out: Out = None, as_json: Json = False,
) -> None:  # fmt: skip
    """Which analyzer names the most dangerous intent: against oracle, chance, the best constant answer, the ceiling."""
    from sumo_adv.benchmark.methods import REFERENCE
    from sumo_adv.benchmark.tables.analysis import analyze
    from sumo_adv.benchmark.tables.analysis_files import labels_hash, write_analysis
    from sumo_adv.benchmark.tables.plots import draw_confusions
    from sumo_adv.benchmark.tables.screen import analysis_text

    answering = [REFERENCE, *(f"llm-a:{m}+learn=off{more}" for m in llm or () for more in ("", "+evidence=off"))]
    request, means = _order(
        suite, ego, ["oracle", *answering], seed, attempts, until, setting, memory, workers, out, False
    )
    cells = _run(request, means, as_json=as_json)
    analysis = analyze(
        cells, request.suite.cases, title=f"Analyzers on {request.suite.name}", analyzers=answering, reference=REFERENCE
    )
    about = replace(_about(request, means), further={"labels_hash": labels_hash(request.suite)})
    files = write_analysis(analysis, cells, means.folder, about)
    files += draw_confusions(analysis, means.folder / "figures")
    _say(means, cells, files, analysis_text(analysis, files[0]), as_json=as_json)


@app.command("growth", epilog="Example: sumo-adv bench growth --suite suite81 --ego idm --out runs/bench")
def growth(
    suite: SuiteOption, ego: Egos = "idm", seed: Seed = 0, attempts: Attempts = 25, until: Until = "valid",
    llm: Annotated[str | None, typer.Option(help="A model in all parts as well.")] = None,
    setting: Setting = None, memory: Memory = None, workers: Workers = None, out: Out = None, as_json: Json = False,
) -> None:  # fmt: skip
    """How the bank grows as encounters go by: hits, seconds, model calls; beside a bank that stays as it is."""
    from sumo_adv.benchmark.methods import GROWING
    from sumo_adv.benchmark.tables.growth import growth as growing
    from sumo_adv.benchmark.tables.growth import write_growth
    from sumo_adv.benchmark.tables.plots import draw_growth

    rows = [f"{who}{more}" for who in ("expert", *([f"llm-a:{llm}"] if llm else [])) for more in GROWING]
    request, means = _order(suite, ego, rows, seed, attempts, until, setting, memory, workers, out, False)
    cells = _run(request, means, as_json=as_json)
    steps = growing(cells, request.suite.cases)
    files = write_growth(steps, cells, means.folder, _about(request, means))
    files.append(draw_growth(means.folder / "figures" / "growth.png", steps, f"Growth over {request.suite.name}"))
    _say(means, cells, files, files[0].read_text(encoding="utf-8"), as_json=as_json)


@app.command("label", epilog="Example: sumo-adv bench label --suite suite81 --ego idm,krauss --out runs/bench")
def label(
    suite: SuiteOption, ego: Egos = "idm", seed: Seed = 0, attempts: Attempts = 25, until: Until = "valid",
    setting: Setting = None, memory: Memory = None, workers: Workers = None, out: Out = None, as_json: Json = False,
) -> None:  # fmt: skip
    """What the oracle finds most dangerous, into labels.json: put it beside a suite's suite.toml."""
    from sumo_adv.benchmark.rows.oracle import oracle_labels
    from sumo_adv.benchmark.tables.write import as_json as text_of
    from sumo_adv.benchmark.tables.write import manifest, write_texts

    request, means = _order(suite, ego, ["oracle"], seed, attempts, until, setting, memory, workers, out, False)
    cells = _run(request, means, as_json=as_json)
    labels: dict[str, dict[str, Any]] = {}
    for cell in cells:
        if cell["attempts"]:
            labels.setdefault(cell["case"], {})[cell["ego"]] = oracle_labels(cell)
    about = manifest(_about(request, means), cells, ["labels.json"])
    files = write_texts(means.folder, {"labels.json": text_of(labels), "labels.manifest.json": text_of(about)})
    _say(means, cells, files, f"{len(labels)} of {len(request.suite.cases)} encounters labelled.", as_json=as_json)


@app.command("league", epilog="Example: sumo-adv bench league --suite suite81 --ego idm,careful,my_driver:Mine")
def league(
    suite: SuiteOption, ego: Egos, seed: Seed = 0, attempts: Attempts = 25, until: Until = "serious",
    setting: Setting = None, memory: Memory = None, workers: Workers = None, out: Out = None, as_json: Json = False,
) -> None:  # fmt: skip
    """Which of several drivers is hardest to hit: the expert against each of them, in the same encounters."""
    from sumo_adv.benchmark.methods import REFERENCE
    from sumo_adv.benchmark.tables import league as tables
    from sumo_adv.benchmark.tables.screen import league_text
    from sumo_adv.benchmark.tables.write import as_json as text_of
    from sumo_adv.benchmark.tables.write import manifest, write_texts

    request, means = _order(suite, ego, [REFERENCE], seed, attempts, until, setting, memory, workers, out, False)
    cells = _run(request, means, as_json=as_json)
    places, duels = tables.league(cells, attempts)
    title = f"{request.suite.name}, {len(request.suite.cases)} encounters"
    about = manifest(_about(request, means), cells, ["league.md", "league.json"])
    made = {
        "league.md": tables.to_markdown(places, duels, title),
        "league.json": text_of(tables.document(places, duels)),
        "league.manifest.json": text_of(about),
    }
    files = write_texts(means.folder, made)
    _say(means, cells, files, league_text(places, title, files[0]), as_json=as_json)


@app.command("make", epilog="Example: sumo-adv bench make --seed 2 --out suites/other")
def make(
    seed: Annotated[int, typer.Option(min=0, help="Another seed: other encounters of the same kinds.")],
    out: Annotated[Path, typer.Option(help="A new folder.")],
    as_json: Json = False,
) -> None:
    """Make a fresh copy of suite81: 50 straight and 31 intersection encounters."""
    from dataclasses import asdict

    from sumo_adv.benchmark.making.suite import make_suite
    from sumo_adv.files import sentences

    def print_candidate(case: str, wrong: str) -> None:
        if not as_json and not wrong:
            typer.echo(case, err=True)

    with sentences(out):
        made = make_suite(seed, out, name=out.name, report=print_candidate)
    if as_json:
        typer.echo(json.dumps(asdict(made), default=str))
        return
    typer.echo(f"{made.file}: {made.drawn} candidates drawn, {sum(made.rejected.values())} rejected.")


def _unique(rows: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(rows))


def _order(
    suite: Sequence[str], ego: str, rows: Sequence[str], seed: int, attempts: int, until: str,
    setting: Sequence[str] | None, memory: Path | None, workers: int | None, out: Path | None, keep_runs: bool,
    seconds: float = 60.0,
) -> tuple[TableRequest, Means]:  # fmt: skip
    from sumo_adv.app import bench_parts
    from sumo_adv.benchmark.run import Means, TableRequest
    from sumo_adv.benchmark.suites import load_suite
    from sumo_adv.report.outcome import versions
    from sumo_adv.simulation.inputs import data_folder

    egos = _unique([e.strip() for e in ego.split(",") if e.strip()])
    if not egos:
        raise UsageError("--ego names no driver; say for instance --ego idm,careful.")
    loaded = load_suite(*suite)
    settings = {"seconds": seconds, **_settings(setting or ()), "attempts": attempts, "until": until}
    limit = load_settings(None, **settings).cell_seconds
    settings.pop("cell_seconds", None)  # it may be another when a table goes on
    request = TableRequest(loaded, egos, tuple(rows), seed, settings, memory or data_folder("memory_bank.sqlite"))
    _check_models(request)
    folder = out or Path("runs") / f"bench-{loaded.name}"
    return request, Means(folder, workers or os.cpu_count() or 1, bench_parts(), versions(), keep_runs, limit)


def _check_models(request: TableRequest) -> None:
    """Raises UsageError for a row with a model that has no server or no key; asks nothing."""
    from sumo_adv.agents.agents import ROLES
    from sumo_adv.benchmark.methods import method_of
    from sumo_adv.llm.chat import Ledger
    from sumo_adv.llm.client import connect

    for row in request.rows:
        given = method.settings if (method := method_of(row)) is not None else {}
        for name in (given[key] for key in ("llm", *ROLES) if given.get(key, BUILTIN) != BUILTIN):
            settings = load_settings(None, **{**request.settings, **given})
            connect(name, settings, Ledger.for_settings(settings))


def _settings(given: Sequence[str]) -> dict[str, Any]:
    """What ``SUMO_ADV_*`` variables and ``--set`` say, as data: a value is what TOML makes of it, else text."""
    values = set_values(given, "proposals=60")
    for name in values:
        if name in SAID_ELSEWHERE:
            raise UsageError(f"--set {name} is not for all rows of a table; say it as {SAID_ELSEWHERE[name]}.")
    return {**_of_variables(), **values}


def _of_variables() -> dict[str, Any]:
    """The settings that ``SUMO_ADV_*`` variables give, but for those of tables' own; a server's key is in none."""
    settings = load_settings()
    return settings.model_dump(mode="json", include=settings.model_fields_set - SAID_ELSEWHERE.keys())


def _run(request: TableRequest, means: Means, *, as_json: bool) -> list[Cell]:
    from sumo_adv.benchmark.run import of_rows, run_table
    from sumo_adv.cli.bench_progress import make_watcher

    try:
        with make_watcher(quiet=as_json) as watcher:
            cells = run_table(request, means, watcher)
    except KeyboardInterrupt:
        typer.echo("sumo-adv: interrupted; what finished is kept, the same command again does the rest.", err=True)
        raise typer.Exit(1) from None
    return of_rows(cells, request.rows, request.egos)


def _write(
    request: TableRequest, means: Means, cells: Sequence[Cell], name: str, reference: str | None, *,
    words: Mapping[str, str] | None = None, as_json: bool,
) -> None:  # fmt: skip
    """The table's files; its main columns on stdout."""
    from sumo_adv.benchmark.methods import growing_banks
    from sumo_adv.benchmark.tables.compute import make_table
    from sumo_adv.benchmark.tables.plots import draw_all
    from sumo_adv.benchmark.tables.screen import table_text
    from sumo_adv.benchmark.tables.write import write_table

    chosen: Suite = request.suite
    made = make_table(
        cells, title=f"{chosen.name}, {len(chosen.cases)} encounters", cases=chosen.cases, egos=request.egos,
        rows=request.rows, reference=reference, words=words or {},
        notes=growing_banks(request.rows),
    )  # fmt: skip
    files = write_table(made, cells, means.folder, _about(request, means), name)
    files += draw_all(cells, means.folder / "figures", request.rows)
    _say(means, cells, files, table_text(made, files[0]), as_json=as_json)


def _say(means: Means, cells: Sequence[Cell], files: Sequence[Path], text: str, *, as_json: bool) -> None:
    """The outcome; exit status 1 if every cell failed."""
    from sumo_adv.benchmark.tables.cells import failed

    broken = [c for c in cells if failed(c)]
    if as_json:
        count = {"cells": len(cells), "failed": len(broken)}
        typer.echo(json.dumps({"folder": str(means.folder), **count, "files": [str(f) for f in files]}))
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


def _about(request: TableRequest, means: Means) -> Any:
    from sumo_adv.benchmark.run import manifest
    from sumo_adv.benchmark.tables.write import About

    given = manifest(request, means)
    return About(
        " ".join(["sumo-adv", *sys.argv[1:]]), request.suite.name, request.suite.version, request.suite.content,
        means.versions, request.settings, request.seed, given["bank_hash"],
    )  # fmt: skip
