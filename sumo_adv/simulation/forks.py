"""Run attempts in forks of the engine process, which are bit-identical to it and start in milliseconds."""

from __future__ import annotations

import gc
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

from sumo_adv.errors import DriverError, SimulationError, SumoAdvError
from sumo_adv.simulation.engine_log import aside
from sumo_adv.simulation.processes import exit_in_words, repair_process, unexpected
from sumo_adv.simulation.watch import WATCH_INTERVAL_S, Call, Watch, keep


def can_fork() -> bool:
    """Return whether attempts can be forked on this system."""
    return hasattr(os, "fork") and sys.platform.startswith("linux")


def in_forks(
    works: Sequence[Callable[[], Any]], reloaded: Callable[[Callable[[], Any]], Callable[[], Any]] | None = None,
    lost: Callable[[str], Any] | None = None, memory: float = 0.0,
) -> list[Any]:  # fmt: skip
    """Do each piece of work in its own fork, all at the same time.

    A fork that dies is repeated if ``reloaded`` is given, unless it was killed because third-party code did not return
    in time.

    Args:
        works: The pieces of work.
        reloaded: Changes a piece of work so that it loads the simulation again first.
        lost: Makes a result from the message that says why a fork died. It is called if the fork has died for the last
            time.
        memory: What a fork may allocate beyond what it starts with [MiB]; 0 means without limit.

    Returns:
        The results, in the order of ``works``.

    Raises:
        SimulationError: A fork died for the last time and ``lost`` is None, or SUMO failed in it.
        DriverError: A fork died or was killed in third-party code, and ``lost`` is None.
        SumoAdvError: A piece of work raised it.
    """
    ends = _forked(works, memory)
    if reloaded is not None:
        for k, end in enumerate(ends):
            if not end.data and not end.late:
                ends[k] = _forked([reloaded(works[k])], memory)[0]
    return [_result(end, lost, repeated=reloaded is not None) for end in ends]


@dataclass(frozen=True, slots=True)
class _End:
    """How a fork ended.

    Attributes:
        data: What it wrote; empty if it died.
        status: Its exit code; negative for the signal that killed it.
        call: The watched call in which it died.
        late: Whether it was killed because that call was overdue.
    """

    data: bytes
    status: int
    call: Call | None
    late: bool


def _forked(works: Sequence[Callable[[], Any]], memory: float) -> list[_End]:
    """Run each piece of work in a fork, and wait until all have ended."""
    children = []
    repair_process()
    gc.freeze()  # a collection in a child would write to the page of every object, and the system would copy them
    for work in works:
        watch = Watch()
        inlet, outlet = os.pipe()
        pid = os.fork()
        if pid == 0:
            os.close(inlet)
            keep(watch)
            _child(work, outlet, memory)
        os.close(outlet)
        children.append((pid, inlet, watch))
    late: set[int] = set()
    written = _all_written({inlet: (pid, watch) for pid, inlet, watch in children}, late)
    ends = []
    for pid, inlet, watch in children:
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        ends.append(_End(written[inlet], status, watch.running(), pid in late))
    return ends


def _has_ended(pid: int) -> bool:
    """Return whether a child process has ended, without collecting its exit status."""
    return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def _all_written(children: Mapping[int, tuple[int, Watch]], late: set[int]) -> dict[int, bytes]:
    """Return what each child writes to its pipe.

    Reading ends when the child closes the pipe, or has ended while a process that it left behind holds the pipe. A
    child whose call is overdue is killed and added to ``late``.
    """
    parts: dict[int, list[bytes]] = {inlet: [] for inlet in children}
    open_ones = set(children)
    while open_ones:
        ready = wait(open_ones, WATCH_INTERVAL_S)
        for ended in () if ready else [each for each in open_ones if _has_ended(children[each][0])]:
            if not wait([ended], 0):
                os.close(ended)
                open_ones.discard(ended)
        for inlet in ready:
            assert isinstance(inlet, int)
            part = os.read(inlet, 1 << 20)
            if part:
                parts[inlet].append(part)
            else:
                os.close(inlet)
                open_ones.discard(inlet)
        for inlet in open_ones:
            pid, watch = children[inlet]
            if pid not in late and watch.overdue() is not None:
                late.add(pid)
                os.kill(pid, signal.SIGKILL)
    return {inlet: b"".join(each) for inlet, each in parts.items()}


@contextmanager
def _bounded(memory: float) -> Iterator[None]:
    """Limit what this process may allocate beyond what it has [MiB], if the system supports it; 0 means no limit."""
    status = Path("/proc/self/status")
    if not memory or not status.is_file():
        yield
        return
    import resource

    data = next(line for line in status.read_text().splitlines() if line.startswith("VmData:"))
    before = resource.getrlimit(resource.RLIMIT_DATA)
    bound = int(data.split()[1]) * 1024 + int(memory * 2**20)
    resource.setrlimit(resource.RLIMIT_DATA, (bound, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _child(work: Callable[[], Any], outlet: int, memory: float) -> None:
    """Do the work, send its result and exit. Never returns, because a fork must not continue as a second engine."""
    try:
        try:
            with aside(), _bounded(memory):
                value = work()
            data = pickle.dumps(("value", value), protocol=pickle.HIGHEST_PROTOCOL)
        except SumoAdvError as error:
            data = pickle.dumps(("error", error))
        except BaseException as error:
            data = pickle.dumps(("error", unexpected("An attempt", error)))
        with os.fdopen(outlet, "wb") as pipe:
            pipe.write(data)
    finally:
        os._exit(0)


def _result(end: _End, lost: Callable[[str], Any] | None, *, repeated: bool) -> Any:
    """Return the result of a fork, or raise its error."""
    if end.data:
        kind, value = pickle.loads(end.data)
        if kind == "error":
            raise value
        return value
    error = _death(end, repeated=repeated)
    if lost is None:
        raise error
    return lost(str(error))


def _death(end: _End, *, repeated: bool) -> SimulationError:
    """Return the error that says why a fork ended without a result."""
    again = ", also when the simulation was loaded again and the attempt repeated" if repeated else ""
    if end.call is not None and end.late:
        return end.call.too_late()
    if end.call is not None and not end.call.is_sumo:
        return DriverError(end.call.ended(f"{exit_in_words(end.status)}{again}"))
    if end.status >= 0:
        return SimulationError(f"A forked attempt ended without a result (exit status {end.status}){again}.")
    name = signal.Signals(-end.status).name
    crash = name in ("SIGSEGV", "SIGABRT", "SIGBUS", "SIGFPE", "SIGILL")
    sentence = "SUMO or the ego's driver crashed in a forked attempt" if crash else "A forked attempt was killed"
    return SimulationError(f"{sentence} ({name}){again}.")
