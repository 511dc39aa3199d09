"""Drivers for ``--ego stuck_drivers:Class`` that raise, hang, leak or end their process, each from a time on."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

from sumo_adv import LaneSpeed, Observation

AT = 6.5  # s: in motorway_cut_in_left the trigger is at 5 s


class Sleeps:
    """Does not return; it does not say that it may be forked, so its attempts run in place.

    The first visit to this moment is the drive without an attack, the second one the first attempt.
    """

    name = "sleepy"
    visits: tuple[int, ...] = (2,)

    def reset(self, seed: int) -> None:
        """There is nothing to forget."""

    def act(self, seen: Observation) -> LaneSpeed | None:
        """As SUMO would, but at the moment and the visits in question."""
        if abs(seen.time - AT) < seen.dt / 2:
            with Path("visits").open("a") as file:
                file.write("x")
            if Path("visits").stat().st_size in self.visits:
                self.stick()
        return None

    def stick(self) -> None:
        """The fault."""
        time.sleep(600.0)


class SleepsForked(Sleeps):
    """The same in forks."""

    forkable = True


class CatchesAll(SleepsForked):
    """Catches the alarm too."""

    def stick(self) -> None:
        """The fault."""
        while True:
            try:
                time.sleep(600.0)
            except BaseException:  # that is the fault
                continue


class ExitsPython(Sleeps):
    """Ends the interpreter."""

    def stick(self) -> None:
        """The fault."""
        sys.exit(3)


class ExitsProcess(SleepsForked):
    """Ends its process without Python. A fork that dies is repeated, which is the third visit."""

    visits = (2, 3)

    def stick(self) -> None:
        """The fault."""
        os._exit(4)


class Leaks(SleepsForked):
    """Keeps 1 GB."""

    def __init__(self) -> None:
        self.kept: list[bytearray] = []

    def stick(self) -> None:
        """The fault."""
        self.kept += [bytearray(100_000_000) for _ in range(10)]


class Raises(Sleeps):
    """Raises an exception in its first attempt."""

    def stick(self) -> None:
        """The fault."""
        raise ZeroDivisionError("no gap")


class AlwaysRaises(Raises):
    """Raises an exception in every attempt, and not without one."""

    visits = tuple(range(2, 100))


class AlwaysExits(ExitsProcess):
    """Ends the process that holds the simulation, without an attack too."""

    forkable = False
    visits = (1,)


class AlwaysExitsAsIfDone(AlwaysExits):
    """Ends the process with the status of success."""

    def stick(self) -> None:
        """The fault."""
        os._exit(0)


class Slow(Sleeps):
    """Takes 0.2 s for each of its answers, and never hangs."""

    def act(self, seen: Observation) -> LaneSpeed | None:
        """As SUMO would, but later."""
        time.sleep(0.2)
        return None


class ExitsAtOnce(Sleeps):
    """Ends the interpreter when it is made."""

    def __init__(self) -> None:
        sys.exit("no licence")


class Debugged(SleepsForked):
    """Stands at a breakpoint for a while."""

    def stick(self) -> None:
        """Longer than the alarm and the grace of a deadline that is not there."""
        time.sleep(3.0)
