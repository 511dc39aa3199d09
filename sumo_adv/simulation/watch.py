"""Note which third-party code runs in this process, where, and since when.

The note lies in memory that the waiting process reads. It can therefore name the code that hangs or has ended its
process. A process has one watch, as it has one alarm.
"""

from __future__ import annotations

import mmap
import signal
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from sumo_adv.errors import DriverError, SimulationError

NOTE_BYTES = 1024  # size of a note
HEAD = struct.Struct("=ddHH")  # beginning and limit [s], sizes of who and where [bytes]
MAX_TEXT_BYTES = 400  # maximum size of who and of where
GRACE_S = 2.0  # after the limit, during which code that catches the alarm or does not return to Python may still end
WATCH_INTERVAL_S = 0.5  # between two checks by a process that waits


SUMO = "SUMO"
STEP_LIMIT_S = 120.0  # for one step of SUMO; a step with 100,000 vehicles takes about 1 s
LOAD_LIMIT_S = 1800.0  # for SUMO to read its files; those of a large city take minutes


class OutOfTimeError(BaseException):
    """Raised by the alarm. It is no subclass of Exception, so that code that catches Exception does not catch it."""


@dataclass(frozen=True, slots=True)
class Call:
    """A call of third-party code or of SUMO.

    Attributes:
        who: Whose code runs; it begins a sentence.
        where: Where it runs, such as "in act, its step 3, at 0.3 s".
        limit: The time after which it is interrupted [s]; 0 means never.
    """

    who: str
    where: str
    limit: float

    @property
    def is_sumo(self) -> bool:
        """Whether this is SUMO's own work rather than the user's code."""
        return self.who == SUMO

    def too_late(self) -> SimulationError:
        """Return the error for a call that did not return in time."""
        if self.is_sumo:
            return SimulationError(
                f"SUMO did not return within {self.limit:g} s {self.where}: it loops, or the input is too large for "
                "this machine; try it with sumo itself."
            )
        return DriverError(
            f"{self.who} did not return within {self.limit:g} s {self.where}: raise its deadline (--ego-deadline), "
            "or give 0 for a debugger."
        )

    def ended(self, how: str) -> str:
        """Return the sentence for a call during which its process ended.

        Args:
            how: How it ended, such as "SIGSEGV" or "exit status 3".

        Returns:
            The sentence.
        """
        return f"{self.who} ended the simulation process ({how}) {self.where}."


class Watch:
    """The note of one process. Its forks write into the same note unless ``keep`` gives them another."""

    def __init__(self, file: Path | None = None) -> None:
        """Create or open the note.

        Args:
            file: A file of NOTE_BYTES bytes, for processes that are not forked; None uses memory that forks share.
        """
        if file is None:
            self._note = mmap.mmap(-1, NOTE_BYTES)
        else:
            with file.open("r+b") as opened:
                self._note = mmap.mmap(opened.fileno(), NOTE_BYTES)

    def begin(self, call: Call) -> None:
        """Note that a call begins now."""
        who, where = call.who.encode()[:MAX_TEXT_BYTES], call.where.encode()[:MAX_TEXT_BYTES]
        self._note[HEAD.size : HEAD.size + len(who) + len(where)] = who + where
        self._note[: HEAD.size] = HEAD.pack(time.monotonic(), call.limit, len(who), len(where))

    def end(self) -> None:
        """Note that the call has returned."""
        self._note[: HEAD.size] = bytes(HEAD.size)

    def running(self) -> Call | None:
        """Return the call that has not returned, or None."""
        return self._read()[1]

    def overdue(self) -> Call | None:
        """Return the call that has not returned, if its time limit and the grace period are over; None otherwise."""
        began, call = self._read()
        late = call is not None and call.limit > 0 and time.monotonic() > began + call.limit + GRACE_S
        return call if late else None

    def _read(self) -> tuple[float, Call | None]:
        """Return when the noted call began [s], and the call."""
        began, limit, who, where = HEAD.unpack(self._note[: HEAD.size])
        if not began:
            return 0.0, None
        text = self._note[HEAD.size : HEAD.size + who + where]
        return began, Call(text[:who].decode(errors="replace"), text[who:].decode(errors="replace"), limit)


_mine = [Watch()]


def keep(watch: Watch) -> None:
    """Note this process's calls in ``watch`` from now on."""
    _mine[0] = watch


@contextmanager
def watched(call: Call) -> Iterator[None]:
    """Note a call while it runs, and interrupt it after its time limit if the system supports alarms.

    Args:
        call: The call; it runs within this context.

    Raises:
        OutOfTimeError: The limit is over. It is raised within the context repeatedly, in case the code catches it.
    """
    alarm = call.limit > 0 and hasattr(signal, "setitimer")
    alarm = alarm and threading.current_thread() is threading.main_thread()
    _mine[0].begin(call)
    before = signal.signal(signal.SIGALRM, _out_of_time) if alarm else None
    try:
        if alarm:
            signal.setitimer(signal.ITIMER_REAL, call.limit, GRACE_S / 4)
        yield
    finally:
        if alarm:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, before)
        _mine[0].end()


@contextmanager
def sumo_at_work(where: str, limit: float) -> Iterator[None]:
    """Note that SUMO works, so that the waiting process can end this one after the limit.

    An alarm would not help, because SUMO does not return to Python meanwhile.

    Args:
        where: What SUMO is doing, as the end of a sentence.
        limit: The time limit [s].
    """
    _mine[0].begin(Call(SUMO, where, limit))
    try:
        yield
    finally:
        _mine[0].end()


def _out_of_time(number: int, frame: FrameType | None) -> None:
    raise OutOfTimeError
