"""Simulated times: SUMO counts in whole milliseconds."""

from __future__ import annotations

import math


def whole_milliseconds(seconds: float) -> float:
    """A time as SUMO takes it (``string2time``): rounded to milliseconds, halves up [s]."""
    return math.floor(1000.0 * seconds + 0.5) / 1000.0


def seconds_text(seconds: float) -> str:
    """A simulated time with two digits, or with three where it needs them, so that a reader gets the same time."""
    text = f"{seconds:.3f}"
    return text.removesuffix("0") if "." in text else text
