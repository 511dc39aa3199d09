"""Write a scenario that ``run`` accepts from a record and its network: tracks, routes, parked vehicles, crosswalks.

The clock begins with the record's first step, and a step takes 0.1 s. Coordinates are the record's own. The ego is the
vehicle that recorded (``sdc``), under its own track id. Its warm-up ends at the record's current step.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby, pairwise
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sumo_adv.datatypes import Floats
from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap
from sumo_adv.simulation.scenario import NETWORK_FILE, ROUTES_FILE, SCENARIO_FILE, TRACKS_FILE
from sumo_adv.simulation.tracks import OBJECT_KINDS, LoggedTrack, TrackLog, write_tracks
from sumo_adv.womd.lines import LineSegments
from sumo_adv.womd.matching import LaneLink, MatchedStretch, SumoNet
from sumo_adv.womd.record import RECORD_STEP_S, TRACK_KINDS, VEHICLE, ObjectTrack, Record

WOMD_ROUTE_EXTENSION_M = 300.0  # by which a route is extended beyond the log, if the network allows
_STRAIGHTEST = "slrLRt"  # SUMO's letters of direction, in order of preference
MAX_PARKED_MOTION_M = 1.0  # maximum apparent motion of a parked vehicle
MAX_PARKED_SPEED_M_S = 0.5  # maximum median speed of a parked vehicle; a standing one has apparent speeds, too
MIN_PARKED_STATES = 10  # a vehicle with fewer valid states (less than 1 s) may have been driving
MAX_QUEUE_OFFSET_M = 1.5  # a standing vehicle this near to a lane's centre line queues rather than parks
MAX_QUEUE_ANGLE_RAD = 0.52  # maximum angle between a queuing vehicle and the lane
MAX_FLIPPED_OFFSET_M = 1.0  # this near to a centre line, a heading against the lane is taken for a flipped one
MAX_SPEED_ERROR_M_S = 2.5  # a recorded speed that differs more from the positions is wrong
SPEED_CHECK_STEPS = 5  # steps around a state of which the median counts; odd, so that jumps to and fro cancel
CROSSWALKS = "crosswalks.add.xml"


class Router:
    """Makes routes on one network."""

    def __init__(self, net: SumoNet) -> None:
        """Index the connections for cars."""
        self._net = net
        self._from: dict[str, list[LaneLink]] = {}  # edge -> links of cars that leave it
        self._through: dict[str, LaneLink] = {}  # internal lane -> its link
        for link in net.links:
            if net.lanes[link.start].cars and net.lanes[link.end].cars:
                self._from.setdefault(net.lanes[link.start].edge, []).append(link)
                for lane in net.inner(link):
                    self._through[lane] = link

    def route(self, stretches: Sequence[MatchedStretch], step: int) -> tuple[str, ...]:
        """Return the route of a vehicle.

        The route begins with the edge of the stretch's first lane or, if that lane is inside a junction, with the edge
        before it. It ends with an edge that nothing follows, or once it is ``WOMD_ROUTE_EXTENSION_M`` longer than the
        stretch. If the stretch's edges are not connected, only the connected part with the vehicle's edge is used.

        Args:
            stretches: The matched stretches of the vehicle's track.
            step: The time step. The stretch at this step or the next one after it is used, otherwise the last one.

        Returns:
            The edge ids; empty if there are no stretches.
        """
        chosen = next((s for s in stretches if s.steps[-1] >= step), stretches[-1] if stretches else None)
        if chosen is None:
            return ()
        *before, last = self._parts(self.edges(chosen))
        current = next(
            lane for at, lane in zip(chosen.steps, chosen.lanes, strict=True) if at >= min(step, chosen.steps[-1])
        )
        link = self._through.get(current)  # for an internal lane, the edge before it counts
        edge = self._net.lanes[current if link is None else link.start].edge
        for part in before:
            if edge in part:
                return tuple(part + self._on(part, ""))
        return tuple(last + self._on(last, chosen.driven[-1]))

    def unbroken(self, stretches: Sequence[MatchedStretch]) -> bool:
        """Return whether a track is at most one stretch, with edges that follow one another."""
        return len(stretches) <= 1 and all(len(self._parts(self.edges(s))) == 1 for s in stretches)

    def _parts(self, edges: list[str]) -> list[list[str]]:
        """Split the edges where none leads to the next."""
        parts = [edges[:1]]
        for before, after in pairwise(edges):
            if any(self._net.lanes[link.end].edge == after for link in self._from.get(before, ())):
                parts[-1].append(after)
            else:
                parts.append([after])
        return parts

    def edges(self, stretch: MatchedStretch) -> list[str]:
        """Return the edges of a stretch outside junctions.

        They include the edges from which its first, and to which its last internal lane leads.
        """
        edges: list[str] = []
        pending: LaneLink | None = None
        for lane in stretch.driven:
            link = self._through.get(lane)
            if link is not None and not edges:
                edges.append(self._net.lanes[link.start].edge)
            if not self._net.lanes[lane].internal:
                edges.append(self._net.lanes[lane].edge)
            pending = link
        if pending is not None:
            edges.append(self._net.lanes[pending.end].edge)
        return [edge for edge, _ in groupby(edges)]

    def _on(self, edges: Sequence[str], lane: str) -> list[str]:
        """Return edges that extend the last one: where the lane leads, and straight on if there is a choice."""
        added: list[str] = []
        length = 0.0
        last = edges[-1] if edges else ""
        while length < WOMD_ROUTE_EXTENSION_M:
            options = [k for k in self._from.get(last, ()) if self._net.lanes[k.end].edge not in {*edges, *added}]
            if not options:
                break
            best = min(options, key=lambda k: (k.start != lane, _STRAIGHTEST.find(k.direction), k.end))
            lane, last = best.end, self._net.lanes[best.end].edge
            length += self._net.lanes[lane].length
            added.append(last)
        return added


def write_scene(record: Record, net: SumoNet, matched: Mapping[int, Sequence[MatchedStretch]], folder: Path) -> None:
    """Write the scenario, tracks, routes and crosswalks beside the network.

    Args:
        record: The record, with steps 0.1 s apart (``evenly_sampled``).
        net: The network.
        matched: The matched stretches of each track by its id.
        folder: The folder of the network.

    Raises:
        UsageError: The ego is never seen.
    """
    ego = record.tracks[record.sdc]
    if not ego.valid.any():
        raise UsageError(f"The record '{record.scenario_id}' never sees its ego, track {ego.id}.")
    parked = parked_vehicles(record, net)
    left_out = {track.id for track in parked}
    moving = [t for t in record.tracks if t.id not in left_out and t.valid.any()]
    time = np.asarray(RECORD_STEP_S * np.arange(len(record.time)), np.float64)
    write_tracks(folder / TRACKS_FILE, TrackLog(time, {str(t.id): _logged(t) for t in moving}))
    _write_xml(folder / ROUTES_FILE, "routes", _routes(record, Router(net), moving, matched))
    _write_xml(folder / CROSSWALKS, "additional", _crosswalks(record))
    (folder / SCENARIO_FILE).write_text(_scenario(record, ego, parked), encoding="utf-8", newline="\n")


def _write_xml(path: Path, tag: str, lines: Iterable[str]) -> None:
    text = "".join(lines)
    path.write_text(f'<?xml version="1.0" encoding="UTF-8"?>\n\n<{tag}>\n{text}</{tag}>\n', "utf-8", newline="\n")


def parked_vehicles(record: Record, net: SumoNet) -> list[ObjectTrack]:
    """Return the vehicles that never move and stand on no lane, without the ego.

    A vehicle with its heading along a lane, or against it and closer to the lane's centre, stands on the lane. Records
    contain headings that are wrong by half a turn.
    """
    standing = [
        t for i, t in enumerate(record.tracks)
        if i != record.sdc and t.kind == VEHICLE and t.valid.any() and _stands(t)
    ]  # fmt: skip
    if not standing:
        return []
    poses = np.array([_pose(t)[:3] for t in standing])
    lanes = LineSegments({name: lane.shape for name, lane in net.lanes.items() if lane.cars})
    hits = lanes.near(poses[:, :2], MAX_QUEUE_OFFSET_M, poses[:, 2])
    flipped = (np.pi - hits.turned < MAX_QUEUE_ANGLE_RAD) & (hits.distance < MAX_FLIPPED_OFFSET_M)
    queued = set(hits.point[(hits.turned < MAX_QUEUE_ANGLE_RAD) | flipped].tolist())
    return [t for i, t in enumerate(standing) if i not in queued]


def _stands(track: ObjectTrack) -> bool:
    """Return whether an object never moves, and is seen for long enough to tell."""
    keep = track.valid
    if np.count_nonzero(keep) < MIN_PARKED_STATES:
        return False
    x, y = track.x[keep], track.y[keep]
    speed = float(np.median(np.hypot(track.vx[keep], track.vy[keep])))
    return float(np.hypot(x - x[0], y - y[0]).max()) <= MAX_PARKED_MOTION_M and speed < MAX_PARKED_SPEED_M_S


def _pose(track: ObjectTrack) -> tuple[float, float, float, float, float]:
    """Return a standing object's x, y [m], heading [rad], length and width [m]: medians over its valid states."""
    keep = track.valid
    heading = track.heading[keep]
    mean = np.arctan2(np.median(np.sin(heading)), np.median(np.cos(heading)))
    x, y, length, width = (float(np.median(v[keep])) for v in (track.x, track.y, track.length, track.width))
    return x, y, float(mean), length, width


