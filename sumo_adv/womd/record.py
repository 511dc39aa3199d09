"""A Waymo Open Motion Dataset record as arrays: what the reader gives and the converter takes.

Coordinates and headings are the record's own (m, rad counter-clockwise from +x); positions of objects are box centres.
Numbers of enums are those of the dataset; names stand beside them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sumo_adv.datatypes import Bools, Floats

LANE_TYPES = ("undefined", "freeway", "surface", "bike")
TRACK_KINDS = ("unset", "vehicle", "pedestrian", "cyclist", "other")
SIGNAL_STATES = (
    "unknown", "arrow_stop", "arrow_caution", "arrow_go", "stop", "caution", "go", "flashing_stop", "flashing_caution",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Neighbour:
    """A lane of the same direction beside this one, over index ranges (inclusive) of both lanes' points."""

    lane: int
    own_start: int
    own_end: int
    other_start: int
    other_end: int


@dataclass(frozen=True, slots=True)
class BoundaryPart:
    """Over points ``start`` to ``end`` of the lane its side is the road line or edge ``feature``; ``kind`` 0 to 8."""

    start: int
    end: int
    feature: int
    kind: int


@dataclass(frozen=True, slots=True)
class LaneFeature:
    """A lane's centre line. points ``(n, 3)`` m; speed_limit m/s, 0 = not given; kind: index of ``LANE_TYPES``."""

    id: int
    points: Floats
    kind: int
    speed_limit: float
    interpolating: bool
    entries: tuple[int, ...]
    exits: tuple[int, ...]
    left: tuple[Neighbour, ...]
    right: tuple[Neighbour, ...]
    left_boundaries: tuple[BoundaryPart, ...]
    right_boundaries: tuple[BoundaryPart, ...]


@dataclass(frozen=True, slots=True)
class LineFeature:
    """A painted line (``edge`` False) or a road edge (True). points ``(n, 3)`` m; kind: the dataset's number."""

    id: int
    edge: bool
    kind: int
    points: Floats


@dataclass(frozen=True, slots=True)
class StopSign:
    """A stop sign, the lanes it rules, and where it stands ``(3,)`` m."""

    id: int
    lanes: tuple[int, ...]
    position: Floats


@dataclass(frozen=True, slots=True)
class AreaFeature:
    """A polygon on the ground: kind crosswalk | speed_bump | driveway; points ``(n, 3)`` m."""

    id: int
    kind: str
    points: Floats


@dataclass(frozen=True, slots=True)
class SignalState:
    """A lane's signal at one step; state: index of ``SIGNAL_STATES``; stop: its stop point ``(3,)`` m, if given."""

    lane: int
    state: int
    stop: Floats | None


@dataclass(frozen=True, slots=True)
class ObjectTrack:
    """One object over all steps, arrays ``(n,)``; where ``valid`` is False the rest means nothing.

    kind: index of ``TRACK_KINDS``; x, y, z m (box centre); length, width, height m; heading rad; vx, vy m/s.
    """

    id: int
    kind: int
    valid: Bools
    x: Floats
    y: Floats
    z: Floats
    length: Floats
    width: Floats
    height: Floats
    heading: Floats
    vx: Floats
    vy: Floats


@dataclass(frozen=True, slots=True)
class Record:
    """One scenario. time ``(n,)`` s; ``current``: index of the step up to which it is history; ``sdc``: index of the
    ego among ``tracks``; ``signals``: for each step the states of all signal lanes; ``content``: SHA-256 of the bytes
    it was read from, in hex."""

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
