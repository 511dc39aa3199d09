"""One planner in one fresh interpreter: loading it, calling it, and turning monty's errors into ours."""

from __future__ import annotations

import re
import secrets
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from sumo_adv.datatypes import Planner
from sumo_adv.errors import (
    PlannerLimitError,
    PlannerResultError,
    PlannerRuntimeError,
    PlannerSyntaxError,
    SandboxError,
)
from sumo_adv.planners.results import REDUCERS, check_endpoint, check_motion, check_trajectory, clean, packed
from sumo_adv.planners.source import HELPERS_CODE, read_source

if TYPE_CHECKING:
    from pydantic_monty import MontyError, MontySession

    from sumo_adv.planners.sandbox import Sandbox

BATCH_FEED = 256  # calls a feed: a feed has ``call_seconds``, and an honest call needs some 10 us
_PLANNER_FILE = "<python-input-1>"  # monty's name for the second feed of a session

Call = tuple[str, Mapping[str, Any], Mapping[str, Any], Mapping[str, float], float, float]
"""One call in a batch: key, bv, ego, parameters, acc, horizon [s]."""


class PlannerSession:
    """One planner in one fresh interpreter; a context manager; for one thread at a time.

    After a time or memory limit or a dead worker the session has ended and every further call raises
    ``PlannerLimitError``; only ``endpoints`` starts it again by itself, with fresh globals.
    """

    def __init__(
        self,
        sandbox: Sandbox,
        planner: Planner,
        roads: Mapping[str, Mapping[str, Any]],
        seed: int,
        type_check: bool,
    ) -> None:
        self.planner = planner
        self.has_trajectory = read_source(planner.source).has_trajectory
        self._sandbox = sandbox
        self._roads = {str(key): road for key, road in roads.items()}
        self._seed = seed
        self._id = secrets.token_hex(8)
        self._who = clean(f"Planner {planner.label}/{planner.mode}")[:120]
        self._session: MontySession | None = None
        self._start(type_check)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    @property
    def worker(self) -> int | None:
        """Process id of the worker, for tests and diagnosis; None once the session has ended."""
        return self._session.worker_pid if self._session is not None else None

    def close(self) -> None:
        """Give the worker back. May be called twice."""
        from pydantic_monty import MontyError

        session, self._session = self._session, None
        if session is not None:
            try:
                session.__exit__(None, None, None)
            except (MontyError, RuntimeError):
                return  # the worker is gone already, which is what closing wants

    def endpoint(
        self,
        key: str,
        bv: Mapping[str, Any],
        ego: Mapping[str, Any],
        parameters: Mapping[str, float],
        acc: float,
        horizon: float,
    ) -> dict[str, float]:
        """Call the planner once.

        Returns:
            x, y [m], heading [rad], speed [m/s], time [s], finite and in range, in the planner's frame.

        Raises:
            PlannerRuntimeError, PlannerLimitError, PlannerResultError: as their names say.
        """
        self._known(key)
        call = (bv, ego, key, parameters, acc, horizon)
        return check_endpoint(self._who, self._feed(f"one_{self._id}(call_{self._id})", {f"call_{self._id}": call}))

    def endpoints(self, calls: Sequence[Call]) -> list[dict[str, float] | SandboxError]:
        """Call the planner for many states; one feed for up to ``BATCH_FEED`` of them.

        A call that fails gives its error at its place and is run once more by itself for it; the others are unharmed.
        All together take at most ``batch_seconds`` (and one call's limit); the rest are ``PlannerLimitError``.

        Raises:
            PlannerLimitError: the session had ended before.
        """
        self._alive()
        deadline = time.monotonic() + self._sandbox.limits.batch_seconds
        results: list[dict[str, float] | SandboxError] = []
        for start in range(0, len(calls), BATCH_FEED):
            part = calls[start : start + BATCH_FEED]
            for call, value in zip(part, self._many(part, deadline), strict=True):
                results.append(self._again(call, deadline) if value is None else _or_error(self._who, value))
        if self._session is None:
            self._start_quietly()
        return results

    def trajectory(
        self, key: str, bv: Mapping[str, Any], endpoint: Mapping[str, float], dt: float
    ) -> list[tuple[float, float, float, float]]:
        """The planner's own trajectory: up to ``MAX_TRAJECTORY`` states (x, y, heading, speed), ``dt`` [s] apart, the
        first one ``dt`` from now (one that begins now is known by its place).

        Raises:
            PlannerResultError: it has none, what it returned is not one, begins elsewhere or jumps.
            PlannerRuntimeError, PlannerLimitError: as their names say.
        """
        if not self.has_trajectory:
            raise PlannerResultError(f"{self._who} defines no trajectory(): use the built-in one.")
        self._known(key)
        value = self._feed(f"path_{self._id}(call_{self._id})", {f"call_{self._id}": (bv, dict(endpoint), key, dt)})
        states = check_trajectory(self._who, value)
        check_motion(self._who, states, bv, dt)
        return states

    def _start(self, type_check: bool) -> None:
        """A fresh interpreter: helpers and roads, then the planner."""
        self._session = self._sandbox.checkout(self._seed, type_check)
        try:
            self._feed(HELPERS_CODE + REDUCERS.replace("ID", self._id), {f"roads_{self._id}": self._roads})
            self._feed(self.planner.source + "\nNone\n", {}, loading=True)
        except SandboxError:
            self.close()
            raise

    def _start_quietly(self) -> SandboxError | None:
        try:
            self._start(False)
        except SandboxError as error:
            return error
        return None

    def _alive(self) -> MontySession:
        if self._session is None:
            raise PlannerLimitError(f"{self._who}: its session has ended: open a new one.")
        return self._session

    def _known(self, key: str) -> None:
        if key not in self._roads:
            raise SandboxError(f"No road was given for the vehicle {clean(str(key))!r}: add it to the session's roads.")

    def _feed(self, code: str, inputs: dict[str, Any], *, loading: bool = False) -> Any:
        """Run one snippet; monty's errors become ours, and an ended session is given up."""
        from pydantic_monty import MontyConversionError, MontyError

        session = self._alive()
        self._sandbox.check_usable()
        printed = _Prints(self._sandbox.limits.output_bytes)
        try:
            try:
                return session.feed_run(code, inputs=inputs, print_callback=printed, skip_type_check=not loading)
            except MontyConversionError:
                return session.feed_run(
                    code, inputs=_plain(inputs), print_callback=printed, skip_type_check=not loading
                )
        except MontyError as error:
            if printed.over:
                self.close()
                raise PlannerLimitError(f"{self._who} prints more than {printed.limit} bytes: print less.") from None
            ours, ended = _translate(error, self._who, loading)
            if ended:
                self.close()
            raise ours from None

    def _many(self, calls: Sequence[Call], deadline: float) -> list[Any]:
        """What the planner gave for each call, None where it failed."""
        nothing: list[Any] = [None] * len(calls)
        if time.monotonic() >= deadline or self._session is None:
            return nothing
        for call in calls:
            self._known(call[0])
        rows = packed(calls)
        batch = rows or [(bv, ego, key, parameters, acc, horizon) for key, bv, ego, parameters, acc, horizon in calls]
        code = f"many_{self._id}(call_{self._id})" if rows is None else f"rows_{self._id}(*call_{self._id})"
        try:
            values = self._feed(code, {f"call_{self._id}": batch})
        except SandboxError:
            return nothing
        return values if type(values) is list and len(values) == len(calls) else nothing

    def _again(self, call: Call, deadline: float) -> dict[str, float] | SandboxError:
        """A call that failed in a batch, by itself."""
        if time.monotonic() >= deadline:
            return PlannerLimitError(f"{self._who}: the batch's time is used up: make the planner faster.")
        if self._session is None and (failure := self._start_quietly()) is not None:
            return failure
        try:
            return self.endpoint(*call)
        except SandboxError as error:
            return error


