"""Define the commands about scenarios that ``run`` takes.

``scenarios`` lists the shipped ones. ``convert`` makes them from Waymo records and CommonRoad scenarios, with a report
on fidelity. ``import`` makes one from a recording of another program.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.report.staging import staged

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sumo_adv.simulation.shipped import ShippedScenario
    from sumo_adv.womd.reader import RecordChoice, Told
    from sumo_adv.womd.record import Record

TABLE_CHARACTERS = 125
EXAMPLE = "Example: sumo-adv convert records.tfrecord --first 3 --out waymo"


def convert(
    source: Annotated[
        Path, typer.Argument(metavar="FILE", help="TFRecord of Waymo motion scenarios, or CommonRoad .xml.")
    ],
    out: Annotated[Path, typer.Option(help="Folder to write into: one folder per record, named by its id.")],
    record_id: Annotated[str | None, typer.Option("--id", help="Only the record of this id.")] = None,
    first: Annotated[
        int | None, typer.Option(min=1, help="Number of records, from the first on (default: all).")
    ] = None,
    keep_going: Annotated[
        bool, typer.Option("--keep-going", help="Report what is wrong with a record and continue with the next.")
    ] = False,
    traffic: Annotated[bool, typer.Option(help="Try random traffic in each network for 120 s.")] = True,
    force: Annotated[bool, typer.Option("--force", help="Replace folders of earlier conversions.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Convert Waymo records to SUMO scenarios: network, tracks, routes, and a report on fidelity."""
    from sumo_adv.womd.reader import RecordChoice

    if record_id is not None and first is not None:
        raise UsageError("Give either --id or --first, not both.")
    failed: list[str] = []

    def tell(error: SumoAdvError) -> None:
        failed.append(str(error))
        typer.echo(f"sumo-adv: {error}", err=True)

    reports = []
    choice = RecordChoice(record_id, first=first)
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
                for said in record.notes:
                    typer.echo(said)
    if as_json:
        typer.echo(json.dumps({"records": reports, "failed": failed}, allow_nan=False))
    elif reports:
        show(reports)
    if failed and not reports:
        raise typer.Exit(1)


def _records(source: Path, choice: RecordChoice, told: Told | None) -> Iterable[Record]:
    """Read the chosen records of a TFRecord file, or the record made of a CommonRoad scenario.

    Raises:
        UsageError: The file is not a TFRecord file, and records of it are chosen.
    """
    from sumo_adv.simulation.inputs import is_commonroad
    from sumo_adv.womd.commonroad import read_commonroad
    from sumo_adv.womd.reader import ALL_RECORDS, read_records

    if not is_commonroad(source):
        return read_records(source, choice, told)
    if choice != ALL_RECORDS:
        raise UsageError(
            f"--id and --first choose records of a TFRecord file, and {source} is not one: leave them out."
        )
    return [read_commonroad(source)]


def _fault(record: str, error: Exception) -> str:
    """Describe an unexpected error in the conversion of a record that no check refused."""
    if isinstance(error, MemoryError):
        return f"Record {record} needs more memory than there is; convert it on a larger machine, or leave it out."
    fault = f"{type(error).__name__}: {error}"[:300]
    return (
        f"Record {record} cannot be converted: a fault of sumo_adv itself ({fault}); please report it with the record."
    )


def _one(record: Record, out: Path, *, traffic: bool, force: bool) -> dict[str, Any]:
    """Convert one record, put its folder in place, and return its report with the folder."""
    from sumo_adv.womd.convert import conversion

    with staged(out / record.scenario_id, force=force) as folder:
        with conversion(record, traffic=traffic) as made:
            shutil.copytree(made.folder, folder.stage, dirs_exist_ok=True)
            report = {**made.report, "cached": made.cached, "folder": str(folder.target)}
        folder.keep(force=force)
    return report


def show(reports: list[dict[str, Any]]) -> None:
    """Print the table of fidelity."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from sumo_adv.womd.fidelity import FIDELITY_COLUMNS, LEGEND, row

    table = Table(box=SIMPLE_HEAD, padding=0, collapse_padding=True, pad_edge=False)
    for name in FIDELITY_COLUMNS:
        table.add_column(name, no_wrap=True, justify="left" if name == "record" else "right")
    for report in reports:
        table.add_row(*row(report))
    console = Console(width=max(Console().width, TABLE_CHARACTERS))  # narrow terminals wrap lines, cells stay whole
    console.print(table)
    console.print(LEGEND, highlight=False)


IMPORT_EXAMPLE = "Example: sumo-adv import fcd.xml --network town.net.xml --ego 17 --out recorded"


def import_fcd(
    recording: Annotated[Path, typer.Argument(metavar="FCD", help="File that sumo --fcd-output wrote, packed or not.")],
    network: Annotated[Path, typer.Option(help="The .net.xml that it was driven on.")],
    ego: Annotated[str, typer.Option(help="Id of the vehicle under test.")],
    out: Annotated[Path, typer.Option(help="Folder to write.")],
    types: Annotated[
        list[Path] | None, typer.Option(help="File of vTypes with the sizes of vehicles; repeatable.")
    ] = None,
    warm_up: Annotated[
        float, typer.Option(min=0.0, help="Time for which the recording moves all vehicles after the ego's arrival, s.")
    ] = 3.0,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier import.")] = False,
) -> None:
    """Make a scenario of floating car data: run it with any ego; the other vehicles become SUMO's, or stay recorded."""
    from sumo_adv.simulation.fcd_scenario import write_scenario
    from sumo_adv.simulation.scan import scan_network
    from sumo_adv.simulation.scenario import SCENARIO_FILE

    scan_network(network)
    with staged(out, force=force) as folder:
        done = write_scenario(folder.stage, recording, network, ego, types or (), warm_up)
        folder.keep(force=force)
    for note in done.notes:
        typer.echo(note, err=True)
    typer.echo(f"{done.objects} objects; run it: sumo-adv run {out / SCENARIO_FILE}")


SCENARIOS_EXAMPLE = "Example: sumo-adv scenarios"
MEANS = (
    "A run finds such an attack in at most 400 attempts: sumo-adv run SCENARIO --until LEVEL --learn off,\n"
    "with --adversaries 2 for one of 2."
)


def scenarios(
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """List the shipped scenarios with road, a dangerous attack and a description, and the shipped networks."""
    from sumo_adv.simulation.inputs import shipped_files
    from sumo_adv.simulation.shipped import shipped_scenarios

    shipped, networks = shipped_scenarios(), shipped_files("networks", ".net.xml")
    if as_json:
        typer.echo(json.dumps({"scenarios": [asdict(s) for s in shipped], "networks": networks}))
        return
    rows = [("scenario", "road", "adversary", "level", "intent")]
    rows += [(s.name, s.road, _adversary(s), s.level or "-", s.intents[0]) for s in shipped]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(word.ljust(width) for word, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    typer.echo(lines[0])
    for line, s in zip(lines[1:], shipped, strict=True):
        typer.echo(f"{line}\n    {s.description}")
    typer.echo(f"Networks: {', '.join(networks)}\n{MEANS}")


def _adversary(scenario: ShippedScenario) -> str:
    """Return the collider's relation, and the number of adversaries if there are several."""
    relation = scenario.relation or "-"
    return relation if scenario.adversaries == 1 else f"{relation}, of {scenario.adversaries}"
