"""Check a planner's result, once in its session and once in this process.

The first check runs inside the session. ``REDUCERS`` turn a result into a flat tuple or list of plain numbers. Without
them, a dict with a hundred thousand chosen integer keys would block this process for minutes. Its hashes collide, so
CPython builds it in quadratic time (measured: 12 000 keys, 0.8 s). A key of 40 nested pairs would block this process
forever, because monty keeps a tuple's hash and CPython computes it again each time. The helpers' names are random in
each session.

The second check runs in this process and does not rely on the first. It checks exact type, count, finiteness and range.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

from sumo_adv.datatypes import Planner
from sumo_adv.errors import PlannerResultError

ENDPOINT_KEYS = ("x", "y", "heading", "speed", "time")
NOTE_PREFIX = "note_"  # of the keys of an endpoint that the planner gets back in ``bv["last"]`` at its next call
MAX_NOTES, MAX_NOTE_CHARACTERS, MAX_NOTE_VALUE = 4, 30, 1e6
NOTE_KEY = re.compile(r"note_[a-z_]{1,25}")
MAX_TRAJECTORY_STATES = 400
MAX_MESSAGE_CHARACTERS = 500
MAX_START_GAP_M = 3.0  # largest distance from the vehicle to the start of its trajectory
MAX_STATE_CHANGE_M_S2 = 150.0  # a larger acceleration between two states is a jump
MAX_COORDINATE_M, MAX_HEADING_RAD, MAX_SPEED_M_S, MAX_TIME_S = 1e5, 1e3, 100.0, 60.0
ENDPOINT_RANGES = {
    "x": (-MAX_COORDINATE_M, MAX_COORDINATE_M), "y": (-MAX_COORDINATE_M, MAX_COORDINATE_M),
    "heading": (-MAX_HEADING_RAD, MAX_HEADING_RAD), "speed": (0.0, MAX_SPEED_M_S), "time": (0.0, MAX_TIME_S),
}  # fmt: skip
"""The range of each number in m, rad, m/s and s. In addition, ``time`` must be more than 0."""

REDUCERS = (
    """
type_ID, len_ID, dict_ID, list_ID, tuple_ID, float_ID, int_ID = type, len, dict, list, tuple, float, int
str_ID = str
missing_ID = KeyError

def number_ID(v):
    k = type_ID(v)
    return k is float_ID or (k is int_ID and -1000000000 < v < 1000000000)

def pick_ID(v):
    if type_ID(v) is not dict_ID:
        return "endpoint() must return a dict, not " + type_ID(v).__name__
    n = len_ID(v)
    if n < 5 or n > MAX_KEYS:
        return "endpoint() must return exactly the keys x, y, heading, speed, time"
    try:
        x, y, h, s, t = v["x"], v["y"], v["heading"], v["speed"], v["time"]
    except missing_ID:
        return "endpoint() must return exactly the keys x, y, heading, speed, time"
    if n > 5:
        return noted_ID(v, (x, y, h, s, t))
    f = float_ID
    if type_ID(x) is f and type_ID(y) is f and type_ID(h) is f and type_ID(s) is f and type_ID(t) is f:
        return (x, y, h, s, t)
    for k in ("x", "y", "heading", "speed", "time"):
        if not number_ID(v[k]):
            return "endpoint() must return a plain number of at most 1e9 as " + k + ", not " + type_ID(v[k]).__name__
    return (x, y, h, s, t)

def noted_ID(v, numbers):
    notes = []
    for k in v:
        if type_ID(k) is not str_ID or len_ID(k) > MAX_LENGTH:
            return "endpoint() must return the keys x, y, heading, speed, time, and short ones that begin with note_"
        if k not in ("x", "y", "heading", "speed", "time"):
            notes.append((k, v[k]))
        if not number_ID(v[k]):
            return "endpoint() must return plain numbers of at most 1e9, not " + type_ID(v[k]).__name__
    return numbers + (tuple_ID(notes),)

def one_ID(c):
    return pick_ID(endpoint(c[1], c[2], roads_ID[c[0]], c[3], c[4], c[5]))

