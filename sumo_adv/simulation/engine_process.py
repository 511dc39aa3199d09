"""The engine process: a loop that calls its worker's methods for the front."""

from __future__ import annotations

import os
import signal
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path

from sumo_adv.errors import SimulationError, SumoAdvError
from sumo_adv.simulation.engine_log import MAX_SAID_CHARACTERS, ProcessOutput, last_error
from sumo_adv.simulation.processes import end_with, repair_process, unexpected
from sumo_adv.simulation.watch import Watch, keep


def serve(
    make_worker: Callable[[list[Connection]], object], control: Connection, slots: list[Connection],
    log: tuple[Path, Path], note: Path, front: Connection,
) -> None:  # fmt: skip
    """Call the methods of the worker that the front names, one after the other. Never returns.

    Args:
        make_worker: Makes the worker from ``slots``.
        control: Where calls come from and results go to.
        slots: The connections on which forks ask the front.
        log: The files of ``engine_log.py:EngineLog``.
        note: The file of the process's ``Watch``.
        front: A connection that closes when the front's process ends.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C and SIGTERM are left to the front
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    end_with(front)
    try:
        output = ProcessOutput(*log)
        keep(Watch(note))
    except FileNotFoundError:  # the front was interrupted and has removed the files
        os._exit(0)
    worker = make_worker(slots)
    while True:
        try:
            method, arguments, named = control.recv()
        except EOFError:
            os._exit(0)  # nothing is left to write, and a regular exit of the interpreter keeps the front waiting
        sizes = output.sizes()
        try:
            reply = ("value", getattr(worker, method)(*arguments, **named))
        except SumoAdvError as error:
            reply = ("error", _with_words(error, output.since(sizes)))
        except Exception as error:
            reply = ("error", unexpected("The simulation", error))
            traceback.print_exc()
        repair_process()
        control.send(reply)


def _with_words(error: SumoAdvError, words: str) -> SumoAdvError:
    """Add SUMO's last error to the message, because SUMO says what is wrong only on its error output."""
    said = last_error(words)
    if isinstance(error, SimulationError) and said and said not in str(error):
        return SimulationError(f"{str(error).rstrip('.')}: {said.strip()[:MAX_SAID_CHARACTERS]}")
    return error
