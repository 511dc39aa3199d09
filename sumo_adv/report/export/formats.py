"""The formats: what each is called, what it needs and which function writes it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from sumo_adv.errors import UsageError
from sumo_adv.report.export.choices import Format, Variant
from sumo_adv.report.export.commonroad import SCENARIO as COMMONROAD_SCENARIO
from sumo_adv.report.export.commonroad import write_commonroad
from sumo_adv.report.export.fcd import fcd
from sumo_adv.report.export.mcap import write_mcap
from sumo_adv.report.export.openscenario import SCENARIO, write_openscenario
from sumo_adv.report.export.osi import write_osi
from sumo_adv.report.export.piece import Piece
from sumo_adv.report.export.replay import CONFIGURATION, write_replay
from sumo_adv.report.export.scenarionet import SUMMARY, write_scenarionet
from sumo_adv.report.export.table import table
from sumo_adv.report.export.womd import write_womd
from sumo_adv.report.tables import write_gzip
from sumo_adv.simulation.programs import find_netconvert

Write = Callable[[Path, Piece, Variant], str | None]


@dataclass(frozen=True, slots=True)
class Entry:
    """A format. ``write`` fills a file, or a folder that is there and empty, and may give a sentence on what is lost.

    ending: of the default name. extra, packages: what to install, and what must then import; both empty = nothing.
    marker: the file by which ``--force`` knows a folder of this format; empty = the format is one file.
    """

    ending: str
    write: Write
    extra: str = ""
    packages: tuple[str, ...] = ()
    marker: str = ""

    @property
    def missing(self) -> str:
        """The packages that do not import, separated by commas."""
        return ", ".join(name for name in self.packages if not _imports(name))

    def need(self, format: Format) -> None:
        """Raise UsageError, saying what to install, if a package is missing."""
        if missing := self.missing:
            raise UsageError(
                f"The format {format} needs what is not installed ({missing}): pip install 'sumo-adv[{self.extra}]'."
            )


def _imports(name: str) -> bool:
    try:
        import_module(name)
    except ImportError:
        return False
    return True


def _text(of: Callable[[Piece], str]) -> Write:
    """A writer of text, packed where the name ends in ``.gz``."""

    def write(target: Path, piece: Piece, variant: Variant) -> None:
        if target.suffix == ".gz":
            write_gzip(target, of(piece))
        else:
            target.write_text(of(piece), encoding="utf-8")

    return write


def _replayed(of: Callable[[Path, Piece], str | None]) -> Write:
    """A writer that knows no variants."""
    return lambda target, piece, variant: of(target, piece)


FORMATS: dict[Format, Entry] = {
    Format.OPENSCENARIO: Entry(
        "-openscenario", lambda target, piece, variant: write_openscenario(target, piece, find_netconvert(), variant),
        "export", ("lxml.etree", "qc_openscenario"), SCENARIO,
    ),
    Format.SUMO: Entry("-sumo", _replayed(write_replay), marker=CONFIGURATION),
    Format.FCD: Entry(".fcd.xml", _text(fcd)),
    Format.CSV: Entry(".csv", _text(table)),
    Format.WOMD: Entry(".tfrecord", _replayed(write_womd), "womd", ("google.protobuf",)),
    Format.COMMONROAD: Entry("-commonroad", _replayed(write_commonroad), marker=COMMONROAD_SCENARIO),
    Format.MCAP: Entry(".mcap", _replayed(write_mcap), "mcap", ("foxglove",)),
    Format.OSI: Entry("_gt.osi", _replayed(write_osi), "osi", ("osi3.osi_groundtruth_pb2",)),
    Format.SCENARIONET: Entry("-scenarionet", _replayed(write_scenarionet), marker=SUMMARY),
}  # fmt: skip
