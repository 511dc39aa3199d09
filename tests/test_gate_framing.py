"""Messages, commands, shapes and rules, byte by byte."""

from __future__ import annotations

import socket
import struct
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sumo_adv.serve import framing, shapes
from sumo_adv.serve.framing import FramingError, Gone, MessageLine, make_command, make_message, make_status, split
from sumo_adv.serve.policy import Policy, Rules
from sumo_adv.serve.seat import errors

NAME = struct.pack("!i", 3) + b"ego"
SPEED = b"\x0b" + struct.pack("!d", 7.0)
commands = st.lists(st.tuples(st.integers(0, 255), st.binary(max_size=600)), min_size=1, max_size=5)


class Quiet(Exception):
    """Nothing came."""


def quiet() -> None:
    raise Quiet


def line() -> tuple[MessageLine, socket.socket]:
    """Ours and the other end."""
    listener = socket.create_server(("127.0.0.1", 0))
    far_end = socket.create_connection(listener.getsockname())
    accepted, _ = listener.accept()
    listener.close()
    return MessageLine(accepted, framing.MAX_MESSAGE_BYTES), far_end


@given(commands)
def test_what_is_made_is_split_again(made: list[tuple[int, bytes]]) -> None:
    parsed = split(make_message(*(make_command(*command) for command in made)))
    assert [(command.number, command.payload) for command in parsed] == made
    assert b"".join(command.raw for command in parsed) == b"".join(make_command(*command) for command in made)


@given(st.binary(max_size=60))
def test_any_bytes_are_split_whole_or_refused(body: bytes) -> None:
    try:
        parsed = split(make_message(body))
    except FramingError:
        return
    assert b"".join(command.raw for command in parsed) == body


@given(st.binary(max_size=60), st.sampled_from(sorted(shapes.SET)), st.binary(min_size=1, max_size=1))
def test_no_payload_raises(body: bytes, setter: int, variable: bytes) -> None:
    policy = Policy(Rules(), ["ego"])
    for number in (setter, setter - 0x20, setter + 0x10, setter - 0x40, framing.FILTER, 0x99):
        for payload in (body, variable + NAME + body, bytes(16) + NAME + body):
            policy.refusal(split(make_message(make_command(number, payload)))[0])


def test_a_command_by_hand() -> None:
    assert make_command(0xA4, b"\x40" + NAME) == b"\x0a\xa4\x40\0\0\0\3ego"
    assert make_message(b"\x02\x02") == b"\0\0\0\x06\x02\x02"
    assert make_status(0xC4, framing.STATUS_ERROR, "no") == b"\x09\xc4\xff\0\0\0\2no"
    long = make_status(0xC4, framing.STATUS_ERROR, "ü" * 300)
    assert long[0] == 0xFD and long[7:].decode() == "ü" * 123
    assert make_command(1, bytes(253))[0] == 255 and make_command(1, bytes(254))[:5] == b"\0\0\0\1\4"
    assert framing.accepted(make_message(make_status(2))) and not framing.accepted(make_message(long))


@pytest.mark.parametrize(
    "body", [b"\x01", b"\x05\xa4", b"\0", b"\0\0\0\0\5", b"\0\xff\xff\xff\xff\2", b"\0\x7f\0\0\0\2"]
)
def test_lengths_that_do_not_add_up(body: bytes) -> None:
    with pytest.raises(FramingError):
        split(make_message(body))


def test_a_refusal_answers_every_command_and_lets_close_be() -> None:
    answers = split(errors(make_message(make_command(0xA4, b"x"), make_command(framing.CLOSE)), "No."))
    assert [(answer.number, answer.payload[0]) for answer in answers] == [(0xA4, 0xFF), (framing.CLOSE, 0)]


@given(st.lists(st.integers(1, 40), min_size=1, max_size=12), st.integers(1, 4))
def test_messages_come_whole_however_they_are_cut(cuts: list[int], count: int) -> None:
    ours, far_end = line()
    messages = [make_message(make_command(k, bytes([k]) * 17)) for k in range(count)]
    stream, at = b"".join(messages), 0
    for cut in [*cuts, len(stream)]:
        far_end.sendall(stream[at : at + cut])
        at += cut
    assert [ours.receive(quiet) for _ in messages] == messages
    ours.close()
    far_end.close()


def test_half_a_message_is_kept_until_the_rest_comes() -> None:
    ours, far_end = line()
    far_end.sendall(b"\0\0\0\x08\x04\2")
    with pytest.raises(Quiet):
        ours.receive(quiet)
    far_end.sendall(b"ab")
    assert ours.receive(quiet) == b"\0\0\0\x08\x04\2ab"
    assert not ours.cut
    far_end.sendall(b"\0\0")
    far_end.close()
    with pytest.raises(Gone, match="middle of a message"):
        ours.receive(quiet)
    assert ours.cut
    ours.close()


@pytest.mark.parametrize("length", [-(2**31), -1, 0, 5, framing.MAX_MESSAGE_BYTES + 1, 2**31 - 1])
def test_lengths_are_bounded(length: int) -> None:
    ours, far_end = line()
    far_end.sendall(struct.pack("!i", length))
    with pytest.raises(FramingError, match=str(length)):
        ours.receive(quiet)
    far_end.close()
    ours.close()


