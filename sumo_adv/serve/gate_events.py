"""What happens at the gate, for people and programs."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


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
