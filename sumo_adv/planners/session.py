"""A session runs one planner in one fresh interpreter, and turns monty's errors into errors of this program."""

from __future__ import annotations

import math
import re
import secrets
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Self

from sumo_adv.datatypes import Planner
from sumo_adv.errors import PlannerLimitError, PlannerResultError, PlannerRuntimeError, PlannerSyntaxError, SandboxError
from sumo_adv.planners.results import (
    REDUCERS,
    check_endpoint,
    check_motion,
    check_trajectory,
    printable_line,
    subject_of,
)
from sumo_adv.planners.text import HELPERS_CODE, read_planner_text

if TYPE_CHECKING:
    from pydantic_monty import MontyError, MontySession


MAX_STOPPED_CALLS = 3  # calls stopped by a limit; each takes a quarter of a second, and a normal call about 10 us
MAX_CALLS_PER_FEED = 256  # a feed may take ``call_seconds``, and a normal call takes about 10 us
_PLANNER_FILE = "<python-input-1>"  # monty's name for the second feed of a session

Data = Mapping[str, Any]
Call = tuple[str, Data, Data, Mapping[str, float], float, float]
"""One call of a planner: the key of its road, bv, ego, parameters, acc [m/s2] and horizon [s]."""


@dataclass(frozen=True, slots=True)
class SandboxLimits:
    """What planner code may use.

    Attributes:
        call_seconds: The time of one call, or of the module level [s].
        batch_seconds: The time of all calls of a batch together [s].
        memory: The size of the heap [bytes].
        recursion: The depth of recursion.
        output_bytes: The amount that one feed may print [bytes].
        suspensions: The number of failed name look-ups and refused system calls in a session.
        grace_seconds: The time after a limit until the worker is killed [s]. A type check takes 0.1 s, or a second on a
            busy machine.
    """

    call_seconds: float = 0.25
    batch_seconds: float = 5.0
    memory: int = 64 * 1024 * 1024
    recursion: int = 200
    output_bytes: int = 64 * 1024
    suspensions: int = 100
    grace_seconds: float = 3.0


