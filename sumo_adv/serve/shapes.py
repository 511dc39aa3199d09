"""What a command's payload must look like: SUMO ends on one byte too few or too many, so it gets neither.

Facts of SUMO 1.28, from its ``traci`` wheel and from asking the program with payloads that do not fit. It also ends on
an error of more than 255 bytes, on huge numbers, on a vehicle class or icon it does not know, and on a
context of variables that its objects do not have.

A shape is a string, one letter a value, as in ``traci``: ``i`` integer, ``d`` double, ``b`` byte, ``B`` unsigned byte,
``s`` string, ``l`` list of strings, ``v`` list of vehicle classes, ``n`` an icon's name, ``f`` list of doubles, ``c``
colour, ``p`` polygon, ``o``/``O``/``g``/``G`` positions, ``r`` a place on a road, each after the byte of its type;
``u`` an unsigned byte without one; ``(...)`` a compound of these values, those in ``[...]`` may be missing;
``{...}`` a compound of any number of such values.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

_INT = struct.Struct("!i")
_FIXED = {  # letter -> type, bytes after it
    "i": (0x09, 4), "d": (0x0B, 8), "b": (0x08, 1), "B": (0x07, 1), "c": (0x11, 4),
    "o": (0x01, 16), "O": (0x03, 24), "g": (0x00, 16), "G": (0x02, 24),
}  # fmt: skip
_SIZED = {"s": 0x0C, "n": 0x0C, "l": 0x0E, "v": 0x0E, "f": 0x10, "p": 0x06, "r": 0x04}
_COMPOUND = 0x0F
_PARAMETER, _PROGRAM = 0x7E, 0x2C
_PAIR = bytes((_SIZED["l"],)) + _INT.pack(2)  # what a list of two strings begins with
MAX_OBJECT_NAME_BYTES = 170  # bytes of a name that comes alone: SUMO puts it into an error, which has at most 255
MAX_NUMBER = 1e10  # of a number; SUMO dies of a position of 1e308
MAX_NAME_BYTES = 80  # bytes of a name where an error may hold two
_CLASSES = frozenset(
    b"private emergency authority army vip pedestrian passenger hov taxi bus coach delivery truck trailer motorcycle "
    b"moped bicycle evehicle tram rail_urban rail rail_electric rail_fast ship container cable_car subway aircraft "
    b"wheelchair scooter drone custom1 custom2 all ignoring".split()
)
_ICONS = frozenset((b"", b"pin", b"hotel", b"fuel", b"tree", b"charging_station"))

Shapes = tuple[str, ...]
NO_ARGUMENTS: Shapes = ("",)

ANY_GET: Mapping[int, Shapes] = {0x7E: ("s",), 0x3E: ("s",)}
"""Variable -> shapes, the same for all getters."""
GET: Mapping[int, Mapping[int, Shapes]] = {
    0x2A: {0x16: ("(ss)",), 0x17: ("s",)},
    0xA2: {0x25: ("i",), 0x30: ("i",), 0x31: ("i",), 0x67: ("i",), 0x2F: ("s",), 0x34: ("s",), 0x32: ("(sss)",)},
    0xA3: {0x37: ("s",), 0x3C: ("b",), 0x43: ("d",)},
    0xA4: {
        0x13: ("i",), 0x1C: ("(dddds)",), 0x1D: ("(dd)",), 0x1E: ("(ddds)",), 0x20: ("i",), 0x37: ("d",),
        0x55: ("(isb)",), 0x58: ("(ds)",), 0x59: ("(ds)",), 0x68: ("d",), 0x74: ("i",), 0x78: ("d",),
        0x83: ("(ru)", "(ou)", "(Ou)"), 0xBF: ("B",),
    },
    0xAA: {0x43: ("d",), 0x58: ("d",), 0x59: ("d",)},
    0xAB: {
        0x82: ("(rB)", "(oB)", "(OB)", "(gB)", "(GB)", "(oBs)", "(OBs)", "(gBs)", "(GBs)"),
        0x83: tuple(f"({a}{b}u)" for a in "roOgG" for b in "roOgG"),
        0x86: ("(sssdidd)",), 0x87: ("(sssdidddddsss)",),
    },
    0xAE: {0x54: ("i",), 0x83: ("(ru)", "(ou)", "(Ou)"), 0xC0: ("i",), 0xC6: ("i",), 0xC7: ("l",)},
}  # fmt: skip
"""Number of a getter -> variable -> shapes of its parameters; a variable that is not here has none."""

NOT_SUBSCRIBED = frozenset({(0xA2, 0x32), (0xAB, 0x82), (0xAB, 0x83), (0xAB, 0x86), (0xAB, 0x87)})
"""Getter and variable that SUMO cannot keep up as a subscription."""

CONTEXTUAL: Mapping[int, frozenset[int]] = {
    number: frozenset(bytes.fromhex(variables))
    for number, variables in {
        0x24: "00011b42515668699b",
        0x25: "00011b42515668699798999a9c",
        0xA0: "000110111213151617232425262728292a4251",
        0xA3: "000110111213141530313334353d41444d4e5a60616263646566717a7f94",
        0xA4: "00011a1f222425262f32333638393a3b404142434445464748494a4b4c4d4f5051525354565b5d5e5f606162636465666769"
              "707172737a7b7c7d7f8487898c8e92959da1a2b1b2b3b5b6b7b8b9babbbcbdbec8",
        0xA7: "0001394243454d4f93bc",
        0xA8: "0001454d4e4f55bc",
        0xA9: "000139424e7b7c",
        0xAA: "00011011121314151a1b3d525a60616263646566717a7b7c7f94",
        0xAD: "00011011121314181923242527282932333435424451",
        0xAE: "0001262f363839404142434445464748494a4b4c4d4f5051565d5e5f7a7b7c7d8eb9babbbcc1c2c3c8",
        0xAF: "00011b425156676869ef",
    }.items()
}  # fmt: skip
"""Getter -> variables that every object within a context has."""

_STAGE = "(isssldddsddds)"
_SHAPES_OF_TYPE: Mapping[int, Shapes] = {
    0x26: ("d",), 0x2F: ("d",), 0x41: ("d",), 0x44: ("d",), 0x46: ("d",), 0x47: ("d",), 0x48: ("d",), 0x4C: ("d",),
    0x4D: ("d",), 0x5D: ("d",), 0x5E: ("d",), 0x5F: ("d",), 0x7B: ("d",), 0x7C: ("d",), 0x7D: ("d",), 0x8E: ("d",),
    0xBA: ("d",), 0xBB: ("d",), 0xBC: ("d",), 0xC8: ("d",),
    0x45: ("c",), 0x49: ("s",), 0x4A: ("s",), 0x4B: ("s",), 0xB9: ("s",),
}  # fmt: skip
_EFFORT = ("(s)", "(sd)", "(ddsd)")
_SPAN = ("(d)", "(ddd)")
ANY_SET: Mapping[int, Shapes] = {0x7E: ("(ss)",)}
"""Variable -> shapes, the same for all setters."""
SET: Mapping[int, Mapping[int, Shapes]] = {
    0x44: {0x9B: ("l",)},
    0x45: {0x97: ("d",), 0x98: ("d",), 0x99: ("i",), 0x9A: ("d",), 0x9C: ("d",)},
    0x47: {0x18: ("(ddddssss)",)},
    0xC0: {0x22: ("d",)},
    0xC2: {
        0x1B: ("s",), 0x20: ("s",), 0x22: ("i",), 0x23: ("s",), 0x24: ("d",), 0x2C: ("(sii{(dsdd{i}s)}{l})",),
        0x35: ("(sss)",), 0x36: ("s",), 0x37: ("(sssii)",),
    },
    0xC3: {0x34: ("v",), 0x35: ("v",), 0x3C: ("(vb)",), 0x3D: ("d",), 0x41: ("d",), 0x44: ("d",)},
    0xC4: {
        **_SHAPES_OF_TYPE,
        0x12: ("(sdbd[bdd])",), 0x13: ("(bd[b])",), 0x14: ("(dd)",), 0x15: ("d",), 0x16: ("(dddd[ds])",),
        0x17: ("(sdbdiddib)",), 0x18: ("(sdbdiddib)",), 0x19: ("()",), 0x21: ("l",), 0x31: ("s",),
        0x3C: ("(d[d])", "d"), 0x40: ("d",), 0x4F: ("s",), 0x53: ("s",), 0x55: ("(issb)",), 0x57: ("l",),
        0x58: _EFFORT, 0x59: _EFFORT, 0x5B: ("i",), 0x5C: ("(sd[i])",), 0x6A: ("",), 0x6C: ("(c[dBdB])",),
        0x72: ("(dd)",), 0x81: ("b",), 0x85: ("(ssssssssssssii)",), 0x89: ("i",), 0x90: ("()",), 0x91: ("()",),
        0xB3: ("i",), 0xB4: ("(siddd[bd])",), 0xB6: ("i",), 0xB8: ("d",), 0xBD: ("s",), 0xBE: ("l",), 0xC2: ("(s)",),
    },
    0xC5: {**_SHAPES_OF_TYPE, 0x88: ("s",)},
    0xC6: {0x80: ("l",), 0x81: ("",)},
    0xC7: {
        0x42: ("o",), 0x43: ("d",), 0x45: ("c",), 0x4D: ("d",), 0x4F: ("s",), 0x6C: ("(c[dBdB])",),
        0x80: ("(sciosddd[n])", "(scio)"), 0x81: ("i",), 0x93: ("s",), 0xBC: ("d",),
    },
    0xC8: {
        0x45: ("c",), 0x4D: ("d",), 0x4E: ("p",), 0x4F: ("s",), 0x55: ("i",), 0x5C: ("(sffBB)",),
        0x80: ("(scBip[d])",), 0x81: ("i",),
    },
    0xCA: {0x34: ("v",), 0x35: ("v",), 0x3D: ("d",), 0x41: ("d",), 0x58: _SPAN, 0x59: _SPAN},
    0xCD: {0x22: ("i",)},
    0xCE: {
        **_SHAPES_OF_TYPE,
        0x40: ("d",), 0x4F: ("s",), 0x5C: ("(sd[d])",), 0x80: ("(ssdd)",), 0x81: ("b",), 0x90: ("()",),
        0xB4: ("(sddd[bd])",), 0xC4: ("(idss)", "(ildd[ds])", "(iss[s])", _STAGE), 0xC5: ("i",),
        0xCD: (f"(i{_STAGE})",),
    },
}  # fmt: skip
"""Number of a setter -> variable -> shapes of its value; a variable that is not here is not for a client."""


class Misfit(Exception):
    """A payload that ends too early, too late, or has another type where one is expected."""


def fits(payload: bytes, at: int, shapes: Shapes) -> bool:
    """Whether what begins at byte ``at`` has one of the shapes, to the last byte."""
    return any(_ends(payload, at, shape) == len(payload) for shape in shapes)


def name_end(payload: bytes, at: int) -> int:
    """Where the string that begins at ``at`` with its length ends. Raises Misfit: the payload ends before."""
    if at + 4 > len(payload):
        raise Misfit
    size = _INT.unpack_from(payload, at)[0]
    if size < 0 or at + 4 + size > len(payload):
        raise Misfit
    return int(at + 4 + size)


def context_fits(payload: bytes, at: int, domain: int) -> bool:
    """Whether the variables from their count at ``at`` on are ones that the objects of a getter's domain have."""
    allowed = CONTEXTUAL.get(domain)
    variables = payload[at + 1 :]
    return allowed is not None and at < len(payload) == at + 1 + payload[at] and allowed.issuperset(variables)


