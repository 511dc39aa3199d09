"""Random and mutated TraCI messages, the same for the same seed; and a client that sends them and counts what it hears.

An attack of another kind is another function in ``KINDS``.
"""

from __future__ import annotations

import random
import socket
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from sumo_adv.serve import framing, shapes
from sumo_adv.serve.framing import make_command, make_message
from sumo_adv.serve.policy import GETTER_TO_SUBSCRIPTION, GETTERS, SETTERS

NAMES = (
    b"ego", b"ego", b"ego", b"other", b"mine", b"car", b"through", b"centre", b"east_in", b"east_in_0", b"loop",
    b"stop", b"poi", b"", b"nobody", b"x" * 200, b"\xff\xfe", b"sumo_adv.poi", b"!ego", b"a b",
)  # fmt: skip
NUMBERS = (0.0, 1.0, -1.0, 0.1, 13.9, -1073741824.0, 1e9, 1e11, 1e308, float("inf"), float("nan"))
WHOLE = (0, 1, 2, -1, 3, 7, 127, 255, 31, 256, 2**31 - 1, -(2**31))
ANSWER_WITHIN = 30.0  # s
_ADD, _ADD_FULL, _REMOVE, _COPY = 0x80, 0x85, 0x81, 0x88


def text(data: bytes) -> bytes:
    return struct.pack("!i", len(data)) + data


def value(chance: random.Random, shape: str) -> bytes:
    """A value of a shape (see ``sumo_adv.serve.shapes``) with random contents."""
    at, made, counts = 0, bytearray(), list[tuple[int, int]]()
    while at < len(shape):
        letter = shape[at]
        if letter in "({":
            counts.append((len(made) + 1, 0))
            made += b"\x0f" + bytes(4)
        elif letter in ")}":
            place, count = counts.pop()
            made[place : place + 4] = struct.pack("!i", count)
        elif letter == "[":
            if chance.random() < 0.5:
                at = shape.index("]", at)
        elif letter != "]":
            made += _single(chance, letter)
        if letter not in "({[]" and counts:
            counts[-1] = counts[-1][0], counts[-1][1] + 1
        at += 1
    return bytes(made)


def _single(chance: random.Random, letter: str) -> bytes:
    number = lambda: struct.pack("!d", chance.choice(NUMBERS))  # noqa: E731
    name = lambda: text(chance.choice(NAMES))  # noqa: E731
    positions = {"o": (1, 2), "O": (3, 3), "g": (0, 2), "G": (2, 3)}
    if letter in positions:
        kind, count = positions[letter]
        return bytes((kind,)) + b"".join(number() for _ in range(count))
    return {
        "i": lambda: b"\x09" + struct.pack("!i", chance.choice(WHOLE)), "d": lambda: b"\x0b" + number(),
        "b": lambda: b"\x08" + chance.randbytes(1), "B": lambda: b"\x07" + chance.randbytes(1),
        "c": lambda: b"\x11" + chance.randbytes(4), "u": lambda: chance.randbytes(1), "s": lambda: b"\x0c" + name(),
        "n": lambda: b"\x0c" + text(b"pin"), "r": lambda: b"\x04" + name() + number() + bytes(1),
        "l": lambda: b"\x0e" + struct.pack("!i", 2) + name() + name(),
        "v": lambda: b"\x0e" + struct.pack("!i", 1) + text(b"taxi"),
        "f": lambda: b"\x10" + struct.pack("!i", 2) + number() + number(),
        "p": lambda: b"\x06\2" + number() * 2 + number() * 2,
    }[letter]()  # fmt: skip


def getter(chance: random.Random) -> bytes:
    number = chance.choice(list(GETTERS))
    variable = chance.choice([*shapes.GET.get(number, {}), *range(256)])
    shape = chance.choice(shapes.get_shapes(number, variable))
    return make_command(number, bytes((variable,)) + text(chance.choice(NAMES)) + value(chance, shape))


def setter(chance: random.Random) -> bytes:
    number = chance.choice([n for n in SETTERS if n in shapes.SET] + [0xC4] * 20)
    variable = chance.choice([*shapes.SET[number], 0x7E])
    shape = chance.choice(shapes.set_shapes(number, variable) or ("",))
    return make_command(number, bytes((variable,)) + text(chance.choice(NAMES)) + value(chance, shape))


