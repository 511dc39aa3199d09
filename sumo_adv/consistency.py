"""Check whether imported motion is plausible: units, order of time, sizes, speeds and headings of recorded tracks.

All importers use it: tables for ``judge``, tracks of scenarios, FCD, Waymo records and CommonRoad obstacles. A unit is
wrong for a whole track. So speeds and headings are compared with the positions over all stretches of a metre in which
the object moves, and more than half must contradict. Reversing, standing, skidding and noise raise no alarm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Ints
from sumo_adv.geometry import wrap

COMPARED_MOTION_M = 1.0  # distance over which speed and heading are compared with positions
MIN_TRAVEL_M = 10.0  # shortest real or claimed travel of an object that is compared
# Limits of speed / motion: mph gives 2.24, and SUMO's lanes may be twice as long as drawn
MAX_SPEED_RATIO = 2.1
MIN_SPEED_RATIO = 0.45
ASKEW_RAD = math.radians(30.0)  # largest angle between heading and motion, either way; slip angles are far below
FITTING_RAD = math.radians(10.0)  # largest angle between heading and motion if a convention explains the motion
MAX_REVERSING_SPEED_M_S = 10.0  # no car reverses faster
UNIT_TOLERANCE = 0.06  # relative tolerance of a factor between two units
ROUNDING_RAD = 0.01  # rounding of a heading of 2 pi
MAX_INPUT_COORDINATE_M = 1e9  # largest distance from the origin
MAX_WIDTH_M = 100.0  # largest width of anything on a road; a car is 180 cm wide
GRID_SLACK_S = 2e-3  # tolerance of an even grid, at most a quarter of a step: SUMO's times are in ms
FRAME_RATES_HZ = (5.0, 120.0)

Range = tuple[float, float]
SIZE_RANGES_M: Mapping[str, tuple[Range, Range]] = {
    "vehicle": ((0.5, 1000.0), (0.2, 5.0)),
    "pedestrian": ((0.1, 3.0), (0.1, 3.0)),
    "cyclist": ((0.3, 5.0), (0.1, 2.0)),
    "other": ((0.01, 100.0), (0.01, 100.0)),
}
"""Plausible lengths and widths [m] by kind. SUMO's longest class is a train of 200 m."""
SIZE_UNITS = (("centimetres", 0.01), ("millimetres", 0.001), ("feet", 0.3048), ("inches", 0.0254))
TYPICAL_SIZE_RANGES_M: Mapping[str, tuple[Range, Range]] = {**SIZE_RANGES_M, "vehicle": ((1.0, 30.0), (0.5, 3.0))}
SPEED_UNITS = (
    ("speeds look like km/h", 3.6), ("speeds look like mph", 2.23694), ("speeds look like feet per second", 3.28084),
    ("speeds look like cm/s", 100.0), ("positions look like feet", 0.3048), ("positions look like centimetres", 0.01),
    ("positions look like millimetres", 0.001), ("times look like milliseconds, or positions like kilometres", 1e3),
    ("times look like microseconds", 1e6), ("times look like nanoseconds", 1e9),
)  # fmt: skip
"""Explanations of speeds that are a factor times the motion."""
METRES_PER_DEGREE = (3e4, 1.3e5)  # m/s of speed per degree/s of motion: positions are in longitude and latitude


@dataclass(frozen=True, slots=True)
class Angles:
    """A convention for headings.

    Attributes:
        words: The convention in words.
        unit: The unit as written after a value.
        most: The largest absolute value.
        to_rad: Converts headings to radians counter-clockwise from +x.
    """

    words: str
    unit: str
    most: float
    to_rad: Callable[[Floats], Floats]


