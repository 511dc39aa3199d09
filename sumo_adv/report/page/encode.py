"""Many numbers in few characters: rounded to whole units, differences, variable-length bytes, deflate, base64.

The page's script reads it back (``assets/decode.js``).  Nothing is lost but the rounding.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]
ABSENT = -1_000_000
"""In a series: not there, or never. No value is that far out: series are capped below it."""


def packed(columns: Sequence[tuple[int, Ints]]) -> str:
    """Columns of whole numbers as text. Each comes with its order: how often differences are taken (1 or 2)."""
    parts = [varints(differences(values, order)) for order, values in columns]
    data = np.concatenate(parts).tobytes() if parts else b""
    return base64.b64encode(zlib.compress(data, 9)).decode()


def differences(values: Ints, order: int) -> Ints:
    """The first value, then differences; of those again for order 2. Reading adds up as often."""
    for _ in range(order):
        values = np.diff(values, prepend=0)
    return values


def varints(values: Ints) -> NDArray[np.uint8]:
    """Zigzag (0, -1, 1, -2 ..: 0, 1, 2, 3 ..), then seven bits a byte, low ones first, top bit = more follow."""
    left = np.where(values < 0, -2 * values - 1, 2 * values).astype(np.uint64)
    lengths = np.ones(len(left), dtype=np.int64)
    for bits in range(7, 63, 7):
        lengths += left >= np.uint64(1 << bits)
    ends = np.cumsum(lengths)
    out = np.zeros(int(ends[-1]) if len(ends) else 0, dtype=np.uint8)
    for k in range(int(lengths.max(initial=0))):
        more = lengths > k
        low = (left[more] >> np.uint64(7 * k)) & np.uint64(127)
        out[(ends - lengths)[more] + k] = low | (np.uint64(128) * (lengths[more] > k + 1))
    return out


def whole(values: NDArray[np.float64], unit: float) -> Ints:
    """Values in whole units, rounded; what is not finite becomes ``ABSENT``."""
    there = np.isfinite(values)
    scaled = np.where(there, values, 0.0) / unit
    return np.where(there, np.rint(np.clip(scaled, -(2**52), 2**52)), ABSENT).astype(np.int64)
