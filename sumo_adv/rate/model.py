"""How often drivers err: the rates that ``docs/rate.md`` derives, each with its source."""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.simulation.human_errors import ErrorKind

KINDS = tuple(ErrorKind)
SLOT = 1.0  # s between two decisions of a driver
NEAR = 100.0  # m around the ego in which drivers err
PER_HOUR = {
    ErrorKind.INATTENTION: 0.14,
    ErrorKind.LATE_BRAKING: 0.07,
    ErrorKind.CHANGE_LEFT: 0.005,
    ErrorKind.CHANGE_RIGHT: 0.005,
    ErrorKind.DRIFT_LEFT: 0.025,
    ErrorKind.DRIFT_RIGHT: 0.025,
    ErrorKind.PRIORITY: 0.1,
    ErrorKind.RED_LIGHT: 0.1,
}
"""Errors that a driver begins in an hour in which the error is possible (``HumanErrors.possible``)."""


def chances(factor: float) -> Floats:
    """The probability ``(kinds,)`` that a driver begins each error in a slot, with all rates times ``factor``."""
    return np.array([PER_HOUR[kind] for kind in KINDS]) * factor * SLOT / 3600.0
