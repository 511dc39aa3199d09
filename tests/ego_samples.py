"""Drivers for ``--ego ego_samples:Class``. SUMO's IDM drives in all of them; some brake, fail or crash at a time."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from sumo_adv.drivers import Action, LaneSpeed, Observation, Steer

BRAKES_AT = 6.0  # s: one second after the trigger of the scenario motorway_cut_in_left
BRAKING = 5.0  # m/s2


class CalmEgo:
    """Leaves everything to SUMO."""

    name = "calm"
    forkable = True

    def reset(self, seed: int) -> None:
        """There is nothing to forget."""

    def act(self, seen: Observation) -> Action:
        """As SUMO would."""
        return None


class BrakingEgo:
    """Brakes at 5 m/s2 from 6 s on; it does not say that it can be forked, so its attempts load and repeat."""

    name = "braking"

    def reset(self, seed: int) -> None:
        """There is nothing to forget."""

    def act(self, seen: Observation) -> LaneSpeed | None:
        """As SUMO would, until it is time."""
        if seen.time < BRAKES_AT - 1e-6:
            return None
        return LaneSpeed(lane=None, speed=max(0.0, seen.ego.speed - BRAKING * seen.dt))


class OnwardEgo(CalmEgo):
    """Keeps its speed and its heading, whatever is ahead."""

    name = "onward"

    def act(self, seen: Observation) -> Steer:
        """Neither pedal nor wheel."""
        return Steer(0.0, 0.0)


class FailingEgo(CalmEgo):
    """Raises at 6 s."""

    name = "failing"

    def act(self, seen: Observation) -> LaneSpeed | None:
        """Fails when it is time."""
        if seen.time > BRAKES_AT:
            raise RuntimeError("the driver fell asleep")
        return None


class CrashingEgo(CalmEgo):
    """Ends its process by a signal at 6 s, as a crash of SUMO does: at the visits to that time, counted from 1, that
    the file ``crashes`` names. The first visit is that of the run without an attack."""

    name = "crashing"

    def act(self, seen: Observation) -> LaneSpeed | None:
        """Counts the visit, and crashes if it is one of those."""
        if abs(seen.time - BRAKES_AT) < seen.dt / 2:
            with Path("visits").open("a") as file:
                file.write("x")
            if Path("visits").stat().st_size in map(int, Path("crashes").read_text().split()):
                os.kill(os.getpid(), signal.SIGSEGV)
        return None
