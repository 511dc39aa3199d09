"""SUMO's second client, through which the gate speaks for the ego; the client's subscriptions; older clients.

Subscriptions end with the client, and before an object that it removes. Clients that know TraCI only up to version 21
are told that version, and subscribe to stops as in that version: SUMO 1.23 made it version 22. Its getter 0x73
(``getNextStops``) still answers in the old form, but subscribing to it is refused (measured with 1.28). Therefore such
a subscription is turned into one to 0x74 (``getStops``), and its results are rewritten.
"""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Callable

from sumo_adv.errors import SumoAdvError
from sumo_adv.serve import framing, shapes
from sumo_adv.serve.framing import SIMSTEP, FramingError, Gone, MessageLine, TraciCommand, make_command, make_message
from sumo_adv.serve.policy import CONTEXTS, GETTER_TO_SUBSCRIPTION, SETTERS

CLIENT_ORDER = 2
MAX_SUMO_ANSWER_BYTES = 2**31 - 1  # of an answer of SUMO
_TIME = make_message(make_command(0xAB, b"\x66" + bytes(4)))
_STEP_LENGTH = make_message(make_command(0xAB, b"\x7b" + bytes(4)))
_STEP = make_message(make_command(framing.SIMSTEP, bytes(8)))
_INVALID = struct.pack("!d", -1073741824.0)
MAX_COMPLAINT_BYTES = 200  # size of an error that SUMO survives in any case
_SUBSCRIPTION = {name: number + 0x10 for number, name in SETTERS.items()}
_CONTEXT = {name: number - 0x40 for number, name in SETTERS.items()}
NEWEST_TRACI, OLDER_TRACI = 22, 21  # versions of TraCI
_OF_VEHICLE, _RESULT = 0xD4, 0xE4  # subscription of a vehicle, and its result
_NEXT_STOPS, _STOPS = 0x73, 0x74
_NO_LIMIT = b"\x09" + bytes(4)
_BEGIN = bytes((_STOPS, 0, 0x0F))  # variable, status, compound: before the count of a result
_FIELDS = "sdsiddddddsssssd"  # types of a stop's fields: those of 0x73, starts and times, words, speed
_INT = struct.Struct("!i")


class SumoGone(SumoAdvError):
    """SUMO has ended."""


class SumoLink:
    """Speaks with SUMO as its client 2, one question at a time. Every call may raise SumoGone."""

    def __init__(self, line: MessageLine, idle: Callable[[], None]) -> None:
        """Request version and order without waiting, because SUMO answers once client 1 has requested them too.

        Args:
            line: The connection to SUMO.
            idle: Called while waiting.
        """
        self._line = line
        self._idle = idle
        self.version = b""
        self._step_length = 0.0
        self._send(make_message(make_command(framing.GETVERSION)))
        self._send(make_message(make_command(framing.SETORDER, struct.pack("!i", CLIENT_ORDER))))

    def greet(self) -> None:
        """Wait for the answers to the first requests."""
        self.version = self._receive()
        if not framing.accepted(self._receive()):
            raise SumoGone("SUMO refused the order of its clients.")

    def _send(self, message: bytes) -> None:
        """Send a message."""
        try:
            self._line.send(message, self._idle)
        except Gone as error:
            raise SumoGone("SUMO has ended.") from error

    def _receive(self) -> bytes:
        """Receive a message."""
        try:
            return self._line.receive(self._idle)
        except (Gone, FramingError) as error:
            raise SumoGone("SUMO has ended.") from error

    def ask(self, message: bytes) -> bytes:
        """Send a message, and return the answer.

        Args:
            message: The message.
        """
        self._send(message)
        return self._receive()

    def step(self) -> bytes:
        """Make a step, and return the answer."""
        return self.ask(_STEP)

    def now(self) -> float:
        """Return SUMO's time [s]; nan if it does not say."""
        answer = self.ask(_TIME)
        return float(struct.unpack("!d", answer[-8:])[0]) if framing.accepted(answer) else math.nan

    def step_length(self) -> float:
        """Return SUMO's step length [s]."""
        if not self._step_length:
            self._step_length = float(struct.unpack("!d", self.ask(_STEP_LENGTH)[-8:])[0])
        return self._step_length

    def await_turn(self, listen: Callable[[], MessageLine | None], talk: Callable[[], None]) -> None:
        """Wait until it is this client's turn.

        Args:
            listen: Returns the line to watch meanwhile; None watches none.
            talk: Called whenever that line has something to receive.
        """
        self._send(_TIME)
        while True:
            sumo_ready, client_ready = self._line.ready(listen(), framing.POLL_PERIOD_S)
            if sumo_ready:
                self._receive()
                return
            if client_ready:
                talk()
            self._idle()

    def unsubscribe(self, command: TraciCommand) -> None:
        """End a subscription.

        Args:
            command: The subscription.
        """
        end = 20 + int.from_bytes(command.payload[16:20], "big")
        rest = command.payload[end : end + 9] if command.number in CONTEXTS else b""
        self.ask(make_message(make_command(command.number, _INVALID * 2 + command.payload[16:end] + rest + b"\0")))

    def leave(self) -> None:
        """Close the connection at this client's turn, and wait for SUMO's last answer."""
        with contextlib.suppress(SumoGone):
            self.ask(make_message(make_command(framing.CLOSE)))
            while True:
                self._receive()

    def close(self) -> None:
        """End the connection at once."""
        self._line.close()