class _Prints:
    """Counts what a planner prints and drops it."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.count = 0

    @property
    def over(self) -> bool:
        return self.count > self.limit

    def __call__(self, stream: str, text: str) -> None:
        self.count += len(text)
        if self.over:
            raise RuntimeError("too much output")


MEASURED = re.compile(r"\d+(?:\.\d+)?m?s > (\d+(?:\.\d+)?m?s)")  # a time that differs from run to run, and its limit


def _translate(error: MontyError, who: str, loading: bool) -> tuple[SandboxError, bool]:
    """Monty's error as ours, and whether the session can go no further."""
    from pydantic_monty import MontyRuntimeError, MontySyntaxError, MontyTypingError

    said = MEASURED.sub(r"more than \1", clean(str(error)))
    if isinstance(error, MontyTypingError):
        return PlannerSyntaxError(f"{who} fails the type check: {said}"), False
    if isinstance(error, MontySyntaxError):
        return PlannerSyntaxError(f"{who}{_line(error)} does not parse: {said}"), False
    if not isinstance(error, MontyRuntimeError):
        return PlannerLimitError(f"{who}: its worker was stopped: {said}"), True
    kind = type(error.exception())
    if kind is TimeoutError:  # where it was stopped differs from run to run
        return PlannerLimitError(f"{who} ran into a limit: {said}"), True
    if kind is MemoryError or said.startswith("RuntimeError: suspension limit"):
        return PlannerLimitError(f"{who}{_line(error)} ran into a limit: {said}"), True
    if kind is RecursionError:
        return PlannerLimitError(f"{who}{_line(error)} ran into a limit: {said}"), False
    if loading and kind in (ImportError, ModuleNotFoundError, NotImplementedError):
        return PlannerSyntaxError(f"{who}{_line(error)} uses what the sandbox lacks: {said}"), False
    return PlannerRuntimeError(f"{who}{_line(error)} raised {said}"), False


def _line(error: Any) -> str:
    """The innermost line of the planner's own text, as words."""
    lines = [frame.line for frame in error.traceback() if frame.filename == _PLANNER_FILE]
    return f", line {lines[-1]}," if lines else ""


def _plain(value: Any) -> Any:
    """Numpy's numbers and arrays, and mappings of any kind, as what can be sent."""
    if value is None or isinstance(value, str | bool | int | float):
        return value
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(item) for item in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    raise SandboxError(f"A {type(value).__name__} cannot be sent to a planner: give numbers, text, lists and dicts.")


def _or_error(who: str, value: Any) -> dict[str, float] | SandboxError:
    try:
        return check_endpoint(who, value)
    except PlannerResultError as error:
        return error
