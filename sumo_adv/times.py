"""Convert times. SUMO counts whole milliseconds; records do not."""

from __future__ import annotations

import math


def whole_milliseconds(seconds: float) -> float:
    """Round a time [s] to milliseconds, halves up, as SUMO does (``string2time``)."""
    return math.floor(1000.0 * seconds + 0.5) / 1000.0


def seconds_text(seconds: float) -> str:
    """Format a time [s] with two decimals, or up to six if they are needed.

    A time with at most six decimals can be read back exactly.
    """
    whole, point, decimals = f"{seconds:.6f}".rstrip("0").partition(".")
    return f"{whole}.{decimals:0<2}" if point else whole
