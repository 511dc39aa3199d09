"""The framing of TraCI: messages of commands, status answers, step answers, and a socket that carries whole messages.

A message is its length (4 bytes, signed, itself included) and commands. A command is its length (1 byte, or 0 and 4
bytes; itself included), its number (1 byte) and a payload. Source: sumo.dlr.de/docs/TraCI/Protocol.html.
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import selectors
import socket
import struct
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

from sumo_adv.errors import SumoAdvError

GETVERSION, LOAD, SIMSTEP, SETORDER, EXECUTEMOVE, FILTER, CLOSE = 0x00, 0x01, 0x02, 0x03, 0x7D, 0x7E, 0x7F
STATUS_OK, STATUS_ERROR = 0x00, 0xFF
MAX_MESSAGE_BYTES = 16 * 2**20  # maximum size of a client's message
MAX_COMMANDS = 50_000  # per message: ten getters for each of 5,000 vehicles; 16 MB could hold 2.8 million
POLL_PERIOD_S = 0.05  # time between two looks at the clock while nothing arrives
MAX_STATUS_TEXT_BYTES = 247  # maximum size of a status answer's text; its length is one byte
SPIN_TIME_S = 1e-4
"""How long a line polls before it sleeps. Waking up takes longer than most answers do."""
_CHUNK_BYTES = 65536
_INT = struct.Struct("!i")


class FramingError(SumoAdvError):
    """The received bytes are no TraCI message."""


class Gone(SumoAdvError):
    """The other end closed the connection, or the connection broke."""


class TraciCommand(NamedTuple):
    """One command.

    Attributes:
        number: Its number.
        payload: Its payload.
        raw: All its bytes.
    """

    number: int
    payload: bytes
    raw: bytes


def make_command(number: int, payload: bytes = b"") -> bytes:
    """Return the bytes of a command.

    Args:
        number: Its number.
        payload: Its payload.
    """
    length = 2 + len(payload)
    if length < 256:
        return bytes((length, number)) + payload
    return b"\0" + _INT.pack(length + 4) + bytes((number,)) + payload


def make_message(*commands: bytes) -> bytes:
    """Return the bytes of a message.

    Args:
        commands: The bytes of its commands.
    """
    body = b"".join(commands)
    return _INT.pack(4 + len(body)) + body


def make_status(number: int, result: int = STATUS_OK, text: str = "") -> bytes:
    """Return SUMO's answer to a command.

    Args:
        number: The number of the command.
        result: Whether the command succeeded.
        text: Why not; it is cut to what the format holds.
    """
    words = text.encode()[:MAX_STATUS_TEXT_BYTES].decode(errors="ignore").encode()
    return make_command(number, bytes((result,)) + _INT.pack(len(words)) + words)


def accepted(answer: bytes) -> bool:
    """Return whether the first command of an answer succeeded.

    Args:
        answer: The message.
    """
    start = 5 if answer[4] else 9
    return len(answer) > start + 1 and answer[start + 1] == STATUS_OK


def complaint(answer: bytes) -> str:
    """Return the error of the first command of an answer; empty if it succeeded.

    Args:
        answer: The message.
    """
    start = 5 if answer[4] else 9
    if accepted(answer) or len(answer) < start + 6:
        return ""
    size = _INT.unpack_from(answer, start + 2)[0]
    return answer[start + 6 : start + 6 + size].decode(errors="replace")


def split(message: bytes) -> list[TraciCommand]:
    """Split a message into commands.

    Args:
        message: The message.

    Raises:
        FramingError: The lengths do not add up, or there are more than ``MAX_COMMANDS``.
    """
    at, end = 4, len(message)
    commands: list[TraciCommand] = []
    while at < end:
        head, length = 1, message[at]
        if length == 0:
            if at + 5 > end:
                raise FramingError("A command ends within its own length.")
            head, length = 5, _INT.unpack_from(message, at + 1)[0]
        if length <= head or at + length > end:
            raise FramingError(f"A command announces {length} bytes, but only {end - at} are left.")
        if len(commands) == MAX_COMMANDS:
            raise FramingError(f"it sent a message of more than {MAX_COMMANDS} commands")
        raw = message[at : at + length]
        commands.append(TraciCommand(raw[head], raw[head + 1 :], raw))
        at += length
    return commands


def _wait_at_most(connection: socket.socket, seconds: float) -> None:
    """Limit the time that any call waits; use the kernel's timeout if it has one, as Python's costs a system call each
    time.
    """
    if sys.platform == "win32":
        connection.settimeout(seconds)
        return
    span = struct.pack("ll", int(seconds), round(seconds % 1 * 1e6))
    connection.settimeout(None)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, span)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, span)


class MessageLine:
    """A socket that carries whole messages."""

    def __init__(self, connection: socket.socket, longest: int) -> None:
        """Use a socket.

        Args:
            connection: The socket.
            longest: The maximum size of a received message [bytes].
        """
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        _wait_at_most(connection, POLL_PERIOD_S)
        self._connection = connection
        self._longest = longest
        self._rest = b""

    def send(self, message: bytes, idle: Callable[[], None]) -> None:
        """Send a whole message, even if the other end takes it in small pieces.

        Args:
            message: The message.
            idle: Called every ``POLL_PERIOD_S`` until the message is sent; it may raise.

        Raises:
            Gone: The connection is closed or broken.
        """
        looked = time.monotonic()
        while message:
            try:
                message = message[self._connection.send(message) :]
            except (TimeoutError, BlockingIOError):
                looked = -math.inf
            except OSError as error:
                raise Gone("the connection broke") from error
            if message and time.monotonic() - looked > POLL_PERIOD_S:
                idle()
                looked = time.monotonic()

    def receive(self, idle: Callable[[], None]) -> bytes:
        """Receive the next whole message, even if it arrives in small pieces.

        Args:
            idle: Called every ``POLL_PERIOD_S`` until the message is complete; it may raise, or receive itself.

        Raises:
            FramingError: The length is that of no message. The rest of the message is not read.
            Gone: The connection is closed or broken.
        """
        data, self._rest = bytearray(self._rest), b""
        looked = time.monotonic()
        while True:
            size = len(data)
            if size >= 4:
                length = int.from_bytes(data[:4], "big", signed=True)
                if not 6 <= length <= self._longest:
                    raise FramingError(f"it announced a message of {length} bytes")
                if size >= length:
                    self._rest = bytes(data[length:])
                    return bytes(data[:length])
            if time.monotonic() - looked > POLL_PERIOD_S:
                self._rest = bytes(data)
                idle()
                data, self._rest = bytearray(self._rest), b""
                looked = time.monotonic()
                continue
            try:
                chunk = self._received()
            except (TimeoutError, BlockingIOError):
                looked = -math.inf
                continue
            except OSError as error:
                raise Gone("the connection broke") from error
            if not chunk:
                raise Gone(
                    "it closed the connection in the middle of a message" if size else "it closed the connection"
                )
            data += chunk

    def _received(self) -> bytes:
        """Return what arrives within ``POLL_PERIOD_S``; raise OSError, also if nothing arrives."""
        if hasattr(os, "sched_yield"):
            until = time.perf_counter() + SPIN_TIME_S
            while time.perf_counter() < until:
                with contextlib.suppress(BlockingIOError):
                    return self._connection.recv(_CHUNK_BYTES, socket.MSG_DONTWAIT)
                os.sched_yield()
        return self._connection.recv(_CHUNK_BYTES)

    def ready(self, other: MessageLine | None, seconds: float) -> tuple[bool, bool]:
        """Wait until a message can be received here or from another line.

        Args:
            other: The other line; None watches only this one.
            seconds: The maximum time [s].

        Returns:
            Whether something can be received here, and from the other line.
        """
        held = other is not None and bool(other._rest)
        watched = [line._connection for line in (self, other) if line is not None]
        with contextlib.suppress(OSError, ValueError), selectors.DefaultSelector() as selector:
            for connection in watched:
                selector.register(connection, selectors.EVENT_READ)
            ready = {key.fileobj for key, _ in selector.select(0.0 if held else seconds)}
            return watched[0] in ready, held or (watched[-1] in ready and other is not None)
        return True, other is not None

    def unread(self, message: bytes) -> None:
        """Put a message back, so that it is received next.

        Args:
            message: The message.
        """
        self._rest = message + self._rest

    @property
    def cut(self) -> bool:
        """Whether the other end is gone, even if there is still something to read that it sent before.

        Systems without POLLRDHUP (all but Linux) notice only once everything is read.
        """
        if hasattr(select, "POLLRDHUP"):
            poll = select.poll()
            try:
                poll.register(self._connection, select.POLLRDHUP)
                return bool(poll.poll(0))
            except (OSError, ValueError):  # closed on this side
                return True
        try:
            return not self._connection.recv(1, socket.MSG_PEEK | getattr(socket, "MSG_DONTWAIT", 0))
        except BlockingIOError:
            return False
        except OSError:
            return True

    def hang_up(self) -> None:
        """End the connection, from any thread. The other end gets what was sent before, and a read here returns."""
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """End the connection, in the thread that reads here."""
        self.hang_up()
        self._connection.close()
