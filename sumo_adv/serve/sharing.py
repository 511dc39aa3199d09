"""A new ``sumo`` with its two clients, the gate and our own connection, and with no third one."""

from __future__ import annotations

import socket
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

from sumo_adv.errors import SimulationError
from sumo_adv.serve.events import Events
from sumo_adv.serve.gate import PATIENCE, Gate
from sumo_adv.serve.sumo_process import StrangerError, SumoProcess

if TYPE_CHECKING:
    from traci.connection import Connection

OUR_ORDER = 1
TRIES = 5  # starts of SUMO, where another program connects to its port before we do


def shared_sumo(
    arguments: Sequence[str], gate: Gate, *, own: Collection[str], kept: Collection[str], events: Events,
    private: bool = True,
) -> tuple[SumoProcess, Connection]:  # fmt: skip
    """SUMO and our connection to it. ``own``, ``kept``: see ``Gate.attach``; ``private``: see ``SumoProcess``.

    Raises:
        SimulationError, UsageError: SUMO does not start, or is not installed, or others are always faster.
    """
    for tries in range(1, TRIES + 1):
        sumo = SumoProcess(arguments, private=private)
        try:
            gate.attach(sumo, own=own, kept=kept)
            return sumo, connect(sumo)
        except StrangerError as error:
            gate.detach(keep=True)
            sumo.close()
            events.tell("stranger", tries=tries, sentence=f"{error} SUMO is started again.")
        except BaseException:
            gate.detach()
            sumo.close()
            raise
    raise SimulationError(
        f"Another program connected to SUMO's port first, {TRIES} times in a row: end it, or run this in a container."
    )


def connect(sumo: SumoProcess) -> Connection:
    """Our own connection, the first in order. Raises StrangerError, SimulationError."""
    import traci

    try:
        with socket.create_server(("127.0.0.1", 0)) as nobody:  # traci connects by itself and takes no socket
            connection = traci.connect(nobody.getsockname()[1], numRetries=0, host="127.0.0.1")
        connection._socket.close()
        connection._socket = sumo.dial(PATIENCE)
        connection._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setOrder(OUR_ORDER)
    except (traci.TraCIException, traci.FatalTraCIError, OSError) as error:
        raise SimulationError(f"SUMO did not take our connection ({sumo.last_error or error}).") from error
    return connection
