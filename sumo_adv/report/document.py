"""An HTML document that is one file: style, script and data inside, and nothing may be loaded or sent.

What comes from files is data alone: JSON in which no ``<`` is left, read by the script and shown as text. Many numbers
take few characters: rounded to whole units, differences, variable-length bytes, deflate, base64. The page's script
reads them back (``assets/decode.js``); nothing is lost but the rounding.
"""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sumo_adv.errors import UsageError
from sumo_adv.files import write_text

DOCUMENT_HEAD = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; script-src {script_hash}; \
style-src {style_hash}; img-src data:; base-uri 'none'; form-action 'none'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<meta name="referrer" content="no-referrer">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<noscript>This page needs JavaScript. It loads nothing and sends nothing.</noscript>
{body}
<script type="application/json" id="data">{data}</script>
<script>{script}</script>
</body>
</html>
"""
WholeNumbers = NDArray[np.int64]
ABSENT = -1_000_000
"""In a series: not there, or never. No value is that far out: series are capped below it."""


@cache
def asset(name: str) -> str:
    return (files("sumo_adv.report") / "assets" / name).read_text(encoding="utf-8")


def document(title: str, body: str, styles: Sequence[str], scripts: Sequence[str], data: Any) -> str:
    """The text of the file. ``title`` and ``body`` are ours; whatever a run wrote belongs into ``data``."""
    style = "\n".join(asset(name) for name in styles)
    script = '(() => {\n"use strict";\n' + "\n".join(asset(name) for name in scripts) + "\n})();\n"
    script_hash, style_hash = (
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'" for text in (script, style)
    )
    return DOCUMENT_HEAD.format(
        title=title, body=body, style=style, script=script, data=embedded(data), script_hash=script_hash,
        style_hash=style_hash,
    )  # fmt: skip


def embedded(data: Any) -> str:
    """JSON that ends no script element and opens no comment, in ASCII."""
    text = json.dumps(data, separators=(",", ":"), default=str)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def write_document(target: Path, html: str) -> None:
    """Write a page, whole or not at all. Raises UsageError where it cannot be written."""
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_text(target, html)
    except OSError as error:
        raise UsageError(f"{target} cannot be written ({error.strerror or error}); give another --out.") from error


def packed(columns: Sequence[tuple[int, WholeNumbers]]) -> str:
    """Columns of whole numbers as text. Each comes with its order: how often differences are taken (1 or 2)."""
    parts = [varints(differences(values, order)) for order, values in columns]
    data = np.concatenate(parts).tobytes() if parts else b""
    return base64.b64encode(zlib.compress(data, 9)).decode()


def differences(values: WholeNumbers, order: int) -> WholeNumbers:
    """The first value, then differences; of those again for order 2. Reading adds up as often."""
    for _ in range(order):
        values = np.diff(values, prepend=0)
    return values


def varints(values: WholeNumbers) -> NDArray[np.uint8]:
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


def whole(values: NDArray[np.float64], unit: float) -> WholeNumbers:
    """Values in whole units, rounded; what is not finite becomes ``ABSENT``."""
    there = np.isfinite(values)
    scaled = np.where(there, values, 0.0) / unit
    return np.where(there, np.rint(np.clip(scaled, -(2**52), 2**52)), ABSENT).astype(np.int64)
