"""What may be chosen of an export. Light: the command line imports it."""

from __future__ import annotations

from enum import StrEnum


class Format(StrEnum):
    """What may be written."""

    OPENSCENARIO = "openscenario"
    FCD = "fcd"
    SUMO = "sumo"
    CSV = "csv"


class Variant(StrEnum):
    """The vehicles that an OpenSCENARIO file drives: all, or all but the ego."""

    REPLAY = "replay"
    FREE_EGO = "free-ego"
