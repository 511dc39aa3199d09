"""The engine process itself: a loop that calls its worker's methods for the front."""

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
    """Do what the front calls, one method of the worker after the other; never returns.

    Args:
        make_worker: Makes the worker from ``slots``.
        control: Where calls come from and results go to.
        slots: The connections on which forks ask the front.
        log: The files of ``engine_log.py:EngineLog``.
        note: The file of the process's ``Watch``.
        front: Closes when the front's process ends.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C and SIGTERM are left to the front
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    end_with(front)
    try:
        output = ProcessOutput(*log)
        keep(Watch(note))
    except FileNotFoundError:  # the front was interrupted and has removed it
        os._exit(0)
    worker = make_worker(slots)
    while True:
        try:
            method, arguments, named = control.recv()
        except EOFError:
            os._exit(0)  # nothing is left to write, and an interpreter that ends in good order keeps the front waiting
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
    """Put SUMO's last error into the sentence: SUMO says what is wrong on its error output only."""
    said = last_error(words)
    if isinstance(error, SimulationError) and said and said not in str(error):
        return SimulationError(f"{str(error).rstrip('.')}: {said.strip()[:MAX_SAID_CHARACTERS]}")
    return error
