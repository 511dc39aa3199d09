"""A bound on the seconds that a driver's code may take for a step."""

from __future__ import annotations

import faulthandler
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from sumo_adv.errors import DriverLostError

GRACE = 5.0  # s after which code that Python cannot interrupt (a loop in C) ends with its process


@contextmanager
def within(seconds: float, sentence: str) -> Iterator[None]:
    """Code that may take ``seconds``, 0 = any time. No bound in other threads than the main one, or without alarms.

    Raises DriverLostError with the sentence: it took longer. Where Python cannot interrupt it, the process ends.
    """
    bounded = seconds > 0 and hasattr(signal, "setitimer")
    if not bounded or threading.current_thread() is not threading.main_thread():
        yield
        return

    def late(number: int, frame: FrameType | None) -> None:
        raise DriverLostError(sentence)

    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    faulthandler.dump_traceback_later(seconds + GRACE, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
