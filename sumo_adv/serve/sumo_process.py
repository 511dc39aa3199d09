"""The real ``sumo`` program as a child that cannot outlive us, with room for two TraCI clients."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from sumo_adv.errors import SimulationError
from sumo_adv.serve import leash
from sumo_adv.serve.leash import TRACI_CLIENTS
from sumo_adv.simulation.programs import find_sumo

MAX_KEPT_LINES = 50  # of what SUMO said last
PORT_RETRY_PERIOD_S = 0.01
_REFUSALS = ("Answered with error to command", "Requested command not implemented")
_ESTABLISHED = "01"  # in /proc/net/tcp


class StrangerError(SimulationError):
    """A program that is none of ours connected to SUMO's port before we did."""


def free_port() -> int:
    """A port of the loopback interface on which no program listens now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class SumoProcess:
    """A running ``sumo`` that waits for its clients.

    On Linux it is killed when the thread that made it ends, so make it in a thread that lasts; elsewhere it ends once
    its clients' connections break.
    """

    def __init__(self, arguments: Sequence[str], *, private: bool = False) -> None:
        """Start it. ``arguments``: SUMO's own, without port and number of clients.

        ``private``: only ``dial`` connects to it. On Linux it then has a network of its own, if the system allows that;
        else it listens at ``port`` on all interfaces, as SUMO does, until it has its clients.

        Raises:
            UsageError: the program is not installed.
            SimulationError: it cannot be started.
        """
        self.port = free_port()
        self._dialled: list[int] = []  # ports that we connected from
        self._made: list[socket.socket] = []
        self._talk: socket.socket | None = None
        program = str(find_sumo())
        command = [program, *arguments, "--remote-port", str(self.port), "--num-clients", str(TRACI_CLIENTS)]
        child_end: socket.socket | None = None
        if sys.platform.startswith("linux"):
            if private:
                self._talk, child_end = socket.socketpair()
            talk = -1 if child_end is None else child_end.fileno()
            command = [sys.executable, "-I", "-S", str(Path(leash.__file__)), str(os.getpid()), str(talk), *command]
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                pass_fds=() if child_end is None else (child_end.fileno(),),
            )  # fmt: skip
        except OSError as error:
            raise SimulationError(f"The program {program} could not be started ({error.strerror}).") from error
        finally:
            if child_end is not None:
                child_end.close()
        self._said: deque[str] = deque(maxlen=MAX_KEPT_LINES)
        self._ear = threading.Thread(target=self._listen, name="sumo-words", daemon=True)
        self._ear.start()

    def _listen(self) -> None:
        assert self._process.stderr is not None
        with self._process.stderr as words:
            for line in words:
                self._said.append(line.decode(errors="replace").strip())

    def dial(self, timeout: float) -> socket.socket:
        """One of its ``TRACI_CLIENTS`` connections, as soon as it listens.

        Raises:
            StrangerError: a stranger took one (noticed on Linux).
            SimulationError: it ended, or does not listen within ``timeout`` seconds.
        """
        until = time.monotonic() + timeout
        while True:
            connection = self._handed_over() if self._talk is not None else self._connected(timeout)
            if connection is not None:
                return connection
            if not self.alive:
                raise SimulationError(f"SUMO did not start ({self.why_ended() or 'it says nothing'}).")
            if time.monotonic() > until:
                raise SimulationError(f"SUMO did not listen within {timeout:g} s.")
            time.sleep(PORT_RETRY_PERIOD_S)

    @property
    def is_private(self) -> bool:
        """Whether it turned out, after a ``dial``, that no stranger can connect."""
        return self._talk is not None

    def _handed_over(self) -> socket.socket | None:
        """A connection that was made in SUMO's own network; None if there is none yet, or no such network."""
        assert self._talk is not None
        if not self._made:
            self._talk.settimeout(PORT_RETRY_PERIOD_S)
            try:
                message, files, _, _ = socket.recv_fds(self._talk, len(leash.PRIVATE), TRACI_CLIENTS)
            except TimeoutError:
                return None
            self._made = [socket.socket(fileno=file) for file in files]
            if message == leash.OPEN:
                self._talk.close()
                self._talk = None
        return self._made.pop(0) if self._made else None

    def _connected(self, timeout: float) -> socket.socket | None:
        """A connection to our port; None if no program listens there yet: the kernel could connect such a one to
        itself.
        """
        dialling = socket.socket()
        try:
            dialling.bind(("127.0.0.1", 0))
            if dialling.getsockname()[1] == self.port:
                raise ConnectionRefusedError
            dialling.settimeout(timeout)
            dialling.connect(("127.0.0.1", self.port))
        except OSError:
            dialling.close()
        else:
            dialling.settimeout(None)
            self._dialled.append(dialling.getsockname()[1])
        is_open = dialling.fileno() >= 0
        if (len(self._dialled) == TRACI_CLIENTS or not is_open) and strangers(self.port, self._dialled):
            dialling.close()
            raise StrangerError("Another program connected to SUMO's port before sumo_adv did.")
        return dialling if is_open else None

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

    @property
    def last_error(self) -> str:
        """What SUMO complained of last, but for calls it refused; or nothing."""
        errors = [line.removeprefix("Error: ") for line in list(self._said) if line.startswith("Error:")]
        return " ".join(line for line in errors if not line.startswith(_REFUSALS))[-300:]

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
        for ours in (self._talk, *self._made):
            if ours is not None:
                ours.close()
        if not self.wait(timeout):
            self._process.kill()
            self._process.wait()
            self._ear.join(1.0)

    def __enter__(self) -> SumoProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def strangers(port: int, ours: Sequence[int]) -> bool:
    """Whether a stranger has a connection to a local port from another one than ``ours``; False where it cannot be
    seen.

    Source: proc(5), ``/proc/net/tcp``: local and remote address and state stand in columns 2 to 4.
    """
    for table in ("tcp", "tcp6"):
        try:
            rows = Path(f"/proc/net/{table}").read_text().splitlines()[1:]
        except OSError:
            continue
        for _, local, remote, state, *_ in map(str.split, rows):
            at, source = (int(address.rpartition(":")[2], 16) for address in (local, remote))
            if at == port and state == _ESTABLISHED and source not in ours:
                return True
    return False