def get_shapes(number: int, variable: int) -> Shapes:
    """What must follow the object's name in a getter."""
    return GET.get(number, {}).get(variable) or ANY_GET.get(variable, NO_ARGUMENTS)


def set_shapes(number: int, variable: int) -> Shapes | None:
    """What must follow the object's name in a setter; None: there is no such setter."""
    return SET.get(number, {}).get(variable) or ANY_SET.get(variable)


def keys_set(payload: bytes, at: int, variable: int) -> list[bytes]:
    """The names of parameters in a setter's value that begins at ``at`` and fits: of ``setParameter``, and those of a
    program of a traffic light, which are lists of key and value."""
    if variable == _PARAMETER:
        begin = at + 1 + 4 + 1  # the compound, its count, the type of the key
        return [payload[begin + 4 : name_end(payload, begin)]]
    if variable != _PROGRAM:
        return []
    pairs = (k + len(_PAIR) for k in range(at, len(payload)) if payload.startswith(_PAIR, k))
    return [payload[begin + 4 : begin + 4 + _INT.unpack_from(payload, begin)[0]] for begin in pairs]


def subscribed(payload: bytes, at: int, domain: int) -> list[bytes]:
    """The variables of a subscription, each with its parameters. ``at``: their count; ``domain``: its getter.

    Raises Misfit: SUMO could not read it.
    """
    if at >= len(payload):
        raise Misfit
    count, at = payload[at], at + 1
    values = []
    for _ in range(count):
        if at >= len(payload) or (domain, payload[at]) in NOT_SUBSCRIBED:
            raise Misfit
        ends = [end for shape in get_shapes(domain, payload[at]) if (end := _ends(payload, at + 1, shape)) > 0]
        if not ends:
            raise Misfit
        values.append(payload[at : ends[0]])
        at = ends[0]
    if at != len(payload):
        raise Misfit
    return values


