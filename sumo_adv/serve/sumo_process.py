"""The real ``sumo`` program as a child that cannot outlive us, with room for two TraCI clients."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Sequence

from sumo_adv.errors import SimulationError
from sumo_adv.simulation.programs import find_sumo

CLIENTS = 2
KEPT_LINES = 50  # of what SUMO said last
_REFUSALS = ("Answered with error to command", "Requested command not implemented")
_LEASH = """\
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)
os.getppid() == int(sys.argv[1]) or os._exit(1)
os.execv(sys.argv[2], sys.argv[2:])
"""  # Linux kills SUMO with us: 1 is PR_SET_PDEATHSIG, it stays over exec


def free_port() -> int:
    """A port of the loopback interface that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class SumoProcess:
    """A running ``sumo`` that waits at ``port`` for its clients.

    On Linux it is killed when the thread that made it ends, so make it in one that lasts; elsewhere it ends once
    its clients' connections break.
    """

    def __init__(self, arguments: Sequence[str]) -> None:
        """Start it. ``arguments``: SUMO's own, without port and number of clients.

        Raises:
            UsageError: the program is not installed.
            SimulationError: it cannot be started.
        """
        self.port = free_port()
        program = str(find_sumo())
        command = [program, *arguments, "--remote-port", str(self.port), "--num-clients", str(CLIENTS)]
        if sys.platform.startswith("linux"):
            command = [sys.executable, "-I", "-S", "-c", _LEASH, str(os.getpid()), *command]
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
            )
        except OSError as error:
            raise SimulationError(f"The program {program} could not be started ({error.strerror}).") from error
        self._said: deque[str] = deque(maxlen=KEPT_LINES)
        self._ear = threading.Thread(target=self._listen, name="sumo-words", daemon=True)
        self._ear.start()

    def _listen(self) -> None:
        assert self._process.stderr is not None
        with self._process.stderr as words:
            for line in words:
                self._said.append(line.decode(errors="replace").strip())

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it still runs."""
        return self._process.poll() is None

    @property
    def last_error(self) -> str:
        """What SUMO complained of last, but for calls it refused; or nothing."""
        said = [line.removeprefix("Error: ") for line in list(self._said) if line.startswith("Error:")]
        return " ".join(line for line in said if not line.startswith(_REFUSALS))[-300:]

    def why_ended(self) -> str:
        """``last_error`` of a SUMO that is about to end."""
        self.wait(1.0)
        return self.last_error

    def wait(self, timeout: float) -> bool:
        """Whether it ended by itself within ``timeout`` seconds."""
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            return False
        self._ear.join(1.0)
        return True

    def close(self, timeout: float = 0.0) -> None:
        """Give it ``timeout`` seconds to end by itself, then kill it."""
        if not self.wait(timeout):
            self._process.kill()
            self._process.wait()
            self._ear.join(1.0)

    def __enter__(self) -> SumoProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
