"""The one seat at the gate: the client that drives the ego, other visitors, and what happens there."""

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
    """What happened."""

    CONNECTED = "connected"  # a client took its seat
    CLOSED = "closed"  # it said close
    LOST = "lost"  # its connection broke, or it sent what is no message
    LATE = "late"  # it used up its time for a turn
    REFUSED = "refused"  # a call, or a connection
    RESTARTED = "restarted"  # the simulation ended in good order
    ENDED = "ended"  # SUMO went away by itself


class Stepper(StrEnum):
    """The maker of a step on the ego's side."""

    CLIENT = "client"
    GATE = "gate"


@dataclass(frozen=True, slots=True)
class GateEvent:
    """Something that happened at the gate, in a sentence."""

    kind: EventKind
    sentence: str


FAREWELL_S = 60.0  # s in which a client that was sent away may still hear why


class Late(SumoAdvError):
    """A client used up its time."""


class Interrupted(SumoAdvError):
    """The gate has something else to do."""


def _patience(deadline: float, interrupted: Callable[[], bool]) -> Callable[[], None]:
    """What a line calls while it waits: it raises Interrupted, and Late once ``deadline`` seconds are over."""
    until = time.monotonic() + deadline

    def idle() -> None:
        if interrupted():
            raise Interrupted
        if time.monotonic() > until:
            raise Late

    return idle


class Client:
    """A connected program: its line, its address, and which of its calls were refused already."""

    def __init__(self, line: MessageLine, peer: str) -> None:
        self.line = line
        self.peer = peer
        self.refused: set[tuple[int, bytes]] = set()

    def receive(self, deadline: float, interrupted: Callable[[], bool] = lambda: False) -> bytes:
        """Its next message.

        Raises:
            Late: it did not come within ``deadline`` seconds.
            Interrupted: ``interrupted()`` became true.
            Gone, FramingError: see Line.
        """
        return self.line.receive(_patience(deadline, interrupted))

    def send(self, message: bytes, deadline: float) -> None:
        """Send it an answer. Raises Late: it did not take it within ``deadline`` seconds; Gone: see Line."""
        self.line.send(message, _patience(deadline, lambda: False))

    def send_away(self, reason: str, patience: float = FAREWELL_S) -> None:
        """Answer its next message with an error and end the connection, within ``patience`` [s]."""
        with suppress(Late, Gone, FramingError):
            self.send(errors(self.receive(patience), reason), patience)
        self.line.close()


def errors(message: bytes, reason: str) -> bytes:
    """The answer that refuses every command of a message, but for saying close. The first says why.

    Raises FramingError: it is no message.
    """
    answers: list[bytes] = []
    for number, _, _ in framing.split(message):
        refused = number != framing.CLOSE
        words = reason if refused and not answers else ""
        answers.append(framing.make_status(number, framing.STATUS_ERROR if refused else framing.STATUS_OK, words))
    return framing.make_message(*answers)


class ClientSlot:
    """Holds at most one client. Thread-safe."""

    def __init__(self, tell: Callable[[GateEvent], None]) -> None:
        self._listener = tell
        self._changed = threading.Condition()
        self.client: Client | None = None

    def tell(self, event: GateEvent) -> None:
        """Tell what happened; a listener cannot stop the gate by failing."""
        try:
            self._listener(event)
        except Exception:
            logging.getLogger(__name__).exception("The listener of the gate's events failed.")

    def take(self, client: Client) -> bool:
        """Whether the client got the seat; a client with a dead connection loses it."""
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
        """Free the seat, unless it was already, and end the client's connection; a late client hears why."""
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
        with self._changed:
            return self._changed.wait_for(lambda: self.client is not None, timeout)
