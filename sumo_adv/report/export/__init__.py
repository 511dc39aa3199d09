"""A run in other tools' formats: what may be chosen. Light, because the command line imports it."""

from __future__ import annotations

from enum import StrEnum


class Format(StrEnum):
    """What may be written; ``all``: each format that has its packages installed."""

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
    """The vehicles that an OpenSCENARIO file drives: all, or all but the ego."""

    REPLAY = "replay"
    FREE_EGO = "free-ego"
