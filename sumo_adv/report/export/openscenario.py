"""A run as ASAM OpenSCENARIO 1.2 with its road as OpenDRIVE: a folder of two files.

World x, y, h are SUMO's coordinates of the network; where a vehicle stands is said in ``entities.py``.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from sumo_adv import __version__
from sumo_adv.errors import UsageError
from sumo_adv.report.export.choices import Variant
from sumo_adv.report.export.entities import add_entities, entity_names, printable
from sumo_adv.report.export.opendrive import write_opendrive
from sumo_adv.report.export.piece import Piece
from sumo_adv.report.export.schema import check_openscenario
from sumo_adv.report.export.storyboard import add_free_ego, add_replay

SCENARIO, ROAD = "scenario.xosc", "road.xodr"


def write_openscenario(folder: Path, piece: Piece, netconvert: Path, variant: Variant = Variant.REPLAY) -> None:
    """Write ``scenario.xosc``, checked against ASAM's schema, and ``road.xodr`` into ``folder``.

    Raises:
        UsageError: there is no adversary for a free ego.
        SumoAdvError: netconvert failed.
    """
    text = openscenario(piece, variant)
    check_openscenario(text)
    write_opendrive(netconvert, piece.network, folder / ROAD, piece.written)
    (folder / SCENARIO).write_text(text, encoding="utf-8")


def openscenario(piece: Piece, variant: Variant = Variant.REPLAY) -> str:
    """The document. Raises UsageError: a free ego needs an adversary."""
    if variant is Variant.FREE_EGO and (piece.adversary is None or piece.takeover is None):
        raise UsageError("A free ego needs an adversary: export a run that was attacked, without --unattacked.")
    names = entity_names(piece.tracks)
    root = Element("OpenSCENARIO")
    header = SubElement(
        root, "FileHeader", revMajor="1", revMinor="2", date=piece.written.strftime("%Y-%m-%dT%H:%M:%S")
    )
    header.set("author", f"sumo_adv {__version__}")
    header.set("description", printable(f"{piece.name}, {variant}; time 0 is {piece.begin:.3f} s of the simulation"))
    properties = SubElement(header, "Properties")
    for name, value in _properties(piece, names).items():
        SubElement(properties, "Property", name=f"sumo_adv_{name}", value=value)
    SubElement(root, "CatalogLocations")
    SubElement(SubElement(root, "RoadNetwork"), "LogicFile", filepath=ROAD)
    add_entities(root, piece.tracks, names)
    (add_replay if variant is Variant.REPLAY else add_free_ego)(root, piece, names)
    indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"


def _properties(piece: Piece, names: dict[str, str]) -> dict[str, str]:
    """What a reader needs to find its way back to the run."""
    properties = {"begin": f"{piece.begin:.3f}", "end": f"{piece.end:.3f}", "ego": names[piece.ego]}
    if piece.adversary is not None:
        properties |= {"adversary": names[piece.adversary], "takeover": f"{piece.takeover:.3f}"}
    return properties | {f"support_{k}": names[support] for k, support in enumerate(piece.supports, 1)}
