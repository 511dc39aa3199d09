"""Every error this program raises on purpose.

SumoAdvError                 one sentence: what is wrong and what to do; exit status 1
├── UsageError               wrong use or bad input; exit status 2
│   └── MissingVehicleError  a vehicle that is named is not in the simulation
├── SimulationError          SUMO failed, or the engine process died
│   └── DriverError          the ego's driver failed, hung, ended its process or used up an attempt's memory
├── SandboxError             planner code failed inside its limits
│   ├── PlannerSyntaxError   not in the sandbox's subset, or does not parse
│   ├── PlannerRuntimeError  raised while running
│   ├── PlannerLimitError    time, memory, recursion or output limit
│   └── PlannerResultError   returned something that is not an endpoint
├── ModelError               a language model cannot be asked, or gives no usable answer; ending model_failed
│   └── BudgetError          the run's calls, tokens or seconds are spent; ending budget_exhausted
└── BankError                the memory bank cannot be opened, read or written
"""

from __future__ import annotations

import errno
from collections.abc import Iterable
from difflib import get_close_matches

OUT_OF_MEMORY = "Memory ran out; end other programs, use fewer workers, or give a smaller input."


class SumoAdvError(Exception):
    """Base class. ``str(error)`` is one sentence a user can act on."""

    exit_status = 1


class UsageError(SumoAdvError):
    """The command line or an input file is wrong."""

    exit_status = 2


class MissingVehicleError(UsageError):
    """The vehicle ``vehicle`` is named, and did not come into the simulation."""

    def __init__(self, message: str, vehicle: str = "") -> None:
        super().__init__(message)
        self.vehicle = vehicle


class SimulationError(SumoAdvError):
    """SUMO refused, failed or vanished."""


class DriverError(SimulationError):
    """The ego's driver failed, hung, ended its process or used up an attempt's memory: that attempt alone is lost."""


class SandboxError(SumoAdvError):
    """Planner code failed inside its limits."""


class PlannerSyntaxError(SandboxError):
    """The planner's text does not parse or uses what the sandbox lacks."""


class PlannerRuntimeError(SandboxError):
    """The planner raised an exception."""


class PlannerLimitError(SandboxError):
    """The planner ran into a limit on time, memory, recursion or output."""


class PlannerResultError(SandboxError):
    """The planner returned something that is not a usable endpoint."""


class ModelError(SumoAdvError):
    """A language model cannot be asked, or gives no usable answer. ``retries`` and ``seconds`` were spent on it."""

    def __init__(self, message: str, *, retries: int = 0, seconds: float = 0.0) -> None:
        super().__init__(message)
        self.retries = retries
        self.seconds = seconds


class BudgetError(ModelError):
    """The calls, tokens or seconds that a run may spend on models are spent."""


class BankError(SumoAdvError):
    """The memory bank cannot be opened, read or written."""

    exit_status = 2


def ran_out_of_memory(error: BaseException | None) -> bool:
    """Whether an error, or its cause, says that the machine has no more memory."""
    while error is not None:
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
            return True
        error = error.__cause__ or error.__context__
    return False


def fault_sentence(error: BaseException) -> str:
    """A sentence about an unexpected error, which is a fault of ours unless memory ran out."""
    if ran_out_of_memory(error):
        return OUT_OF_MEMORY
    message = " ".join(f"{type(error).__name__}: {error}".split())
    return f"A fault of sumo_adv itself ({message}); please report it."


def nearest(name: str, known: Iterable[str]) -> str:
    """``; the nearest is 'attempts'`` for the known name that is most like ``name``; empty if none is like it."""
    by_lower = {each.lower(): each for each in known}
    matches = get_close_matches(name.lower(), by_lower, n=1)
    return f"; the nearest is '{by_lower[matches[0]]}'" if matches else ""
