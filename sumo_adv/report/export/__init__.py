"""List the formats that a run can be exported to. The command line imports this module, so it imports little."""

from __future__ import annotations

from enum import StrEnum


class Format(StrEnum):
    """The formats of an export; ``ALL`` means each format whose packages are installed."""

    OPENSCENARIO = "openscenario"
    SUMO = "sumo"
    FCD = "fcd"
    CSV = "csv"
    WOMD = "womd"
    COMMONROAD = "commonroad"
    MCAP = "mcap"
    OSI = "osi"
    SCENARIONET = "scenarionet"
    ALL = "all"


class Variant(StrEnum):
    """The vehicles that an OpenSCENARIO file drives: all of them, or all but the ego."""

    REPLAY = "replay"
    FREE_EGO = "free-ego"
