"""The real ``sumo`` program as a child that cannot outlive its starter, with room for two TraCI clients."""

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

MAX_KEPT_LINES = 50  # maximum number of SUMO's last lines that are kept
PORT_RETRY_PERIOD_S = 0.01
_REFUSALS = ("Answered with error to command", "Requested command not implemented")
_ESTABLISHED = "01"  # in /proc/net/tcp


class StrangerError(SimulationError):
    """Another program connected to SUMO's port before this one did."""


def free_port() -> int:
    """Return a port of the loopback interface on which no program listens now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


class SumoProcess:
    """A running ``sumo`` that waits for its clients.

    On Linux, it is killed when the thread that made it ends, so make it in a thread that lasts. On other systems, it
    ends once its clients' connections break.

    Attributes:
        port: The port that it listens at.
    """

    def __init__(self, arguments: Sequence[str], *, private: bool = False) -> None:
        """Start SUMO.

        Args:
            arguments: SUMO's arguments, without port and number of clients.
            private: Whether only ``dial`` connects to it. On Linux, it then has its own network, if the system allows
                that. Otherwise it listens at ``port`` on all interfaces, as SUMO does, until it has its clients.

        Raises:
            UsageError: The program is not installed.
            SimulationError: The program cannot be started.
        """
        self.port = free_port()
        self._dialled: list[int] = []  # the ports that this program connected from
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
        """Keep the last lines that SUMO writes."""
        assert self._process.stderr is not None
        with self._process.stderr as words:
            for line in words:
                self._said.append(line.decode(errors="replace").strip())

    def dial(self, timeout: float) -> socket.socket:
        """Return one of the ``TRACI_CLIENTS`` connections, as soon as SUMO listens.

        Args:
            timeout: The maximum time [s].

        Raises:
            StrangerError: Another program took a connection (noticed on Linux).
            SimulationError: SUMO ended, or does not listen in time.
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
        """Whether no other program can connect. This is known after a ``dial``."""
        return self._talk is not None

    def _handed_over(self) -> socket.socket | None:
        """Return a connection made in SUMO's own network; None if there is none yet, or no such network."""
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
        """Return a connection to the port; None if no program listens there yet.

        The kernel could connect a socket that is bound to that port to itself.
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
        """The process id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether SUMO runs."""
        return self._process.poll() is None

    @property
    def last_error(self) -> str:
        """SUMO's last errors, except those about refused calls; empty if there are none."""
        errors = [line.removeprefix("Error: ") for line in list(self._said) if line.startswith("Error:")]
        return " ".join(line for line in errors if not line.startswith(_REFUSALS))[-300:]

    def why_ended(self) -> str:
        """Return ``last_error`` of a SUMO that is about to end."""
        self.wait(1.0)
        return self.last_error

    def wait(self, timeout: float) -> bool:
        """Wait for SUMO to end by itself.

        Args:
            timeout: The maximum time [s].

        Returns:
            Whether it ended.
        """
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            return False
        self._ear.join(1.0)
        return True

    def close(self, timeout: float = 0.0) -> None:
        """Give SUMO time to end by itself, then kill it.

        Args:
            timeout: The time [s].
        """
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
    """Return whether another program has a connection to a local port.

    Source: proc(5), ``/proc/net/tcp``: local and remote address and state are in columns 2 to 4.

    Args:
        port: The port.
        ours: The ports that this program connected from.

    Returns:
        The answer; False if the system does not say.
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
