"""The shapes of command payloads: SUMO ends on one byte too few or too many, so it must receive neither.

The facts are those of SUMO 1.28, from its ``traci`` wheel and from calls of the program with payloads that do not fit.
SUMO also ends on an error of more than 255 bytes, on huge numbers, on an unknown vehicle class or icon, and on a
context of variables that its objects do not have.

A shape is a string with one letter per value, as in ``traci``. Each of these values comes after the byte of its type:
``i`` integer, ``d`` double, ``b`` byte, ``B`` unsigned byte, ``s`` string, ``l`` list of strings, ``v`` list of vehicle
classes, ``n`` name of an icon, ``f`` list of doubles, ``c`` colour, ``p`` polygon, ``o``/``O``/``g``/``G`` positions,
``r`` a place on a road. ``u`` is an unsigned byte without a type. ``(...)`` is a compound of these values, of which
those in ``[...]`` may be missing. ``{...}`` is a compound of any number of such values.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

_INT = struct.Struct("!i")
_FIXED = {  # letter -> type, number of bytes after it
    "i": (0x09, 4), "d": (0x0B, 8), "b": (0x08, 1), "B": (0x07, 1), "c": (0x11, 4),
    "o": (0x01, 16), "O": (0x03, 24), "g": (0x00, 16), "G": (0x02, 24),
}  # fmt: skip
_SIZED = {"s": 0x0C, "n": 0x0C, "l": 0x0E, "v": 0x0E, "f": 0x10, "p": 0x06, "r": 0x04}
_COMPOUND = 0x0F
_PARAMETER, _PROGRAM = 0x7E, 0x2C
_PAIR = bytes((_SIZED["l"],)) + _INT.pack(2)  # beginning of a list of two strings
MAX_OBJECT_NAME_BYTES = 170  # for a single name: SUMO puts it into an error, which has at most 255
MAX_NUMBER = 1e10  # a position of 1e308 ends SUMO
MAX_NAME_BYTES = 80  # for a name if an error may hold two
_CLASSES = frozenset(
    b"private emergency authority army vip pedestrian passenger hov taxi bus coach delivery truck trailer motorcycle "
    b"moped bicycle evehicle tram rail_urban rail rail_electric rail_fast ship container cable_car subway aircraft "
    b"wheelchair scooter drone custom1 custom2 all ignoring".split()
)
_ICONS = frozenset((b"", b"pin", b"hotel", b"fuel", b"tree", b"charging_station"))

Shapes = tuple[str, ...]
NO_ARGUMENTS: Shapes = ("",)

ANY_GET: Mapping[int, Shapes] = {0x7E: ("s",), 0x3E: ("s",)}
"""Maps a variable to its shapes, the same for all getters."""
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
"""Maps the number of a getter and a variable to the shapes of its parameters. A variable that is missing has none."""

NOT_SUBSCRIBED = frozenset({(0xA2, 0x32), (0xAB, 0x82), (0xAB, 0x83), (0xAB, 0x86), (0xAB, 0x87)})
"""Getters and variables that SUMO cannot maintain as a subscription."""

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
"""Maps a getter to the variables that every object within a context has."""

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
"""Maps a variable to its shapes, the same for all setters."""
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
"""Maps the number of a setter and a variable to the shapes of its value.

