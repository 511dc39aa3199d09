"""What the engine process prints: SUMO's words and tracebacks go into a file, and those of attempts into another."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sumo_adv.simulation.warnings_log import warnings_in

MAX_ASIDE_BYTES = 1 << 20  # of what attempts have printed, after which their file begins anew
MAX_SAID_CHARACTERS = 300  # of SUMO's words in a sentence
ERROR = "Error: "


class EngineLog:
    """The front's handle of the two files.

    Attributes:
        file: The file of SUMO's words and tracebacks.
        aside: The file of what attempts print.
    """

    def __init__(self, folder: Path) -> None:
        self.file, self.aside = folder / "log", folder / "aside"
        self.file.touch()
        self.aside.touch()
        self._earlier = 0  # bytes of the file that belong to earlier episodes

    def begin_episode(self) -> None:
        """Let what is printed from now on belong to a new episode."""
        self._earlier = self.file.stat().st_size
        self.aside.write_bytes(b"")

    def said(self) -> str:
        """Return what was printed in this episode: SUMO's words and tracebacks, then the words of attempts."""
        apart = self.aside.read_bytes() if self.aside.is_file() else b""
        return (self.file.read_bytes()[self._earlier :] + apart).decode(errors="replace")

    def warnings(self) -> tuple[str, ...]:
        """Return SUMO's warnings in this episode, without those of attempts and repetitions."""
        return warnings_in(self.file.read_bytes()[self._earlier :].decode(errors="replace"))

    def last_words(self) -> str:
        """Return SUMO's last error, or the last line that was printed, in brackets; empty without any."""
        lines = [line for line in self.said().splitlines() if line.strip()]
        errors = [line.removeprefix(ERROR) for line in lines if line.startswith("Error:")] or lines
        return f" ({errors[-1][:MAX_SAID_CHARACTERS]})" if errors else ""


class ProcessOutput:
    """The two files in the engine process, whose standard output and error go into the first one from now on."""

    def __init__(self, file: Path, aside: Path) -> None:
        """Raises FileNotFoundError: the front was interrupted and has removed the files."""
        self._files = (file, aside)
        words = os.open(file, os.O_WRONLY | os.O_APPEND)
        _Aside.file = os.open(aside, os.O_WRONLY | os.O_APPEND)
        sys.stdout.flush()
        os.dup2(words, 1)
        os.dup2(words, 2)

    def sizes(self) -> list[int]:
        """Return how many bytes each file has."""
        return [file.stat().st_size for file in self._files]

    def since(self, sizes: list[int]) -> str:
        """Return what was printed since the files had these sizes [bytes]."""
        parts = [file.read_bytes()[size:] for file, size in zip(self._files, sizes, strict=True)]
        return b"".join(parts).decode(errors="replace")


def last_error(words: str) -> str:
    """Return SUMO's last error among what was printed; empty without one."""
    errors = [line.removeprefix(ERROR) for line in words.splitlines() if line.startswith(ERROR)]
    return errors[-1] if errors else ""


class _Aside:
    """The file of this engine process for what SUMO prints of attempts and repetitions; None elsewhere."""

    file: int | None = None


@contextmanager
def aside() -> Iterator[None]:
    """Keep apart what SUMO prints within it: it belongs to an attempt, or repeats what SUMO has printed before.

    Its warnings are none of the episode's.
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
