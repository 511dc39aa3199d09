"""The server: options that the command line has in addition to the settings of an episode."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

LOCK_STEP_DEADLINE_S, REAL_TIME_DEADLINE_S = 10.0, 2.0  # maximum time of a client for one step


class Mode(StrEnum):
    """What follows an encounter."""

    CONTINUOUS = "continuous"  # the next encounter, in the same simulation
    EPISODES = "episodes"  # the same encounter again, with the refined planner, in a new simulation


class OnLoss(StrEnum):
    """What drives the ego while its client is lost or late."""

    SUMO = "sumo"
    BRAKE = "brake"
    END = "end"  # nothing; the server ends


@dataclass(frozen=True, slots=True)
class Options:
    """The options of a server, except the encounters themselves.

    Attributes:
        host: The address to listen at.
        port: The port to listen at.
        allow: Addresses or networks that may connect.
        mode: What follows an encounter.
        on_loss: What drives the ego while its client is lost or late.
        real_time: Whether simulated time follows the clock.
        encounters: The number of encounters; None for no limit.
        ego_type: The vehicle type of the ego; None takes that of the input.
        may_set: The domains that the client may set, in addition to its own vehicle.
        patience: How long to wait for a client [s]; None for no limit.
        deadline: The time of a client for one step [s]; None takes the default of the mode.
        older: Whether clients know TraCI only up to version 21.
    """

    host: str = "127.0.0.1"
    port: int = 8813
    allow: tuple[str, ...] = ()
    mode: Mode = Mode.CONTINUOUS
    on_loss: OnLoss = OnLoss.SUMO
    real_time: bool = False
    encounters: int | None = None
    ego_type: str | None = None
    may_set: tuple[str, ...] = ()
    patience: float | None = None
    deadline: float | None = None
    older: bool = False

    @property
    def turn(self) -> float:
        """The time of its own that the client may take for one step [s]."""
        return self.deadline or (REAL_TIME_DEADLINE_S if self.real_time else LOCK_STEP_DEADLINE_S)
