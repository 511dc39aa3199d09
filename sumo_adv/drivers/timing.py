"""Measure the wall time of a driver's own code, at each answer, and sum it over forks and runs.

A driver's ``act`` reads attributes of its observation, which the engine computes only then. That time is the engine's:
``engine_work`` marks it, and it does not count.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, ParamSpec, TypeVar

from sumo_adv.drivers.protocol import Action, EgoController, Observation
from sumo_adv.drivers.wrapped import WrappedEgo
from sumo_adv.errors import SumoError

P = ParamSpec("P")
T = TypeVar("T")
BINS_PER_DOUBLING = 8  # bins of the time for an answer; each is 9 % wide
FIRST_EDGE_MS = 0.01  # upper edge of bin 0


@dataclass(frozen=True, slots=True)
class DriverTime:
    """How long a driver's answers took.

    Attributes:
        calls: Number of answers.
        seconds: Wall time of all answers [s].
        bins: Number of answers in each bin k, with the upper edge ``FIRST_EDGE_MS * 2 ** (k / BINS_PER_DOUBLING)``
            [ms]. An answer is in the first bin whose upper edge it does not exceed.
    """

    calls: int = 0
    seconds: float = 0.0
    bins: Mapping[int, int] = field(default_factory=dict)

    @property
    def mean_ms(self) -> float:
        """Mean time for an answer [ms]; 0 without answers."""
        return 1e3 * self.seconds / self.calls if self.calls else 0.0

    def within_ms(self, share: float) -> float:
        """Return the time within which a share of the answers came: the upper edge of a bin; 0 without answers.

        Args:
            share: The share, in [0, 1].

        Returns:
            The time [ms].
        """
        needed, counted = share * self.calls, 0
        for k in sorted(self.bins):
            counted += self.bins[k]
            if counted >= needed:
                return FIRST_EDGE_MS * 2.0 ** (k / BINS_PER_DOUBLING)
        return 0.0

    def as_data(self) -> dict[str, Any]:
        """Return the block ``driver_time`` of ``outcome.json``."""
        return {
            "calls": self.calls, "seconds": round(self.seconds, 4), "mean_ms": round(self.mean_ms, 3),
            "p99_ms": round(self.within_ms(0.99), 3), "bins": {str(k): self.bins[k] for k in sorted(self.bins)},
        }  # fmt: skip

    def words(self, of: float) -> str:
        """Return a sentence for people.

        Args:
            of: Wall time of the whole [s]. Several attempts may run at once, so the driver's time may be longer. Then
                the sentence names the reason.
        """
        at_once = " (in several processes at once)" if self.seconds > of else ""
        return (
            f"Your driver took {self.seconds:.1f} s of {of:.1f} s{at_once}: {self.calls:,} calls, "
            f"mean {_ms(self.mean_ms)}, 99 % within {_ms(self.within_ms(0.99))}."
        )


def total_time(times: Iterable[DriverTime]) -> DriverTime:
    """Return the sum of several driver times."""
    calls, seconds, bins = 0, 0.0, Counter[int]()
    for each in times:
        calls, seconds = calls + each.calls, seconds + each.seconds
        bins.update(each.bins)
    return DriverTime(calls, seconds, dict(bins))


def read_driver_time(written: Mapping[str, Any] | None) -> DriverTime | None:
    """Read the block ``driver_time`` of an ``outcome.json``.

    Args:
        written: The block, or None if the file has none.

    Raises:
        KeyError: The block is not as this program writes it.
        TypeError: The block is not as this program writes it.
        ValueError: The block is not as this program writes it.
    """
    if written is None:
        return None
    bins = {int(k): int(count) for k, count in written["bins"].items()}
    return DriverTime(int(written["calls"]), float(written["seconds"]), bins)


def _ms(milliseconds: float) -> str:
    return f"{milliseconds:.0f} ms" if milliseconds >= 10.0 else f"{milliseconds:.2g} ms"


def bin_of(seconds: float) -> int:
    """Return the bin of an answer that took ``seconds`` [s]."""
    edges = seconds * 1e3 / FIRST_EDGE_MS
    return 0 if edges <= 1.0 else math.ceil(BINS_PER_DOUBLING * math.log2(edges))


SUMO_MODULES = ("libsumo", "traci")  # they define the errors that SUMO raises
_engine_seconds = [0.0]  # time that this process has spent on observations while a driver read them
_at_work = [False]


def engine_work(function: Callable[P, T]) -> Callable[P, T]:
    """Mark a function that computes a part of an observation: its time and SUMO's errors are the engine's.

    The marked function raises ``SumoError`` if SUMO fails in it.
    """

    @wraps(function)
    def timed(*args: P.args, **kwargs: P.kwargs) -> T:
        if _at_work[0]:
            return function(*args, **kwargs)
        _at_work[0], began = True, time.perf_counter()
        try:
            return function(*args, **kwargs)
        except Exception as error:
            if type(error).__module__.partition(".")[0] in SUMO_MODULES:
                raise SumoError(f"SUMO failed while the ego's driver read its observation ({error}).") from error
            raise
        finally:
            _engine_seconds[0] += time.perf_counter() - began
            _at_work[0] = False

    return timed


class Stopwatch:
    """Measures the driver's own code in the ``with`` block.

    Attributes:
        seconds: Its time [s], once the block has ended.
    """

    def __enter__(self) -> Stopwatch:
        self.seconds, self._engine, self._began = 0.0, _engine_seconds[0], time.perf_counter()
        return self

    def __exit__(self, *_: object) -> None:
        self.seconds = max(time.perf_counter() - self._began - (_engine_seconds[0] - self._engine), 0.0)


class TimedEgo(WrappedEgo):
    """A driver whose answers are timed.

    Attributes:
        time: How long its answers took so far.
        last: How long the last answer took [s].
    """

    def __init__(self, driver: EgoController) -> None:
        super().__init__(driver)
        self.last = 0.0
        self._calls, self._seconds, self._bins = 0, 0.0, Counter[int]()

    @property
    def time(self) -> DriverTime:
        return DriverTime(self._calls, self._seconds, dict(self._bins))

    def start_over(self) -> None:
        """Count from zero, as in a fork, whose time is added to that of its parent."""
        self._calls, self._seconds, self._bins = 0, 0.0, Counter()

    def add(self, time: DriverTime) -> None:
        """Add the time of answers in a fork."""
        self._calls, self._seconds = self._calls + time.calls, self._seconds + time.seconds
        self._bins.update(time.bins)

    def act(self, observation: Observation) -> Action:
        with (watch := Stopwatch()):
            action = self._driver.act(observation)
        self.last = watch.seconds
        self._calls, self._seconds = self._calls + 1, self._seconds + watch.seconds
        self._bins[bin_of(watch.seconds)] += 1
        return action
