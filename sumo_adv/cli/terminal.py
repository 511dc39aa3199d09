"""Word and clean what goes to a terminal.

Names come from other people's files, and may hold sequences that control the terminal.
"""

from __future__ import annotations

import re
from typing import Any, TextIO

_SEQUENCE = re.compile(
    r"(\x1b\[[0-9;]*m)"  # a colour: kept
    r"|\x1b\[[0-?]*[ -/]*[@-~]"  # moves the cursor, erases ...
    r"|\x1b[\]PX^_].*?(?:\x07|\x1b\\|$)"  # titles, the clipboard, links ...
    r"|\x1b.?|[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]",  # the rest, and marks that reverse text
    re.DOTALL,
)


def clean(text: str) -> str:
    """Remove what a terminal would take as an order. Colours and line ends stay."""
    return _SEQUENCE.sub(lambda match: match[1] or "", text)


class Cleaned:
    """A stream to a terminal that cleans the texts written to it. Everything else is the stream's own."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write the cleaned text, and return the length of the original."""
        self._stream.write(clean(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write lines, cleaned."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def counted(number: int, noun: str) -> str:
    """Return a number with its noun.

    Args:
        number: The number.
        noun: The noun in the singular.
    """
    return f"{number} {noun}{'s' * (number != 1)}"


def cleaned(stream: TextIO | None) -> Any:
    """Return the stream, wrapped in ``Cleaned`` if it is a terminal."""
    return Cleaned(stream) if stream is not None and stream.isatty() else stream