A client may not set a variable that is missing.
"""


class Misfit(Exception):
    """A payload ends too early or too late, or has another type than expected."""


def fits(payload: bytes, at: int, shapes: Shapes) -> bool:
    """Return whether the payload from a byte on has one of the shapes, to the last byte.

    Args:
        payload: The payload.
        at: The index of the byte.
        shapes: The shapes.
    """
    return any(_ends(payload, at, shape) == len(payload) for shape in shapes)


def name_end(payload: bytes, at: int) -> int:
    """Return the end of the string that begins with its length.

    Args:
        payload: The payload.
        at: The index of its first byte.

    Raises:
        Misfit: The payload ends before the string.
    """
    if at + 4 > len(payload):
        raise Misfit
    size = _INT.unpack_from(payload, at)[0]
    if size < 0 or at + 4 + size > len(payload):
        raise Misfit
    return int(at + 4 + size)


def context_fits(payload: bytes, at: int, domain: int) -> bool:
    """Return whether the objects of a domain have all variables of a context.

    Args:
        payload: The payload.
        at: The index of the variables' count, which the variables follow.
        domain: The number of the domain's getter.
    """
    allowed = CONTEXTUAL.get(domain)
    variables = payload[at + 1 :]
    return allowed is not None and at < len(payload) == at + 1 + payload[at] and allowed.issuperset(variables)


def get_shapes(number: int, variable: int) -> Shapes:
    """Return the shapes of a getter's parameters, which follow the object's name.

    Args:
        number: The number of the getter.
        variable: The variable.
    """
    return GET.get(number, {}).get(variable) or ANY_GET.get(variable, NO_ARGUMENTS)


def set_shapes(number: int, variable: int) -> Shapes | None:
    """Return the shapes of a setter's value, which follows the object's name.

    Args:
        number: The number of the setter.
        variable: The variable.

    Returns:
        The shapes; None if there is no such setter.
    """
    return SET.get(number, {}).get(variable) or ANY_SET.get(variable)


def keys_set(payload: bytes, at: int, variable: int) -> list[bytes]:
    """Return the names of the parameters that a setter sets.

    They are the key of ``setParameter``, and the keys in a program of a traffic light, which holds lists of key and
    value.

    Args:
        payload: The payload, which fits.
        at: The index at which the value begins.
        variable: The variable.
    """
    if variable == _PARAMETER:
        begin = at + 1 + 4 + 1  # the compound, its count, and the type of the key
        return [payload[begin + 4 : name_end(payload, begin)]]
    if variable != _PROGRAM:
        return []
    pairs = (k + len(_PAIR) for k in range(at, len(payload)) if payload.startswith(_PAIR, k))
    return [payload[begin + 4 : begin + 4 + _INT.unpack_from(payload, begin)[0]] for begin in pairs]


def subscribed(payload: bytes, at: int, domain: int) -> list[bytes]:
    """Return the variables of a subscription, each with its parameters.

    Args:
        payload: The payload.
        at: The index of the variables' count.
        domain: The number of the domain's getter.

    Raises:
        Misfit: SUMO could not read the payload.
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
    """A compound value.

    Attributes:
        items: Its items.
        least: The minimum number of items.
        many: Whether its first item may come any number of times.
    """

    items: tuple[str | _Compound, ...]
    least: int
    many: bool


@cache
def _items(shape: str) -> tuple[str | _Compound, ...]:
    """Parse a shape."""
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
    """Return the end of a value of this shape; -1 if there is none."""
    try:
        for item in _items(shape):
            at = _value(payload, at, item)
    except Misfit:
        return -1
    return at


def _value(payload: bytes, at: int, item: str | _Compound) -> int:
    """Return the end of a value; raise Misfit if it does not fit."""
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
    """Return the end of a compound; raise Misfit if it does not fit."""
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
    """Return the end of some doubles; raise Misfit if one is too large or missing."""
    if at + 8 * count > len(payload):
        raise Misfit
    if not all(-MAX_NUMBER <= number <= MAX_NUMBER for number in struct.unpack_from(f"!{count}d", payload, at)):
        raise Misfit
    return at + 8 * count


def _sized(payload: bytes, at: int, letter: str) -> int:
    """Return the end of a value with its own size; raise Misfit if it does not fit."""
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
    """Return the end of a name; raise Misfit if it is longer than ``MAX_NAME_BYTES``."""
    end = name_end(payload, at)
    if end - at - 4 > MAX_NAME_BYTES:
        raise Misfit
    return end
