"""A planner's text: its form, which is checked without running it, and the helper functions that it may call.

A planner is Python text. Its first statement (after comments and a docstring) is a literal table of its parameters::

    PARAMETERS = {"gap": (2.0, 0.5, 8.0, "m", "how far before the ego the endpoint lies")}

    def endpoint(bv, ego, road, parameters, acc, horizon):
        x, y, heading, speed = at(ego["path"], horizon)
        px, py = offset((x, y, heading), ego["length"] + parameters["gap"], 0.0)
        return {"x": px, "y": py, "heading": heading, "speed": speed, "time": horizon}

Each entry is ``(default, low, high, unit, meaning)``. ``trajectory(bv, endpoint, road, dt)`` is optional. The checks in
this module give early and clear messages. They do not protect the program, which is the task of the sandbox.
"""

from __future__ import annotations

import ast
import keyword
import math
from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

from sumo_adv.datatypes import Parameter, Planner
from sumo_adv.errors import PlannerSyntaxError

MAX_PLANNER_BYTES = 32 * 1024
MAX_PARAMETERS = 12
MAX_PARAMETER_VALUE = 1e6  # in SI units; exceeds every distance, speed or time of an encounter
ENDPOINT_ARGUMENTS = ("bv", "ego", "road", "parameters", "acc", "horizon")
TRAJECTORY_ARGUMENTS = ("bv", "endpoint", "road", "dt")
REFUSED_NAMES = frozenset({"exec", "eval", "compile", "globals", "locals", "vars", "dir", "__import__"})
"""Names with which a planner could list and rebind the session's own helpers."""

HELPERS_TEXT = """\
Functions that are already there (do not define or import them):
at(path, t) -> (x, y, heading, speed): where a path is at time t [s]; path is a list of (t, x, y, heading, speed) with t
    ascending, such as ego["path"]; clamped at both ends, linear between, headings by the shorter way.
offset(pose, ahead, left) -> (x, y): the point `ahead` m along and `left` m to the left of pose = (x, y, heading, ...).
clip(v, low, high): v brought into [low, high].
wrap(angle): the same angle [rad] in (-pi, pi].
"""

HELPERS_CODE = """\
from math import ceil as _ceil, cos as _cos, sin as _sin


def clip(v, low, high):
    return low if v < low else high if v > high else v


def wrap(angle):
    return angle - 6.283185307179586 * _ceil((angle - 3.141592653589793) / 6.283185307179586)


def offset(pose, ahead, left):
    c = _cos(pose[2])
    s = _sin(pose[2])
    return (pose[0] + ahead * c - left * s, pose[1] + ahead * s + left * c)


def at(path, t):
    last = len(path) - 1
    a = path[0]
    if last == 0 or t <= a[0]:
        return (a[1], a[2], a[3], a[4])
    b = path[last]
    if t >= b[0]:
        return (b[1], b[2], b[3], b[4])
    i = int((t - a[0]) / (b[0] - a[0]) * last)
    if i >= last:
        i = last - 1
    while path[i][0] > t:
        i -= 1
    while path[i + 1][0] <= t:
        i += 1
    a = path[i]
    b = path[i + 1]
    f = (t - a[0]) / (b[0] - a[0])
    return (
        a[1] + f * (b[1] - a[1]),
        a[2] + f * (b[2] - a[2]),
        wrap(a[3] + f * wrap(b[3] - a[3])),
        a[4] + f * (b[4] - a[4]),
    )
"""

HELPERS_STUBS = """\
from typing import Any

def at(path: Any, t: float) -> tuple[float, float, float, float]: ...
def offset(pose: Any, ahead: float, left: float) -> tuple[float, float]: ...
def clip(v: float, low: float, high: float) -> float: ...
def wrap(angle: float) -> float: ...
"""


class PlannerFacts(NamedTuple):
    """What a planner's text defines.

    Attributes:
        parameters: Its parameters.
        has_trajectory: Whether it defines ``trajectory``.
    """

    parameters: tuple[Parameter, ...]
    has_trajectory: bool


def parse_parameters(text: str) -> tuple[Parameter, ...]:
    """Read the parameter table at the top of a planner's text.

    Raises:
        PlannerSyntaxError: The text does not parse, lacks the table or ``endpoint``, or a number is out of its bounds.
    """
    return read_planner_text(text).parameters


def make_planner(label: str, mode: str, text: str, origin: str, parent: str | None = None) -> Planner:
    """Make a planner from its text.

    Args:
        label: The label of the intent.
        mode: The planner's mode.
        text: The planner's text.
        origin: The author: seed, expert, a model's name or person.
        parent: The planner that this one was derived from, or None.

    Raises:
        PlannerSyntaxError: The text is not a planner; see ``parse_parameters``.
    """
    return Planner(label, mode, text, parse_parameters(text), origin, parent)


@lru_cache(maxsize=256)
def read_planner_text(text: str) -> PlannerFacts:
    """Parse and check a planner's text without running it.

    Raises:
        PlannerSyntaxError: The text is not a planner; see ``parse_parameters``. The message names the line if it is
            known.
    """
    tree = _parse(text)
    body = tree.body[1:] if tree.body and _is_docstring(tree.body[0]) else tree.body
    parameters = tuple(_parameters(_table(body)))
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    if "endpoint" not in functions:
        raise PlannerSyntaxError(f"The planner does not define endpoint({', '.join(ENDPOINT_ARGUMENTS)}): add it.")
    _check_arguments(functions["endpoint"], ENDPOINT_ARGUMENTS)
    if "trajectory" in functions:
        _check_arguments(functions["trajectory"], TRAJECTORY_ARGUMENTS)
    return PlannerFacts(parameters, "trajectory" in functions)


