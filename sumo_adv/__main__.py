"""Start ``sumo-adv``, also as ``python -m sumo_adv``.

An interrupt ends the program from its first moment on. Everything else is loaded after the handlers are in place.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType


def main() -> None:
    """Run the program. SIGTERM, which services and time limits send, has the effect of Ctrl-C."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    from sumo_adv.cli.main import main as run

    run(_raise_interrupts)


def _raise_interrupts() -> None:
    """Let interrupts raise KeyboardInterrupt from now on."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)


def _leave(number: int, frame: FrameType | None) -> None:
    """Report the interruption and exit at once.

    Nothing needs to be cleaned up while modules are loaded. An exception could be replaced by another one there.
    """
    os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, b"sumo-adv: interrupted.\n")
    os._exit(1)


if __name__ == "__main__":
    main()
