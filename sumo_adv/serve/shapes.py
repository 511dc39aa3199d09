"""What a command's payload must look like: SUMO ends on one byte too few or too many, so it gets neither.

Facts of SUMO 1.28, from its ``traci`` wheel and from asking the program with payloads that do not fit.

A shape is a string, one letter a value, as in ``traci``: ``i`` integer, ``d`` double, ``b`` byte, ``B`` unsigned byte,
``s`` string, ``l`` list of strings, ``f`` list of doubles, ``c`` colour, ``p`` polygon, ``o``/``O``/``g``/``G``
positions, ``r`` a place on a road, each after the byte of its type; ``u`` an unsigned byte without one; ``(...)`` a
compound of so many values, those in ``[...]`` may be missing; ``*`` any one value.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from functools import cache

_INT = struct.Struct("!i")
_FIXED = {  # letter -> type, bytes after it
    "i": (0x09, 4), "d": (0x0B, 8), "b": (0x08, 1), "B": (0x07, 1), "c": (0x11, 4),
    "o": (0x01, 16), "O": (0x03, 24), "g": (0x00, 16), "G": (0x02, 24),
}  # fmt: skip
_SIZED = {"s": 0x0C, "l": 0x0E, "f": 0x10, "p": 0x06, "r": 0x04}
_LETTERS = {kind: letter for letter, (kind, _) in _FIXED.items()} | {kind: letter for letter, kind in _SIZED.items()}
_COMPOUND = 0x0F
_DEEPEST = 6  # compounds within compounds

Shapes = tuple[str, ...]
NONE: Shapes = ("",)

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

_STAGE = "(isssldddsddds)"
_TYPE: Mapping[int, Shapes] = {
    0x26: ("d",), 0x2F: ("d",), 0x41: ("d",), 0x44: ("d",), 0x46: ("d",), 0x47: ("d",), 0x48: ("d",), 0x4C: ("d",),
    0x4D: ("d",), 0x5D: ("d",), 0x5E: ("d",), 0x5F: ("d",), 0x7B: ("d",), 0x7C: ("d",), 0x7D: ("d",), 0x8E: ("d",),
    0xBA: ("d",), 0xBB: ("d",), 0xBC: ("d",), 0xC8: ("d",),
    0x45: ("c",), 0x49: ("s",), 0x4A: ("s",), 0x4B: ("s",), 0xB9: ("s",),
}  # fmt: skip
_EFFORT = ("(s)", "(sd)", "(ddsd)")
_SPAN = ("(d)", "(ddd)")
_STOP = "(sdb[diddib])"
ANY_SET: Mapping[int, Shapes] = {0x7E: ("(ss)",)}
"""Variable -> shapes, the same for all setters."""
SET: Mapping[int, Mapping[int, Shapes]] = {
    0x44: {0x9B: ("l",)},
    0x45: {0x97: ("d",), 0x98: ("d",), 0x99: ("i",), 0x9A: ("d",), 0x9C: ("d",)},
    0x47: {0x18: ("(ddddssss)",)},
    0xC0: {0x22: ("d",)},
    0xC2: {
        0x1B: ("s",), 0x20: ("s",), 0x22: ("i",), 0x23: ("s",), 0x24: ("d",), 0x2C: ("(sii*[*])",), 0x35: ("(sss)",),
        0x36: ("s",), 0x37: ("(sssii)",),
    },
    0xC3: {0x34: ("l",), 0x35: ("l",), 0x3C: ("(lb)",), 0x3D: ("d",), 0x41: ("d",), 0x44: ("d",)},
    0xC4: {
        **_TYPE,
        0x12: ("(sdbd[bdd])",), 0x13: ("(bd[b])",), 0x14: ("(dd)",), 0x15: ("d",), 0x16: ("(dddd[ds])",),
        0x17: ("(sdbdiddib)",), 0x18: ("(sdbdiddib)",), 0x19: ("()",), 0x21: ("l",), 0x31: ("s",),
        0x3C: ("(d[d])", "d"), 0x40: ("d",), 0x4F: ("s",), 0x53: ("s",), 0x55: ("(issb)",), 0x57: ("l",),
        0x58: _EFFORT, 0x59: _EFFORT, 0x5B: ("i",), 0x5C: ("(sd[i])",), 0x6A: ("",), 0x6C: ("(c[dBdB])",),
        0x72: ("(dd)",), 0x81: ("b",), 0x85: ("(ssssssssssssii)",), 0x89: ("i",), 0x90: ("()",), 0x91: ("()",),
        0xB3: ("i",), 0xB4: ("(siddd[bd])",), 0xB6: ("i",), 0xB8: ("d",), 0xBD: ("s",), 0xBE: ("l",), 0xC2: ("(s)",),
    },
    0xC5: {**_TYPE, 0x88: ("s",)},
    0xC6: {0x80: ("l",), 0x81: ("",)},
    0xC7: {
        0x42: ("o",), 0x43: ("d",), 0x45: ("c",), 0x4D: ("d",), 0x4F: ("s",), 0x6C: ("(c[dBdB])",),
        0x80: ("(sciosddd[s])", "(scio)"), 0x81: ("i",), 0x93: ("s",), 0xBC: ("d",),
    },
    0xC8: {
        0x45: ("c",), 0x4D: ("d",), 0x4E: ("p",), 0x4F: ("s",), 0x55: ("i",), 0x5C: ("(sffBB)",),
        0x80: ("(scBip[d])",), 0x81: ("i",),
    },
    0xCA: {0x34: ("l",), 0x35: ("l",), 0x3D: ("d",), 0x41: ("d",), 0x58: _SPAN, 0x59: _SPAN},
    0xCD: {0x22: ("i",)},
    0xCE: {
        **_TYPE,
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
    """Where the string that begins at ``at`` with its length ends.

    Raises:
        Misfit: the payload ends before.
    """
    if at + 4 > len(payload):
        raise Misfit
    size = _INT.unpack_from(payload, at)[0]
    if size < 0 or at + 4 + size > len(payload):
        raise Misfit
    return int(at + 4 + size)


def get_shapes(number: int, variable: int) -> Shapes:
    """What must follow the object's name in a getter."""
    return GET.get(number, {}).get(variable) or ANY_GET.get(variable, NONE)


