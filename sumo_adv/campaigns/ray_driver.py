"""Run the process that talks to a Ray cluster. Ray may hang or end this process without harm to the program's own.

Ray is imported only here. Ray's output goes into a file. The two processes exchange messages of the classes below.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from sumo_adv.campaigns.local import POLL_INTERVAL_S, alone
from sumo_adv.errors import SumoAdvError

CONNECTION_TIMEOUT_S = 5.0  # for a server to accept a connection
NODE_POLL_INTERVAL_S = 2.0  # between reports of the cluster's nodes
LOG = "log"


# -- from the program -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Put:
    """Keep a value in Ray's store.

    Attributes:
        key: The number of the value.
        value: The value.
    """

    key: int
    value: Any


@dataclass(frozen=True, slots=True)
class Start:
    """Run a function on a node.

    Attributes:
        number: The number of the task.
        node: The id of the node.
        function: The function. Its arguments are the values under ``keys``, then ``arguments``.
        keys: The keys of values in Ray's store.
        arguments: Further arguments.
        recycle: The number of tasks after which the node's worker process is replaced.
    """

    number: int
    node: str
    function: Callable[..., Any]
    keys: tuple[int, ...]
    arguments: tuple[Any, ...]
    recycle: int


# -- to the program ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Loaded:
    """Ray is imported, and connecting begins."""


@dataclass(frozen=True, slots=True)
class JobRefused:
    """There is no connection.

    Attributes:
        why: The reason.
    """

    why: str


@dataclass(frozen=True, slots=True)
class Node:
    """A node of the cluster that is alive.

    Attributes:
        id: The node's id.
        name: The node's host name.
        processors: The number of processors.
    """

    id: str
    name: str
    processors: int


@dataclass(frozen=True, slots=True)
class Nodes:
    """All nodes that are alive and have processors."""

    alive: tuple[Node, ...]


@dataclass(frozen=True, slots=True)
class JobResult:
    """What a task returned.

    Attributes:
        number: The number of the task.
        value: The value.
    """

    number: int
    value: Any


@dataclass(frozen=True, slots=True)
class Raised:
    """What a task raised.

    Attributes:
        number: The number of the task.
        error: The error. An error of another type is described by a ``SumoAdvError``.
    """

    number: int
    error: SumoAdvError


@dataclass(frozen=True, slots=True)
class Lost:
    """The worker or node of a task was lost.

    Attributes:
        number: The number of the task.
        text: Ray's message.
    """

    number: int
    text: str


def serve_jobs(connection: Connection, address: str, folder: Path) -> None:
    """Connect to the cluster and execute the program's commands until it sends None.

    Args:
        connection: The connection to the program.
        address: The cluster's address.
        folder: The folder of the log.
    """
    alone(folder)
    words = os.open(folder / LOG, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    os.dup2(words, 1)
    os.dup2(words, 2)
    try:
        import ray
    except ImportError:
        connection.send(JobRefused("Ray is not installed: pip install 'sumo-adv[ray]'"))
        return
    connection.send(Loaded())
    try:
        _knock(address)
        ray.init(address=address, log_to_driver=False, configure_logging=True, logging_level=logging.ERROR)
    except Exception as error:
        reason = str(error).strip().splitlines()[0].rstrip(".") if str(error).strip() else type(error).__name__
        connection.send(JobRefused(reason))
        return
    with suppress(EOFError):
        _Driver(ray, connection).run()
    ray.shutdown()


def _knock(address: str) -> None:
    """Check that a server listens if the address is HOST:PORT; raise OSError if none does."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host, int(port)), CONNECTION_TIMEOUT_S).close()


class _Driver:
    """Ray's side of a pool: the values in its store, and the tasks that run."""

    def __init__(self, ray: Any, connection: Connection) -> None:
        self._ray, self._connection = ray, connection
        self._kept = dict[int, Any]()
        self._running = dict[Any, int]()

    def run(self) -> None:
        """Execute commands and report nodes and results until None is received."""
        look = 0.0
        while True:
            while self._connection.poll(0.0 if self._running else POLL_INTERVAL_S):
                command = self._connection.recv()
                if command is None:
                    return
                if isinstance(command, Put):
                    self._kept[command.key] = self._ray.put(command.value)
                else:
                    self._start(command)
            if time.monotonic() >= look:
                self._connection.send(self._nodes())
                look = time.monotonic() + NODE_POLL_INTERVAL_S
            if self._running:
                for ready in self._ray.wait(list(self._running), timeout=POLL_INTERVAL_S)[0]:
                    self._connection.send(self._end(self._running.pop(ready), ready))

    def _nodes(self) -> Nodes:
        alive = [node for node in self._ray.nodes() if node["Alive"] and node["Resources"].get("CPU", 0) >= 1]
        return Nodes(
            tuple(Node(n["NodeID"], n["NodeManagerHostname"], int(n["Resources"]["CPU"])) for n in alive)
        )  # fmt: skip

    def _start(self, command: Start) -> None:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        task = self._ray.remote(num_cpus=1, max_retries=0, max_calls=command.recycle)(command.function)
        there = NodeAffinitySchedulingStrategy(command.node, soft=False)
        values = [self._kept[key] for key in command.keys]
        self._running[task.options(scheduling_strategy=there).remote(*values, *command.arguments)] = command.number

    def _end(self, number: int, ready: Any) -> JobResult | Raised | Lost:
        """Make the message about the end of a task."""
        try:
            return JobResult(number, self._ray.get(ready))
        except self._ray.exceptions.RayTaskError as error:
            cause = error.cause
            if isinstance(cause, SumoAdvError):
                return Raised(number, cause)
            return Raised(number, SumoAdvError(f"sumo_adv cannot run there ({type(cause).__name__}: {cause})"))
        except self._ray.exceptions.RayError as error:
            return Lost(number, str(error))
