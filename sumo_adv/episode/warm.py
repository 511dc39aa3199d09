"""An engine and sandboxes for many episodes.

Each episode runs in a fork of a process that has imported all modules and run nothing. It has the same surroundings as
in a new process, and starts in milliseconds. The fork answers the front itself. Its parent waits, and ends as the fork
does if that dies. Without forks each episode gets a new process.
"""

from __future__ import annotations

import ctypes
import faulthandler
import os
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Self

from sumo_adv.config import Settings
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.simulation.engine import QUIET_VARIABLES, Engine, can_fork
from sumo_adv.simulation.programs import load_libsumo

PR_SET_PDEATHSIG = 1  # linux/prctl.h
OWN_VARIABLES = {*QUIET_VARIABLES, "TMPDIR"}  # of the engine process, whatever its front has


class WarmEngine:
    """One engine process for many episodes, started again after a failure; ``slots``: see ``Engine``."""

    def __init__(self, slots: int = 1) -> None:
        self._engine: Engine | None = None
        self._slots = slots

    @contextmanager
    def episode(self) -> Iterator[Engine]:
        """The engine for one episode; the process loads its modules meanwhile. Raises SimulationError if it does not
        start."""
        if self._engine is None:
            self._engine = Engine(body, self._slots)
        engine = self._engine
        try:
            engine.post("begin", dict(os.environ), str(Path.cwd()), sys.path)
            yield engine
            in_order = not (engine.lost or engine.talks or engine.asked)
            if in_order:
                engine.request("end")
        except BaseException:
            self.close()
            raise
        if not in_order or not can_fork():
            self.close()

    def close(self) -> None:
        """End the process; the next episode gets a new one."""
        if self._engine is not None:
            self._engine.close()
            self._engine = None


class WarmSandboxes:
    """Sandboxes for many episodes: one for each value of the setting ``bubblewrap``, opened when first needed."""

    def __init__(self) -> None:
        self._by_bubblewrap: dict[bool, Sandbox] = {}

    def of(self, settings: Settings) -> Sandbox:
        bubblewrap = settings.bubblewrap
        if bubblewrap not in self._by_bubblewrap:
            self._by_bubblewrap[bubblewrap] = Sandbox(bubblewrap=bubblewrap)
        return self._by_bubblewrap[bubblewrap]

    def close(self) -> None:
        for sandbox in self._by_bubblewrap.values():
            sandbox.close()


class WarmProcesses:
    """An engine and sandboxes for many episodes; a context manager."""

    def __init__(self) -> None:
        self._engine, self._sandboxes = WarmEngine(), WarmSandboxes()

    def close(self) -> None:
        try:
            self._engine.close()
        finally:
            self._sandboxes.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Nursery:
    """The commands ``begin`` and ``end``, and those of the episode in between."""

    def __init__(self, slots: list[Connection]) -> None:
        self._slots = slots
        self._handlers: dict[str, Callable[..., Any]] = {}
        self._in_fork = False

    def begin(self, environment: dict[str, str], folder: str, path: list[str]) -> None:
        """Begin an episode with its front's environment, working folder and ``sys.path``.

        Returns in the fork that serves it; and in the parent when the fork has ended, in answer to the last command. A
        fork that does not end by itself takes its parent along.
        """
        from sumo_adv.episode.worker import body as episode_body

        if can_fork():
            own = tempfile.mkdtemp()
            pid = os.fork()
            if pid != 0:
                _, status = os.waitpid(pid, 0)
                shutil.rmtree(own, ignore_errors=True)
                if status != 0:
                    _end_as(os.waitstatus_to_exitcode(status))
                return
            self._in_fork = True
            die_with_parent()
            tempfile.tempdir = own
        os.environ.update({k: v for k, v in environment.items() if k not in OWN_VARIABLES})
        for name in os.environ.keys() - environment.keys() - OWN_VARIABLES:
            del os.environ[name]
        os.chdir(folder)
        sys.path[:] = path
        self._handlers = episode_body(self._slots)

    def end(self) -> None:
        """End the fork. Its parent answers."""
        if self._in_fork:
            sys.stdout.flush()
            os._exit(0)

    def command(self, name: str) -> Callable[..., Any]:
        return lambda *arguments: self._handlers[name](*arguments)


def _end_as(exitcode: int) -> None:
    """End this process as another one ended: by that signal if negative."""
    if exitcode < 0:
        faulthandler.disable()
        signal.signal(-exitcode, signal.SIG_DFL)
        os.kill(os.getpid(), -exitcode)
    os._exit(exitcode)


def body(slots: list[Connection]) -> dict[str, Callable[..., Any]]:
    """The commands of the engine process."""
    import shapely.geometry  # noqa: F401 - imported before the first fork, because every episode needs it

    from sumo_adv.episode.worker import COMMANDS

    load_libsumo()
    faulthandler.enable()
    nursery = _Nursery(slots)
    return {"begin": nursery.begin, "end": nursery.end, **{name: nursery.command(name) for name in COMMANDS}}


def die_with_parent() -> None:
    """On Linux: have this process killed when its parent ends."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
