"""Attempts in forks of the engine process: bit-identical to the process itself, and started in milliseconds."""

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
    """Whether attempts can be forked on this system."""
    return hasattr(os, "fork") and sys.platform.startswith("linux")


def in_forks(
    works: Sequence[Callable[[], Any]], reloaded: Callable[[Callable[[], Any]], Callable[[], Any]] | None = None,
    lost: Callable[[str], Any] | None = None, memory: float = 0.0,
) -> list[Any]:  # fmt: skip
    """Do each piece of work in a fork of its own, at the same time; results in order.

    reloaded: adds to a piece of work that it loads the simulation again first. A fork that dies is repeated with it.
        A fork is not repeated if it was killed because code of others did not return in time.
    lost: makes a result of the sentence that says why a fork died, if it dies again when it is repeated.
    memory: what a fork may use beyond what it begins with [MiB]; 0: without bound.

    Raises SimulationError: a fork died, and again when it was repeated, and there is no ``lost``; or its work failed.
    DriverError if code of others ran in it then.
    """
    ends = _forked(works, memory)
    if reloaded is not None:
        for k, end in enumerate(ends):
            if not end.data and not end.late:
                ends[k] = _forked([reloaded(works[k])], memory)[0]
    return [_result(end, lost, repeated=reloaded is not None) for end in ends]


@dataclass(frozen=True, slots=True)
class _End:
    """What a fork wrote, nothing if it died; its exit code, negative for the signal that killed it; the call of code of
    others that it died in, and whether it was killed because that was late."""

    data: bytes
    status: int
    call: Call | None
    late: bool


def _forked(works: Sequence[Callable[[], Any]], memory: float) -> list[_End]:
    children = []
    repair_process()
    gc.freeze()  # a collection in a child would write to every object's page, which the system then copies
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
    return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def _all_written(children: Mapping[int, tuple[int, Watch]], late: set[int]) -> dict[int, bytes]:
    """What comes out of each pipe until its child closes it, or has ended and a process that it left behind holds it. A
    child whose call is overdue is killed, and noted."""
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
    """Bound what this process may allocate beyond what it has [MiB], where the system can; 0: do not."""
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
    """Never returns: whatever goes wrong, a fork must not go on as a second engine."""
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
    """Why a fork ended without a result."""
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
