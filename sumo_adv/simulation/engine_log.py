"""Collect what the engine process prints.

SUMO's messages and tracebacks go into one file. What attempts print goes into another.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sumo_adv.simulation.warnings_log import warnings_in

MAX_ASIDE_BYTES = 1 << 20  # size at which the file for the output of attempts is emptied
MAX_SAID_CHARACTERS = 300  # maximum length of SUMO's text in a message
ERROR = "Error: "


class EngineLog:
    """The front's handle of the two files.

    Attributes:
        file: The file of SUMO's messages and tracebacks.
        aside: The file for the output of attempts.
    """

    def __init__(self, folder: Path) -> None:
        """Create both files.

        Args:
            folder: Where the files are created.
        """
        self.file, self.aside = folder / "log", folder / "aside"
        self.file.touch()
        self.aside.touch()
        self._earlier = 0  # size of the part of the file that belongs to earlier episodes [bytes]

    def begin_episode(self) -> None:
        """Start a new episode: ``said`` and ``warnings`` cover only what is printed from now on."""
        self._earlier = self.file.stat().st_size
        self.aside.write_bytes(b"")

    def said(self) -> str:
        """Return what was printed in this episode: SUMO's messages and tracebacks, then the output of attempts."""
        apart = self.aside.read_bytes() if self.aside.is_file() else b""
        return (self.file.read_bytes()[self._earlier :] + apart).decode(errors="replace")

    def warnings(self) -> tuple[str, ...]:
        """Return SUMO's warnings in this episode, without those of attempts and repetitions."""
        return warnings_in(self.file.read_bytes()[self._earlier :].decode(errors="replace"))

    def last_words(self) -> str:
        """Return SUMO's last error or, without one, the last line that was printed.

        Returns:
            The text in brackets after a space; empty if nothing was printed.
        """
        lines = [line for line in self.said().splitlines() if line.strip()]
        errors = [line.removeprefix(ERROR) for line in lines if line.startswith("Error:")] or lines
        return f" ({errors[-1][:MAX_SAID_CHARACTERS]})" if errors else ""


class ProcessOutput:
    """The two files in the engine process.

    Standard output and standard error of the process go into the first file from now on.
    """

    def __init__(self, file: Path, aside: Path) -> None:
        """Open the files and redirect the output.

        Args:
            file: The file of SUMO's messages and tracebacks.
            aside: The file for the output of attempts.

        Raises:
            FileNotFoundError: The front was interrupted and has removed the files.
        """
        self._files = (file, aside)
        words = os.open(file, os.O_WRONLY | os.O_APPEND)
        _Aside.file = os.open(aside, os.O_WRONLY | os.O_APPEND)
        sys.stdout.flush()
        os.dup2(words, 1)
        os.dup2(words, 2)

    def sizes(self) -> list[int]:
        """Return the size of each file [bytes]."""
        return [file.stat().st_size for file in self._files]

    def since(self, sizes: list[int]) -> str:
        """Return what was printed since the files had these sizes [bytes]."""
        parts = [file.read_bytes()[size:] for file, size in zip(self._files, sizes, strict=True)]
        return b"".join(parts).decode(errors="replace")


def last_error(words: str) -> str:
    """Return SUMO's last error in what was printed; empty without one."""
    errors = [line.removeprefix(ERROR) for line in words.splitlines() if line.startswith(ERROR)]
    return errors[-1] if errors else ""


class _Aside:
    """The descriptor of the file for what attempts and repetitions print; None outside an engine process."""

    file: int | None = None


@contextmanager
def aside() -> Iterator[None]:
    """Redirect what SUMO prints within this context to a separate file.

    Use it for attempts and for runs that repeat earlier messages, so that their warnings do not count for the episode.
    """
    if _Aside.file is None:
        yield
        return
    if os.fstat(_Aside.file).st_size > MAX_ASIDE_BYTES:
        os.ftruncate(_Aside.file, 0)
    kept = [os.dup(1), os.dup(2)]
    sys.stdout.flush()
    for number in (1, 2):
        os.dup2(_Aside.file, number)
    try:
        yield
    finally:
        sys.stdout.flush()
        for number, file in zip((1, 2), kept, strict=True):
            os.dup2(file, number)
            os.close(file)
