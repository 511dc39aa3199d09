"""Define ``judge``, for stored runs and standard cut-ins, and ``compare``, for two drivers or two revisions."""

from __future__ import annotations

import csv
import json
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.files import sentences, write_text

if TYPE_CHECKING:
    from sumo_adv.report.judging import Judgement

EXAMPLE = "Example: sumo-adv judge runs/priority_crossing-3"


def judge(
    folders: Annotated[
        list[Path] | None, typer.Argument(metavar="[DIR]...", help="Folders of runs, or folders that hold runs.")
    ] = None,
    cut_ins: Annotated[
        Path | None,
        typer.Option(
            "--cut-ins", metavar="FILE", help="CSV of ego_kmh, other_kmh, gap_m, lateral_ms to judge instead."
        ),
    ] = None,
    replay: Annotated[
        bool, typer.Option("--replay", help="Rerun the simulations, with reference drivers in the loop.")
    ] = False,
    ego: Annotated[
        str | None, typer.Option(help="The class that drove the runs, module:Class; a replay needs it.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="CSV to write (cut-ins: default on stdout).")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Runs replayed at once (default: one per core).")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Say what collisions mean: the level of each run, the drivers that avoid it, and how severe it is.

    Runs whose outcome.json has schema 1 are rewritten once as schema 2.
    """
    if cut_ins is not None:
        if folders:
            raise UsageError("Give either folders of runs or --cut-ins FILE, not both.")
        _cut_ins(cut_ins, out, as_json=as_json)
        return
    if not folders:
        raise UsageError("Give folders of runs, or --cut-ins FILE.")
    _runs(folders, replay, ego, out, workers or os.cpu_count() or 1, as_json=as_json)


def _runs(folders: list[Path], replay: bool, ego: str | None, out: Path | None, workers: int, *, as_json: bool) -> None:
    """Judge runs in parallel, print or write the table, and exit with status 1 if a run failed."""
    from sumo_adv.report.judging import counts, run_folders

    judgements: list[Judgement] = []
    failed: list[str] = []
    with ThreadPoolExecutor(workers) as pool:
        todo = [(folder, pool.submit(_judged, folder, replay, ego)) for folder in run_folders(folders)]
        for folder, future in todo:
            try:
                judgements.append(future.result())
            except SumoAdvError as error:
                failed.append(f"{folder}: {error}")
    rows = [j.row() for j in judgements]
    if out is not None:
        _write(out, rows)
    if as_json:
        typer.echo(json.dumps({"runs": rows, "counts": counts(judgements), "failed": failed}))
    else:
        for row in rows if len(rows) <= 30 or out is None else ():
            typer.echo(_line(row))
        for name, row in counts(judgements).items():
            typer.echo(f"{name}: " + ", ".join(f"{key} {value}" for key, value in row.items()))
    for sentence in failed:
        typer.echo(f"sumo-adv: {sentence}", err=True)
    if failed:
        raise typer.Exit(1)


def _judged(folder: Path, replay: bool, ego: str | None) -> Judgement:
    from sumo_adv.report.judging import judge_files
    from sumo_adv.report.read import bring_up_to_date, reading

    with reading(folder):
        bring_up_to_date(folder)
        return _replayed(folder, ego) if replay else judge_files(folder)


def _replayed(folder: Path, ego: str | None) -> Judgement:
    """Simulate a run again, with its reference drivers.

    Raises:
        UsageError: ``ego`` is not the driver of the run.
        SumoAdvError: The encounter did not come back.
    """
    from sumo_adv.app import replay
    from sumo_adv.drivers.registry import is_foreign, trusted_driver
    from sumo_adv.report.judging import Judgement
    from sumo_adv.report.manifest import read_manifest
    from sumo_adv.report.outcome import verdict
    from sumo_adv.report.read import read_run

    before = read_run(folder).outcome.get("outcome") or {}
    recorded = read_manifest(folder)
    driver = recorded.task.ego_driver
    if trusted_driver(ego, driver, folder) != driver and is_foreign(driver):
        raise UsageError(f"The run in {folder} was driven by {driver!r}, not by {ego!r}.")
    run = replay(recorded)
    best = None if run.best is None else run.best.best
    if best is None:
        raise SumoAdvError(f"The encounter did not recur ({run.reason})")
    return Judgement(folder, driver, before, verdict(best.verdict), "replay")


def _line(row: dict[str, Any]) -> str:
    words = [f"{row['run']}: {row['level']}"]
    if row["collided"]:
        by = ", ".join(row["preventable_by"] or ()) or "nobody"
        hit = row["impact_speed"]
        hard = f"delta-v {row['delta_v'] or 0.0:.1f} m/s" if hit is None else f"hit at {hit:.1f} m/s"
        words.append(f"{hard} ({row['severity']}), avoided by {by}")
    words += [f"inconclusive ({row['inconclusive']})"] if row["inconclusive"] else []
    words += ["the ego stood"] if row["ego_stationary"] else []
    return ", ".join(words)


def _cut_ins(file: Path, out: Path | None, *, as_json: bool) -> None:
    """Judge the cut-ins of a CSV file."""
    import numpy as np

    from sumo_adv.metrics.own_data import ANSWERING_DRIVERS, CASE_COLUMNS, judge_cut_ins

    try:
        with file.open(newline="", encoding="utf-8") as text:
            table = list(csv.DictReader(text))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"The cut-ins in {file} cannot be read ({error}).") from error
    if not table or any(name not in table[0] for name in CASE_COLUMNS):
        raise UsageError(f"{file} needs rows with the columns {', '.join(CASE_COLUMNS)}.")
    try:
        cases = np.array([[float(row[name]) for name in CASE_COLUMNS] for row in table])
    except (TypeError, ValueError) as error:
        raise UsageError(f"{file} holds something that is not a number ({error}).") from error
    rows = [{**given, **answer} for given, answer in zip(table, judge_cut_ins(cases), strict=True)]
    if out is not None:
        _write(out, rows)
    if as_json:
        typer.echo(json.dumps({"cut_ins": len(rows), "prevented": _prevented(rows, ANSWERING_DRIVERS)}))
    elif out is None:
        head = list(rows[0])
        typer.echo(",".join(head))
        for row in rows:
            typer.echo(",".join(str(row[name]) for name in head))
    else:
        typer.echo(f"{len(rows)} cut-ins into {out}: {_prevented(rows, ANSWERING_DRIVERS)}")


def _prevented(rows: list[dict[str, Any]], names: tuple[str, ...]) -> dict[str, int]:
    """Count the collisions of the unchanged ego, and how many of them each driver avoids."""
    hit = [row for row in rows if row["unchanged"] != "none"]
    return {"collisions": len(hit)} | {n: sum(row[n] == "none" for row in hit) for n in names if n != "unchanged"}


def _write(out: Path, rows: list[dict[str, Any]]) -> None:
    from sumo_adv.report.tables import csv_text, plain_row

    plain = [{k: " ".join(v) if isinstance(v, list) else v for k, v in row.items()} for row in rows]
    with sentences(out):
        write_text(out, csv_text(list(rows[0]) if rows else [], map(plain_row, plain)))


COMPARE_EXAMPLE = "Example: sumo-adv compare runs/regress-main runs/regress-branch --out runs/compared"


def compare(
    first: Annotated[Path, typer.Argument(metavar="A", help="Folder of a run, a campaign, a bench or a regression.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Another such folder; or the same one, with --egos.")],
    egos: Annotated[
        str | None, typer.Option(metavar="A,B", help="The driver to compare from each folder, if a folder has several.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for a page with the replays of the cases that changed.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace another comparison's folder.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Compare two sides: rates, severity, attempts until valid, and which cases changed, paired by encounter.

    Differences are B - A: a negative one means that B is hit less often or less hard.
    """
    from sumo_adv.comparison.compare import compare as compared
    from sumo_adv.comparison.compare import read_side
    from sumo_adv.comparison.page import to_markdown, write_comparison

    done = compared(read_side(first), read_side(second), _two(egos))
    page = None if out is None else write_comparison(out, done, force=force)
    if as_json:
        typer.echo(json.dumps(done.document() | {"page": None if page is None else str(page)}))
        return
    typer.echo(to_markdown(done, lambda episode: None if episode.run is None else str(episode.run)))
    if page is not None:
        typer.echo(f"Page: {page}")


def _two(egos: str | None) -> tuple[str, str] | None:
    """Split the option ``--egos`` into two drivers."""
    if egos is None:
        return None
    names = [name.strip() for name in egos.split(",")]
    if len(names) != 2 or not all(names):
        raise UsageError(f"--egos takes two drivers, such as idm,careful, not '{egos}'.")
    return names[0], names[1]