@dataclass(frozen=True, slots=True)
class _Compound:
    """``least`` of its items must be there; ``many``: any number of each."""

    items: tuple[str | _Compound, ...]
    least: int
    many: bool


@cache
def _items(shape: str) -> tuple[str | _Compound, ...]:
    stack: list[list[str | _Compound]] = [[]]
    least: list[int | None] = [None]
    for letter in shape:
        if letter in "({":
            stack.append([])
            least.append(None)
        elif letter in ")}":
            inside, needed = stack.pop(), least.pop()
            stack[-1].append(_Compound(tuple(inside), len(inside) if needed is None else needed, letter == "}"))
        elif letter == "[":
            least[-1] = len(stack[-1])
        elif letter != "]":
            stack[-1].append(letter)
    return tuple(stack[0])


def _ends(payload: bytes, at: int, shape: str) -> int:
    """Where a value of this shape ends, -1 if there is none."""
    try:
        for item in _items(shape):
            at = _value(payload, at, item)
    except Misfit:
        return -1
    return at


def _value(payload: bytes, at: int, item: str | _Compound) -> int:
    if item == "u":
        return at + 1
    if at >= len(payload):
        raise Misfit
    if isinstance(item, _Compound):
        return _compound(payload, at, item)
    if item in _FIXED:
        kind, size = _FIXED[item]
        if payload[at] != kind:
            raise Misfit
        return _doubles(payload, at + 1, size // 8) if size >= 8 else at + 1 + size
    if payload[at] != _SIZED[item]:
        raise Misfit
    return _sized(payload, at + 1, item)


def _compound(payload: bytes, at: int, item: _Compound) -> int:
    if payload[at] != _COMPOUND or at + 5 > len(payload):
        raise Misfit
    count = _INT.unpack_from(payload, at + 1)[0]
    if not (0 <= count <= len(payload) if item.many else item.least <= count <= len(item.items)):
        raise Misfit
    at += 5
    for k in range(count):
        at = _value(payload, at, item.items[0 if item.many else k])
    return at


def _doubles(payload: bytes, at: int, count: int) -> int:
    if at + 8 * count > len(payload):
        raise Misfit
    if not all(-MAX_NUMBER <= number <= MAX_NUMBER for number in struct.unpack_from(f"!{count}d", payload, at)):
        raise Misfit
    return at + 8 * count


def _sized(payload: bytes, at: int, letter: str) -> int:
    if letter in "snr":
        end = _short_name(payload, at)
        if letter == "n" and payload[at + 4 : end] not in _ICONS:
            raise Misfit
        return _doubles(payload, end, 1) + 1 if letter == "r" else end
    if letter == "p":
        if at >= len(payload):
            raise Misfit
        if payload[at]:
            return _doubles(payload, at + 1, 2 * payload[at])
        at += 1
    if at + 4 > len(payload):
        raise Misfit
    count = _INT.unpack_from(payload, at)[0]
    if not 0 <= count <= len(payload):
        raise Misfit
    at += 4
    if letter in "lv":
        for _ in range(count):
            end = _short_name(payload, at)
            if letter == "v" and payload[at + 4 : end] not in _CLASSES:
                raise Misfit
            at = end
        return at
    return _doubles(payload, at, (2 if letter == "p" else 1) * count)


def _short_name(payload: bytes, at: int) -> int:
    end = name_end(payload, at)
    if end - at - 4 > MAX_NAME_BYTES:
        raise Misfit
    return end
