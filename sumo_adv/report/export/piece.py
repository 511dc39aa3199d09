"""Select what is exported of a run: a part of an attempt or of the unattacked run, and the lanes around it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats, Role, Track
from sumo_adv.drivers.protocol import DriverInside
from sumo_adv.errors import UsageError
from sumo_adv.metrics.boxes import first_contact, row_of
from sumo_adv.report.manifest import waymo_source
from sumo_adv.report.page_road import ROAD_RADIUS_M, network
from sumo_adv.report.read import MANIFEST_FILE, read_run, reading
from sumo_adv.road_users import RoadUser, road_user
from sumo_adv.simulation.inputs import WaymoSource
from sumo_adv.simulation.lane_links import LaneGraph, NumberedLane, numbered_lane
from sumo_adv.simulation.network import NetworkLane, RoadMap
from sumo_adv.simulation.signals import SignalLog

HEIGHT_M = {"car": 1.5, "truck": 3.2, "bicycle": 1.7, "pedestrian": 1.75, "obstacle": 1.5}  # SUMO has none
WHEELBASE_SHARE, DEFAULT_STEERING_RAD = 0.6, 0.6  # share of the length; maximum steering angle
MIN_TRUCK_LENGTH_M, MIN_CAR_WIDTH_M = 6.5, 1.0
POINT_SPACING_M = 0.5  # distance between points of a spaced line
STANDING_M = 0.01  # an obstacle that stays within this distance stands


@dataclass(frozen=True, slots=True)
class ExportedRun:
    """The exported part of a run.

    Attributes:
        name: The name of the run's input.
        network: The network, a net.xml.
        tracks: The vehicles between ``begin`` and ``end``, in the order of first appearance.
        begin: The beginning of the exported part, in simulation time [s].
        end: The end of the exported part, in simulation time [s].
        step: The step length [s].
        ego: The ego's id.
        adversary: The collider's id; None if unattacked.
        takeover: When the attack begins to drive the adversaries [s]; None if unattacked.
        written: When the run was made.
        supports: The ids of the other adversaries.
        level: The level that the attempt reached; empty if unattacked.
        lights: The states of traffic lights near the ego; empty if unattacked.
        waymo: The record that the run's input was converted from; None if there is none.
        inside: Plans and notes of the ego's driver; empty if unattacked.
    """

    name: str
    network: Path
    tracks: tuple[Track, ...]
    begin: float
    end: float
    step: float
    ego: str
    adversary: str | None
    takeover: float | None
    written: datetime
    supports: tuple[str, ...] = ()
    level: str = ""
    lights: SignalLog = SignalLog({})  # noqa: RUF009 - frozen
    waymo: WaymoSource | None = None
    inside: tuple[DriverInside, ...] = ()

    def track(self, vehicle: str) -> Track:
        """Return the track of a vehicle, which must exist."""
        return next(t for t in self.tracks if t.id == vehicle)

    def contact(self) -> float | None:
        """Return when the boxes of ego and collider first touch [s]; None if they do not."""
        if self.adversary is None:
            return None
        ego, other = self.track(self.ego), self.track(self.adversary)
        start, end = max(ego.time[0], other.time[0]), min(ego.time[-1], other.time[-1])
        if end < start:
            return None
        ego, other = ego.between(start, end), other.between(start, end)
        time = float(first_contact(row_of(ego), row_of(other), ego.time)[0])
        return time if math.isfinite(time) else None


def read_piece(
    folder: Path, *, unattacked: bool = False, before: float | None = None, whole: bool = False
) -> ExportedRun:
    """Read the part of a run to export.

    Args:
        folder: The run's folder.
        unattacked: Whether the unattacked run is exported instead of the attempt that counts.
        before: How long before the takeover the part begins [s]; None takes the run's own history.
        whole: Whether the part begins at the start of the simulation.

    Returns:
        The part.

    Raises:
        UsageError: The folder holds no run, there is nothing to export, the ego is not in the part, or a file is
            damaged.
    """
    run = read_run(folder)
    tracks = run.raw if unattacked else run.best
    if not tracks:
        fault = "no states of the unattacked run" if unattacked else "no states: it met no encounter"
        raise UsageError(f"The run in {folder} has {fault}, so there is nothing to export.")
    with reading(folder):
        settings = run.manifest["settings"]
        file = run.folder / "inputs" / Path(run.manifest["network"]).name
        if not file.is_file():
            raise UsageError(f"{file} is missing, so the run in {run.folder} cannot be exported.")
        takeover = run.outcome["trigger_time"]
        moment = run.outcome["encounter"]["time"] if takeover is None else takeover
        first, end = min(t.time[0] for t in tracks), max(t.time[-1] for t in tracks)
        lead = settings["history"] if before is None else before
        begin = first if whole else max(first, float(moment) - lead)
        shown = [part for t in tracks if (part := t.between(begin, end)).time.size]
        ego = run.outcome["ego"]["id"]
        adversaries = [str(a["id"]) for a in run.outcome.get("adversaries") or []]
        driven = {t.id for t in shown if t.role is Role.ADVERSARY}
        attacked = None if unattacked or not adversaries or adversaries[0] not in driven else adversaries[0]
        supports = [name for name in adversaries[1:] if name in driven and attacked is not None]
        if ego not in {t.id for t in shown}:
            raise UsageError(f"The ego is not in the exported part of the run in {run.folder}; give --whole.")
        best = None if attacked is None else run.outcome.get("best")
        level = "" if best is None else str(run.outcome["attempts"][best]["level"] or "")
        inside = () if unattacked else tuple(each for each in run.inside if begin <= each.time <= end)
        return ExportedRun(
            str(run.manifest["name"]), file, tuple(shown), float(min(t.time[0] for t in shown)), float(end),
            float(settings["step_length"]), ego, attacked, float(takeover) if attacked is not None else None,
            datetime.fromtimestamp((run.folder / MANIFEST_FILE).stat().st_mtime, UTC).replace(microsecond=0),
            tuple(supports), level, SignalLog({}) if unattacked else run.lights, waymo_source(run.manifest), inside,
        )  # fmt: skip


# -- vehicles and words -----------------------------------------------------------------------------------------------


def kind(track: Track) -> str:
    """Classify a vehicle by role and size as car, truck, bicycle, pedestrian or obstacle."""
    user = road_user(track)
    if user is not RoadUser.VEHICLE:
        return "pedestrian" if user is RoadUser.PEDESTRIAN else "bicycle"
    if track.role is Role.OBSTACLE:
        return "obstacle"
    if track.width < MIN_CAR_WIDTH_M:
        return "bicycle"
    return "truck" if track.length >= MIN_TRUCK_LENGTH_M else "car"


def stands(track: Track) -> bool:
    """Return whether a track is an object that never moves. Pedestrians and cyclists may, so they are none."""
    return kind(track) == "obstacle" and bool(max(np.ptp(track.x), np.ptp(track.y)) <= STANDING_M)


def stretches(track: Track, step: float) -> list[Track]:
    """Split a track where states are missing, as in a log that lost sight of the object.

    Args:
        track: The track.
        step: The step length [s].

    Returns:
        The parts without a gap, in order of time; the track itself if it has none.
    """
    breaks = np.flatnonzero(np.diff(track.time) > 1.5 * step) + 1
    return [track.picked(part) for part in np.split(np.arange(len(track.time)), breaks)] if len(breaks) else [track]


def state_at(track: Track, time: float, step: float) -> int | None:
    """Return the index of the track's state at a time; None if it has no state within half a step.

    Args:
        track: The track.
        time: The time [s].
        step: The step length [s].
    """
    k = int(np.searchsorted(track.time, time - step / 2))
    return k if k < len(track.time) and track.time[k] < time + step / 2 else None


def height_of(track: Track, k: int) -> float:
    """Return the height of the road under a vehicle at state ``k`` [m]."""
    return float(np.broadcast_to(track.z, track.x.shape)[k])


def printable(text: str) -> str:
    """Replace characters that XML 1.0 cannot hold, and ``$``, which marks a parameter in OpenSCENARIO."""
    return "".join(c if c.isprintable() and c != "$" else "_" for c in text)


def metres(value: float) -> str:
    """Format a length to 0.1 mm."""
    return f"{value + 0.0:.4f}"


# -- the lanes around the vehicles ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class MapLane(NumberedLane):
    """A lane under a number, with its network."""

    lane: NetworkLane
    road: RoadMap

    def height(self, x: Any, y: Any) -> Any:
        """Return the height [m] of the lane at points (any shape)."""
        return 0.0 * x if self.road.heights is None else self.road.heights.at(self.lane.id, x, y)


def map_lanes(piece: ExportedRun) -> list[MapLane]:
    """Number the lanes for motor vehicles near the vehicles' paths, including the lanes within junctions.

    Args:
        piece: What is exported.

    Returns:
        The lanes within ``ROAD_RADIUS_M`` of the paths, numbered from 1.

    Raises:
        UsageError: The network cannot be read.
    """
    from shapely import MultiPoint, dwithin, linestrings

    road = network(piece.network)
    lanes = [lane for lane in road.lanes.values() if lane.carriageway and len(lane.shape) > 1]
    points = np.concatenate([np.column_stack([t.x, t.y])[::10] for t in piece.tracks])
    near = dwithin([linestrings(lane.shape) for lane in lanes], MultiPoint(points), ROAD_RADIUS_M)
    kept = [lane for lane, is_near in zip(lanes, near, strict=True) if is_near]
    numbers = {lane.id: k for k, lane in enumerate(kept, 1)}
    graph = LaneGraph(road)
    return [_map_lane(lane, road, graph, numbers) for lane in kept]


def _map_lane(lane: NetworkLane, road: RoadMap, graph: LaneGraph, numbers: Mapping[str, int]) -> MapLane:
    made = numbered_lane(
        numbers[lane.id], lane.shape, lane.width, junction=lane.internal, links=graph.links(lane), numbers=numbers
    )
    return MapLane(**{each.name: getattr(made, each.name) for each in fields(made)}, lane=lane, road=road)


def spaced(line: Floats) -> Floats:
    """Resample a line ``(n, 2)`` with a point about every ``POINT_SPACING_M`` and at its ends."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    stations = np.linspace(0.0, along[-1], max(2, round(along[-1] / POINT_SPACING_M) + 1))
    return np.column_stack([np.interp(stations, along, line[:, k]) for k in (0, 1)])
