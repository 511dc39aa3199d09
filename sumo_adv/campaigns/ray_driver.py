"""The process that speaks to a Ray cluster. Ray may hang in it or end it: the program's own process goes on.

Ray is imported here alone. What it prints goes into a file. The messages on both ways are the classes below.
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

CONNECTION_TIMEOUT_S = 5.0  # for a server to take a connection
NODE_POLL_INTERVAL_S = 2.0  # between looks at the cluster's nodes
LOG = "log"


# -- from the program -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Put:
    """Keep a value in Ray's store, under a number."""

    key: int
    value: Any


@dataclass(frozen=True, slots=True)
class Start:
    """Run ``function`` of the values under ``keys`` and of ``arguments`` on one node. ``recycle``: tasks after which
    its worker process is replaced."""

    number: int
    node: str
    function: Callable[..., Any]
    keys: tuple[int, ...]
    arguments: tuple[Any, ...]
    recycle: int


# -- to the program ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Loaded:
    """Ray is imported; connecting begins."""


@dataclass(frozen=True, slots=True)
class JobRefused:
    """There is no connection, and why."""

    why: str


@dataclass(frozen=True, slots=True)
class Node:
    """A node of the cluster that is alive, with its processors."""

    id: str
    name: str
    processors: int


@dataclass(frozen=True, slots=True)
class Nodes:
    """All nodes that are alive and have processors."""

    alive: tuple[Node, ...]


@dataclass(frozen=True, slots=True)
class JobResult:
    """What a task returned."""

    number: int
    value: Any


@dataclass(frozen=True, slots=True)
class Raised:
    """What a task raised; any other error than the program's own is a SumoAdvError in its words."""

    number: int
    error: SumoAdvError


@dataclass(frozen=True, slots=True)
class Lost:
    """The worker or node of a task was lost."""

    number: int
    text: str


def serve_jobs(connection: Connection, address: str, folder: Path) -> None:
    """Connect to the cluster and do what the program asks for, until it sends None."""
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
    """Raises OSError if no server listens at HOST:PORT."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host, int(port)), CONNECTION_TIMEOUT_S).close()


class _Driver:
    """Ray's part of a pool: values in its store, and the tasks that run."""

    def __init__(self, ray: Any, connection: Connection) -> None:
        self._ray, self._connection = ray, connection
        self._kept = dict[int, Any]()
        self._running = dict[Any, int]()

    def run(self) -> None:
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
        try:
            return JobResult(number, self._ray.get(ready))
        except self._ray.exceptions.RayTaskError as error:
            cause = error.cause
            if isinstance(cause, SumoAdvError):
                return Raised(number, cause)
            return Raised(number, SumoAdvError(f"sumo_adv cannot run there ({type(cause).__name__}: {cause})"))
        except self._ray.exceptions.RayError as error:
            return Lost(number, str(error))