class PlannerSession:
    """One planner in one fresh interpreter. It is a context manager, for one thread at a time.

    A time limit, a memory limit or a dead worker ends the session. Every further call then raises
    ``PlannerLimitError``. Only ``endpoints`` restarts a session that ends during the call, with fresh globals.
    """

    def __init__(
        self, start: Callable[[int, bool], MontySession], usable: Callable[[], None], limits: SandboxLimits,
        planner: Planner, roads: Mapping[str, Data], seed: int, type_check: bool,
    ) -> None:  # fmt: skip
        """Start an interpreter and load the planner.

        Args:
            start: Returns an empty interpreter for a seed, with or without type checks.
            usable: Raises SandboxError if interpreters can no longer be used.
            limits: What planner code may use.
            planner: The planner.
            roads: The ``road`` dictionaries by the keys that calls may name.
            seed: The seed of the planner's ``random``.
            type_check: Whether to type check the text before it runs.

        Raises:
            SandboxError: The planner cannot be loaded; see ``Sandbox.session``.
        """
        self.planner = planner
        self.has_trajectory = read_planner_text(planner.text).has_trajectory
        self._new, self._usable, self._limits = start, usable, limits
        self._roads = {str(key): road for key, road in roads.items()}
        self._seed = seed
        self._id = secrets.token_hex(8)
        self._subject = subject_of(planner)
        self._session: MontySession | None = None
        self._start(type_check)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def worker(self) -> int | None:
        """The process id of the worker, for tests and diagnosis; None after the session has ended."""
        return self._session.worker_pid if self._session is not None else None

    def close(self) -> None:
        """Return the worker to the pool. A second call does nothing."""
        from pydantic_monty import MontyError

        session, self._session = self._session, None
        if session is not None:
            try:
                session.__exit__(None, None, None)
            except (MontyError, RuntimeError):
                return  # the worker has already ended

    def endpoint(
        self, key: str, bv: Data, ego: Data, parameters: Mapping[str, float], acc: float, horizon: float
    ) -> dict[str, float]:
        """Call the planner's ``endpoint`` once.

        Args:
            key: The key of the vehicle's road.
            bv: What the planner observes of the background vehicle.
            ego: What the planner observes of the ego.
            parameters: The planner's parameter values, by name.
            acc: The intended acceleration [m/s2].
            horizon: The planning horizon [s].

        Returns:
            x, y [m], heading [rad], speed [m/s] and time [s], by name, in the planner's frame. All are finite and in
            range.

        Raises:
            PlannerRuntimeError: The call failed.
            PlannerLimitError: The call was stopped.
            PlannerResultError: The call returned something else.
        """
        self._known(key)
        call = (key, bv, ego, parameters, acc, horizon)
        return check_endpoint(self._subject, self._feed(f"one_{self._id}(call_{self._id})", {f"call_{self._id}": call}))

    def endpoints(self, calls: Sequence[Call]) -> list[dict[str, float] | SandboxError]:
        """Call the planner's ``endpoint`` for many states, up to ``MAX_CALLS_PER_FEED`` of them in one feed.

        A call that fails in a feed runs once more by itself. If it fails again, its error takes the place of its
        result. The other calls keep their results. The batch takes at most ``batch_seconds`` plus one call's limit. It
        ends early after ``MAX_STOPPED_CALLS`` calls have reached a limit. The remaining calls then yield
        ``PlannerLimitError``.

        Args:
            calls: The calls.

        Returns:
            The result of each call, as ``endpoint`` returns it, or its error.

        Raises:
            PlannerLimitError: The session had already ended.
        """
        self._alive()
        deadline = time.monotonic() + self._limits.batch_seconds
        results: list[dict[str, float] | SandboxError] = []
        stopped = 0
        for start in range(0, len(calls), MAX_CALLS_PER_FEED):
            part = calls[start : start + MAX_CALLS_PER_FEED]
            for call, value in zip(part, self._many(part, deadline), strict=True):
                results.append(self._again(call, deadline) if value is None else _or_error(self._subject, value))
                stopped += isinstance(results[-1], PlannerLimitError)
                if stopped >= MAX_STOPPED_CALLS:
                    deadline = -math.inf
        if self._session is None:
            with suppress(SandboxError):
                self._start(False)
        return results

    def trajectory(
        self, key: str, bv: Data, endpoint: Mapping[str, float], dt: float
    ) -> list[tuple[float, float, float, float]]:
        """Call the planner's ``trajectory`` once.

        Args:
            key: The key of the vehicle's road.
            bv: What the planner observes of the background vehicle.
            endpoint: The endpoint that the planner returned.
            dt: The time between two states [s].

        Returns:
            At most ``MAX_TRAJECTORY_STATES`` states: x, y [m], heading [rad] and speed [m/s]. The first state is ``dt``
            from now, or now if it is at the vehicle's place (``follower.starting_now``).

        Raises:
            PlannerRuntimeError: The call failed.
            PlannerLimitError: The call was stopped.
            PlannerResultError: The planner defines no trajectory, it begins away from the vehicle, it jumps, or the
                call returned something else.
        """
        if not self.has_trajectory:
            raise PlannerResultError(f"{self._subject} defines no trajectory(): use the built-in one.")
        self._known(key)
        value = self._feed(f"path_{self._id}(call_{self._id})", {f"call_{self._id}": (bv, dict(endpoint), key, dt)})
        states = check_trajectory(self._subject, value)
        check_motion(self._subject, states, bv, dt)
        return states

    def _start(self, type_check: bool) -> None:
        """Load the helpers and roads, then the planner, into a fresh interpreter."""
        self._session = self._new(self._seed, type_check)
        try:
            self._feed(HELPERS_CODE + REDUCERS.replace("ID", self._id), {f"roads_{self._id}": self._roads})
            self._feed(self.planner.text + "\nNone\n", {}, loading=True)
        except SandboxError:
            self.close()
            raise

    def _alive(self) -> MontySession:
        if self._session is None:
            raise PlannerLimitError(f"{self._subject}: its session has ended: open a new one.")
        return self._session

    def _known(self, key: str) -> None:
        if key not in self._roads:
            raise SandboxError(
                f"No road was given for the vehicle {printable_line(str(key))!r}: add it to the session's roads."
            )

    def _feed(self, code: str, inputs: dict[str, Any], *, loading: bool = False) -> Any:
        """Run one snippet. If it fails, raise SandboxError, and close the session if it has ended."""
        from pydantic_monty import MontyConversionError, MontyError

        session = self._alive()
        self._usable()
        printed = _Prints(self._limits.output_bytes)
        run = partial(session.feed_run, code, print_callback=printed, skip_type_check=not loading)
        try:
            try:
                return run(inputs=inputs)
            except MontyConversionError:
                return run(inputs=_plain(inputs))
        except MontyError as error:
            if printed.over:
                self.close()
                raise PlannerLimitError(
                    f"{self._subject} prints more than {printed.limit} bytes: print less."
                ) from None
            translated, ended = _translate(error, self._subject, loading)
            if ended:
                self.close()
            raise translated from None

    def _many(self, calls: Sequence[Call], deadline: float) -> list[Any]:
        """Call the planner for each call in one feed; the result of a failed call is None."""
        nothing: list[Any] = [None] * len(calls)
        if time.monotonic() >= deadline or self._session is None:
            return nothing
        for call in calls:
            self._known(call[0])
        try:
            values = self._feed(f"many_{self._id}(call_{self._id})", {f"call_{self._id}": list(calls)})
        except SandboxError:
            return nothing
        return values if type(values) is list and len(values) == len(calls) else nothing

    def _again(self, call: Call, deadline: float) -> dict[str, float] | SandboxError:
        """Run a call that failed in a batch once more, by itself."""
        if time.monotonic() >= deadline:
            return PlannerLimitError(f"{self._subject}: the batch's time is used up: make the planner faster.")
        try:
            if self._session is None:
                self._start(False)
            return self.endpoint(*call)
        except SandboxError as error:
            return error