def subscription(chance: random.Random) -> bytes:
    domain = chance.choice(list(GETTERS))
    begin = struct.pack("!2d", chance.choice(NUMBERS), chance.choice(NUMBERS)) + text(chance.choice(NAMES))
    variable_ids = [
        chance.choice([*shapes.GET.get(domain, {0: ("",)}), *range(256)]) for _ in range(chance.randrange(6))
    ]
    if chance.random() < 0.5:
        reach = struct.pack("!d", chance.choice(NUMBERS))
        return make_command(
            chance.choice(list(GETTERS)) - 0x20,
            begin + bytes((domain,)) + reach + bytes((len(variable_ids), *variable_ids)),
        )
    variables = b"".join(bytes((w,)) + value(chance, chance.choice(shapes.get_shapes(domain, w))) for w in variable_ids)
    return make_command(domain + GETTER_TO_SUBSCRIPTION, begin + bytes((len(variable_ids),)) + variables)


def control(chance: random.Random) -> bytes:
    number = chance.choice((framing.GETVERSION, framing.LOAD, framing.SETORDER, framing.EXECUTEMOVE, framing.FILTER))
    return make_command(number, chance.randbytes(chance.randrange(12)))


def step(chance: random.Random) -> bytes:
    until = chance.choice((0.0, 0.0, 0.0, 0.5, 3.0, *NUMBERS))
    return make_command(framing.SIMSTEP, struct.pack("!d", until))


KINDS: tuple[Callable[[random.Random], bytes], ...] = (getter, setter, setter, subscription, control, step)


def mutated(chance: random.Random, message: bytes) -> bytes:
    """A message with some bytes changed, added, dropped or announced in vain."""
    data = bytearray(message)
    for _ in range(chance.randrange(1, 4)):
        at = chance.randrange(len(data)) if data else 0
        mutation = chance.randrange(5)
        if mutation == 0 and data:
            data[at] = chance.randrange(256)
        elif mutation == 1:
            data[at:at] = chance.randbytes(chance.randrange(1, 9))
        elif mutation == 2:
            del data[at : at + chance.randrange(1, 9)]
        elif mutation == 3 and len(data) >= 4:
            data[:4] = struct.pack("!i", len(data))
        elif len(data) > 5:
            data[4] = chance.randrange(256)
    return bytes(data)


def messages(seed: int) -> Iterator[tuple[bytes, bool]]:
    """Messages without end, and whether each is well framed."""
    chance = random.Random(seed)
    while True:
        commands = [chance.choice(KINDS)(chance) for _ in range(chance.choice((1, 1, 1, 2, 5)))]
        message = make_message(*commands)
        if chance.random() < 0.25:
            yield mutated(chance, message), False
        else:
            yield message, True


class Fuzzer:
    """Sends messages one after the other; ``sent`` keeps the last ones, ``counts`` the outcomes of all."""

    def __init__(self, port: int, seed: int) -> None:
        self.counts: Counter[str] = Counter()
        self.sent: list[bytes] = []
        self._port, self._messages = port, messages(seed)
        self._socket: socket.socket | None = None

    def send(self) -> None:
        """The next message, on a new connection if the last one was cut.

        Raises:
            AssertionError: a well framed message was not answered command by command.
        """
        message, whole = next(self._messages)
        self.sent = [*self.sent[-20:], message]
        if self._socket is None:
            self._socket = socket.create_connection(("127.0.0.1", self._port), ANSWER_WITHIN)
            self.counts["connections"] += 1
        try:
            self._socket.sendall(message)
            if not whole:
                self._socket.settimeout(0.05)  # s: it may have announced more than it holds
            answer = _answer(self._socket)
        except OSError:
            answer = b""
        if answer and whole:
            self.counts["answered"] += 1
            self.counts["refused"] += answer[6] != framing.STATUS_OK
        elif answer:
            self.counts["mutated, answered"] += 1
        else:
            assert not whole or self.counts["connections"] > 1, "a well framed message was not answered"
            self.counts["mutated, cut" if not whole else "whole, cut"] += 1
        if not answer or not whole:
            self.close()

    def close(self) -> None:
        """Hang up."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _answer(connection: socket.socket) -> bytes:
    data = bytearray()
    while len(data) < 4 or len(data) < struct.unpack_from("!i", data)[0]:
        part = connection.recv(65536)
        if not part:
            return b""
        data += part
    return bytes(data)


@contextmanager
def closing(fuzzer: Fuzzer) -> Iterator[Fuzzer]:
    try:
        yield fuzzer
    finally:
        fuzzer.close()
