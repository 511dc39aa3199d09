"""Define every error that this program raises on purpose.

SumoAdvError                 one sentence: what is wrong and what to do; exit status 1
├── UsageError               wrong use or bad input; exit status 2
│   └── MissingVehicleError  a named vehicle is not in the simulation
├── SimulationError          SUMO failed, or the engine process died
│   ├── DriverError          the ego's driver failed, hung, ended its process or used up an attempt's memory
│   └── SumoError            SUMO failed while the ego's driver read its observation
├── SandboxError             planner code failed inside its limits
│   ├── PlannerSyntaxError   the text does not parse, or is outside the sandbox's subset of Python
│   ├── PlannerRuntimeError  the planner raised an exception
│   ├── PlannerLimitError    time, memory, recursion or output limit
│   └── PlannerResultError   the result is not an endpoint
├── ModelError               a language model cannot be asked, or gives no usable answer; ending model_failed
│   └── BudgetError          the run's calls, tokens or seconds are spent; ending budget_exhausted
└── BankError                the memory bank cannot be opened, read or written; exit status 2
"""

from __future__ import annotations

import errno
from collections.abc import Iterable
from difflib import get_close_matches

OUT_OF_MEMORY = "Memory ran out; end other programs, use fewer workers, or give a smaller input."


class SumoAdvError(Exception):
    """The base class of all errors. ``str(error)`` is one sentence that a user can act on."""

    exit_status = 1


class UsageError(SumoAdvError):
    """The command line or an input file is wrong."""

    exit_status = 2


class MissingVehicleError(UsageError):
    """A named vehicle did not come into the simulation.

    Attributes:
        vehicle: The id of the vehicle.
    """

    def __init__(self, message: str, vehicle: str = "") -> None:
        super().__init__(message)
        self.vehicle = vehicle


class SimulationError(SumoAdvError):
    """SUMO refused, failed or vanished."""


class DriverError(SimulationError):
    """The ego's driver failed, hung, ended its process or used up an attempt's memory. Only that attempt is lost."""


class SumoError(SimulationError):
    """SUMO failed while the ego's driver read its observation. The driver is not to blame."""


class SandboxError(SumoAdvError):
    """Planner code failed inside its limits."""


class PlannerSyntaxError(SandboxError):
    """The planner's text does not parse, or uses what the sandbox does not support."""


class PlannerRuntimeError(SandboxError):
    """The planner raised an exception."""


class PlannerLimitError(SandboxError):
    """The planner ran into a limit on time, memory, recursion or output."""


class PlannerResultError(SandboxError):
    """The planner returned something that is not a usable endpoint."""


class ModelError(SumoAdvError):
    """A language model cannot be asked, or gives no usable answer.

    Attributes:
        retries: The number of retries that were spent.
        seconds: The time that was spent [s].
    """

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
    """Return whether an error, or one of its causes, says that memory ran out."""
    while error is not None:
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
            return True
        error = error.__cause__ or error.__context__
    return False


def fault_sentence(error: BaseException) -> str:
    """Describe an unexpected error in a sentence.

    Args:
        error: The error.

    Returns:
        A request to report a fault of this program, or advice if memory ran out.
    """
    if ran_out_of_memory(error):
        return OUT_OF_MEMORY
    message = " ".join(f"{type(error).__name__}: {error}".split())
    return f"A fault of sumo_adv itself ({message}); please report it."


def nearest(name: str, known: Iterable[str]) -> str:
    """Name the known name that is most like a given one.

    Args:
        name: The given name.
        known: The known names.

    Returns:
        A part of a sentence such as ``; the nearest is 'attempts'``, or '' if none is similar.
    """
    by_lower = {each.lower(): each for each in known}
    matches = get_close_matches(name.lower(), by_lower, n=1)
    return f"; the nearest is '{by_lower[matches[0]]}'" if matches else ""
