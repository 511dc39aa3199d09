"""SUMO's second client: the connection through which the gate speaks for the ego."""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Callable

from sumo_adv.errors import SumoAdvError
from sumo_adv.serve import framing
from sumo_adv.serve.framing import Command, FramingError, Gone, Line, make_command, make_message
from sumo_adv.serve.policy import CONTEXTS

ORDER = 2
LONGEST = 2**31 - 1  # bytes of an answer of SUMO
_TIME = make_message(make_command(0xAB, b"\x66" + bytes(4)))
_STEP_LENGTH = make_message(make_command(0xAB, b"\x7b" + bytes(4)))
_STEP = make_message(make_command(framing.SIMSTEP, bytes(8)))
_INVALID = struct.pack("!d", -1073741824.0)


class SumoGone(SumoAdvError):
    """SUMO is no more."""


class Link:
    """Speaks with SUMO as its client 2; asks one thing at a time. Every call may raise SumoGone."""

    def __init__(self, line: Line, idle: Callable[[], None]) -> None:
        """Ask for version and order, without waiting: SUMO answers when client 1 has asked too."""
        self._line = line
        self._idle = idle
        self.version = b""
        self._step_length = 0.0
        self._send(make_message(make_command(framing.GETVERSION)))
        self._send(make_message(make_command(framing.SETORDER, struct.pack("!i", ORDER))))

    def greet(self) -> None:
        """Wait for the answers to what was asked at first."""
        self.version = self._receive()
        if not framing.accepted(self._receive()):
            raise SumoGone("SUMO refused the order of its clients.")

    def _send(self, message: bytes) -> None:
        try:
            self._line.send(message, self._idle)
        except Gone as error:
            raise SumoGone("SUMO is no more.") from error

    def _receive(self) -> bytes:
        try:
            return self._line.receive(self._idle)
        except (Gone, FramingError) as error:
            raise SumoGone("SUMO is no more.") from error

    def ask(self, message: bytes) -> bytes:
        """SUMO's answer to a message of one command."""
        self._send(message)
        return self._receive()

    def step(self) -> bytes:
        """Let SUMO step once."""
        return self.ask(_STEP)

    def now(self) -> float:
        """SUMO's time [s]; nan if it does not say."""
        answer = self.ask(_TIME)
        return float(struct.unpack("!d", answer[-8:])[0]) if framing.accepted(answer) else math.nan

    def step_length(self) -> float:
        """SUMO's step [s]."""
        if not self._step_length:
            self._step_length = float(struct.unpack("!d", self.ask(_STEP_LENGTH)[-8:])[0])
        return self._step_length

    def await_turn(self, listen: Callable[[], Line | None], talk: Callable[[], None]) -> None:
        """Wait until SUMO has come to us, calling ``talk`` whenever the line that ``listen`` names can be received."""
        self._send(_TIME)
        while True:
            sumo_ready, client_ready = self._line.ready(listen(), framing.SLICE)
            if sumo_ready:
                self._receive()
                return
            if client_ready:
                talk()
            self._idle()

    def unsubscribe(self, command: Command) -> None:
        """End what a subscription began."""
        end = 20 + int.from_bytes(command.payload[16:20], "big")
        rest = command.payload[end : end + 9] if command.number in CONTEXTS else b""
        self.ask(make_message(make_command(command.number, _INVALID * 2 + command.payload[16:end] + rest + b"\0")))

    def leave(self) -> None:
        """Say close when our turn comes, and wait for SUMO's goodbye."""
        with contextlib.suppress(SumoGone):
            self.ask(make_message(make_command(framing.CLOSE)))
            while True:
                self._receive()

    def close(self) -> None:
        """Close the connection."""
        self._line.close()
