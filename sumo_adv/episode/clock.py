"""Where the wall time of a run goes, and how much of it is left."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class PartsClock:
    """Counts wall time by part. A second within a nested part counts for that part alone.

    Attributes:
        seconds: How long each part took so far [s]. A part that goes on is not in it.
    """

    def __init__(self, now: Callable[[], float] = time.perf_counter) -> None:
        """Count from zero; ``now``: the time [s]."""
        self.seconds: dict[str, float] = {}
        self._now = now
        self._nested: list[float] = []  # s of the parts within each part that goes on

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count the time of the ``with`` block for a part, also if the block raises."""
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
        """Count some of the time of one part for another."""
        self._count(of, -seconds)
        self._count(to, seconds)

    def _count(self, name: str, seconds: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
