"""Writes a run in the chosen format of another tool."""

from __future__ import annotations

from pathlib import Path

from sumo_adv.errors import UsageError
from sumo_adv.files import sentences, write_text, write_whole
from sumo_adv.report.export.choices import Format, Variant
from sumo_adv.report.export.fcd import fcd
from sumo_adv.report.export.openscenario import SCENARIO, write_openscenario
from sumo_adv.report.export.piece import Piece
from sumo_adv.report.export.replay import CONFIGURATION, write_replay
from sumo_adv.report.export.table import table
from sumo_adv.report.staging import staged
from sumo_adv.report.tables import write_gzip
from sumo_adv.simulation.programs import find_netconvert


def write_export(target: Path, piece: Piece, format: Format, variant: Variant, *, force: bool) -> None:
    """Write a run in another tool's format: the whole file or folder, or nothing.

    Raises UsageError: ``target`` exists, or an error of the format.
    """
    if format in (Format.OPENSCENARIO, Format.SUMO):
        _folder(target, piece, format, variant, force=force)
    else:
        _file(target, piece, format, force=force)


def _folder(target: Path, piece: Piece, format: Format, variant: Variant, *, force: bool) -> None:
    marker = SCENARIO if format is Format.OPENSCENARIO else CONFIGURATION
    with staged(target, force=force, marker=marker) as folder:
        if format is Format.OPENSCENARIO:
            write_openscenario(folder.stage, piece, find_netconvert(), variant)
        else:
            write_replay(folder.stage, piece)
        folder.keep(force=force)


def _file(target: Path, piece: Piece, format: Format, *, force: bool) -> None:
    if target.is_dir() or (target.exists() and not force):
        raise UsageError(f"{target} is there already; give another --out, or --force to replace a file.")
    text = fcd(piece) if format is Format.FCD else table(piece)
    with sentences(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.suffix == ".gz":
            write_whole(target, lambda part: write_gzip(part, text))
        else:
            write_text(target, text)
