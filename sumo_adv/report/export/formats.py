"""The formats: what each is called, what it needs, and writing a run in one of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from sumo_adv.errors import UsageError
from sumo_adv.files import sentences, write_whole
from sumo_adv.report.export import Format, Variant
from sumo_adv.report.export.commonroad import COMMONROAD_SCENARIO_FILE, SUMMARY, write_commonroad, write_scenarionet
from sumo_adv.report.export.messages import write_mcap, write_osi
from sumo_adv.report.export.openscenario import OPENSCENARIO_FILE, write_openscenario
from sumo_adv.report.export.piece import ExportedRun
from sumo_adv.report.export.sumo import CONFIGURATION, fcd, table, write_replay
from sumo_adv.report.export.womd import write_womd
from sumo_adv.report.read import OUTCOME_FILE
from sumo_adv.report.staging import staged
from sumo_adv.report.tables import write_gzip
from sumo_adv.simulation.programs import find_netconvert

WriteFormat = Callable[[Path, ExportedRun, Variant], str | None]


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """A format. ``write`` fills a file, or a folder that is there and empty, and may give a sentence on what is lost.

    ending: of the default name. extra, packages: what to install, and what must then import; both empty = nothing.
    marker: the file by which ``--force`` knows a folder of this format; empty = the format is one file.
    """

    ending: str
    write: WriteFormat
    extra: str = ""
    packages: tuple[str, ...] = ()
    marker: str = ""

    @property
    def missing(self) -> str:
        """The packages that do not import, separated by commas."""
        lacking = []
        for name in self.packages:
            try:
                import_module(name)
            except ImportError:
                lacking.append(name)
        return ", ".join(lacking)

    def need(self, format: Format) -> None:
        """Raise UsageError, saying what to install, if a package is missing."""
        if missing := self.missing:
            raise UsageError(
                f"The format {format} needs what is not installed ({missing}): pip install 'sumo-adv[{self.extra}]'."
            )


def _text(of: Callable[[ExportedRun], str]) -> WriteFormat:
    """A writer of text, packed where the name ends in ``.gz``."""

    def write(target: Path, piece: ExportedRun, variant: Variant) -> None:
        if target.suffix == ".gz":
            write_gzip(target, of(piece))
        else:
            target.write_text(of(piece), encoding="utf-8")

    return write


def _replayed(of: Callable[[Path, ExportedRun], str | None]) -> WriteFormat:
    """A writer that knows no variants."""
    return lambda target, piece, variant: of(target, piece)


FORMATS: dict[Format, ExportFormat] = {
    Format.OPENSCENARIO: ExportFormat(
        "-openscenario", lambda target, piece, variant: write_openscenario(target, piece, find_netconvert(), variant),
        "export", ("lxml.etree", "qc_openscenario"), OPENSCENARIO_FILE,
    ),
    Format.SUMO: ExportFormat("-sumo", _replayed(write_replay), marker=CONFIGURATION),
    Format.FCD: ExportFormat(".fcd.xml", _text(fcd)),
    Format.CSV: ExportFormat(".csv", _text(table)),
    Format.WOMD: ExportFormat(".tfrecord", _replayed(write_womd), "womd", ("google.protobuf",)),
    Format.COMMONROAD: ExportFormat("-commonroad", _replayed(write_commonroad), marker=COMMONROAD_SCENARIO_FILE),
    Format.MCAP: ExportFormat(".mcap", _replayed(write_mcap), "mcap", ("foxglove",)),
    Format.OSI: ExportFormat("_gt.osi", _replayed(write_osi), "osi", ("osi3.osi_groundtruth_pb2",)),
    Format.SCENARIONET: ExportFormat("-scenarionet", _replayed(write_scenarionet), marker=SUMMARY),
}  # fmt: skip
HOLDERS = (".", "failures", "runs")  # where hunts, regression suites and campaigns keep their runs


def chosen(format: Format) -> list[Format]:
    """The formats that ``format`` stands for. Raises UsageError: a package of the one format is missing."""
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
    if (folder / OUTCOME_FILE).is_file() or not folder.is_dir():
        return [folder]
    places = [folder / holder for holder in HOLDERS if (folder / holder).is_dir()]
    return [run for place in places for run in sorted(place.iterdir()) if (run / OUTCOME_FILE).is_file()]


def write_export(target: Path, piece: ExportedRun, format: Format, variant: Variant, *, force: bool) -> str | None:
    """Write a run in one format: the whole file or folder, or nothing. Gives a sentence if something is lost.

    Raises UsageError: ``target`` exists, a package of the format is missing, or an error of the format.
    """
    entry = FORMATS[format]
    entry.need(format)
    if entry.marker:
        with staged(target, force=force) as folder:
            lost = entry.write(folder.stage, piece, variant)
            folder.keep(force=force)
        return lost
    if target.is_dir() or (target.exists() and not force):
        raise UsageError(f"{target} is there already; give another --out, or --force to replace a file.")
    with sentences(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        said: list[str | None] = []
        write_whole(target, lambda part: said.append(entry.write(part, piece, variant)))
        return said[0]
