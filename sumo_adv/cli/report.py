"""Define ``report``, which makes pages of a run or a batch, and ``figure``, which makes pictures and films."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv.app import shipped_bank
from sumo_adv.campaigns.results import OUTCOME_FILE, read_row
from sumo_adv.cli.terminal import counted
from sumo_adv.errors import UsageError
from sumo_adv.files import refuse_links, sentences
from sumo_adv.report.staging import RESULTS_FILE, staged

if TYPE_CHECKING:
    from sumo_adv.report.index import Report

EXAMPLE = "Example: sumo-adv report runs/priority_crossing-3"


def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="The folder of a run, or of a batch.")],
    out: Annotated[
        Path | None, typer.Option(help="File of a run's page, or folder of a batch's (default: in DIR).")
    ] = None,
    pages: Annotated[
        int | None, typer.Option(min=0, help="Of a batch: maximum number of replay pages to make now (default: all).")
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Of a batch: processes (default: the cores).")] = None,
    force: Annotated[bool, typer.Option("--force", help="Of a batch: rebuild all pages.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Make one HTML file that replays a run, or an index of a batch with a replay behind each row. Nothing needs a
    network.
    """
    refuse_links(folder)
    if (folder / OUTCOME_FILE).is_file():
        result = _run(folder, out)
    elif (folder / RESULTS_FILE).is_file() or _loose(folder):
        result = _batch(folder, out, pages, workers or os.cpu_count() or 1, force=force, quiet=as_json)
    else:
        raise UsageError(
            f"{folder} is not the folder of a run or of a batch (no {OUTCOME_FILE}, no {RESULTS_FILE} in it)."
        )
    if as_json:
        typer.echo(json.dumps(result))
        return
    for sentence in result.get("damaged", [])[:3]:
        typer.echo(f"sumo-adv: {sentence}", err=True)
    typer.echo(result["words"])


def _run(folder: Path, out: Path | None) -> dict[str, Any]:
    """Make the page of a run."""
    from sumo_adv.report.document import write_document
    from sumo_adv.report.page import make_page

    html = make_page(folder)
    target = out or folder / "report.html"
    if target.is_dir():
        raise UsageError(f"{target} is a folder; give a file as --out.")
    write_document(target, html)
    size = target.stat().st_size
    return {"page": str(target), "bytes": size, "words": f"Page: {target} ({size / 1000:.0f} kB)"}


def _batch(
    folder: Path, out: Path | None, pages: int | None, workers: int, *, force: bool, quiet: bool
) -> dict[str, Any]:
    """Make the index and the pages of a batch, or of runs side by side."""
    from sumo_adv.campaigns.store import packed_texts, unpack_runs
    from sumo_adv.cli.progress import Counter
    from sumo_adv.report.coverage import campaign_coverage, write_coverage
    from sumo_adv.report.index import Packs, read_rows, table_of, write_report
    from sumo_adv.report.scenario_table import rows_of_runs, write_scenarios

    target = out or folder / "report"
    if target.is_file():
        raise UsageError(f"{target} is a file; give a folder as --out.")
    if (folder / RESULTS_FILE).is_file():
        table, runs = read_rows(folder / RESULTS_FILE), folder / "runs"
    else:
        table, runs = table_of(row for run in _loose(folder) if (row := read_row(run)) is not None), folder
    packs = Packs(packed_texts(folder, OUTCOME_FILE), lambda names, into: unpack_runs(folder, names, into, staged))
    counter = Counter("pages", quiet=quiet)
    of = [runs / str(row["id"]) for row in table.rows]
    coverage = campaign_coverage(folder, of, packs.outcomes, shipped_bank())
    scenarios = rows_of_runs(of, packs.outcomes)
    made = write_report(
        runs, target, folder.resolve().name, table, packs, coverage, scenarios, most=pages, workers=workers,
        again=force, tell=counter.tell,
    )  # fmt: skip
    counter.close()
    cells, names = write_coverage(target, coverage), write_scenarios(target, scenarios)
    met, every = coverage.covered()
    words = f"{_words(made)}\nCoverage: {met} of {every} cells have an encounter. Table: {cells}"
    return {
        "index": str(made.index), "episodes": made.episodes, "pages": made.pages, "made": made.made,
        "damaged": list(made.damaged), "coverage": str(cells), "cells": every, "covered": met,
        "scenarios": str(names),
        "words": f"{words}\nNamed scenarios: {names}",
    }  # fmt: skip


def _words(made: Report) -> str:
    lacking = made.episodes - made.pages
    rest = f" {lacking} without a page: rerun the command to make more." if lacking and not made.damaged else ""
    many = f"{counted(made.episodes, 'episode')}, {counted(made.pages, 'replay page')}, {made.made} made now"
    return f"Index: {made.index} ({many}).{rest}"


def _loose(folder: Path) -> list[Path]:
    """List runs side by side in a folder, as ``serve`` leaves them."""
    return sorted(f.parent for f in folder.glob(f"*/{OUTCOME_FILE}")) if folder.is_dir() else []


FIGURE_EXAMPLE = "Example: sumo-adv figure runs/priority_crossing-3 --out encounter.pdf"
PICTURES, FILMS = ("png", "svg", "pdf"), ("gif", "mp4")


def figure(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run or a hunt.")],
    out: Annotated[
        Path | None, typer.Option(help="A .png, .svg, .pdf, .gif or .mp4 file (default: figure.png in DIR).")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Draw a run as papers do, without and with the attack, or film the attack. Of a hunt: its failures over time."""
    target = out or folder / "figure.png"
    kind = target.suffix.removeprefix(".").lower()
    if kind not in (*PICTURES, *FILMS):
        kinds = ", ".join(f".{k}" for k in (*PICTURES, *FILMS))
        raise UsageError(f"{target} has an ending that cannot be drawn; give --out a file that ends in one of {kinds}.")
    if target.is_dir() or (target.exists() and not force):
        raise UsageError(f"{target} already exists; give another --out, or --force to replace the file.")
    from sumo_adv.report.index import HUNT

    if (folder / HUNT).is_file():
        _draw_hunt(folder, target, kind)
    else:
        _draw_run(folder, target, kind)
    typer.echo(json.dumps({"out": str(target), "kind": kind}) if as_json else f"Figure: {target}")


def _draw_hunt(folder: Path, target: Path, kind: str) -> None:
    """Draw a hunt's failures over time."""
    from sumo_adv.hunting.rounds import over_time
    from sumo_adv.report.figures import draw_over_time, save

    if kind in FILMS:
        raise UsageError(f"A hunt has no film: give --out a file that ends in one of .{', .'.join(PICTURES)}.")
    after = over_time(folder)
    with sentences(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        picture = draw_over_time([a.minutes for a in after], [a.found for a in after], [a.discovery for a in after])
        save(picture, target, kind)


def _draw_run(folder: Path, target: Path, kind: str) -> None:
    """Draw or film a run."""
    from sumo_adv.report.figures import draw_paper, read_story, save, write_film
    from sumo_adv.report.read import reading

    with reading(folder), sentences(target):
        story = read_story(folder)
        target.parent.mkdir(parents=True, exist_ok=True)
        if kind in FILMS:
            write_film(story, target, kind)
        else:
            save(draw_paper(story), target, kind)