def set_shapes(number: int, variable: int) -> Shapes | None:
    """What must follow the object's name in a setter; None: there is no such setter."""
    return SET.get(number, {}).get(variable) or ANY_SET.get(variable)


def subscription_end(payload: bytes, at: int, domain: int) -> int:
    """Where the variables of a subscription end, each with its parameters. ``at``: their count; ``domain``: its getter.

    Raises:
        Misfit: SUMO could not read it.
    """
    if at >= len(payload):
        raise Misfit
    count, at = payload[at], at + 1
    for _ in range(count):
        if at >= len(payload):
            raise Misfit
        ends = [end for shape in get_shapes(domain, payload[at]) if (end := _ends(payload, at + 1, shape)) > 0]
        if not ends:
            raise Misfit
        at = ends[0]
    return at


_Item = str | tuple[int, tuple["_Item", ...]]


@cache
def _items(shape: str) -> tuple[int, tuple[_Item, ...]]:
    """The values of a shape, compounds as (how many must be there, values)."""
    stack: list[list[_Item]] = [[]]
    needed: list[int | None] = [None]
    for letter in shape:
        if letter == "(":
            stack.append([])
            needed.append(None)
        elif letter == ")":
            inside, least = stack.pop(), needed.pop()
            stack[-1].append((len(inside) if least is None else least, tuple(inside)))
        elif letter == "[":
            needed[-1] = len(stack[-1])
        elif letter != "]":
            stack[-1].append(letter)
    return len(stack[0]), tuple(stack[0])


def _ends(payload: bytes, at: int, shape: str) -> int:
    """Where a value of this shape ends, -1 if there is none."""
    try:
        for item in _items(shape)[1]:
            at = _value(payload, at, item, 0)
    except Misfit:
        return -1
    return at


def _value(payload: bytes, at: int, item: _Item, depth: int) -> int:
    if item == "u":
        return at + 1
    if at >= len(payload) or depth > _DEEPEST:
        raise Misfit
    kind = payload[at]
    if isinstance(item, tuple) or (item == "*" and kind == _COMPOUND):
        return _compound(payload, at, item, depth)
    letter = _LETTERS.get(kind)
    if letter is None or (letter != item and item != "*"):
        raise Misfit
    if letter in _FIXED:
        return at + 1 + _FIXED[letter][1]
    return _sized(payload, at + 1, letter)


def _compound(payload: bytes, at: int, item: _Item, depth: int) -> int:
    if payload[at] != _COMPOUND or at + 5 > len(payload):
        raise Misfit
    count = _INT.unpack_from(payload, at + 1)[0]
    if isinstance(item, tuple):
        least, items = item
        if not least <= count <= len(items):
            raise Misfit
    elif not 0 <= count <= len(payload):
        raise Misfit
    at += 5
    for k in range(count):
        at = _value(payload, at, items[k] if isinstance(item, tuple) else "*", depth + 1)
    return at


def _sized(payload: bytes, at: int, letter: str) -> int:
    if letter in "sr":
        return name_end(payload, at) + (9 if letter == "r" else 0)
    if letter == "p":
        if at >= len(payload):
            raise Misfit
        if payload[at]:
            return at + 1 + 16 * payload[at]
        at += 1
    if at + 4 > len(payload):
        raise Misfit
    count = _INT.unpack_from(payload, at)[0]
    if not 0 <= count <= len(payload):
        raise Misfit
    at += 4
    if letter == "l":
        for _ in range(count):
            at = name_end(payload, at)
        return at
    return int(at + (16 if letter == "p" else 8) * count)
