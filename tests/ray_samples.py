"""What may speak to Ray in its place (``RayPool``'s ``driver``): clusters that hang, die, or have unfit nodes."""

from __future__ import annotations

import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from sumo_adv.campaigns.ray_driver import LOG, JobRefused, JobResult, Loaded, Lost, Node, Nodes, Put, Raised
from sumo_adv.errors import SumoAdvError, UsageError

GOOD, BAD = Node("1", "good", 2), Node("2", "bad", 4)


def mute(connection: Connection, address: str, folder: Path) -> None:
    """Ray tries to connect, and goes on trying."""
    connection.send(Loaded())
    time.sleep(600.0)


def not_installed(connection: Connection, address: str, folder: Path) -> None:
    """There is no Ray."""
    connection.send(JobRefused("Ray is not installed: pip install 'sumo-adv[ray]'"))


def _cluster(nodes: tuple[Node, ...], answer: Callable[[Any, int], Any]) -> Callable[[Connection, str, Path], None]:
    """A cluster with these nodes; ``answer``: to the n-th task, None to die."""

    def serve(connection: Connection, address: str, folder: Path) -> None:
        connection.send(Loaded())
        connection.send(Nodes(nodes))
        tasks = 0
        while (command := connection.recv()) is not None:
            if isinstance(command, Put):
                continue
            said = answer(command, tasks)
            tasks += 1
            if said is None:
                (folder / LOG).write_text("[2026-11-28 1:2:3 E 1 2] rpc.h:204: No GCS within 60 seconds. It is gone.\n")
                return
            connection.send(said)

    return serve


def _where(command: Any, tasks: int) -> Any:
    """The check of the bad node says what is missing; a job's result is the node that it ran on."""
    if command.arguments:
        return JobResult(command.number, command.node)
    return JobResult(command.number, "There is no file a.net.xml on this node" if command.node == BAD.id else "")


def _later(command: Any, tasks: int) -> Any:
    """Both nodes pass their check, and the bad one refuses its jobs."""
    if not command.arguments:
        return JobResult(command.number, "")
    if command.node == BAD.id:
        return Raised(command.number, UsageError("The file is gone."))
    return JobResult(command.number, command.node)


def _dies(command: Any, tasks: int) -> Any:
    """One job is done, then Ray ends its process."""
    return JobResult(command.number, command.node if command.arguments else "") if tasks < 2 else None


def _loses(command: Any, tasks: int) -> Any:
    """The worker of every job is lost three times."""
    if not command.arguments or tasks > 3:
        return JobResult(command.number, command.node if command.arguments else "")
    return Lost(command.number, "killed")


def _raises(command: Any, tasks: int) -> Any:
    return (
        Raised(command.number, SumoAdvError("The disk is full."))
        if command.arguments
        else JobResult(command.number, "")
    )


def half_fit(connection: Connection, address: str, folder: Path) -> None:
    """A cluster of a good node and one without the input."""
    _cluster((GOOD, BAD), _where)(connection, address, folder)


def unfit(connection: Connection, address: str, folder: Path) -> None:
    """A cluster whose only node is without the input."""
    _cluster((BAD,), _where)(connection, address, folder)


def fails_later(connection: Connection, address: str, folder: Path) -> None:
    """A cluster of a good node and one that loses the input after its check."""
    _cluster((GOOD, BAD), _later)(connection, address, folder)


def dies(connection: Connection, address: str, folder: Path) -> None:
    """A cluster whose head dies after the first job."""
    _cluster((Node("1", "good", 1),), _dies)(connection, address, folder)


def loses(connection: Connection, address: str, folder: Path) -> None:
    """A cluster that loses workers."""
    _cluster((Node("1", "good", 1),), _loses)(connection, address, folder)


def raises(connection: Connection, address: str, folder: Path) -> None:
    """A cluster on which no job can be run."""
    _cluster((GOOD,), _raises)(connection, address, folder)
