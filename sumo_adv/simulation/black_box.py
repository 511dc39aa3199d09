"""Where the driver under test was when its process died: a few bytes that outlive the process.

The engine's front makes the file; the engine and its forks write the place of their process into it. A driver that
crashes, or that calls ``os._exit``, cannot say so itself.
"""

from __future__ import annotations

import mmap
import os
import struct
from pathlib import Path

_ENTRY = struct.Struct("=idi")  # process, time [s], step from 1; step 0: not in the driver's code
_PLACES = 64  # of processes, by their number modulo this


class BlackBox:
    """The file in a folder; it is made if it is not there."""

    def __init__(self, folder: Path) -> None:
        """Raises OSError: it cannot be written."""
        size = _ENTRY.size * _PLACES
        with (folder / "driver").open("a+b") as file:
            file.truncate(size)
            self._bytes = mmap.mmap(file.fileno(), size)

    def note(self, time: float, step: int) -> None:
        """This process enters the driver's code at a time [s] and step; step 0: it leaves it."""
        process = os.getpid()
        _ENTRY.pack_into(self._bytes, _ENTRY.size * (process % _PLACES), process, time, step)

    def where(self, process: int) -> str:
        """Where a process was in the driver's code, in words; empty if it was not in it."""
        noted, time, step = _ENTRY.unpack_from(self._bytes, _ENTRY.size * (process % _PLACES))
        return f"in act at {time:.1f} s, step {step}" if noted == process and step > 0 else ""
