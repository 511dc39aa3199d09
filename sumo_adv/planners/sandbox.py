"""The pool of workers that run planner code: processes of monty, an interpreter for model-written Python.

There are three walls. The first is monty: no host objects, files or network, and limits on time, memory and recursion.
The second is bubblewrap around its process (``jail``). The third is the check of everything that comes back
(``results``).

The clock is frozen, sleep takes no time, random is seeded, and prints are counted and dropped. Globals live as long as
a session, so a planner can see what earlier calls of its session left there. Calls of one batch also share the objects
they were given. A planner never sees another planner's data, because each session starts from an empty interpreter.

Measured on two slow cores, in bubblewrap or not: 0.7 ms a session (2 ms with a road of 1000 points), 0.15 ms a call
(0.25 ms with an ego path of 80 states), 20 us a call in a batch of 100, 16 ms a type check.
"""

from __future__ import annotations

import importlib.util
import os
import sys
import tempfile
import threading
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from sumo_adv.datatypes import Planner
from sumo_adv.errors import SandboxError
from sumo_adv.planners.jail import Jail, make_jail, wrapper_script
from sumo_adv.planners.results import clean
from sumo_adv.planners.session import PlannerSession, SandboxLimits
from sumo_adv.planners.source import HELPERS_STUBS

if TYPE_CHECKING:
    from pydantic_monty import Monty, MontySession

_INSTANT = datetime(2025, 1, 1, tzinfo=UTC)


class Sandbox:
    """Owns the pool of workers. The pool opens at the first use. A context manager.

    Use it in the process that made it, because a pool does not survive a fork. Sessions may live in different threads.

    Args:
        limits: what planner code may use.
        bubblewrap: False turns bubblewrap off, and so does ``off`` in the variable ``SUMO_ADV_BUBBLEWRAP``.
        workers: maximum number of open sessions.
    """

    def __init__(self, limits: SandboxLimits | None = None, *, bubblewrap: bool = True, workers: int = 16) -> None:
        self.limits = limits or SandboxLimits()
        self._bubblewrap = bubblewrap
        self._workers = workers
        self._lock = threading.Lock()
        self._jail: Jail | None = None
        self._pool: Monty | None = None
        self._owner: ThreadPoolExecutor | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._process = os.getpid()
        self._closed = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    @property
    def isolation(self) -> str:
        """``bubblewrap`` or ``process``."""
        return self._open().isolation

    @property
    def note(self) -> str:
        """One sentence on the isolation, for ``doctor`` and outcomes."""
        return self._open().note

    def session(
        self, planner: Planner, roads: Mapping[str, Mapping[str, Any]], *, seed: int = 0, type_check: bool = False
    ) -> PlannerSession:
        """A fresh interpreter with the planner loaded.

        Args:
            planner: the planner to run.
            roads: the ``road`` of each key that calls may name; plain data, sent once.
            seed: seed of the planner's ``random``.
            type_check: whether to type check the text before it runs.

        Raises:
            PlannerSyntaxError: the text is not in the subset, or the type check failed.
            PlannerRuntimeError, PlannerLimitError: its module level failed.
            SandboxError: no worker is available.
        """
        self._open()
        return PlannerSession(self, planner, roads, seed, type_check)

    def close(self) -> None:
        """Stop the workers. May be called twice."""
        with self._lock:
            self._closed = True
            pool, owner, folder = self._pool, self._owner, self._folder
            self._pool = self._owner = self._folder = None
        if os.getpid() != self._process:
            return
        if pool is not None and owner is not None:
            owner.submit(pool.__exit__, None, None, None).result()
            owner.shutdown()
        if folder is not None:
            folder.cleanup()

    def _open(self) -> Jail:
        """Start the pool, once."""
        with self._lock:
            self.check_usable()
            if self._jail is not None:
                return self._jail
            jail = make_jail(self._bubblewrap)
            program = jail.command[0]
            if os.name == "posix":
                self._folder = tempfile.TemporaryDirectory(prefix="sumo-adv-")
                script = Path(self._folder.name) / "worker"
                script.write_text(wrapper_script(jail, self.limits.memory))
                script.chmod(0o700)
                if not os.access(script, os.X_OK):
                    raise SandboxError(
                        f"No program can be started in {Path(self._folder.name).parent}, which is mounted noexec: set "
                        "TMPDIR to a folder where one can (a container's tmpfs wants the option exec)."
                    )
                program = str(script)
            self._start(program)
            self._jail = jail
            return jail

    def _start(self, program: str) -> None:
        """Start the pool from one lasting thread: under bubblewrap, workers die with the thread that started them."""
        from pydantic_monty import Monty

        _spare_look_ups()
        self._pool = Monty(
            binary_path=program,
            min_processes=0,
            max_processes=self._workers,
            checkout_timeout=10.0,
            request_timeout=self.limits.batch_seconds + 10.0,
            feed_duration_limit_grace=self.limits.grace_seconds,
        )
        self._owner = ThreadPoolExecutor(1, thread_name_prefix="sandbox")
        self._owner.submit(self._pool.__enter__).result()

    def check_usable(self) -> None:
        """Raise ``SandboxError`` if the sandbox is closed or belongs to another process."""
        if self._closed:
            raise SandboxError("The sandbox is closed: make a new one.")
        if os.getpid() != self._process:
            raise SandboxError("The sandbox was opened in another process: use it there.")

    def checkout(self, seed: int, type_check: bool) -> MontySession:
        """A worker for one session."""
        from pydantic_monty import MontyError

        with self._lock:
            self.check_usable()
            pool, owner = self._pool, self._owner
        assert pool is not None and owner is not None  # _open came first
        session = pool.checkout(
            script_name="planner.py",
            limits={
                "max_feed_duration_secs": self.limits.call_seconds,
                "max_memory": self.limits.memory,
                "max_recursion_depth": self.limits.recursion,
                "max_suspensions": self.limits.suspensions,
                "max_total_sleep_secs": 0.0,
            },
            type_check=type_check,
            type_check_stubs=HELPERS_STUBS if type_check else None,
            type_check_format="concise" if type_check else None,
            os_policy={"datetime": _INSTANT, "timezone": "utc", "sleep": "zero", "random_start": {"seed": seed}},
        )
        try:
            owner.submit(session.__enter__).result()
        except TimeoutError:
            raise SandboxError(f"All {self._workers} sandbox workers are busy: close planner sessions.") from None
        except (MontyError, OSError, RuntimeError) as error:
            raise SandboxError(f"The sandbox's worker does not start ({clean(str(error))}): run doctor.") from None
        return session


def _spare_look_ups() -> None:
    """Mark opentelemetry as missing where it is not installed.

    Monty imports it at every feed. If it is missing, Python searches all its folders each time, which takes half of the
    feed (48 of 92 us). None among the modules ends the search at once.
    """
    if "opentelemetry" not in sys.modules and importlib.util.find_spec("opentelemetry") is None:
        sys.modules["opentelemetry"] = None  # type: ignore[assignment]
