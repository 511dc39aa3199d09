"""A user's own generator, ``--row module:Class``, behind our protocol.

Idea: any class that is made without arguments and has ``begin(encounter)`` and ``propose(tried)``
(``benchmark.nouns.Opponent``). It gets the budget, the stop rule and the gates of all rows; ``examples/own_generator``
has one in twenty lines. Answers are checked before they are driven.
Limits: it runs in our process and may import anything: it is the user's own code, not a model's.
Citation: none, it is yours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace

import numpy as np

from sumo_adv.benchmark.nouns import Encounter
from sumo_adv.datatypes import Attempt, Planner, PrescribedMotion, Proposal, acceleration_of
from sumo_adv.drivers.registry import in_one_line, make_object
from sumo_adv.errors import PlannerResultError, PlannerRuntimeError
from sumo_adv.situation import Situation

ARRAYS = ("x", "y", "heading", "speed")


class UserRow:
    """A user's generator; its errors become one sentence that names it."""

    def __init__(self, spec: str) -> None:
        """``spec``: ``module:Class``, found on ``sys.path`` or in the current folder. Raises UsageError."""
        self._generator = make_object("generator", spec, {}, {"begin": "begin(encounter)", "propose": "propose(tried)"})
        self.name = spec
        self._situations: Mapping[float, Situation] = {}

    def begin(self, encounter: Encounter) -> None:
        """Of a copy: other rows see nothing of what is written there. Raises PlannerRuntimeError if its code fails."""
        self._situations = encounter.situations
        try:
            self._generator.begin(replace(encounter, situations=deepcopy(dict(encounter.situations))))
        except Exception as error:  # user code
            raise PlannerRuntimeError(f"The generator {self.name!r} failed in begin: {in_one_line(error)}.") from error

    def propose(self, tried: Sequence[Attempt]) -> Proposal | None:
        """Raises PlannerRuntimeError if the user's code fails, PlannerResultError if its answer cannot be driven."""
        try:
            answer = self._generator.propose(tried)
        except Exception as error:  # user code
            reason = in_one_line(error)
            raise PlannerRuntimeError(f"The generator {self.name!r} failed in propose: {reason}.") from error
        if answer is None:
            return None
        try:
            return _checked(answer, self._situations, self.name)
        except ValueError as error:
            raise PlannerResultError(f"The generator {self.name!r} returned {error}.") from error
        except (TypeError, AttributeError) as error:
            fault = f"a Proposal with a field of a wrong type ({in_one_line(error)})"
            raise PlannerResultError(f"The generator {self.name!r} returned {fault}.") from error


def _checked(answer: object, situations: Mapping[float, Situation], name: str) -> Proposal:
    """The proposal, marked as the generator's. Raises ValueError that names the answer and the need."""
    if not isinstance(answer, Proposal):
        raise ValueError(f"{type(answer).__name__}; propose must return a Proposal or None")
    if answer.delay not in situations:
        delays = ", ".join(f"{d:g}" for d in sorted(situations))
        raise ValueError(f"the delay {answer.delay!r}, which the encounter does not have; use one of {delays}")
    targets = situations[answer.delay].targets
    if answer.bv not in targets:
        raise ValueError(f"the vehicle {answer.bv!r}; use one of the encounter's targets, {', '.join(targets)}")
    if answer.course is not None:
        return replace(answer, by=name, course=_course(answer.course))
    if not isinstance(answer.planner, Planner) or not answer.planner.source:
        raise ValueError("a Proposal with neither a course nor a planner's source text; give one of them")
    numbers = answer.parameters.values()
    if not all(isinstance(n, int | float) and np.isfinite(n) for n in numbers):
        raise ValueError("parameters that are not all finite numbers")
    try:
        acceleration_of(answer.acceleration)
    except ValueError as error:
        raise ValueError(f"an acceleration that cannot be used ({str(error).rstrip('.')})") from error
    return replace(answer, by=name)


def _course(course: object) -> PrescribedMotion:
    """The course as arrays of floats. Raises ValueError."""
    if not isinstance(course, PrescribedMotion):
        raise ValueError(f"a course that is {type(course).__name__}; it must be a PrescribedMotion")
    try:
        arrays = [np.array(getattr(course, name), float) for name in ARRAYS]
    except (TypeError, ValueError) as error:
        raise ValueError("a course whose x, y, heading and speed are not all arrays of numbers") from error
    shape = arrays[0].shape
    if len(shape) != 1 or not shape[0] or any(a.shape != shape for a in arrays):
        raise ValueError("a course whose x, y, heading and speed are not arrays (n,) of one length, 1 or more")
    if not all(np.isfinite(a).all() for a in arrays):
        raise ValueError("a course with numbers that are not finite")
    if (arrays[3] < 0).any():
        raise ValueError("a course with negative speeds; a vehicle drives forwards along its heading")
    x, y, heading, speed = arrays
    return PrescribedMotion(x, y, heading, speed)