def many_ID(calls):
    out = []
    for c in calls:
        try:
            out.append(pick_ID(endpoint(c[1], c[2], roads_ID[c[0]], c[3], c[4], c[5])))
        except:
            out.append(None)
    return out

def path_ID(c):
    v = trajectory(c[0], c[1], roads_ID[c[2]], c[3])
    if type_ID(v) is not list_ID and type_ID(v) is not tuple_ID:
        return "trajectory() must return a list, not " + type_ID(v).__name__
    if not 1 <= len_ID(v) <= MAX_TRAJECTORY:
        return "trajectory() must return 1 to MAX_TRAJECTORY states"
    out = []
    for s in v:
        if (type_ID(s) is not tuple_ID and type_ID(s) is not list_ID) or len_ID(s) != 4:
            return "trajectory() must return states (x, y, heading, speed)"
        for n in s:
            if not number_ID(n):
                return "trajectory() must return plain numbers of at most 1e9, not " + type_ID(n).__name__
            out.append(n)
    return out
""".replace("MAX_TRAJECTORY", str(MAX_TRAJECTORY_STATES))
    .replace("MAX_KEYS", str(len(ENDPOINT_KEYS) + MAX_NOTES))
    .replace("MAX_LENGTH", str(MAX_NOTE_CHARACTERS))
)
"""Code of the session's helpers. A session replaces ``ID`` with random digits of its own."""


def check_endpoint(subject: str, value: Any) -> dict[str, float]:
    """Check an endpoint.

    Args:
        subject: The planner, as the subject of messages.
        value: What the session's reducer returned: five numbers and, if the planner notes something, pairs of keys and
            numbers.

    Returns:
        The five numbers by name: x, y [m], heading [rad], speed [m/s] and time [s]; and the notes by their keys.

    Raises:
        PlannerResultError: The value is not a tuple of five valid numbers and valid notes. The message says what is
            wrong.
    """
    notes = {}
    if type(value) is tuple and len(value) == len(ENDPOINT_KEYS) + 1:
        *value, pairs = value
        value, notes = tuple(value), _notes(subject, pairs)
    if type(value) is not tuple or len(value) != len(ENDPOINT_KEYS):
        raise _bad(subject, value)
    x, y, heading, speed, time = value
    if type(x) is type(y) is type(heading) is type(speed) is type(time) is float and (
        -MAX_COORDINATE_M <= x <= MAX_COORDINATE_M and -MAX_COORDINATE_M <= y <= MAX_COORDINATE_M
        and -MAX_HEADING_RAD <= heading <= MAX_HEADING_RAD
        and 0.0 <= speed <= MAX_SPEED_M_S and 0.0 < time <= MAX_TIME_S
    ):  # the usual case: the checks below in one expression  # fmt: skip
        return {"x": x, "y": y, "heading": heading, "speed": speed, "time": time, **notes}
    result = {name: _number(subject, name, n) for name, n in zip(ENDPOINT_KEYS, value, strict=True)}
    if result["time"] <= 0.0:
        raise PlannerResultError(f"{subject}: time must be more than 0 s, it is {result['time']!r}.")
    return result | notes


def notes_of(endpoint: Mapping[str, float]) -> dict[str, float]:
    """Return the notes of an endpoint, which a planner gets back at its next call.

    Args:
        endpoint: The endpoint, by name.
    """
    return {key: value for key, value in endpoint.items() if key.startswith(NOTE_PREFIX)}


def _notes(subject: str, pairs: Any) -> dict[str, float]:
    """Check the notes of an endpoint, given as pairs of key and number."""
    if type(pairs) is not tuple or len(pairs) > MAX_NOTES:
        raise _bad(subject, pairs)
    notes: dict[str, float] = {}
    for pair in pairs:
        if type(pair) is not tuple or len(pair) != 2 or type(pair[0]) is not str:
            raise _bad(subject, pair)
        key, value = pair
        if not NOTE_KEY.fullmatch(key):
            shown = printable_line(key)
            raise PlannerResultError(f"{subject}: endpoint() returns {shown!r}; further keys are note_ and a-z.")
        if type(value) not in (int, float) or not abs(value) <= MAX_NOTE_VALUE:
            raise PlannerResultError(f"{subject}: {key} must be a number within {MAX_NOTE_VALUE:g}.")
        notes[key] = float(value)
    return notes


