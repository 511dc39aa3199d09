"""Drivers that are given as a class or an object, and travel to the engine's process by value.

A class of a script or a notebook cannot be imported in another process. cloudpickle sends its code along.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sumo_adv.drivers.user import METHODS, in_one_line, lacking
from sumo_adv.errors import UsageError

PREFIX = "object:"  # of the names of such drivers; no module can be called so, because a colon follows


@dataclass(frozen=True, slots=True)
class GivenEgo:
    """A driver as bytes. name: ``object:`` and its class; made: it is an object, else a class to make one of."""

    name: str
    made: bool
    content: bytes


def pack(ego: Any) -> GivenEgo:
    """A class or an object as bytes.

    Raises UsageError: it lacks a method that a driver needs, or cannot be turned into bytes.
    """
    import cloudpickle

    made = not isinstance(ego, type)
    name = PREFIX + (type(ego) if made else ego).__name__
    missing = lacking(ego, METHODS)
    if missing:
        raise UsageError(f"The ego {name!r} has no method {missing!r}; it needs {' and '.join(METHODS.values())}.")
    try:
        return GivenEgo(name, made, cloudpickle.dumps(ego))
    except Exception as error:  # whatever the user's object raises
        raise UsageError(
            f"The ego {name!r} cannot be sent to the engine's process ({in_one_line(error)}): make in reset what "
            "cannot be copied, or give the class instead of an object."
        ) from error


def unpack(given: GivenEgo, parameters: Mapping[str, Any]) -> Any:
    """The driver; ``parameters`` are those of its constructor, if it is still to be made.

    Raises UsageError: it cannot be made.
    """
    import cloudpickle

    try:
        ego = cloudpickle.loads(given.content)
        return ego if given.made else ego(**parameters)
    except Exception as error:  # user code
        raise UsageError(f"The ego {given.name!r} could not be made: {in_one_line(error)}.") from error


def lost(name: str, source: str) -> UsageError:
    """That a driver was given as an object, and ``source`` does not hold it."""
    return UsageError(
        f"{source} was driven by an object from Python, {name.removeprefix(PREFIX)!r}, which no file holds: "
        "give it again with sumo_adv.run(ego=...)."
    )