@pytest.mark.parametrize(
    ("shape", "payload", "fits"),
    [
        ("", b"", True), ("", b"\0", False), ("d", SPEED, True), ("d", SPEED + b"\0", False), ("d", SPEED[:-1], False),
        ("i", SPEED, False), ("d", b"\x0b" + struct.pack("!d", float("nan")), False), ("s", b"\x0c" + NAME, True),
        ("s", b"\x0c\xff\xff\xff\xff", False), ("s", b"\x0c\0\0\0\x51" + b"x" * 81, False),
        ("(dd)", b"\x0f\0\0\0\2" + SPEED * 2, True), ("(dd)", b"\x0f\0\0\0\1" + SPEED, False),
        ("(d[d])", b"\x0f\0\0\0\1" + SPEED, True), ("(d[d])", b"\x0f\0\0\0\3" + SPEED * 3, False),
        ("{d}", b"\x0f\0\0\0\3" + SPEED * 3, True), ("{d}", b"\x0f\x7f\0\0\0" + SPEED, False),
        ("()", b"\x0f\0\0\0\0", True), ("l", b"\x0e\0\0\0\2" + NAME * 2, True),
        ("(ru)", b"\x0f\0\0\0\2\x04" + NAME + bytes(9) + b"\1", True), ("p", b"\x06\2" + bytes(32), True),
        ("p", b"\x06\0\0\0\0\2" + bytes(32), True), ("p", b"\x06\3" + bytes(32), False),
        ("l", b"\x0e\0\0\0\3" + NAME * 2, False), ("v", b"\x0e\0\0\0\1" + NAME, False), ("c", b"\x11abcd", True),
    ],
)  # fmt: skip
def test_shapes(shape: str, payload: bytes, fits: bool) -> None:
    assert shapes.fits(b"xx" + payload, 2, (shape,)) is fits


def refused(policy: Policy, number: int, payload: bytes) -> bool:
    return policy.refusal(split(make_message(make_command(number, payload)))[0]) is not None


def test_rules_by_hand() -> None:
    policy = Policy(Rules(), ["ego"])
    other_name = struct.pack("!i", 5) + b"other"
    assert not refused(policy, 0xA4, b"\x40" + other_name)
    assert not refused(policy, 0xC4, b"\x40" + NAME + SPEED) and refused(policy, 0xC4, b"\x40" + other_name + SPEED)
    assert refused(policy, 0xC4, b"\xfe" + NAME + SPEED)
    assert refused(policy, 0xCB, b"\x95" + bytes(4) + b"\x0c" + NAME) and refused(policy, framing.LOAD, b"")
    assert refused(policy, framing.EXECUTEMOVE, b"")
    add = split(make_message(make_command(0xC6, b"\x80" + other_name + b"\x0e\0\0\0\1" + NAME)))[0]
    assert policy.refusal(add) is None and refused(policy, 0xC6, b"\x81" + other_name)
    policy.took(add)
    assert not refused(policy, 0xC6, b"\x81" + other_name)


def named(name: bytes) -> bytes:
    return struct.pack("!i", len(name)) + name


@pytest.mark.parametrize("name", [b"\xff\xfe", b"a\0b", b"two\nlines", b"sumo_adv.ego.route.0"])
def test_nothing_is_added_under_a_name_that_is_no_text_or_ours(name: bytes) -> None:
    """The server reads all names, and adds routes of its own."""
    policy = Policy(Rules(), ["ego"])
    edges = b"\x0e\0\0\0\1" + NAME
    assert not refused(policy, 0xC6, b"\x80" + named(b"mine") + edges)
    assert refused(policy, 0xC6, b"\x80" + named(name) + edges)
    assert not refused(policy, 0xC5, b"\x88" + NAME + b"\x0c" + named(b"mine"))
    assert refused(policy, 0xC5, b"\x88" + NAME + b"\x0c" + named(name))


def test_an_ego_that_the_server_inserts_is_neither_added_nor_removed_by_its_client() -> None:
    remove = b"\x81" + NAME + b"\x08\0"
    assert not refused(Policy(Rules(), ["ego"]), 0xC4, remove)
    assert refused(Policy(Rules(), ["ego"], ["ego"]), 0xC4, remove)
    assert not refused(Policy(Rules(), ["ego"], ["ego"]), 0xC4, b"\x40" + NAME + SPEED)


def test_contexts_only_of_variables_that_the_objects_have() -> None:
    policy = Policy(Rules(), [])
    begin = bytes(16) + NAME
    reach = struct.pack("!d", 50.0)
    assert not refused(policy, 0x84, begin + b"\xa4" + reach + b"\2\x40\x42")
    assert refused(policy, 0x84, begin + b"\xaa" + reach + b"\1\x40")  # edges have no such variable
    assert refused(policy, 0x84, begin + b"\xa4" + reach + b"\1\x68")  # a leader needs a distance
    assert refused(policy, 0x84, begin + b"\xa6" + reach + b"\1\x00") and refused(policy, 0x84, begin + b"\xa4" + reach)
    assert not refused(policy, 0x84, begin + b"\xa4" + reach + b"\0")


def test_whoever_takes_an_answer_in_sips_is_looked_at_too() -> None:
    """Up to 100 kB each 10 ms of 40 MB: there is always room for a little more."""
    ours, far = line()

    def sip() -> None:
        while far.recv(100_000):
            time.sleep(0.01)

    began = time.monotonic()
    sipping = threading.Thread(target=sip, daemon=True)
    sipping.start()

    def idle() -> None:
        if time.monotonic() - began > 0.3:
            raise TimeoutError

    with pytest.raises(TimeoutError):
        ours.send(bytes(40_000_000), idle)
    assert time.monotonic() - began < 2.0
    ours.close()
    sipping.join(5.0)
    far.close()
