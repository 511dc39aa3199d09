"""SUMO's second client, through which the gate speaks for the ego; what the ego's client subscribed to; older clients.

Subscriptions end with the client, and before an object that it removes. Clients that know TraCI only up to version 21
are told that version, and subscribe to stops as then: SUMO 1.23 made it version 22. Its getter 0x73 (``getNextStops``)
still answers in the old form, but subscribing to it is refused (measured with 1.28). So it becomes one to 0x74
(``getStops``); its results are rewritten.
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
MAX_SUMO_ANSWER_BYTES = 2**31 - 1  # bytes of an answer of SUMO
_TIME = make_message(make_command(0xAB, b"\x66" + bytes(4)))
_STEP_LENGTH = make_message(make_command(0xAB, b"\x7b" + bytes(4)))
_STEP = make_message(make_command(framing.SIMSTEP, bytes(8)))
_INVALID = struct.pack("!d", -1073741824.0)
MAX_COMPLAINT_BYTES = 200  # bytes of an error that SUMO survives in any case
_SUBSCRIPTION = {name: number + 0x10 for number, name in SETTERS.items()}
_CONTEXT = {name: number - 0x40 for number, name in SETTERS.items()}
NEWEST_TRACI, OLDER_TRACI = 22, 21  # versions of TraCI
_OF_VEHICLE, _RESULT = 0xD4, 0xE4  # of a vehicle
_NEXT_STOPS, _STOPS = 0x73, 0x74
_NO_LIMIT = b"\x09" + bytes(4)
_BEGIN = bytes((_STOPS, 0, 0x0F))  # variable, status, compound: before the count of a result
_FIELDS = "sdsiddddddsssssd"  # types of a stop: those of 0x73, starts and times, words, speed
_INT = struct.Struct("!i")


class SumoGone(SumoAdvError):
    """SUMO is no more."""


class SumoLink:
    """Speaks with SUMO as its client 2; asks one thing at a time. Every call may raise SumoGone."""

    def __init__(self, line: MessageLine, idle: Callable[[], None]) -> None:
        """Ask for version and order, without waiting: SUMO answers when client 1 has asked too."""
        self._line = line
        self._idle = idle
        self.version = b""
        self._step_length = 0.0
        self._send(make_message(make_command(framing.GETVERSION)))
        self._send(make_message(make_command(framing.SETORDER, struct.pack("!i", CLIENT_ORDER))))

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
        self._send(message)
        return self._receive()

    def step(self) -> bytes:
        return self.ask(_STEP)

    def now(self) -> float:
        """SUMO's time [s]; nan if it does not say."""
        answer = self.ask(_TIME)
        return float(struct.unpack("!d", answer[-8:])[0]) if framing.accepted(answer) else math.nan

    def step_length(self) -> float:
        if not self._step_length:
            self._step_length = float(struct.unpack("!d", self.ask(_STEP_LENGTH)[-8:])[0])
        return self._step_length

    def await_turn(self, listen: Callable[[], MessageLine | None], talk: Callable[[], None]) -> None:
        """Wait until SUMO has come to us, calling ``talk`` whenever the line that ``listen`` names can be received."""
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
        self._line.close()


class Subscriptions:
    """Of one simulation. Every method that speaks with SUMO may raise SumoGone."""

    def __init__(self, link: SumoLink) -> None:
        self._link = link
        self._kept: dict[
            tuple[int, bytes, bytes], TraciCommand
        ] = {}  # by number, domain of a context, name of the object

    def note(self, command: TraciCommand) -> None:
        """SUMO accepted a subscription, or the end of one."""
        end = shapes.name_end(command.payload, 16)
        context = command.number in CONTEXTS
        domain = command.payload[end : end + 1] if context else b""
        key = command.number, domain, command.payload[20:end]
        if command.payload[end + (9 if context else 0)]:
            self._kept[key] = command
        else:
            self._kept.pop(key, None)

    def end(self) -> None:
        for command in list(self._kept.values()):
            self._link.unsubscribe(command)
        self._kept.clear()

    def end_of(self, domain: str, name: bytes) -> None:
        """End those of an object that is about to be removed: SUMO fails in every step after that otherwise."""
        numbers = _SUBSCRIPTION[domain], _CONTEXT[domain]
        for key in [key for key in self._kept if key[0] in numbers and key[2] == name]:
            self._link.unsubscribe(self._kept.pop(key))

    def deadly(self, command: TraciCommand) -> str:
        """What SUMO would complain of, if it would be too long for it: it puts a sentence a variable into one error."""
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
        self._names: set[bytes] = set()  # vehicles of which it subscribed to the stops

    def version(self, answer: bytes) -> bytes:
        """SUMO's answer about its version, with the older number: it stands behind status, length and command."""
        at = 4 + answer[4] + 2
        return answer[:at] + _INT.pack(OLDER_TRACI) + answer[at + 4 :]

    def asked(self, command: TraciCommand) -> TraciCommand:
        """A subscription as SUMO takes it: stops come last. Other commands stay as they are."""
        if command.number != _OF_VEHICLE:
            return command
        try:
            end = shapes.name_end(command.payload, 16)
            variables = shapes.subscribed(command.payload, end, _OF_VEHICLE - 0x30)
        except shapes.Misfit:
            return command
        kept = [variable for variable in variables if variable[0] != _NEXT_STOPS]
        name = command.payload[20:end]
        if not variables:  # it ends; others only add to what is subscribed to already
            self._names.discard(name)
        if len(kept) == len(variables) or any(variable[0] == _STOPS for variable in kept):
            return command
        self._names.add(name)
        kept.append(bytes((_STOPS,)) + _NO_LIMIT)
        payload = command.payload[:end] + bytes((len(kept),)) + b"".join(kept)
        return TraciCommand(command.number, payload, make_command(command.number, payload))

    def answered(self, number: int, answer: bytes) -> bytes:
        """The answer to a subscription or a step, with stops in the old form."""
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
        if result[head] != _RESULT:
            return result
        payload = result[head + 1 :]
        if payload[4 : shapes.name_end(payload, 0)] not in self._names:
            return result
        at = payload.find(_BEGIN)
        while at >= 0:  # a match too early is part of another value: stops come last and end with the result
            stops = _old_form(payload, at + len(_BEGIN))
            if stops is not None:
                return make_command(_RESULT, payload[:at] + bytes((_NEXT_STOPS, 0, 0x0F)) + stops)
            at = payload.find(_BEGIN, at + 1)
        return result


def _old_form(payload: bytes, at: int) -> bytes | None:
    """Count and stops of 0x73 for those of 0x74 that begin at ``at`` and end with the payload; None if they do not."""
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
    """Lane, end, place, flags, duration, until. The old flags are shifted by one; the lowest says that it stands there,
    which is so once it has an arrival (the ninth field)."""
    arrived = struct.unpack("!d", fields[8][1:])[0] >= 0.0
    flags = 2 * _INT.unpack(fields[3][1:])[0] + arrived
    return b"".join((*fields[:3], b"\x09" + _INT.pack(flags), *fields[4:6]))