def check_trajectory(subject: str, value: Any) -> list[tuple[float, float, float, float]]:
    """Check a trajectory.

    Args:
        subject: The planner, as the subject of messages.
        value: What the session's reducer returned: a flat list of numbers.

    Returns:
        The states: x, y [m], heading [rad] and speed [m/s].

    Raises:
        PlannerResultError: The value is not a list of valid states. The message says what is wrong.
    """
    if type(value) is not list or not value or len(value) > 4 * MAX_TRAJECTORY_STATES or len(value) % 4:
        raise _bad(subject, value)
    n = [_number(subject, ENDPOINT_KEYS[i % 4], number) for i, number in enumerate(value)]
    return [(n[i], n[i + 1], n[i + 2], n[i + 3]) for i in range(0, len(n), 4)]


def check_motion(
    subject: str, states: Sequence[tuple[float, float, float, float]], bv: Mapping[str, Any], dt: float
) -> None:
    """Check that states form one motion that begins at the vehicle. The limits of vehicles are not checked.

    Args:
        subject: The planner, as the subject of messages.
        states: The states: x, y [m], heading [rad] and speed [m/s].
        bv: The observed vehicle.
        dt: The time between two states [s].

    Raises:
        PlannerResultError: The trajectory begins elsewhere, or jumps.
    """
    away = math.hypot(states[0][0] - bv["x"], states[0][1] - bv["y"])
    if away > MAX_START_GAP_M + 1.5 * bv["speed"] * dt:
        raise PlannerResultError(f"{subject}: its trajectory begins {away:.1f} m from where the vehicle is.")
    if len(states) > 1:  # the velocity may change from the vehicle's to that of the first two states in two steps
        (ax, ay, *_), (bx, by, *_) = states[:2]
        step = bv["speed"] * dt
        change = math.hypot(bx - ax - step * math.cos(bv["heading"]), by - ay - step * math.sin(bv["heading"]))
        if change > 2.0 * MAX_STATE_CHANGE_M_S2 * dt * dt:
            jump = f"jumps between states 0 and 1, {change:.1f} m from where the vehicle was going"
            raise PlannerResultError(f"{subject}: its trajectory {jump}.")
    for k in range(1, len(states) - 1):
        (ax, ay, *_), (bx, by, *_), (cx, cy, *_) = states[k - 1 : k + 2]
        change = math.hypot(cx - 2 * bx + ax, cy - 2 * by + ay)
        if change > MAX_STATE_CHANGE_M_S2 * dt * dt:
            jump = f"jumps between states {k} and {k + 1}, {change:.1f} m from where it was going"
            raise PlannerResultError(f"{subject}: its trajectory {jump}.")


def printable_line(text: str) -> str:
    """Return the text as one line of at most ``MAX_MESSAGE_CHARACTERS`` characters, without control codes."""
    short = text[: 2 * MAX_MESSAGE_CHARACTERS].replace("\n", "; ")
    return "".join(c for c in short if c.isprintable())[:MAX_MESSAGE_CHARACTERS].rstrip("; .")


def subject_of(planner: Planner) -> str:
    """Name the planner as the subject of error messages."""
    return printable_line(f"Planner {planner.label}/{planner.mode}")[:120]


def _number(subject: str, name: str, value: Any) -> float:
    if type(value) not in (int, float):
        raise PlannerResultError(f"{subject}: {name} must be a plain number.")
    low, high = ENDPOINT_RANGES[name]
    if not low <= value <= high:  # NaN is in no range, and a huge int compares exactly
        shown = repr(value) if type(value) is float else "a whole number out of range"
        raise PlannerResultError(f"{subject}: {name} must be finite and within {low:g} to {high:g}, it is {shown}.")
    return float(value)


def _bad(subject: str, value: Any) -> PlannerResultError:
    """Make an error, with the reducer's own sentence if the value is one."""
    reason = printable_line(value) if type(value) is str else "the result is not what a planner may return"
    return PlannerResultError(f"{subject}: {reason}.")
