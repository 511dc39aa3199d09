"""For clients that know TraCI only up to version 21: they are told that version, and subscribe to stops as then.

SUMO 1.23 made it version 22.  Its getter 0x73 (``getNextStops``) still answers in the old form, but subscribing to it
is refused (measured with 1.28).  So it becomes one to 0x74 (``getStops``); its results are rewritten.
"""

from __future__ import annotations

import struct

from sumo_adv.serve import shapes
from sumo_adv.serve.framing import SIMSTEP, Command, make_command, make_message

NEWEST, OLDER = 22, 21  # versions of TraCI
_SUBSCRIPTION, _RESULT = 0xD4, 0xE4  # of a vehicle
_NEXT_STOPS, _STOPS = 0x73, 0x74
_NO_LIMIT = b"\x09" + bytes(4)
_BEGIN = bytes((_STOPS, 0, 0x0F))  # variable, status, compound: before the count of a result
_FIELDS = "sdsiddddddsssssd"  # types of a stop: those of 0x73, starts and times, words, speed
_INT = struct.Struct("!i")


class OlderClients:
    """Translates for one client in one simulation."""

    def __init__(self) -> None:
        self._names: set[bytes] = set()  # vehicles of which it subscribed to the stops

    def version(self, answer: bytes) -> bytes:
        """SUMO's answer about its version, with the older number: it stands behind status, length and command."""
        at = 4 + answer[4] + 2
        return answer[:at] + _INT.pack(OLDER) + answer[at + 4 :]

    def asked(self, command: Command) -> Command:
        """A subscription as SUMO takes it: stops come last. Other commands stay as they are."""
        if command.number != _SUBSCRIPTION:
            return command
        try:
            end = shapes.name_end(command.payload, 16)
            variables = shapes.subscribed(command.payload, end, _SUBSCRIPTION - 0x30)
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
        return Command(command.number, payload, make_command(command.number, payload))

    def answered(self, number: int, answer: bytes) -> bytes:
        """The answer to a subscription or a step, with stops in the old form."""
        if not self._names or number not in (_SUBSCRIPTION, SIMSTEP) or answer[6] != 0:
            return answer
        at = 4 + answer[4] + (4 if number == SIMSTEP else 0)
        parts = [answer[4:at]]
        while at < len(answer):
            head, length = (1, answer[at]) if answer[at] else (5, _INT.unpack_from(answer, at + 1)[0])
            parts.append(self._result(answer[at : at + length], head))
            at += length
        return make_message(*parts)

    def _result(self, result: bytes, head: int) -> bytes:
        """The result of one subscription."""
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
