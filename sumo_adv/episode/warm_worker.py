"""Serve many episodes from one engine process, each in a fork of it.

``warm.py`` gives the reasons.
"""

from __future__ import annotations

import ctypes
import faulthandler
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Mapping, Sequence
from multiprocessing.connection import Connection

import shapely.geometry  # noqa: F401 - imported before the first fork, because every episode needs it

from sumo_adv.episode.warm import WarmCalls
from sumo_adv.episode.worker import EpisodeWorker
from sumo_adv.simulation.forks import can_fork
from sumo_adv.simulation.processes import SINGLE_THREAD_VARIABLES
from sumo_adv.simulation.programs import load_libsumo

PR_SET_PDEATHSIG = 1  # linux/prctl.h
ENDED_ITSELF = 86  # exit code of a fork after its episode; a driver that ends the process rarely has it
OWN_VARIABLES = {*SINGLE_THREAD_VARIABLES, "TMPDIR"}  # kept by the engine process, whatever its front has


class WarmWorker(EpisodeWorker, WarmCalls):
    """Serves one episode after the other, each in a fork of its own."""

    def __init__(self, slots: Sequence[Connection]) -> None:
        """Load libsumo before the first fork.

        Args:
            slots: The connections of forks to the front.
        """
        load_libsumo()
        faulthandler.enable()
        super().__init__(slots)
        self._in_fork = False

    def begin(self, environment: Mapping[str, str], folder: str, path: Sequence[str]) -> None:
        """Begin an episode with the front's environment, working folder and ``sys.path``.

        In the fork that serves the episode, this method returns at once. In the parent it returns when the fork has
        ended, and so answers the fork's last call. If the fork fails, the parent ends in the same way.

        Args:
            environment: The front's environment variables.
            folder: The front's working folder.
            path: The front's ``sys.path``.
        """
        if can_fork():
            own = tempfile.mkdtemp()
            pid = os.fork()
            if pid != 0:
                _, status = os.waitpid(pid, 0)
                shutil.rmtree(own, ignore_errors=True)
                if (code := os.waitstatus_to_exitcode(status)) != ENDED_ITSELF:
                    _end_as(code)
                return
            self._in_fork = True
            die_with_parent()
            tempfile.tempdir = own
        os.environ.update({k: v for k, v in environment.items() if k not in OWN_VARIABLES})
        for name in os.environ.keys() - environment.keys() - OWN_VARIABLES:
            del os.environ[name]
        os.chdir(folder)
        sys.path[:] = path

    def end(self) -> None:
        """End the fork. Its parent answers the call."""
        if self._in_fork:
            sys.stdout.flush()
            os._exit(ENDED_ITSELF)


def _end_as(exitcode: int) -> None:
    """End this process as another one ended: with its exit code, or by its signal if the code is negative."""
    if exitcode < 0:
        faulthandler.disable()
        signal.signal(-exitcode, signal.SIG_DFL)
        os.kill(os.getpid(), -exitcode)
    os._exit(exitcode)


def die_with_parent() -> None:
    """Have this process killed when its parent ends (Linux only)."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
