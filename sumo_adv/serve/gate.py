"""The gate: the port that an ego's TraCI client connects to, in front of a real ``sumo`` that never sees that client.

SUMO has two clients. The server's own connection has order 1, and the gate has order 2. The gate passes on what the
ego's client requests, and makes the steps instead of the client whenever the client is absent, late or lost. Native
SUMO would end, or wait for ever. One thread pumps with blocking sockets: a request through asyncio took twice as long.
"""

from __future__ import annotations

import ipaddress
import socket
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress

from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.serve import link, peers
from sumo_adv.serve.framing import MAX_MESSAGE_BYTES, FramingError, Gone, MessageLine
from sumo_adv.serve.link import SumoLink
from sumo_adv.serve.policy import Policy, Rules
from sumo_adv.serve.seat import Client, ClientSlot, EventKind, GateEvent, Interrupted, Late, Stepper
from sumo_adv.serve.sumo_process import SumoProcess
from sumo_adv.serve.turns import Turns

TURN_DEADLINE_S = 10.0  # for a turn, from when SUMO waits for the client; the server's time before does not count
SHARED_SUMO_TIMEOUT_S = 30.0  # for SUMO to listen, and for the last simulation to end
MAX_STRANGERS = 16  # maximum number of connections that have not sent anything yet
STOP_POLL_PERIOD_S = 0.2  # between two checks whether the server stops
_TAKEN = "Another client drives the ego: one at a time."
_NO_RULES = Rules()