RADIANS = Angles("radians counter-clockwise from +x", " rad", 2 * math.pi + ROUNDING_RAD, lambda h: h)
UNWRAPPED = Angles(RADIANS.words, " rad", 4 * math.pi, RADIANS.to_rad)
"""Waymo's convention. Real records have headings of up to 3.3 pi."""
SUMO_DEGREES = Angles("degrees clockwise from north", " degrees", 360.0, lambda h: np.radians(90.0 - h))
CONVENTIONS = (
    RADIANS,
    Angles("degrees counter-clockwise from +x", " degrees", 360.0, np.radians),
    SUMO_DEGREES,
    Angles("radians clockwise from north", " rad", RADIANS.most, lambda h: np.pi / 2 - h),
    Angles("radians of a map whose y points down", " rad", RADIANS.most, lambda h: -h),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class GivenMotion:
    """The states of one object as a file gives them. Arrays are ``(n,)`` in order of time.

    Attributes:
        name: The name of the object.
        kind: ``vehicle``, ``pedestrian``, ``cyclist`` or ``other``.
        time: The times [s].
        x: The x of the positions [m].
        y: The y of the positions [m].
        heading: The headings, in the convention ``angles``.
        speed: The speeds [m/s], negative while the object reverses.
        length: The length of the object [m].
        width: The width of the object [m].
        angles: The convention for headings.
    """

    name: str
    kind: str
    time: Floats
    x: Floats
    y: Floats
    heading: Floats
    speed: Floats
    length: float
    width: float
    angles: Angles = RADIANS


@dataclass(frozen=True, slots=True)
class Fault:
    """An implausible state.

    Attributes:
        motion: The motion.
        index: The index of the state.
        what: What is wrong, as the end of a sentence whose subject is the state.
        cause: What the file looks like; empty if nothing explains the fault.
    """

    motion: GivenMotion
    index: int
    what: str
    cause: str

    @property
    def says(self) -> str:
        """What is wrong, with the cause."""
        return f"{self.what}: {self.cause}" if self.cause else self.what

    @property
    def time(self) -> float:
        """The time of the state [s]."""
        return float(self.motion.time[self.index])


def find_fault(motions: Sequence[GivenMotion], *, noisy: bool) -> Fault | None:
    """Find the first implausible state.

    Args:
        motions: The motions of the objects.
        noisy: Whether the motions were measured. Then a single object may be wrong by itself: a contradiction that no
            unit explains counts only if it holds for half of the moving objects. Headings and sizes always need that,
            because small headings in degrees look like noise, and a box that never moves may be a building.

    Returns:
        The fault; None if there is none.
    """
    moving = 0
    sizes: list[Fault] = []
    contradictions: list[Fault] = []
    for motion in motions:
        if fault := _not_finite(motion) or _beyond_turns(motion):
            return fault
        stretches = _stretches(motion) if len(motion.time) > 1 else None
        moves = stretches is not None and stretches.counts
        size = _wrong_size(motion, motion.kind if moves or not noisy else "other")
        if size and (not noisy or motion.width > MAX_WIDTH_M):
            return size
        sizes += [size] if size else []
        if stretches is None or motion.kind not in ("vehicle", "cyclist"):
            continue  # SUMO's pedestrians jump sideways and turn on the spot
        moving += moves
        speed = _against_speed(motion, stretches)
        fault = speed or _against_heading(motion, stretches)
        if fault and (not noisy or (speed and speed.cause)):
            return fault
        contradictions += [fault] if fault else []
    most = max(sizes, contradictions, key=len)
    return most[0] if most and 2 * len(most) >= moving else None


# -- times ----------------------------------------------------------------------------------------------------------


def even_grid(times: Floats) -> tuple[Floats, Floats]:
    """Find the even grid of times, and how far each time is off it.

    The step begins as the smallest difference. It is measured over ever longer parts, so that rounded times (0.033,
    0.067, 0.1 of a thirtieth) give the intended step. Gaps do no harm.

    Args:
        times: Ascending times ``(n,)`` [s].

    Returns:
        The times of the grid [s], and the distance of each given time from the grid ``(n,)`` [s].
    """
    if len(times) < 2:
        return times, np.zeros(len(times))
    since, last = times - times[0], len(times) - 1
    step = float(np.diff(times).min())
    for k in (*(2**p for p in range(last.bit_length())), last):
        steps = max(round(float(since[k]) / step), 1)
        if abs(float(since[k]) - steps * step) > _slack(step):
            break
        step = float(since[k]) / steps
    count = round(float(since[-1]) / step)
    return np.linspace(times[0], times[-1], count + 1), np.abs(since - np.rint(since / step) * step)


def steps_over(times: Floats) -> float:
    """Return how many steps of the smallest difference ascending ``times`` [s] span."""
    return 0.0 if len(times) < 2 else float(times[-1] - times[0]) / float(np.diff(times).min())


def off_grid(times: Floats) -> int | None:
    """Return the index of the worst of ascending ``times`` [s] that is off their even grid; None if none is."""
    grid, off = even_grid(times)
    worst = int(off.argmax())
    return worst if len(grid) > 1 and off[worst] > _slack(float(grid[1] - grid[0])) else None


def _slack(step: float) -> float:
    return min(GRID_SLACK_S, step / 4)


def unordered(times: Floats) -> tuple[int, str] | None:
    """Find the first time that does not come after the one before it.

    Args:
        times: The times [s].

    Returns:
        Its index, and what is wrong with it in words; None if the times ascend.
    """
    wrong = np.flatnonzero(np.diff(times) <= 0.0)
    if not len(wrong):
        return None
    k = int(wrong[0]) + 1
    return k, f"at {times[k]:g} s " + ("comes twice" if times[k] == times[k - 1] else f"comes after {times[k - 1]:g} s")


# -- each state -----------------------------------------------------------------------------------------------------


def _not_finite(m: GivenMotion) -> Fault | None:
    """Find a number that is not finite, or a position that is on no map."""
    for column in ("time", "x", "y", "heading", "speed", "length", "width"):
        values = np.atleast_1d(np.asarray(getattr(m, column), float))
        bad = ~(np.abs(values) < MAX_INPUT_COORDINATE_M) if column in ("x", "y") else ~np.isfinite(values)
        if bad.any():
            k = int(bad.argmax())
            kind = "not a finite number" if not math.isfinite(values[k]) else "not a place on a map"
            return Fault(m, k, f"has {values[k]:g} for {column}, which is {kind}", "")
    return None


def _wrong_size(m: GivenMotion, kind: str) -> Fault | None:
    """Find a size that no object of this ``kind`` has."""
    if _within((m.length, m.width), SIZE_RANGES_M[kind]) and not (kind == "vehicle" and m.width > max(m.length, 3.0)):
        return None
    swapped = _within((m.width, m.length), TYPICAL_SIZE_RANGES_M[m.kind])
    units = (
        unit
        for unit, factor in SIZE_UNITS
        if _within((m.length * factor, m.width * factor), TYPICAL_SIZE_RANGES_M[m.kind])
    )
    unit = next(units, None)
    cause = "length and width look swapped" if swapped else f"sizes look like {unit}" if unit else ""
    return Fault(m, 0, f"gives the {m.kind} '{m.name}' a size of {m.length:g} by {m.width:g} m", cause)


def _within(size: tuple[float, float], ranges: tuple[Range, Range]) -> bool:
    return all(low <= value <= high for value, (low, high) in zip(size, ranges, strict=True))


def _beyond_turns(m: GivenMotion) -> Fault | None:
    """Find a heading beyond the largest value of its convention."""
    beyond = np.abs(m.heading) > m.angles.most
    if not beyond.any():
        return None
    k = int(beyond.argmax())
    radians = m.angles.unit == " rad"
    most = f"{m.angles.most / math.pi:.0f} pi" if radians else f"{m.angles.most:.0f}"
    what = f"has the heading {m.heading[k]:g}{m.angles.unit} for '{m.name}', which is beyond {most}"
    if not radians:
        return Fault(m, k, what, "")
    stretches = _stretches(m) if len(m.time) > 1 else None
    fits = stretches and len(stretches.chord) and float(np.median(_off(RADIANS, m, stretches))) < FITTING_RAD
    return Fault(m, k, what, "headings are added up over turns" if fits else "headings look like degrees")


# -- speed and heading against the positions ------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Stretches:
    """Stretches of about a metre of a track. Arrays are ``(m,)``.

    Attributes:
        first: The index of each stretch's first state.
        last: The index of its last state.
        chord: Its length by the positions [m].
        driven: Its length by the speeds [m].
        direction: The direction of its motion [rad].
        seconds: Its duration [s].
        path: The length of the whole track by the positions [m].
        claimed: The length of the whole track by the speeds [m].
        extent: The diagonal of the box around all positions [m].
    """

    first: Ints
    last: Ints
    chord: Floats
    driven: Floats
    direction: Floats
    seconds: Floats
    path: float
    claimed: float
    extent: float

    @property
    def counts(self) -> bool:
        """Whether the object moved far enough to be compared."""
        return max(self.extent, self.claimed) >= MIN_TRAVEL_M


def _stretches(m: GivenMotion) -> _Stretches:
    dt, dx, dy = np.diff(m.time), np.diff(m.x), np.diff(m.y)
    seen = dt < 1.5 * float(np.median(dt))  # not over gaps
    moved = np.where(seen, np.hypot(dx, dy), 0.0)
    speed = np.abs(m.speed)
    claimed = np.where(seen, (speed[1:] + speed[:-1]) / 2 * dt, 0.0)
    driven = np.concatenate([[0.0], np.cumsum(claimed)])
    gaps = np.concatenate([[0], np.cumsum(~seen)])
    metre = np.concatenate([[0], np.floor(np.cumsum(moved) / COMPARED_MOTION_M)])
    ends = np.flatnonzero(np.diff(metre, prepend=-1.0) > 0)
    first, last = ends[:-1], ends[1:]
    chord = np.hypot(m.x[last] - m.x[first], m.y[last] - m.y[first])
    keep = (gaps[last] == gaps[first]) & (chord > COMPARED_MOTION_M / 2)  # drop the jitter of a standing object
    first, last, chord = first[keep], last[keep], chord[keep]
    direction = np.arctan2(m.y[last] - m.y[first], m.x[last] - m.x[first])
    return _Stretches(
        first, last, chord, driven[last] - driven[first], direction, m.time[last] - m.time[first], float(moved.sum()),
        float(claimed.sum()), math.hypot(float(np.ptp(m.x)), float(np.ptp(m.y))),
    )  # fmt: skip


def _against_speed(m: GivenMotion, s: _Stretches) -> Fault | None:
    """Find speeds that contradict the positions."""
    if not s.counts:
        return None
    if s.extent >= MIN_TRAVEL_M and len(s.chord):
        k, factor = int(s.first[0]), float(np.median(s.driven / s.chord))
        moves = f"moves at {float(np.median(s.chord / s.seconds)):.3g} m/s"
    else:
        k, factor = int(np.abs(m.speed).argmax()), s.claimed / max(s.path, 1e-12)
        moves = f"moves {s.path:.3g} m in all"
    if MIN_SPEED_RATIO <= factor <= MAX_SPEED_RATIO:
        return None
    what = f"has the speed {m.speed[k]:g} m/s for '{m.name}', which {moves}"
    return Fault(m, k, what, _unit_of(factor, m.time))


def _unit_of(factor: float, time: Floats) -> str:
    """Say what a track looks like whose speeds are ``factor`` times its motion; empty if no unit explains it."""
    if factor <= 0.0:
        return "speeds are missing"
    off, words = min((abs(math.log(factor / unit)), words) for words, unit in SPEED_UNITS)
    if off < UNIT_TOLERANCE:
        return words
    if np.all(time == np.rint(time)) and FRAME_RATES_HZ[0] <= factor <= FRAME_RATES_HZ[1]:
        return "times look like numbers of frames"
    if METRES_PER_DEGREE[0] <= factor <= METRES_PER_DEGREE[1]:
        return "positions look like longitude and latitude"
    return ""


def _against_heading(m: GivenMotion, s: _Stretches) -> Fault | None:
    """Find headings that contradict the direction of motion."""
    if s.extent < MIN_TRAVEL_M or not len(s.chord):
        return None
    off = _off(m.angles, m, s)
    against: Bools = (np.maximum(m.speed[s.first], m.speed[s.last]) < 0.0) & (off < ASKEW_RAD)
    if 2 * np.count_nonzero(against) > len(against):
        k = int(s.first[against.argmax()])
        what = f"has the speed {m.speed[k]:g} m/s for '{m.name}', which moves forwards"
        return Fault(m, k, what, "speeds look like velocities along an axis")
    askew = np.minimum(off, np.pi - off) > ASKEW_RAD
    backwards = (off > np.pi - ASKEW_RAD) & (s.chord / s.seconds > MAX_REVERSING_SPEED_M_S)
    wrong: Bools = askew | backwards
    if 2 * np.count_nonzero(wrong) <= len(wrong):
        return None
    k = int(wrong.argmax())
    fits = [(float(np.median(_off(angles, m, s))), f"headings look like {angles.words}") for angles in CONVENTIONS]
    if backwards[k]:
        fits.append((float(np.median(np.pi - off)), "headings point backwards"))
    best, words = min(fits)
    cause = words if best < FITTING_RAD else ""
    given, towards = float(m.heading[s.first[k]]), float(np.degrees(s.direction[k]))
    what = f"has the heading {given:g}{m.angles.unit} for '{m.name}', which moves towards {towards:.0f} degrees from +x"
    return Fault(m, int(s.first[k]), what, cause)


def _off(angles: Angles, m: GivenMotion, s: _Stretches) -> Floats:
    """Return the absolute angle [rad] between each stretch's motion and the mean heading of its two ends."""
    ends = [angles.to_rad(m.heading[at]) for at in (s.first, s.last)]
    mean = np.arctan2(sum(map(np.sin, ends)), sum(map(np.cos, ends)))
    return np.abs(wrap(mean - s.direction))