@lru_cache(maxsize=256)
def uses_acceleration(text: str) -> bool:
    """Return whether a planner's text reads the intent's acceleration, which is its argument ``acc``.

    Raises:
        PlannerSyntaxError: The text does not parse.
    """
    return any(isinstance(node, ast.Name) and node.id == "acc" for node in ast.walk(_parse(text)))


def _parse(text: str) -> ast.Module:
    """Parse a text with ``ast.parse``. Raise ``PlannerSyntaxError`` for all faults, even of hostile text."""
    if not isinstance(text, str) or len(text) > MAX_PLANNER_BYTES:
        raise PlannerSyntaxError(f"The planner must be text of at most {MAX_PLANNER_BYTES} bytes: shorten it.")
    strange = next((c for c in text if (c < " " and c not in "\n\r\t") or "\ud800" <= c <= "\udfff"), None)
    if strange is not None:
        raise PlannerSyntaxError(f"The planner's text holds the character {strange!r}: remove it.")
    if len(text.encode()) > MAX_PLANNER_BYTES:
        raise PlannerSyntaxError(f"The planner must be text of at most {MAX_PLANNER_BYTES} bytes: shorten it.")
    try:
        tree = ast.parse(text)
        names = (node for node in ast.walk(tree) if isinstance(node, ast.Name))
        refused = next((name for name in names if name.id in REFUSED_NAMES), None)
    except SyntaxError as error:
        raise _syntax_error(error.lineno, f"does not parse ({str(error.msg)[:200]})") from None
    except (MemoryError, RecursionError, ValueError, OverflowError) as error:
        raise PlannerSyntaxError(
            f"The planner's text cannot be parsed ({type(error).__name__}): nest less deeply."
        ) from None
    if refused is not None:
        raise _syntax_error(refused.lineno, f"uses {refused.id}, which planners may not: write it without")
    return tree


def _syntax_error(line: int | None, what: str) -> PlannerSyntaxError:
    return PlannerSyntaxError(f"The planner{f', line {line},' if line else ''} {what}.")


def _is_docstring(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _table(body: list[ast.stmt]) -> ast.Dict:
    """Return the dict display that the first statement binds to ``PARAMETERS``."""
    match body[:1]:
        case [
            ast.Assign(targets=[ast.Name(id="PARAMETERS")], value=ast.Dict() as table)
            | ast.AnnAssign(target=ast.Name(id="PARAMETERS"), value=ast.Dict() as table)
        ]:
            return table
    raise _syntax_error(
        body[0].lineno if body else None,
        'must begin with the table PARAMETERS = {"name": (default, low, high, "unit", "meaning")}',
    )


def _parameters(table: ast.Dict) -> Iterator[Parameter]:
    if len(table.keys) > MAX_PARAMETERS:
        raise _syntax_error(table.lineno, f"has {len(table.keys)} parameters; at most {MAX_PARAMETERS} are allowed")
    seen: set[str] = set()
    for key, value in zip(table.keys, table.values, strict=True):
        line = value.lineno
        try:
            name = ast.literal_eval(key) if key is not None else None
            entry = ast.literal_eval(value)
        except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
            raise _syntax_error(line, "has something other than literals in PARAMETERS: write plain numbers") from None
        if not isinstance(name, str) or not name.isidentifier() or keyword.iskeyword(name) or len(name) > 40:
            raise _syntax_error(line, "names a parameter with something else than a (short) Python identifier")
        if name in seen:
            raise _syntax_error(line, f"names the parameter {name} twice")
        seen.add(name)
        yield _parameter(name, entry, line)


def _parameter(name: str, entry: object, line: int) -> Parameter:
    if not isinstance(entry, tuple | list) or len(entry) not in (4, 5):
        raise _syntax_error(line, f'must give the parameter {name} as (default, low, high, "unit", "meaning")')
    numbers = entry[:3]
    if not all(type(n) in (int, float) for n in numbers):
        raise _syntax_error(line, f"must give default, low and high of the parameter {name} as numbers")
    try:
        default, low, high = (float(n) for n in numbers)
    except OverflowError:
        raise _syntax_error(line, f"gives the parameter {name} a number that is too large") from None
    if not all(math.isfinite(n) for n in (default, low, high)):
        raise _syntax_error(line, f"gives the parameter {name} a number that is not finite")
    if max(abs(low), abs(high), abs(default)) > MAX_PARAMETER_VALUE:
        bound = f"{MAX_PARAMETER_VALUE:g}"
        raise _syntax_error(line, f"gives the parameter {name} a number beyond {bound}: use metres, seconds, m/s")
    if not low <= default <= high:
        raise _syntax_error(line, f"breaks low <= default <= high for the parameter {name}")
    words = entry[3:]
    if not all(isinstance(word, str) and len(word) <= 300 for word in words):
        raise _syntax_error(line, f"must give unit and meaning of the parameter {name} as short text")
    return Parameter(name, default, low, high, *words)


def _check_arguments(function: ast.FunctionDef, names: tuple[str, ...]) -> None:
    given = function.args
    extra = given.posonlyargs or given.kwonlyargs or given.vararg or given.kwarg
    if extra or tuple(argument.arg for argument in given.args) != names:
        raise _syntax_error(
            function.lineno, f"must define {function.name}({', '.join(names)}) with just these arguments"
        )
