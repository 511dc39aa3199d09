"""``convert``: Waymo records and CommonRoad scenarios to folders that ``run`` takes, each with a report on fidelity."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv.errors import SumoAdvError, UsageError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sumo_adv.womd.reader import Choice, Told
    from sumo_adv.womd.record import Record

TABLE_WIDTH = 125  # characters
EXAMPLE = "Example: sumo-adv convert records.tfrecord --first 3 --out waymo"


def convert(
    source: Annotated[
        Path, typer.Argument(metavar="FILE", help="TFRecord of Waymo motion scenarios, or CommonRoad .xml.")
    ],
    out: Annotated[Path, typer.Option(help="Folder to write into: a folder a record, by its id.")],
    record_id: Annotated[str | None, typer.Option("--id", help="Only the record of this id.")] = None,
    index: Annotated[int | None, typer.Option(min=0, help="Only the record at this place, from 0.")] = None,
    first: Annotated[int | None, typer.Option(min=1, help="Number of records from the first on; else all.")] = None,
    keep_going: Annotated[
        bool, typer.Option("--keep-going", help="Tell what is wrong with a record and take the next one.")
    ] = False,
    traffic: Annotated[bool, typer.Option(help="Try random traffic in each network for 120 s.")] = True,
    force: Annotated[bool, typer.Option("--force", help="Replace folders of earlier conversions.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Convert Waymo records to SUMO scenarios: network, tracks, routes, and a report on fidelity."""
    from sumo_adv.womd.reader import Choice

    if sum(given is not None for given in (record_id, index, first)) > 1:
        raise UsageError("Give one of --id, --index and --first, not several.")
    failed: list[str] = []

    def tell(error: SumoAdvError) -> None:
        failed.append(str(error))
        typer.echo(f"sumo-adv: {error}", err=True)

    reports = []
    choice = Choice(record_id, index, first)
    for record in _records(source, choice, tell if keep_going else None):
        try:
            reports.append(_one(record, out, traffic=traffic, force=force))
        except SumoAdvError as error:
            if not keep_going:
                raise
            tell(error)
        except Exception as error:
            fault = SumoAdvError(_fault(record.scenario_id, error))
            if not keep_going:
                raise fault from error
            tell(fault)
        else:
            if not as_json:
                note = reports[-1]["sampling"]["note"]
                typer.echo(f"{record.scenario_id}: {reports[-1]['folder']}{f' ({note})' if note else ''}")
    if as_json:
        typer.echo(json.dumps({"records": reports, "failed": failed}, allow_nan=False))
    elif reports:
        show(reports)
    if failed and not reports:
        raise typer.Exit(1)


def _records(source: Path, choice: Choice, told: Told | None) -> Iterable[Record]:
    """The chosen records of a TFRecord file, or the record made of a CommonRoad scenario. Raises UsageError."""
    from sumo_adv.simulation.inputs import is_commonroad
    from sumo_adv.womd.commonroad import read_commonroad
    from sumo_adv.womd.reader import ALL, read_records

    if not is_commonroad(source):
        return read_records(source, choice, told)
    if choice != ALL:
        raise UsageError(f"--id, --index and --first choose among records of a TFRecord file, which {source} is not.")
    return [read_commonroad(source)]


def _fault(record: str, error: Exception) -> str:
    """What to say of a record that no check refused and that cannot be converted all the same."""
    if isinstance(error, MemoryError):
        return f"Record {record} needs more memory than there is; convert it on a larger machine, or leave it out."
    fault = f"{type(error).__name__}: {error}"[:300]
    return (
        f"Record {record} cannot be converted: a fault of sumo_adv itself ({fault}); please report it with the record."
    )


def _one(record: Record, out: Path, *, traffic: bool, force: bool) -> dict[str, Any]:
    """Put one record's folder in its place; its report and folder."""
    from sumo_adv.report.staging import staged
    from sumo_adv.womd.convert import REPORT, conversion

    with staged(out / record.scenario_id, force=force, marker=REPORT) as folder:
        with conversion(record, traffic=traffic) as made:
            shutil.copytree(made.folder, folder.stage, dirs_exist_ok=True)
            report = {**made.report, "cached": made.cached, "folder": str(folder.target)}
        folder.keep(force=force)
    return report


def show(reports: list[dict[str, Any]]) -> None:
    """The reports as a table."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from sumo_adv.womd.fidelity import COLUMNS, LEGEND, row

    table = Table(box=SIMPLE_HEAD, padding=0, collapse_padding=True, pad_edge=False)
    for name in COLUMNS:
        table.add_column(name, no_wrap=True, justify="left" if name == "record" else "right")
    for report in reports:
        table.add_row(*row(report))
    console = Console()
    console = Console(width=max(console.width, TABLE_WIDTH))  # a narrow terminal wraps lines, but loses no cell
    console.print(table)
    console.print(LEGEND, highlight=False)
