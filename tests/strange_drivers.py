"""Drivers for ``--ego strange_drivers:Class`` that do to their process, or to what they are given, what none should."""

from __future__ import annotations

import os
import signal
import sys
import time

from sumo_adv import LaneSpeed, Observation

AT = 6.5  # s: in motorway_cut_in_left the trigger is at 5 s


class Strange:
    """Drives as SUMO would, and does something strange once, in the drive without an attack or the first attempt."""

    name = "strange"
    forkable = True

    def reset(self, seed: int) -> None:
        """There is nothing to forget."""

    def act(self, seen: Observation) -> LaneSpeed | None:
        if abs(seen.time - AT) < seen.dt / 2:
            return self.strange(seen)
        return None

    def strange(self, seen: Observation) -> LaneSpeed | None:
        """The fault."""
        return None


class ChangesLane(Strange):
    """Works in place on the road that it was given."""

    def strange(self, seen: Observation) -> LaneSpeed | None:
        assert seen.road is not None
        centre = seen.road.lanes[0].centre
        centre -= centre[0]
        return None


class ChangesEdges(Strange):
    def strange(self, seen: Observation) -> LaneSpeed | None:
        assert seen.road is not None
        seen.road.edges[0][:] = 0.0
        return None


class Forces(Strange):
    """Sets the flag of an array back."""

    def strange(self, seen: Observation) -> LaneSpeed | None:
        assert seen.road is not None
        seen.road.lanes[0].centre.setflags(write=True)
        return None


class Interrupts(Strange):
    def strange(self, seen: Observation) -> LaneSpeed | None:
        raise KeyboardInterrupt


class OwnBase(Strange):
    class Mine(BaseException):
        """No subclass of Exception."""

    def strange(self, seen: Observation) -> LaneSpeed | None:
        raise self.Mine("as I like")


class FarLane(Strange):
    def strange(self, seen: Observation) -> LaneSpeed | None:
        return LaneSpeed(lane=10**30, speed=3.0)


class IgnoresChildren(Strange):
    """The system then says nothing of the children of this process."""

    def __init__(self) -> None:
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)


class Closes(Strange):
    """Closes the standard files of its process."""

    def __init__(self) -> None:
        sys.stdout.close()
        os.close(1)
        os.close(0)


class Forks(Strange):
    """Its copy goes on as a second simulation."""

    def strange(self, seen: Observation) -> LaneSpeed | None:
        os.fork()
        return None


class LeavesSleeper(Strange):
    """Leaves a process behind that holds all that this one has."""

    def strange(self, seen: Observation) -> LaneSpeed | None:
        if os.fork() == 0:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)
            time.sleep(600.0)
        return None
