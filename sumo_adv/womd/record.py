"""A record of the Waymo Open Motion Dataset as arrays, which the reader returns and the converter takes.

Coordinates [m] and headings [rad], counter-clockwise from +x, are those of the record. Positions of objects are box
centres. Enum numbers are those of the dataset.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sumo_adv.consistency import UNWRAPPED, GivenMotion, find_fault
from sumo_adv.datatypes import Bools, Floats, Ints
from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap, wrap_below_pi

LANE_TYPES = ("undefined", "freeway", "surface", "bike")
TRACK_KINDS = ("unset", "vehicle", "pedestrian", "cyclist", "other")
SIGNAL_STATES = (
    "unknown", "arrow_stop", "arrow_caution", "arrow_go", "stop", "caution", "go", "flashing_stop", "flashing_caution",
)  # fmt: skip
VEHICLE, BIKE = TRACK_KINDS.index("vehicle"), LANE_TYPES.index("bike")
MAX_RECORD_EXTENT_M = 20_000.0  # between any two places; 600 m in the dataset
MAX_RECORD_ROAD_M = 500_000.0  # lanes and lines together; 20 km in the dataset
MAX_RECORD_COORDINATE_M = 1e7  # from the origin; UTM northings are up to 10,000 km
MAX_RECORD_DURATION_S = 3600.0  # from the first time stamp to the last
RECORD_STEP_S = 0.1
# Maximum distance of a time stamp from an even grid; clocks that are slow by 0.5 % are accepted as they are.
TIME_STAMP_TOLERANCE_S = 0.05
STEP_TOLERANCE_S = 0.01  # maximum deviation of a step: 0.15 m at 15 m/s, the tolerance of the gate ``continuity``
# Two states at most this far apart are joined by a straight line; over a longer gap, an object is unseen.
MAX_BRIDGED_GAP_S = 0.35


@dataclass(frozen=True, slots=True)
class Neighbour:
    """A lane of the same direction beside a lane, over inclusive index ranges of both lanes' points.

    Attributes:
        lane: The id of the neighbouring lane.
        own_start: The first index on the lane itself.
        own_end: The last index on the lane itself.
        other_start: The first index on the neighbouring lane.
        other_end: The last index on the neighbouring lane.
    """

    lane: int
    own_start: int
    own_end: int
    other_start: int
    other_end: int


@dataclass(frozen=True, slots=True)
class LaneFeature:
    """A lane.

    Attributes:
        id: The id of the lane.
        points: Its centre line, ``(n, 3)`` [m].
        kind: Its type, an index of ``LANE_TYPES``.
        speed_limit: Its speed limit [m/s]; 0 if not given.
        interpolating: Whether the dataset interpolated it, as in a junction.
        entries: The ids of the lanes before.
        exits: The ids of the lanes after.
        left: Its neighbours on the left.
        right: Its neighbours on the right.
    """

    id: int
    points: Floats
    kind: int
    speed_limit: float
    interpolating: bool
    entries: tuple[int, ...]
    exits: tuple[int, ...]
    left: tuple[Neighbour, ...]
    right: tuple[Neighbour, ...]


@dataclass(frozen=True, slots=True)
class LineFeature:
    """A painted line or a road edge.

    Attributes:
        edge: Whether it is a road edge.
        points: The line, ``(n, 3)`` [m].
    """

    edge: bool
    points: Floats


@dataclass(frozen=True, slots=True)
class StopSign:
    """A stop sign.

    Attributes:
        lanes: The ids of the lanes that it rules.
        position: Its place, ``(3,)`` [m].
    """

    lanes: tuple[int, ...]
    position: Floats


@dataclass(frozen=True, slots=True)
class AreaFeature:
    """A polygon on the ground.

    Attributes:
        id: The id of the area.
        kind: crosswalk, speed_bump or driveway.
        points: The polygon, ``(n, 3)`` [m].
    """

    id: int
    kind: str
    points: Floats


@dataclass(frozen=True, slots=True)
class SignalState:
    """A lane's signal at one step.

    Attributes:
        lane: The id of the lane.
        state: The state, an index of ``SIGNAL_STATES``.
        stop: The stop point, ``(3,)`` [m]; None if not given.
    """

    lane: int
    state: int
    stop: Floats | None


@dataclass(frozen=True, slots=True)
class ObjectTrack:
    """One object over all steps.

    Arrays have shape ``(n,)``. Where ``valid`` is False, the other values mean nothing.

    Attributes:
        id: The id of the object.
        kind: Its kind, an index of ``TRACK_KINDS``.
        valid: Whether its state is known.
        x: x of the box centre [m].
        y: y of the box centre [m].
        length: Length [m].
        width: Width [m].
        heading: Heading [rad].
        vx: Velocity along x [m/s].
        vy: Velocity along y [m/s].
    """

    id: int
    kind: int
    valid: Bools
    x: Floats
    y: Floats
    length: Floats
    width: Floats
    heading: Floats
    vx: Floats
    vy: Floats


@dataclass(frozen=True, slots=True)
class Record:
    """One scenario.

    Attributes:
        scenario_id: The id of the scenario.
        time: The time stamps, ``(n,)`` [s].
        current: The index of the current step; steps up to it are history.
        sdc: The index of the ego in ``tracks``.
        tracks: The tracks.
        objects_of_interest: The ids of objects of interest.
        to_predict: The indices of the tracks to predict.
        lanes: The lanes by id.
        lines: The painted lines and road edges by id.
        stop_signs: The stop signs.
        areas: The polygons on the ground.
        signals: For each step, the states of all signal lanes.
        content: The SHA-256 of the bytes that it was read from, in hex.
        notes: Sentences on what of the file is left out.
    """

    scenario_id: str
    time: Floats
    current: int
    sdc: int
    tracks: Sequence[ObjectTrack]
    objects_of_interest: tuple[int, ...]
    to_predict: tuple[int, ...]
    lanes: Mapping[int, LaneFeature]
    lines: Mapping[int, LineFeature]
    stop_signs: Sequence[StopSign]
    areas: Sequence[AreaFeature]
    signals: Sequence[tuple[SignalState, ...]]
    content: str = ""
    notes: Sequence[str] = ()


def check_record(record: Record, where: str) -> None:
    """Refuse a record that spans too much, or whose motion is impossible.

    Args:
        record: The record.
        where: Names the record in errors.

    Raises:
        UsageError: The record is refused.
    """
    _check_bounds(record, where)
    if fault := find_fault([_motion(t, record.time) for t in record.tracks if t.valid.any()], noisy=True):
        at = f"its track {fault.motion.name} at {fault.time - record.time[0]:.2f} s"
        raise UsageError(f"{where} cannot be right: {at} {fault.says}.")


def _motion(t: ObjectTrack, time: Floats) -> GivenMotion:
    """Return the valid states of a track for the consistency check."""
    v = t.valid
    kind = TRACK_KINDS[t.kind] if 1 <= t.kind < len(TRACK_KINDS) else "other"
    length, width = (float(np.median(values[v])) for values in (t.length, t.width))
    speed = np.hypot(t.vx[v], t.vy[v])
    return GivenMotion(str(t.id), kind, time[v], t.x[v], t.y[v], t.heading[v], speed, length, width, UNWRAPPED)


def _check_bounds(record: Record, where: str) -> None:
    """Refuse a record that spans more than any real one; ``where`` names it.

    One wrong coordinate or time stamp would cost gigabytes, because roads are filled in metre by metre, and records are
    resampled step by step.

    Raises:
        UsageError: The record is refused.
    """
    span = float(record.time[-1] - record.time[0])
    if span > MAX_RECORD_DURATION_S:
        raise UsageError(
            f"{where} spans {span:.3g} s, more than the {MAX_RECORD_DURATION_S:g} s that are read: its times are wrong."
        )
    drawn: list[LaneFeature | LineFeature | AreaFeature]
    drawn = [*record.lanes.values(), *record.lines.values(), *record.areas]
    lines = [each.points[:, :2] for each in drawn]
    lines += [sign.position[None, :2] for sign in record.stop_signs]
    states = [np.stack([t.x[t.valid], t.y[t.valid]], axis=1) for t in record.tracks]
    for kind, places in (("map point", lines), ("position of an object", states)):
        _check_places(np.concatenate([np.empty((0, 2)), *places]), kind, where)
    _check_places(np.concatenate([np.empty((0, 2)), *lines, *states]), "position of an object", where)
    road = sum(float(np.hypot(*np.diff(line, axis=0).T).sum()) for line in lines)
    if road > MAX_RECORD_ROAD_M:
        raise UsageError(
            f"{where} has {road / 1000:.4g} km of lines, more than the {MAX_RECORD_ROAD_M / 1000:g} that are read."
        )


def _check_places(places: Floats, kind: str, where: str) -> None:
    """Refuse places too far from the origin or from each other."""
    if not len(places):
        return
    far = float(np.abs(places).max())
    if far > MAX_RECORD_COORDINATE_M:
        raise UsageError(f"{where} has a {kind} {far:.3g} m from the origin: that is not a place on a map in metres.")
    extent = float(np.ptp(places, axis=0).max())
    if extent > MAX_RECORD_EXTENT_M:
        raise UsageError(f"{where} has a {kind} {extent / 1000:.4g} km from another place, which no record spans.")


@dataclass(frozen=True, slots=True)
class Sampling:
    """How a record was sampled.

    Attributes:
        step: The median time between its steps [s].
        worst: The largest distance of a time stamp from an even 10 Hz grid [s].
        jitter: The largest difference of the time between two steps from 0.1 s [s].
        resampled: Whether it was resampled.
    """

    step: float
    worst: float
    jitter: float
    resampled: bool

    @property
    def sentence(self) -> str:
        """A sentence for the user; empty if the record was not resampled."""
        if not self.resampled:
            return ""
        return (
            f"resampled to 10 Hz: steps {self.step:.3f} s apart, uneven by up to {self.jitter:.3f} s, "
            f"time stamps up to {self.worst:.3f} s off"
        )


def evenly_sampled(record: Record) -> tuple[Record, Sampling]:
    """Return a record on the grid ``time[0] + 0.1 k`` [s].

    Positions, speeds and sizes are interpolated linearly, and headings turn the shorter way. An object is valid if the
    states on both sides are valid and not too far apart in time. Signals keep the last state. The current step is the
    one nearest to that of the record.

    Returns:
        The record, unchanged if it is already on the grid, and how it was sampled.
    """
    time = record.time - record.time[0]
    steps = np.diff(time) if len(time) > 1 else np.array([RECORD_STEP_S])
    step, jitter = float(np.median(steps)), float(np.abs(steps - RECORD_STEP_S).max())
    worst = float(np.abs(time - RECORD_STEP_S * np.arange(len(time))).max())
    if worst <= TIME_STAMP_TOLERANCE_S and jitter <= STEP_TOLERANCE_S:
        return record, Sampling(step, worst, jitter, resampled=False)
    grid = np.asarray(RECORD_STEP_S * np.arange(int(time[-1] / RECORD_STEP_S + 1e-6) + 1), np.float64)
    high = np.clip(np.searchsorted(time, grid - 1e-9), 0, len(time) - 1)
    low = np.maximum(high - (time[high] > grid + 1e-9), 0)
    gap = time[high] - time[low]
    share = np.where(gap > 0.0, (grid - time[low]) / np.maximum(gap, 1e-9), 0.0)
    bridged: Bools = np.asarray(gap <= max(MAX_BRIDGED_GAP_S, 1.5 * step))
    even = replace(
        record, time=record.time[0] + grid, current=int(np.argmin(np.abs(grid - time[record.current]))),
        tracks=[_track(track, low, high, share, bridged) for track in record.tracks],
        signals=[record.signals[k] for k in low],
    )  # fmt: skip
    return even, Sampling(step, worst, jitter, resampled=True)


def _track(track: ObjectTrack, low: Ints, high: Ints, share: Floats, bridged: Bools) -> ObjectTrack:
    """Return a track interpolated between its states ``low`` and ``high``."""
    linear: dict[str, Any] = {}
    for name in ("x", "y", "length", "width", "vx", "vy"):
        before, after = getattr(track, name)[low], getattr(track, name)[high]
        linear[name] = np.asarray(np.where(share == 0.0, before, before * (1 - share) + after * share))
    turn = wrap_below_pi(track.heading[high] - track.heading[low])
    return replace(
        track, valid=track.valid[low] & track.valid[high] & bridged,
        heading=wrap(track.heading[low] + share * turn),
        **linear,
    )  # fmt: skip
