"""Writes runs in the formats of other tools."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sumo_adv.errors import UsageError
from sumo_adv.files import sentences, write_whole
from sumo_adv.report.export.choices import Format, Variant
from sumo_adv.report.export.formats import FORMATS, Entry
from sumo_adv.report.export.piece import Piece
from sumo_adv.report.page.read import OUTCOME
from sumo_adv.report.staging import staged

HOLDERS = (".", "failures", "runs")  # where hunts, regression suites and campaigns keep their runs


def chosen(format: Format) -> list[Format]:
    """The formats that ``format`` stands for.

    Raises UsageError: a package of the one format is missing.
    """
    if format is Format.ALL:
        return [each for each, entry in FORMATS.items() if not entry.missing]
    FORMATS[format].need(format)
    return [format]


def left_out() -> Iterator[str]:
    """A sentence for each format that lacks a package."""
    for format, entry in FORMATS.items():
        try:
            entry.need(format)
        except UsageError as error:
            yield str(error)


def runs_in(folder: Path) -> list[Path]:
    """``folder`` itself if it is a run's, or none at all; else the runs of a hunt, a regression suite or a campaign."""
    if (folder / OUTCOME).is_file() or not folder.is_dir():
        return [folder]
    places = [folder / holder for holder in HOLDERS if (folder / holder).is_dir()]
    return [run for place in places for run in sorted(place.iterdir()) if (run / OUTCOME).is_file()]


def write_export(target: Path, piece: Piece, format: Format, variant: Variant, *, force: bool) -> str | None:
    """Write a run in one format: the whole file or folder, or nothing. Gives a sentence if something is lost.

    Raises UsageError: ``target`` exists, a package of the format is missing, or an error of the format.
    """
    entry = FORMATS[format]
    entry.need(format)
    if entry.marker:
        with staged(target, force=force, marker=entry.marker) as folder:
            lost = entry.write(folder.stage, piece, variant)
            folder.keep(force=force)
        return lost
    return _file(target, piece, entry, variant, force=force)


def _file(target: Path, piece: Piece, entry: Entry, variant: Variant, *, force: bool) -> str | None:
    if target.is_dir() or (target.exists() and not force):
        raise UsageError(f"{target} is there already; give another --out, or --force to replace a file.")
    with sentences(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        lost: list[str | None] = []
        write_whole(target, lambda part: lost.append(entry.write(part, piece, variant)))
        return lost[0]
