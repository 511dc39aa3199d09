"""Start processes, end them together with the process that started them, and say how they ended."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from typing import Any

from sumo_adv.errors import OUT_OF_MEMORY, SimulationError, ran_out_of_memory

SINGLE_THREAD_VARIABLES = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@contextmanager
def environment(variables: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for the processes that start within this context."""
    saved = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in saved.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


@contextmanager
def allowed_from_daemons() -> Iterator[None]:
    """Allow a daemonic process, such as a worker of a vectorised environment, to start processes within this context.

    ``multiprocessing`` refuses that, because such a child would outlive a worker that is killed. The engine does not
    outlive it, because the engine ends when its connection closes.
    """
    me = multiprocessing.current_process()
    daemonic, me.daemon = me.daemon, False
    try:
        yield
    finally:
        me.daemon = daemonic


@contextmanager
def deferred_interrupts() -> Iterator[None]:
    """Start processes that ignore Ctrl-C from their first instruction on.

    A Ctrl-C or SIGTERM that arrives meanwhile reaches this process at the end of the context, so that no process is
    left half started.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # starting it later would unblock the signals
    received: list[
        int
    ] = []  # SIGTERM is not blocked, because processes would inherit the block, and SIGTERM must end them
    handlers = dict[int, Any]()
    if threading.current_thread() is threading.main_thread():  # a Ctrl-C that is blocked here may go to another thread
        handlers = {k: h for k in (signal.SIGINT, signal.SIGTERM) if callable(h := signal.getsignal(k))}
    for number in handlers:
        signal.signal(number, lambda k, _: received.append(k))
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if received:
            signal.raise_signal(received[0])


def end_with(front: Connection) -> None:
    """Make sure that this process and its later children end when the front's process ends, however it ends.

    They form a process group, which is killed when the other end of ``front`` closes. A separate process watches the
    connection, because Python cannot act while SUMO works. If the system cannot fork (Windows), nothing is done: there
    this process ends when it next reads its connection.

    Args:
        front: A connection whose other end only the front's process holds.
    """
    if not hasattr(os, "fork"):
        return
    os.setpgid(0, 0)
    me, (inlet, outlet) = os.getpid(), os.pipe()
    if os.fork() == 0:
        os.close(outlet)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        ended = wait([front, inlet])
        if front in ended:
            os.killpg(me, signal.SIGKILL)
        os._exit(0)  # the watched process has ended by itself
    os.close(inlet)  # ``outlet`` stays open as long as this process or a fork of it lives


def check_parent() -> None:
    """Check that the process that started this one still runs.

    A worker that outlives it for a moment finds its scratch folder removed. It must keep no result of that.

    Raises:
        EOFError: The parent has ended.
    """
    parent = multiprocessing.parent_process()
    if parent is not None and not parent.is_alive():
        raise EOFError("The process that started this one has ended.")


def repair_process() -> None:
    """Undo damage by third-party code that this process and its forks could not survive.

    The damage can be an ignored SIGCHLD, so that the system does not report children, or closed standard files, whose
    numbers a fork's pipe would get.
    """
    if hasattr(signal, "SIGCHLD"):
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number
    for name, number in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None or getattr(sys, name).closed:
            setattr(sys, name, os.fdopen(number, "w", closefd=False))


def exit_in_words(exitcode: int | None) -> str:
    """Return an exit code in words, such as "exit status 3" or "killed by SIGKILL"."""
    if exitcode is None or exitcode >= 0:
        return f"exit status {exitcode}"
    try:
        return f"killed by {signal.Signals(-exitcode).name}"
    except ValueError:
        return f"killed by signal {-exitcode}"


def unexpected(what: str, error: BaseException) -> SimulationError:
    """Return the error for a failure with an exception that this program does not raise.

    Args:
        what: What failed; it begins the sentence.
        error: The exception.

    Returns:
        The error; that of too little memory if memory ran out.
    """
    sentence = f"{what} failed ({type(error).__name__}: {error})."
    return SimulationError(OUT_OF_MEMORY if ran_out_of_memory(error) else sentence)
