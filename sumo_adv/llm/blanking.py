"""Blanks a key out of what a server says, also where it is spelt with escapes or comes in UTF-16."""

from __future__ import annotations

import json
import re
from collections.abc import Callable

BLANK = "***"
MOST_BACKSLASHES = 8  # before one character: JSON in JSON in JSON has 7

Blanker = Callable[[str], str]


def blanker(key: str | None) -> Blanker:
    """A function that returns a text with ``BLANK`` wherever the key is.

    The key is found as it is, and with any of its characters as an escape of JSON, Python, URLs or HTML. Call it before
    a text is cut, and again on what is decoded from it.
    """
    if not key:
        return lambda text: text
    spelt = re.compile(r"\x00*".join(map(_spellings, key)))
    return lambda text: spelt.sub(BLANK, text)


def _spellings(character: str) -> str:
    code = ord(character)
    numbers = rf"u0*{code:x}|u\{{0*{code:x}\}}|U0*{code:x}|x0*{code:x}|0*{code:o}"
    slashes = rf"\\{{0,{MOST_BACKSLASHES}}}"
    return (
        rf"(?:{slashes}{re.escape(character)}|\\{slashes}(?i:{numbers})"
        rf"|%(?i:{code:02x})|&#0*{code};|&#(?i:x0*{code:x});)"
    )


def decoded(body: bytes) -> str:
    """The text of a body in UTF-8, UTF-16 or UTF-32, as JSON tells them apart; what cannot be read is replaced."""
    return body.decode(json.detect_encoding(body), "replace")
