"""Define ``export``: write a run, or each of many, in the formats of other tools."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv.app import unpacked
from sumo_adv.errors import UsageError
from sumo_adv.report.export import Format, Variant

if TYPE_CHECKING:
    from sumo_adv.report.export.piece import ExportedRun

EXAMPLE = "Example: sumo-adv export runs/priority_crossing-3 --format openscenario --variant free-ego --out scenario"


def export(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="Folder of a run, or of many: a hunt, a campaign, the results of regress."),
    ],
    format: Annotated[Format, typer.Option(help="Format to write; all: every format whose packages are installed.")],
    out: Annotated[
        Path | None,
        typer.Option(
            help="File or folder to write, .gz for a packed fcd or csv; for several exports, their folder "
            "(default: beside DIR)."
        ),
    ] = None,
    variant: Annotated[
        Variant, typer.Option(help="For openscenario: replay all vehicles, or leave the ego to the player.")
    ] = Variant.REPLAY,
    unattacked: Annotated[bool, typer.Option("--unattacked", help="Export the run without an attack instead.")] = False,
    before: Annotated[
        float | None, typer.Option(min=0.0, help="Begin this long before the takeover, s (default: the run's history).")
    ] = None,
    whole: Annotated[bool, typer.Option("--whole", help="Begin where the simulation began.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier export.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Write a run, or each of many, for other tools: one format, or all."""
    if whole and before is not None:
        raise UsageError("Give either --whole or --before, not both.")
    if variant is not Variant.REPLAY and format is not Format.OPENSCENARIO:
        raise UsageError("Only --format openscenario has a --variant.")
    from sumo_adv.campaigns.store import packed_rows
    from sumo_adv.regression.case import CASE_FILE
    from sumo_adv.report.export.formats import FORMATS, chosen, left_out, runs_in, write_export
    from sumo_adv.report.export.piece import read_piece
    from sumo_adv.report.read import reading

    runs, formats = runs_in(folder), chosen(format)
    here = {run.name for run in runs}
    packed = [name for name in packed_rows(folder) if name not in here]  # a folder is newer than a pack
    if not runs and not packed:
        if (folder / CASE_FILE).is_file() or any(folder.glob(f"*/{CASE_FILE}")):
            raise UsageError(
                f"{folder} holds kept cases, which have no states to export; run sumo-adv regress {folder} --ego EGO, "
                f"and give the results of regress: runs/regress-{folder.resolve().name}."
            )
        raise UsageError(
            f"{folder} holds no runs; give the folder of a run, a hunt, a campaign, or the results of regress."
        )
    if format is Format.ALL:
        for sentence in left_out():
            typer.echo(f"Left out: {sentence}", err=True)
    single = runs == [folder]
    source = folder.resolve()
    place = out or (source.parent if single else source.with_name(f"{source.name}-exports"))
    cut = partial(read_piece, unattacked=unattacked, before=before, whole=whole)
    made = 0
    for run, piece in _pieces(chain(runs, unpacked(folder, packed)), cut, single=single):
        for each in formats:
            target = place / f"{run.resolve().name}{FORMATS[each].ending}"
            if out is not None and single and format is not Format.ALL:
                target = out
            with reading(run):
                lost = write_export(target, piece, each, variant, force=force)
            if lost is not None:
                typer.echo(lost, err=True)
            _say(target, piece, each, as_json=as_json)
            made += 1
    if not made:
        raise UsageError(f"None of the {len(runs) + len(packed)} runs in {folder} could be exported.")


def _pieces(
    runs: Iterable[Path], cut: Callable[[Path], ExportedRun], *, single: bool
) -> Iterator[tuple[Path, ExportedRun]]:
    """Read the part of each run that is exported. Runs that cannot be exported are reported and left out.

    Args:
        runs: The folders of the runs.
        cut: Reads the part of a run.
        single: Whether there is only one run, which must not be left out.

    Yields:
        The folder and the part of a run.

    Raises:
        UsageError: A ``single`` run cannot be exported.
    """
    from sumo_adv.report.read import reading

    for run in runs:
        try:
            with reading(run):
                piece = cut(run)
        except UsageError as error:
            if single:
                raise
            typer.echo(f"Left out: {error}", err=True)
            continue
        yield run, piece


def _say(target: Path, piece: ExportedRun, format: Format, *, as_json: bool) -> None:
    made: dict[str, Any] = {
        "format": str(format), "out": str(target), "vehicles": len(piece.tracks), "begin": round(piece.begin, 3),
        "end": round(piece.end, 3), "ego": piece.ego, "adversary": piece.adversary, "takeover": piece.takeover,
        **({"supports": list(piece.supports)} if piece.supports else {}),
    }  # fmt: skip
    if as_json:
        typer.echo(json.dumps(made))
        return
    typer.echo(f"{len(piece.tracks)} vehicles from {piece.begin:.1f} to {piece.end:.1f} s: {target}")
