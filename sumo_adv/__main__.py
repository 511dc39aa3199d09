"""``sumo-adv``, ``python -m sumo_adv``: can be interrupted from its first moment on, and only then loads the rest."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType


def main() -> None:
    """The program. SIGTERM, which services and time limits send, is to all of it what Ctrl-C is."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    from sumo_adv.cli.main import main as run

    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    run()


def _leave(number: int, frame: FrameType | None) -> None:
    """While modules are loaded there is nothing to clean up, and an exception could end as another one."""
    os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, b"sumo-adv: interrupted.\n")
    os._exit(1)


if __name__ == "__main__":
    main()
