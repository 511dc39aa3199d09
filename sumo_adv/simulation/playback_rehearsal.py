"""A rehearsal of a log in forks: recorded vehicles on which SUMO crashes are played back as boxes beside SUMO."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from sumo_adv.errors import SimulationError
from sumo_adv.simulation.forks import in_forks
from sumo_adv.simulation.playback import Playback

MAX_VEHICLES_BESIDE = 3  # recorded vehicles on which SUMO crashes


def put_unplayable_beside(log: Playback, ego: object, play_until: Callable[[float], None]) -> bool:
    """Put recorded vehicles on which SUMO crashes beside SUMO; each is found by halving.

    Args:
        log: The log.
        ego: The ego's id, or what it is instead; a recorded ego stays in SUMO.
        play_until: Loads the simulation and plays the log until a time [s]. It is called in forks.

    Returns:
        Whether there was one. The simulation must then be loaded again.
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
    """Whether SUMO lives through the log with these vehicles beside it."""

    def rehearse() -> bool:
        log.put_beside(beside)
        try:
            play_until(log.spec.end)
        except SimulationError:
            return False
        return True

    log.put_beside(())
    return in_forks([rehearse], lost=lambda why: False) == [True]
