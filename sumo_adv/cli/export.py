"""``export``: a run in the formats of other tools."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sumo_adv.errors import UsageError
from sumo_adv.report.export.choices import Format, Variant

if TYPE_CHECKING:
    from sumo_adv.report.export.piece import Piece

EXAMPLE = "Example: sumo-adv export runs/priority_crossing-3 --format openscenario --variant free-ego --out scenario"

ENDINGS = {Format.OPENSCENARIO: "-openscenario", Format.SUMO: "-sumo", Format.FCD: ".fcd.xml", Format.CSV: ".csv"}


def export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of a run.")],
    format: Annotated[Format, typer.Option(help="openscenario and sumo make a folder, fcd and csv a file.")],
    out: Annotated[
        Path | None, typer.Option(help="What to write; .gz for a packed fcd or csv (default: beside DIR).")
    ] = None,
    variant: Annotated[
        Variant, typer.Option(help="Of openscenario: all replayed, or the ego left to the player.")
    ] = Variant.REPLAY,
    unattacked: Annotated[bool, typer.Option("--unattacked", help="The run without an attack instead.")] = False,
    before: Annotated[
        float | None, typer.Option(min=0.0, help="Begin so long before the takeover, s (default: the run's history).")
    ] = None,
    whole: Annotated[bool, typer.Option("--whole", help="Begin where the simulation began.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an earlier export.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout, nothing else.")] = False,
) -> None:
    """Write a run for other tools: OpenSCENARIO with OpenDRIVE, SUMO's FCD, a replay for plain SUMO, one CSV."""
    if whole and before is not None:
        raise UsageError("Give either --whole or --before, not both.")
    if variant is not Variant.REPLAY and format is not Format.OPENSCENARIO:
        raise UsageError("Only --format openscenario has a --variant.")
    from sumo_adv.report.export.piece import read_piece

    piece = read_piece(folder, unattacked=unattacked, before=before, whole=whole)
    target = out or folder.resolve().parent / f"{folder.resolve().name}{ENDINGS[format]}"
    write(target, piece, format, variant, force=force)
    _say(target, piece, format, as_json=as_json)


def write(target: Path, piece: Piece, format: Format, variant: Variant, *, force: bool) -> None:
    """Write the piece whole or not at all. Raises UsageError: ``target`` is taken; and what the format may raise."""
    if format in (Format.OPENSCENARIO, Format.SUMO):
        _folder(target, piece, format, variant, force=force)
    else:
        _file(target, piece, format, force=force)


def _folder(target: Path, piece: Piece, format: Format, variant: Variant, *, force: bool) -> None:
    from sumo_adv.report.export.openscenario import SCENARIO, write_openscenario
    from sumo_adv.report.export.replay import CONFIGURATION, write_replay
    from sumo_adv.report.folder import staged
    from sumo_adv.womd.network.netconvert import find_netconvert

    marker = SCENARIO if format is Format.OPENSCENARIO else CONFIGURATION
    with staged(target, force=force, marker=marker) as folder:
        if format is Format.OPENSCENARIO:
            write_openscenario(folder.stage, piece, find_netconvert(), variant)
        else:
            write_replay(folder.stage, piece)
        folder.keep(force=force)


def _file(target: Path, piece: Piece, format: Format, *, force: bool) -> None:
    from sumo_adv.files import sentences, write_text, write_whole
    from sumo_adv.report.export.fcd import fcd
    from sumo_adv.report.export.table import table
    from sumo_adv.report.tables import write_gzip

    if target.is_dir() or (target.exists() and not force):
        raise UsageError(f"{target} is there already; give another --out, or --force to replace a file.")
    text = fcd(piece) if format is Format.FCD else table(piece)
    with sentences(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.suffix == ".gz":
            write_whole(target, lambda part: write_gzip(part, text))
        else:
            write_text(target, text)


def _say(target: Path, piece: Piece, format: Format, *, as_json: bool) -> None:
    made: dict[str, Any] = {
        "format": str(format), "out": str(target), "vehicles": len(piece.tracks), "begin": round(piece.begin, 3),
        "end": round(piece.end, 3), "ego": piece.ego, "adversary": piece.adversary, "takeover": piece.takeover,
    }  # fmt: skip
    if as_json:
        typer.echo(json.dumps(made))
        return
    typer.echo(f"{len(piece.tracks)} vehicles from {piece.begin:.1f} to {piece.end:.1f} s: {target}")