def _logged(track: ObjectTrack) -> LoggedTrack:
    """Return a track of the record as a track of the log."""
    kind = TRACK_KINDS[track.kind] if 0 <= track.kind < len(TRACK_KINDS) else ""
    *_, length, width = _pose(track)
    return LoggedTrack(
        id=str(track.id), kind=kind if kind in OBJECT_KINDS else "other", valid=track.valid, x=track.x, y=track.y,
        heading=wrap(track.heading), speed=_speeds(track), length=length, width=width,
    )  # fmt: skip


def _speeds(track: ObjectTrack) -> Floats:
    """Return the speeds [m/s], from the positions where the recorded velocity contradicts them.

    The velocities of a newly seen object, and single ones later, are often wrong. So are some positions. The median
    over the steps around a state is not affected by one wrong position. A track of fewer steps is not compared.
    """
    speed = np.hypot(track.vx, track.vy)
    valid = np.flatnonzero(track.valid)
    if len(valid) <= SPEED_CHECK_STEPS:
        return speed
    velocities = np.diff(np.stack([track.x[valid], track.y[valid]]), axis=1) / (RECORD_STEP_S * np.diff(valid))
    windows = np.median(sliding_window_view(velocities, SPEED_CHECK_STEPS, axis=1), axis=2)
    around = np.clip(np.arange(len(valid)) - SPEED_CHECK_STEPS // 2, 0, windows.shape[1] - 1)
    motion = np.hypot(*windows[:, around])
    wrong = np.abs(motion - speed[valid]) > MAX_SPEED_ERROR_M_S
    speed[valid[wrong]] = motion[wrong]
    return speed


def _routes(
    record: Record, router: Router, tracks: Sequence[ObjectTrack], matched: Mapping[int, Sequence[MatchedStretch]]
) -> Iterator[str]:
    """Yield the routes of vehicles that are on the network at the hand-over or later, under their track ids."""
    for track in tracks:
        if edges := router.route(matched.get(track.id, ()), record.current):
            yield f'    <route id="{track.id}" edges="{" ".join(edges)}"/>\n'


def _crosswalks(record: Record) -> Iterator[str]:
    """Yield the crosswalks as filled polygons over the road, for sumo-gui; they do not affect any vehicle."""
    for area in record.areas:
        if area.kind == "crosswalk" and len(area.points) > 2:
            shape = " ".join(f"{x:.3f},{y:.3f}" for x, y in area.points[:, :2].tolist())
            yield (
                f'    <poly id="crosswalk{area.id}" type="crosswalk" color="230,230,230,160" fill="true" layer="1" '
                f'shape="{shape}"/>\n'
            )


def _scenario(record: Record, ego: ObjectTrack, parked: Sequence[ObjectTrack]) -> str:
    """Return the text of the scenario file."""
    first = int(np.flatnonzero(ego.valid)[0])
    predicted = ", ".join(str(record.tracks[i].id) for i in record.to_predict) or "none"
    interest = ", ".join(map(str, record.objects_of_interest)) or "none"
    text = f"""\
# Converted from the record {record.scenario_id}: {len(record.time)} steps, the current one at \
{RECORD_STEP_S * record.current:.1f} s.
# Objects of interest: {interest}. Tracks to predict: {predicted}.
schema = 1
network = "{NETWORK_FILE}"
tracks = "{TRACKS_FILE}"
additional = ["{CROSSWALKS}"]

[demand]
files = ["{ROUTES_FILE}"]
begin = 0.0

[ego]
id = "{ego.id}"

[window]
warm_up = {RECORD_STEP_S * max(record.current - first, 0):.1f}
"""
    for track in parked:
        x, y, heading, length, width = _pose(track)
        text += (
            f"\n[[parked]]  # track {track.id}\nx = {x:.3f}\ny = {y:.3f}\nheading = {heading:.4f}\n"
            f"length = {length:.3f}\nwidth = {width:.3f}\n"
        )
    return text
