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
    from sumo_adv.report.export.write import write_export
    from sumo_adv.report.page.read import reading

    target = out or folder.resolve().parent / f"{folder.resolve().name}{ENDINGS[format]}"
    with reading(folder):
        piece = read_piece(folder, unattacked=unattacked, before=before, whole=whole)
        write_export(target, piece, format, variant, force=force)
    _say(target, piece, format, as_json=as_json)


def _say(target: Path, piece: Piece, format: Format, *, as_json: bool) -> None:
    made: dict[str, Any] = {
        "format": str(format), "out": str(target), "vehicles": len(piece.tracks), "begin": round(piece.begin, 3),
        "end": round(piece.end, 3), "ego": piece.ego, "adversary": piece.adversary, "takeover": piece.takeover,
        **({"supports": list(piece.supports)} if piece.supports else {}),
    }  # fmt: skip
    if as_json:
        typer.echo(json.dumps(made))
        return
    typer.echo(f"{len(piece.tracks)} vehicles from {piece.begin:.1f} to {piece.end:.1f} s: {target}")
