"""Rehearse a log in forks, to find recorded vehicles on which SUMO crashes and play them as boxes beside SUMO."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from sumo_adv.errors import SimulationError
from sumo_adv.simulation.forks import in_forks
from sumo_adv.simulation.playback import Playback

MAX_VEHICLES_BESIDE = 3  # maximum number of recorded vehicles on which SUMO crashes


def put_unplayable_beside(log: Playback, ego: object, play_until: Callable[[float], None]) -> bool:
    """Put recorded vehicles on which SUMO crashes beside SUMO. Bisection finds each of them.

    Args:
        log: The log.
        ego: The id of a recorded ego, which stays in SUMO; any other object if the ego is not recorded.
        play_until: Loads the simulation and plays the log until a time [s]. It is called in forks.

    Returns:
        Whether there was such a vehicle. The simulation must then be reloaded.
    """
    survives = partial(_survives, log, play_until)
    beside: list[str] = []
    while len(beside) < MAX_VEHICLES_BESIDE and not survives(beside):
        suspects = [name for name in log.recorded if name != ego]
        while len(suspects) > 1:
            half = suspects[: len(suspects) // 2]
            suspects = half if survives([*beside, *half]) else suspects[len(half) :]
        beside += suspects
    log.put_beside(beside)
    return bool(beside)


def _survives(log: Playback, play_until: Callable[[float], None], beside: Sequence[str]) -> bool:
    """Return whether SUMO survives the log with these vehicles beside it."""

    def rehearse() -> bool:
        log.put_beside(beside)
        try:
            play_until(log.spec.end)
        except SimulationError:
            return False
        return True

    log.put_beside(())
    return in_forks([rehearse], lost=lambda why: False) == [True]
