"""An engine and sandboxes for many episodes.

Each episode runs in a fork of a process that has imported all modules and run nothing. It starts in milliseconds, in
the same surroundings as in a new process. The fork itself answers the front. Its parent waits, and ends in the same way
if the fork dies. Without forks, each episode gets a new process.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Protocol, Self

from sumo_adv.config import Settings
from sumo_adv.episode.engine import EpisodeCalls, EpisodeEngine
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.forks import can_fork


class WarmCalls(EpisodeCalls, Protocol):
    """The calls of an engine process for many episodes.

    The calls of an episode come between ``begin`` and ``end``.
    """

    def begin(self, environment: Mapping[str, str], folder: str, path: Sequence[str]) -> None:
        """Begin an episode.

        Args:
            environment: The front's environment variables.
            folder: The front's working folder.
            path: The front's ``sys.path``.
        """

    def end(self) -> None:
        """End the episode."""


def _warm_worker(slots: list[Connection]) -> WarmCalls:
    from sumo_adv.episode.warm_worker import WarmWorker

    return WarmWorker(slots)


class WarmEngine:
    """One engine process for many episodes. It is started again after a failure."""

    def __init__(self, slots: int = 1) -> None:
        """Start without a process; the first episode starts it.

        Args:
            slots: The number of forks that run at once.
        """
        self._engine: Engine[WarmCalls] | None = None
        self._slots = slots

    @contextmanager
    def episode(self) -> Iterator[EpisodeEngine]:
        """Open an episode.

        The engine is yielded at once, while its process still loads its modules. After a failure the process is ended.

        Yields:
            The engine for the episode.

        Raises:
            SimulationError: The process does not start.
        """
        if self._engine is None:
            self._engine = Engine(_warm_worker, self._slots)
        engine = self._engine
        try:
            engine.post(WarmCalls.begin, dict(os.environ), str(Path.cwd()), sys.path)
            yield engine
            in_order = not (engine.lost or engine.talks or engine.asked)
            if in_order:
                engine.call(WarmCalls.end)
        except BaseException:
            self.close()
            raise
        if not in_order or not can_fork():
            self.close()

    def close(self) -> None:
        """End the process. The next episode gets a new one."""
        if self._engine is not None:
            self._engine.close()
            self._engine = None


class WarmSandboxes:
    """Sandboxes for many episodes: one for each value of the setting ``bubblewrap``, opened when first needed."""

    def __init__(self) -> None:
        self._by_bubblewrap: dict[bool, Sandbox] = {}

    def of(self, settings: Settings) -> Sandbox:
        """Return the sandbox for the settings of an episode.

        Args:
            settings: The settings.
        """
        bubblewrap = settings.bubblewrap
        if bubblewrap not in self._by_bubblewrap:
            self._by_bubblewrap[bubblewrap] = Sandbox(bubblewrap=bubblewrap)
        return self._by_bubblewrap[bubblewrap]

    def close(self) -> None:
        """Close all sandboxes."""
        for sandbox in self._by_bubblewrap.values():
            sandbox.close()


class WarmProcesses:
    """An engine and sandboxes for many episodes. As a context manager, it closes them."""

    def __init__(self) -> None:
        self._engine, self._sandboxes = WarmEngine(), WarmSandboxes()

    def close(self) -> None:
        """Close the engine and the sandboxes."""
        try:
            self._engine.close()
        finally:
            self._sandboxes.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