class Subscriptions:
    """The client's subscriptions in one simulation. Every method that speaks with SUMO may raise SumoGone."""

    def __init__(self, link: SumoLink) -> None:
        """Start without subscriptions.

        Args:
            link: The link to SUMO.
        """
        self._link = link
        self._kept: dict[
            tuple[int, bytes, bytes], TraciCommand
        ] = {}  # by number, domain of a context, name of the object

    def note(self, command: TraciCommand) -> None:
        """Record a subscription that SUMO accepted, or the end of one.

        Args:
            command: The subscription.
        """
        end = shapes.name_end(command.payload, 16)
        context = command.number in CONTEXTS
        domain = command.payload[end : end + 1] if context else b""
        key = command.number, domain, command.payload[20:end]
        if command.payload[end + (9 if context else 0)]:
            self._kept[key] = command
        else:
            self._kept.pop(key, None)

    def end(self) -> None:
        """End all subscriptions."""
        for command in list(self._kept.values()):
            self._link.unsubscribe(command)
        self._kept.clear()

    def end_of(self, domain: str, name: bytes) -> None:
        """End those of an object that is about to be removed; otherwise SUMO fails in every step after that.

        Args:
            domain: The domain of the object.
            name: The name of the object.
        """
        numbers = _SUBSCRIPTION[domain], _CONTEXT[domain]
        for key in [key for key in self._kept if key[0] in numbers and key[2] == name]:
            self._link.unsubscribe(self._kept.pop(key))

    def deadly(self, command: TraciCommand) -> str:
        """Return the error of a subscription if SUMO would end on its length: it puts one sentence per variable into an
        error.

        Args:
            command: The subscription.

        Returns:
            The error; empty if SUMO survives it.
        """
        end = shapes.name_end(command.payload, 16)
        getter = command.number - GETTER_TO_SUBSCRIPTION
        variables = shapes.subscribed(command.payload, end, getter)
        if len(variables) < 2:
            return ""
        name = command.payload[16:end]
        questions = (make_command(getter, variable[:1] + name + variable[1:]) for variable in variables)
        complaints = [framing.complaint(self._link.ask(make_message(question))) for question in questions]
        whole = f"Could not add subscription. {' '.join(complaints).strip()}"
        return whole if len(whole.encode()) > MAX_COMPLAINT_BYTES else ""


