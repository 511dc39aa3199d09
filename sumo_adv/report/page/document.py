"""An HTML document that is one file: style, script and data inside, and nothing may be loaded or sent.

What comes from files is data alone: JSON in which no ``<`` is left, read by the script and shown as text.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from sumo_adv.errors import UsageError

HEAD = """<!DOCTYPE html>
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


@cache
def asset(name: str) -> str:
    """A file that travels with the package."""
    return (files("sumo_adv.report.page") / "assets" / name).read_text(encoding="utf-8")


def document(title: str, body: str, styles: Sequence[str], scripts: Sequence[str], data: Any) -> str:
    """The text of the file. ``title`` and ``body`` are ours; whatever a run wrote belongs into ``data``."""
    style = "\n".join(asset(name) for name in styles)
    script = '(() => {\n"use strict";\n' + "\n".join(asset(name) for name in scripts) + "\n})();\n"
    return HEAD.format(
        title=title, body=body, style=style, script=script, data=embedded(data),
        script_hash=_hash(script), style_hash=_hash(style),
    )  # fmt: skip


def embedded(data: Any) -> str:
    """JSON that ends no script element and opens no comment, in ASCII."""
    text = json.dumps(data, separators=(",", ":"), default=str)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def write_document(target: Path, html: str) -> None:
    """Write a page, whole or not at all. Raises UsageError where it cannot be written."""
    part = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        part.write_text(html, encoding="utf-8")
        part.replace(target)
    except OSError as error:
        raise UsageError(f"{target} cannot be written ({error.strerror or error}); give another --out.") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
