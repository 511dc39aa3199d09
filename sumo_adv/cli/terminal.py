"""What goes to a terminal: names come from files of others, and may hold sequences that steer it."""

from __future__ import annotations

import re
from typing import Any, TextIO

_SEQUENCE = re.compile(
    r"(\x1b\[[0-9;]*m)"  # a colour: kept
    r"|\x1b\[[0-?]*[ -/]*[@-~]"  # moves, erases ...
    r"|\x1b[\]PX^_].*?(?:\x07|\x1b\\|$)"  # titles, the clipboard, links ...
    r"|\x1b.?|[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]",  # the rest, and marks that turn text round
    re.DOTALL,
)


def clean(text: str) -> str:
    """A text of any source without what a terminal would take for an order; colours and line ends stay."""
    return _SEQUENCE.sub(lambda match: match[1] or "", text)


class Cleaned:
    """A stream to a terminal that writes texts cleaned, and is the stream else."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write the text without orders to the terminal; the number of characters that it had."""
        self._stream.write(clean(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def cleaned(stream: TextIO | None) -> Any:
    """The stream, cleaned where it is a terminal."""
    return Cleaned(stream) if stream is not None and stream.isatty() else stream
