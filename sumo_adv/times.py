"""Times: SUMO counts in whole milliseconds; records do not."""

from __future__ import annotations

import math


def whole_milliseconds(seconds: float) -> float:
    """A time as SUMO takes it (``string2time``): rounded to milliseconds, halves up [s]."""
    return math.floor(1000.0 * seconds + 0.5) / 1000.0


def seconds_text(seconds: float) -> str:
    """A time with two decimals, or up to six where it needs them, so that a reader gets the same time."""
    whole, point, decimals = f"{seconds:.6f}".rstrip("0").partition(".")
    return f"{whole}.{decimals:0<2}" if point else whole