class Gate:
    """One port for the ego's client, through any number of simulations. Its methods may be called from any thread."""

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 0,
        *,
        allow: Sequence[str] = (),
        deadline: float = TURN_DEADLINE_S,
        rules: Rules = _NO_RULES,
        older: bool = False,
        on_event: Callable[[GateEvent], None] | None = None,
    ) -> None:
        """Check the addresses; nothing is opened yet.

        Args:
            host: The address to listen at.
            port: The port to listen at; 0 takes any free one.
            allow: Addresses or networks that may connect; needed unless the host is loopback. On Linux, a client on
                this machine must belong to the same user (or root), unless its address is among them.
            deadline: The time of the client for one turn [s].
            rules: What the client may set.
            older: Whether clients know TraCI only up to version 21.
            on_event: Called with each event at the gate.

        Raises:
            UsageError: An address is invalid, or the host is not loopback and no address is allowed.
        """
        self._host, self._wanted_port, self._deadline, self._rules = host, port, deadline, rules
        self._older = older
        self._allow = [_network(text) for text in allow]
        if not _is_loopback(host) and not self._allow:
            raise UsageError(
                f"TraCI has no log-in: for the host {host}, give the addresses that may connect (--allow)."
            )
        self._seat = ClientSlot(on_event or (lambda event: None))
        self._changed = threading.Condition()
        self._stopping = self._running = False
        self._turns: Turns | None = None
        self._strangers = list[socket.socket]()  # oldest first
        self._strangers_lock = threading.Lock()
        self._listener: socket.socket | None = None
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Listen.

        Raises:
            UsageError: The address or port cannot be used.
        """
        family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
        try:
            self._listener = socket.create_server((self._host, self._wanted_port), family=family)
        except (OSError, OverflowError) as error:
            raise UsageError(f"Cannot listen at {self._host}:{self._wanted_port} ({error}).") from error
        self._listener.settimeout(STOP_POLL_PERIOD_S)
        for name, body in (("gate-door", self._door), ("gate-pump", self._pump)):
            self._threads.append(threading.Thread(target=body, name=name, daemon=True))
            self._threads[-1].start()

    def stop(self) -> None:
        """Close everything. A simulation that is still attached loses its second client."""
        self.detach()
        self.wait_detached(STOP_POLL_PERIOD_S)
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()
        if client := self._seat.client:
            self._seat.leave(client, EventKind.ENDED, f"The server ended; the client at {client.peer} was sent away.")
        if self._listener is not None:
            self._listener.close()

    def __enter__(self) -> Gate:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def port(self) -> int:
        """The port that the gate listens at."""
        assert self._listener is not None, "the gate was not started"
        port: int = self._listener.getsockname()[1]
        return port

    @property
    def opens(self) -> str | None:
        """What the port opens beyond this machine, in a sentence; None if nothing."""
        if _is_loopback(self._host):
            return None
        allowed = ", ".join(map(str, self._allow))
        return (
            f"Port {self.port} of {self._host} is open to {allowed}: TraCI has no log-in and no encryption, "
            "so any program there can read the simulation and drive the ego."
        )

    @property
    def connected(self) -> bool:
        """Whether a client is connected."""
        return self._seat.client is not None

    def wait_connected(self, timeout: float) -> bool:
        """Wait for a client.

        Args:
            timeout: The maximum time [s].

        Returns:
            Whether a client is connected.
        """
        return self._seat.wait(timeout)

    @property
    def stepped_by(self) -> Stepper:
        """What made the last step on the ego's side."""
        return self._turns.stepped_by if self._turns else Stepper.GATE

    @property
    def client_steps(self) -> int:
        """The number of steps that the client made."""
        return self._turns.client_steps if self._turns else 0

    @property
    def own(self) -> frozenset[str]:
        """The vehicles that the client may set: those given to it, and those that it added."""
        return self._turns.policy.own if self._turns else frozenset()

    def attach(self, sumo: SumoProcess, own: Iterable[str] = (), kept: Iterable[str] = ()) -> None:
        """Become SUMO's second client. Call this before your own connection requests its order.

        Args:
            sumo: The running SUMO.
            own: The vehicles that the client may set.
            kept: Those of them that it neither adds nor removes.

        Raises:
            StrangerError: Another program connected to SUMO first.
            SimulationError: SUMO does not listen, or another simulation is still attached.
        """
        if not self.wait_detached(SHARED_SUMO_TIMEOUT_S):
            raise SimulationError("The gate is still attached to another simulation: detach it and end that SUMO.")
        line = MessageLine(sumo.dial(SHARED_SUMO_TIMEOUT_S), link.MAX_SUMO_ANSWER_BYTES)
        policy = Policy(self._rules, own, tuple(kept))
        turns = Turns(
            lambda idle: SumoLink(line, idle), policy, self._seat, self._deadline, lambda: self._stopping,
            sumo.why_ended, self._older,
        )  # fmt: skip
        with self._changed:
            self._turns, self._running = turns, True
            self._changed.notify_all()

    def detach(self, keep: bool = False) -> None:
        """Let SUMO end in good order: call this, then close your own connection. Returns at once.

        Args:
            keep: Whether the client stays for the next simulation. If not, its connection is closed after its last
                answer.
        """
        if self._running and self._turns is not None:
            self._turns.part(keep)

    def wait_detached(self, timeout: float) -> bool:
        """Wait until no simulation is attached.

        Args:
            timeout: The maximum time [s].

        Returns:
            Whether no simulation is attached.
        """
        with self._changed:
            return self._changed.wait_for(lambda: not self._running, timeout)

    def _pump(self) -> None:
        """Serve the turns of each attached simulation."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._running or self._stopping)
                if not self._running or self._turns is None:
                    return
            try:
                self._turns.run()
            except Exception as error:  # a gate that stops pumping would block the next simulation for ever
                self._seat.tell(GateEvent(EventKind.ENDED, f"The gate failed ({type(error).__name__}: {error})."))
            finally:
                with self._changed:
                    self._running = False
                    self._changed.notify_all()

    def _door(self) -> None:
        """Accept connections, and refuse unwelcome ones."""
        assert self._listener is not None
        while not self._stopping:
            try:
                connection, address = self._listener.accept()
            except TimeoutError:
                continue
            except OSError:
                time.sleep(STOP_POLL_PERIOD_S)
                continue
            peer = f"{address[0]}:{address[1]}"
            if why := self._unwelcome(connection, address[0]):
                connection.close()
                self._refused(f"A connection from {peer} was refused: {why}.")
            else:
                self._let_wait(connection)
                threading.Thread(target=self._greet, args=(connection, peer), name="gate-greet", daemon=True).start()

    def _unwelcome(self, connection: socket.socket, text: str) -> str:
        """Return why a connection is refused; empty if it is not."""
        address = ipaddress.ip_address(text.partition("%")[0])
        address = getattr(address, "ipv4_mapped", None) or address
        if any(address in network for network in self._allow):
            return ""
        if not address.is_loopback:
            return "the address is not among those allowed"
        try:
            ours = peers.is_ours(connection)
        except OSError:  # it is gone already
            ours = False
        return "" if ours else f"it is another user's; --allow {address} lets all users of this machine in"

    def _let_wait(self, connection: socket.socket) -> None:
        """Add a connection that has not sent anything yet; cut the oldest one if there are too many.

        A client sends at once, so silent connections cannot lock out a client.
        """
        with self._strangers_lock:
            self._strangers.append(connection)
            if len(self._strangers) > MAX_STRANGERS:
                with suppress(OSError):
                    self._strangers.pop(0).shutdown(socket.SHUT_RDWR)

    def _refused(self, sentence: str) -> None:
        """Report a refused connection."""
        self._seat.tell(GateEvent(EventKind.REFUSED, sentence))

    def _greet(self, connection: socket.socket, peer: str) -> None:
        """Give the seat to the first connection that sends a whole message."""
        try:
            client = Client(MessageLine(connection, MAX_MESSAGE_BYTES), peer)
            message = client.receive(self._deadline, lambda: self._stopping)
        except (Gone, FramingError) as reason:
            connection.close()
            self._refused(f"A connection from {peer} was cut: {reason}.")
        except (Late, Interrupted):
            connection.close()
            self._refused(f"A connection from {peer} was cut: it did not send a whole message.")
        else:
            client.line.unread(message)
            if not self._seat.take(client):
                self._refused(f"A connection from {peer} was refused: another client drives the ego.")
                client.send_away(_TAKEN, self._deadline)
        finally:
            with self._strangers_lock:
                if connection in self._strangers:
                    self._strangers.remove(connection)


def _is_loopback(host: str) -> bool:
    """Return whether a host is loopback; raise UsageError if it is no address."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError as error:
        raise UsageError(
            f"{host} is not an address to listen at: give one of this machine, such as 127.0.0.1."
        ) from error


def _network(text: str) -> ipaddress.IPv4Network | ipaddress.IPv6Network:
    """Parse an address or network; raise UsageError if it is neither."""
    try:
        return ipaddress.ip_network(text, strict=False)
    except ValueError as error:
        raise UsageError(
            f"{text} is not an address or network: give one such as 192.168.1.7 or 192.168.1.0/24."
        ) from error
