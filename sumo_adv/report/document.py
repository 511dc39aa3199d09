"""Make an HTML document that is one file: style, script and data are inside, and it can load and send nothing.

Text from other files enters the document only as data: JSON without any ``<``, which the script reads and shows as
text. Long series of numbers are packed: they are rounded to whole units, replaced by differences, and encoded as
variable-length bytes, deflate and base64. The page's script unpacks them (``assets/decode.js``). Only the rounding
loses information.
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
"""A series has this value where it has none or is infinite. Series are capped below it, so no real value equals it."""


@cache
def asset(name: str) -> str:
    """Return the text of a file in ``report/assets``."""
    return (files("sumo_adv.report") / "assets" / name).read_text(encoding="utf-8")


def document(title: str, body: str, styles: Sequence[str], scripts: Sequence[str], data: Any) -> str:
    """Assemble the text of an HTML document.

    Args:
        title: The title. It is not escaped, so it must not contain text from a run.
        body: The HTML of the body. It is not escaped either.
        styles: Names of style sheets in ``assets``, in order.
        scripts: Names of scripts in ``assets``, in order.
        data: The data that the scripts read. Everything that a run wrote belongs here.

    Returns:
        The HTML.
    """
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
    """Encode data as ASCII JSON that can neither end a script element nor open a comment."""
    text = json.dumps(data, separators=(",", ":"), default=str)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def write_document(target: Path, html: str) -> None:
    """Write a page, whole or not at all.

    Args:
        target: The file. Missing parent folders are created.
        html: The text.

    Raises:
        UsageError: The file cannot be written.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        write_text(target, html)
    except OSError as error:
        raise UsageError(f"{target} cannot be written ({error.strerror or error}); give another --out.") from error


def packed(columns: Sequence[tuple[int, WholeNumbers]]) -> str:
    """Pack columns of whole numbers as text.

    Args:
        columns: Each column with its order, which is how often differences are taken (1 or 2).

    Returns:
        The columns in base64.
    """
    parts = [varints(differences(values, order)) for order, values in columns]
    data = np.concatenate(parts).tobytes() if parts else b""
    return base64.b64encode(zlib.compress(data, 9)).decode()


def differences(values: WholeNumbers, order: int) -> WholeNumbers:
    """Take differences ``order`` times; the first value stays. As many cumulative sums restore the values."""
    for _ in range(order):
        values = np.diff(values, prepend=0)
    return values


def varints(values: WholeNumbers) -> NDArray[np.uint8]:
    """Encode whole numbers as bytes.

    Numbers are zigzag-encoded first (0, -1, 1, -2 become 0, 1, 2, 3). Each byte holds seven bits, the lowest bits
    first; its top bit is set if more bytes follow.
    """
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
    """Round values to whole units; values that are not finite become ``ABSENT``."""
    there = np.isfinite(values)
    scaled = np.where(there, values, 0.0) / unit
    return np.where(there, np.rint(np.clip(scaled, -(2**52), 2**52)), ABSENT).astype(np.int64)
