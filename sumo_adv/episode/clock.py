"""Measure where the wall time of a run goes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class PartsClock:
    """Counts wall time by part.

    Time within a nested part counts for the nested part alone.

    Attributes:
        seconds: How long each part took so far, by name [s]. Parts that still run are not included.
    """

    def __init__(self, now: Callable[[], float] = time.perf_counter) -> None:
        """Start at zero.

        Args:
            now: Returns the present time [s].
        """
        self.seconds: dict[str, float] = {}
        self._now = now
        self._nested: list[float] = []  # s of nested parts, for each part that still runs

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count the time of the ``with`` block for a part, even if the block raises.

        Args:
            name: The name of the part.
        """
        began = self._now()
        self._nested.append(0.0)
        try:
            yield
        finally:
            spent = self._now() - began
            self._count(name, spent - self._nested.pop())
            if self._nested:
                self._nested[-1] += spent

    def move(self, seconds: float, of: str, to: str) -> None:
        """Count some of the time of one part for another.

        Args:
            seconds: The time to move [s].
            of: The part for which the time was counted.
            to: The part for which it counts from now on.
        """
        self._count(of, -seconds)
        self._count(to, seconds)

    def _count(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
