"""How a server runs: what the command line says beyond the settings of an episode."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

LOCK_STEP_DEADLINE_S, REAL_TIME_DEADLINE_S = 10.0, 2.0  # s a client may take for one step


class Mode(StrEnum):
    """What follows on an encounter."""

    CONTINUOUS = "continuous"  # the next one, in the same simulation
    EPISODES = "episodes"  # the same again, with the refined planner, in a new simulation


class OnLoss(StrEnum):
    """What drives the ego while its client is lost or late."""

    SUMO = "sumo"
    BRAKE = "brake"
    END = "end"  # nothing: the server ends


@dataclass(frozen=True, slots=True)
class Options:
    """Everything but the encounters themselves. Times in s; None = no limit, or the default of the mode."""

    host: str = "127.0.0.1"
    port: int = 8813
    allow: tuple[str, ...] = ()
    mode: Mode = Mode.CONTINUOUS
    on_loss: OnLoss = OnLoss.SUMO
    real_time: bool = False
    encounters: int | None = None
    ego_type: str | None = None
    may_set: tuple[str, ...] = ()  # domains, besides its own vehicle
    patience: float | None = None
    deadline: float | None = None
    older: bool = False  # clients know TraCI only up to version 21

    @property
    def turn(self) -> float:
        """Seconds of its own time that the client may take for one step."""
        return self.deadline or (REAL_TIME_DEADLINE_S if self.real_time else LOCK_STEP_DEADLINE_S)
