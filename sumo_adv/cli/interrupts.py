"""Ctrl-C and SIGTERM while a command works."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType
from typing import Any, Self

INTERRUPT_SIGNALS = (signal.SIGINT, signal.SIGTERM)  # Ctrl-C; what services and time limits send


class Interrupts:
    """Remembers a Ctrl-C or SIGTERM beside raising KeyboardInterrupt: pydantic-monty 1.4 swallows an interrupt that
    comes while it runs a planner (measured). A context manager for the main thread."""

    happened = False  # in this process, ever

    def __enter__(self) -> Self:
        self._pressed = False
        self._before = {number: signal.signal(number, self._press) for number in INTERRUPT_SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Raises KeyboardInterrupt if Ctrl-C was pressed and got lost."""
        if self._pressed:
            raise KeyboardInterrupt

    def checked(self, tell: Callable[[str, Any], None]) -> Callable[[str, Any], None]:
        """``tell``, which then raises KeyboardInterrupt if Ctrl-C was pressed and got lost."""

        def report_then_check(what: str, value: Any) -> None:
            tell(what, value)
            self.check()

        return report_then_check

    def hold(self) -> None:
        """From here on both are ignored: the rest takes a second or two."""
        for number in INTERRUPT_SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def _press(self, number: int, frame: FrameType | None) -> None:
        self._pressed = Interrupts.happened = True
        raise KeyboardInterrupt
