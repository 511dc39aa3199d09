"""The one seat at the gate: the client that drives the ego, other visitors, and the events there."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum

from sumo_adv.errors import SumoAdvError
from sumo_adv.serve import framing
from sumo_adv.serve.framing import FramingError, Gone, MessageLine


class EventKind(StrEnum):
    """The kinds of events at the gate."""

    CONNECTED = "connected"  # a client took the seat
    CLOSED = "closed"  # the client closed the connection in good order
    LOST = "lost"  # its connection broke, or it sent no valid message
    LATE = "late"  # it used up its time for a turn
    REFUSED = "refused"  # a call or a connection was refused
    RESTARTED = "restarted"  # the simulation ended in good order
    ENDED = "ended"  # SUMO ended by itself


class Stepper(StrEnum):
    """What makes a step on the ego's side."""

    CLIENT = "client"
    GATE = "gate"


@dataclass(frozen=True, slots=True)
class GateEvent:
    """An event at the gate.

    Attributes:
        kind: Its kind.
        sentence: A description, in a sentence.
    """

    kind: EventKind
    sentence: str


FAREWELL_S = 60.0  # how long a client that was sent away may still receive the reason


class Late(SumoAdvError):
    """A client used up its time."""


class Interrupted(SumoAdvError):
    """The gate has something else to do."""


def _patience(deadline: float, interrupted: Callable[[], bool]) -> Callable[[], None]:
    """Return the idle function of a waiting line; it raises Interrupted, or Late after ``deadline`` seconds."""
    until = time.monotonic() + deadline

    def idle() -> None:
        if interrupted():
            raise Interrupted
        if time.monotonic() > until:
            raise Late

    return idle


class Client:
    """A connected program.

    Attributes:
        line: The connection.
        peer: The address.
        refused: The calls that were refused and reported.
    """

    def __init__(self, line: MessageLine, peer: str) -> None:
        """Wrap a connection.

        Args:
            line: The connection.
            peer: The address.
        """
        self.line = line
        self.peer = peer
        self.refused: set[tuple[int, bytes]] = set()

    def receive(self, deadline: float, interrupted: Callable[[], bool] = lambda: False) -> bytes:
        """Receive the client's next message.

        Args:
            deadline: The maximum time [s].
            interrupted: Tells that the gate has something else to do.

        Raises:
            Late: The message did not arrive in time.
            Interrupted: ``interrupted()`` became true.
            Gone: As ``MessageLine.receive``.
            FramingError: As ``MessageLine.receive``.
        """
        return self.line.receive(_patience(deadline, interrupted))

    def send(self, message: bytes, deadline: float) -> None:
        """Send the client an answer.

        Args:
            message: The answer.
            deadline: The maximum time [s].

        Raises:
            Late: The client did not take it in time.
            Gone: As ``MessageLine.send``.
        """
        self.line.send(message, _patience(deadline, lambda: False))

    def send_away(self, reason: str, patience: float = FAREWELL_S) -> None:
        """Answer the client's next message with an error, and end the connection.

        Args:
            reason: The error.
            patience: The maximum time [s].
        """
        with suppress(Late, Gone, FramingError):
            self.send(errors(self.receive(patience), reason), patience)
        self.line.close()


def errors(message: bytes, reason: str) -> bytes:
    """Return the answer that refuses every command of a message, except close. The first refusal has the reason.

    Args:
        message: The message.
        reason: The reason.

    Raises:
        FramingError: The message is none.
    """
    answers: list[bytes] = []
    for number, _, _ in framing.split(message):
        refused = number != framing.CLOSE
        words = reason if refused and not answers else ""
        answers.append(framing.make_status(number, framing.STATUS_ERROR if refused else framing.STATUS_OK, words))
    return framing.make_message(*answers)


class ClientSlot:
    """Holds at most one client. It is thread-safe.

    Attributes:
        client: The client; None if the seat is free.
    """

    def __init__(self, tell: Callable[[GateEvent], None]) -> None:
        """Start with a free seat.

        Args:
            tell: Called with each event.
        """
        self._listener = tell
        self._changed = threading.Condition()
        self.client: Client | None = None

    def tell(self, event: GateEvent) -> None:
        """Report an event; a listener that fails does not stop the gate.

        Args:
            event: The event.
        """
        try:
            self._listener(event)
        except Exception:
            logging.getLogger(__name__).exception("The listener of the gate's events failed.")

    def take(self, client: Client) -> bool:
        """Give the seat to a client. A client whose connection is dead loses it.

        Args:
            client: The client.

        Returns:
            Whether the client got the seat.
        """
        sitting = self.client
        if sitting is not None and sitting.line.cut:
            self.leave(sitting, EventKind.LOST, f"The client at {sitting.peer} was lost: its connection broke.")
        with self._changed:
            if self.client is not None:
                return False
            self.client = client
            self._changed.notify_all()
        self.tell(GateEvent(EventKind.CONNECTED, f"A client connected from {client.peer}."))
        return True

    def leave(self, client: Client, kind: EventKind, sentence: str) -> None:
        """Free the seat if the client has it, and end the client's connection; a late client is told why.

        Args:
            client: The client.
            kind: The kind of the event.
            sentence: The event in a sentence.
        """
        with self._changed:
            if self.client is not client:
                return
            self.client = None
            self._changed.notify_all()
        if kind is EventKind.LATE:
            threading.Thread(target=client.send_away, args=(sentence,), daemon=True).start()
        else:
            client.line.hang_up()
        self.tell(GateEvent(kind, sentence))

    def wait(self, timeout: float) -> bool:
        """Wait for a client.

        Args:
            timeout: The maximum time [s].

        Returns:
            Whether there is a client.
        """
        with self._changed:
            return self._changed.wait_for(lambda: self.client is not None, timeout)
