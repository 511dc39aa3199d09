"""Register the export formats with their names and needs, and write a run in one of them."""

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
    """An export format.

    Attributes:
        ending: The ending of the default name.
        write: A function that writes a file or fills an existing empty folder. It may return a sentence about what is
            lost.
        extra: The extra of this program to install; empty if the format needs no packages.
        packages: The packages that must import; empty if the format needs none.
        marker: The file by which ``--force`` recognises a folder of this format; empty if the format is one file.
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
        """Check that all packages import.

        Args:
            format: The format's name.

        Raises:
            UsageError: A package is missing. The message says what to install.
        """
        if missing := self.missing:
            raise UsageError(
                f"The format {format} needs what is not installed ({missing}): pip install 'sumo-adv[{self.extra}]'."
            )


def _text(of: Callable[[ExportedRun], str]) -> WriteFormat:
    """Make a writer of text, which compresses the text if the name ends in ``.gz``."""

    def write(target: Path, piece: ExportedRun, variant: Variant) -> None:
        if target.suffix == ".gz":
            write_gzip(target, of(piece))
        else:
            target.write_text(of(piece), encoding="utf-8")

    return write


def _replayed(of: Callable[[Path, ExportedRun], str | None]) -> WriteFormat:
    """Make a writer that ignores the variant."""
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
HOLDERS = (".", "failures", "runs")  # subfolders in which hunts, regression suites and campaigns keep their runs


def chosen(format: Format) -> list[Format]:
    """Return the formats that a choice means.

    Args:
        format: The choice.

    Returns:
        The format itself, or all formats without missing packages.

    Raises:
        UsageError: A package of the one format is missing.
    """
    if format is Format.ALL:
        return [each for each, entry in FORMATS.items() if not entry.missing]
    FORMATS[format].need(format)
    return [format]


def left_out() -> Iterator[str]:
    """Yield a sentence for each format that lacks a package."""
    for format, entry in FORMATS.items():
        try:
            entry.need(format)
        except UsageError as error:
            yield str(error)


def runs_in(folder: Path) -> list[Path]:
    """Find the runs to export.

    Args:
        folder: The folder of a run, a hunt or a campaign, or the results of regress.

    Returns:
        The folders of the runs. ``folder`` itself if it is a run's folder or no folder at all.
    """
    if (folder / OUTCOME_FILE).is_file() or not folder.is_dir():
        return [folder]
    places = [folder / holder for holder in HOLDERS if (folder / holder).is_dir()]
    return [run for place in places for run in sorted(place.iterdir()) if (run / OUTCOME_FILE).is_file()]


def write_export(target: Path, piece: ExportedRun, format: Format, variant: Variant, *, force: bool) -> str | None:
    """Write a run in one format, whole or not at all.

    Args:
        target: The file or folder.
        piece: What is exported.
        format: The format, not ``ALL``.
        variant: The vehicles that an OpenSCENARIO file drives.
        force: Whether an existing target is replaced.

    Returns:
        A sentence if something is lost, otherwise None.

    Raises:
        UsageError: ``target`` exists, a package is missing, or the format cannot hold the run.
    """
    entry = FORMATS[format]
    entry.need(format)
    if entry.marker:
        with staged(target, force=force) as folder:
            lost = entry.write(folder.stage, piece, variant)
            folder.keep(force=force)
        return lost
    if target.is_dir() or (target.exists() and not force):
        raise UsageError(f"{target} already exists; give another --out, or --force to replace the file.")
    with sentences(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        said: list[str | None] = []
        write_whole(target, lambda part: said.append(entry.write(part, piece, variant)))
        return said[0]