class OlderClients:
    """Translates for one client in one simulation."""

    def __init__(self) -> None:
        """Start without subscriptions."""
        self._names: set[bytes] = set()  # vehicles with a subscription to their stops

    def version(self, answer: bytes) -> bytes:
        """Return SUMO's answer about its version, with the older number.

        The number comes after status, length and command.

        Args:
            answer: SUMO's answer.
        """
        at = 4 + answer[4] + 2
        return answer[:at] + _INT.pack(OLDER_TRACI) + answer[at + 4 :]

    def asked(self, command: TraciCommand) -> TraciCommand:
        """Return a subscription in SUMO's form, in which stops come last. Other commands are not changed.

        Args:
            command: The client's command.
        """
        if command.number != _OF_VEHICLE:
            return command
        try:
            end = shapes.name_end(command.payload, 16)
            variables = shapes.subscribed(command.payload, end, _OF_VEHICLE - 0x30)
        except shapes.Misfit:
            return command
        kept = [variable for variable in variables if variable[0] != _NEXT_STOPS]
        name = command.payload[20:end]
        if not variables:  # this ends the subscription; others only add to it
            self._names.discard(name)
        if len(kept) == len(variables) or any(variable[0] == _STOPS for variable in kept):
            return command
        self._names.add(name)
        kept.append(bytes((_STOPS,)) + _NO_LIMIT)
        payload = command.payload[:end] + bytes((len(kept),)) + b"".join(kept)
        return TraciCommand(command.number, payload, make_command(command.number, payload))

    def answered(self, number: int, answer: bytes) -> bytes:
        """Return the answer to a subscription or a step, with stops in the old form.

        Args:
            number: The number of the command.
            answer: SUMO's answer.
        """
        if not self._names or number not in (_OF_VEHICLE, SIMSTEP) or answer[6] != 0:
            return answer
        at = 4 + answer[4] + (4 if number == SIMSTEP else 0)
        parts = [answer[4:at]]
        while at < len(answer):
            head, length = (1, answer[at]) if answer[at] else (5, _INT.unpack_from(answer, at + 1)[0])
            parts.append(self._result(answer[at : at + length], head))
            at += length
        return make_message(*parts)

    def _result(self, result: bytes, head: int) -> bytes:
        """Return a subscription's result, with stops in the old form."""
        if result[head] != _RESULT:
            return result
        payload = result[head + 1 :]
        if payload[4 : shapes.name_end(payload, 0)] not in self._names:
            return result
        at = payload.find(_BEGIN)
        while at >= 0:  # a match too early belongs to another value; stops come last and end with the result
            stops = _old_form(payload, at + len(_BEGIN))
            if stops is not None:
                return make_command(_RESULT, payload[:at] + bytes((_NEXT_STOPS, 0, 0x0F)) + stops)
            at = payload.find(_BEGIN, at + 1)
        return result


def _old_form(payload: bytes, at: int) -> bytes | None:
    """Turn the stops of 0x74 from ``at`` to the payload's end into count and stops of 0x73; return None if they do not
    fit.
    """
    try:
        count = _INT.unpack_from(payload, at + 5)[0]
        at += 9
        stops = []
        for _ in range(count):
            fields = []
            for kind in _FIELDS:
                end = shapes.name_end(payload, at + 1) if kind == "s" else at + (9 if kind == "d" else 5)
                fields.append(payload[at:end])
                at = end
            stops.append(_old_stop(fields))
    except (shapes.Misfit, struct.error, IndexError):
        return None
    return None if at != len(payload) else _INT.pack(1 + 4 * count) + b"\x09" + _INT.pack(count) + b"".join(stops)


def _old_stop(fields: list[bytes]) -> bytes:
    """Return lane, end, place, flags, duration and until.

    The old flags are shifted by one. Their lowest bit says that the vehicle stands there, which is so once the stop has
    an arrival (the ninth field).
    """
    arrived = struct.unpack("!d", fields[8][1:])[0] >= 0.0
    flags = 2 * _INT.unpack(fields[3][1:])[0] + arrived
    return b"".join((*fields[:3], b"\x09" + _INT.pack(flags), *fields[4:6]))
