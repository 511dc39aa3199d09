"""Handle Ctrl-C and SIGTERM while a command works."""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType
from typing import Any, Self

INTERRUPT_SIGNALS = (signal.SIGINT, signal.SIGTERM)  # sent by Ctrl-C; by services and time limits


class Interrupts:
    """Remembers Ctrl-C or SIGTERM and raises KeyboardInterrupt.

    It is a context manager for the main thread. It remembers the interrupt because pydantic-monty 1.4 swallows one that
    comes while it runs a planner (measured).

    Attributes:
        happened: Whether an interrupt came in this process, at any time.
    """

    happened = False

    def __enter__(self) -> Self:
        self._pressed = False
        self._before = {number: signal.signal(number, self._press) for number in INTERRUPT_SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Raise an interrupt that was swallowed.

        Raises:
            KeyboardInterrupt: Ctrl-C was pressed.
        """
        if self._pressed:
            raise KeyboardInterrupt

    def checked(self, tell: Callable[[str, Any], None]) -> Callable[[str, Any], None]:
        """Wrap ``tell`` so that it raises a swallowed interrupt after each call."""

        def report_then_check(what: str, value: Any) -> None:
            tell(what, value)
            self.check()

        return report_then_check

    def hold(self) -> None:
        """Ignore Ctrl-C and SIGTERM from now on, because the rest takes only a second or two."""
        for number in INTERRUPT_SIGNALS:
            signal.signal(number, signal.SIG_IGN)

    def _press(self, number: int, frame: FrameType | None) -> None:
        self._pressed = Interrupts.happened = True
        raise KeyboardInterrupt