class _Prints:
    """Counts what a planner prints and drops it."""

    def __init__(self, limit: int) -> None:
        self.limit, self.over, self._count = limit, False, 0

    def __call__(self, stream: str, text: str) -> None:
        self._count += len(text)
        self.over = self._count > self.limit
        if self.over:
            raise RuntimeError("too much output")


# A measured time, which differs between runs, and its limit
MEASURED_TIME = re.compile(r"\d+(?:\.\d+)?m?s > (\d+(?:\.\d+)?m?s)")


def _translate(error: MontyError, subject: str, loading: bool) -> tuple[SandboxError, bool]:
    """Turn an error of monty into one of this program, and tell whether it ended the session."""
    from pydantic_monty import MontyRuntimeError, MontySyntaxError, MontyTypingError

    message = MEASURED_TIME.sub(r"more than \1", printable_line(str(error)))
    if isinstance(error, MontyTypingError):
        return PlannerSyntaxError(f"{subject} fails the type check: {message}"), False
    if isinstance(error, MontySyntaxError):
        return PlannerSyntaxError(f"{subject}{_line(error)} does not parse: {message}"), False
    if not isinstance(error, MontyRuntimeError):
        return PlannerLimitError(f"{subject}: its worker was stopped: {message}"), True
    kind = type(error.exception())
    if kind is TimeoutError:  # no line is named, because the line differs from run to run
        return PlannerLimitError(f"{subject} ran into a limit: {message}"), True
    if kind is MemoryError or message.startswith("RuntimeError: suspension limit"):
        return PlannerLimitError(f"{subject}{_line(error)} ran into a limit: {message}"), True
    if kind is RecursionError:
        return PlannerLimitError(f"{subject}{_line(error)} ran into a limit: {message}"), False
    if loading and kind in (ImportError, ModuleNotFoundError, NotImplementedError):
        return PlannerSyntaxError(f"{subject}{_line(error)} uses what the sandbox lacks: {message}"), False
    return PlannerRuntimeError(f"{subject}{_line(error)} raised {message}"), False


def _line(error: Any) -> str:
    """Name the innermost line of the planner's own text in words."""
    lines = [frame.line for frame in error.traceback() if frame.filename == _PLANNER_FILE]
    return f", line {lines[-1]}," if lines else ""


def _plain(value: Any) -> Any:
    """Convert numpy's numbers and arrays, and mappings, to data that monty accepts, or raise SandboxError."""
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    raise SandboxError(f"A {type(value).__name__} cannot be sent to a planner: give numbers, text, lists and dicts.")


def _or_error(subject: str, value: Any) -> dict[str, float] | SandboxError:
    try:
        return check_endpoint(subject, value)
    except PlannerResultError as error:
        return error
