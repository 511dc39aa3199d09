"""From a record and its network to a scenario that ``run`` takes: tracks, routes, parked vehicles, crosswalks.

The clock begins with the record's first step, 0.1 s a step; coordinates are the record's own. The ego is the vehicle
that recorded (``sdc``), under its own track id, and its warm-up ends at the record's current step.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap
from sumo_adv.simulation.tracks import KINDS, LoggedTrack, TrackLog, write_tracks
from sumo_adv.womd.matching import Stretch
from sumo_adv.womd.record import TRACK_KINDS, ObjectTrack, Record
from sumo_adv.womd.routes import Router
from sumo_adv.womd.sampling import STEP
from sumo_adv.womd.segments import Segments
from sumo_adv.womd.sumonet import SumoNet

STANDING = 1.0  # m that a parked vehicle may seem to move
QUEUED = 1.5  # m from a lane's centre line within which a standing vehicle queues rather than parks
QUEUED_TURN = 0.52  # rad between it and the lane
VEHICLE = 1  # index of TRACK_KINDS

NETWORK, SCENARIO, TRACKS, ROUTES = "network.net.xml", "scenario.toml", "tracks.csv.gz", "routes.rou.xml"
CROSSWALKS = "crosswalks.add.xml"


def write_scene(record: Record, net: SumoNet, matched: Mapping[int, Sequence[Stretch]], folder: Path) -> None:
    """Scenario, tracks, routes and crosswalks into ``folder``, beside the network there.

    The record's steps are 0.1 s apart (``sampling.evenly_sampled``). Raises UsageError if its ego is never seen.
    """
    ego = record.tracks[record.sdc]
    if not ego.valid.any():
        raise UsageError(f"The record '{record.scenario_id}' never sees its ego, track {ego.id}.")
    parked = parked_vehicles(record, net)
    left_out = {track.id for track in parked}
    moving = [t for t in record.tracks if t.id not in left_out and t.valid.any()]
    write_tracks(folder / TRACKS, track_log(record, moving))
    _write_routes(record, Router(net), moving, matched, folder / ROUTES)
    _write_crosswalks(record, folder / CROSSWALKS)
    (folder / SCENARIO).write_text(_scenario(record, ego, parked), encoding="utf-8", newline="\n")


def parked_vehicles(record: Record, net: SumoNet) -> list[ObjectTrack]:
    """Vehicles that never move and stand on no lane, the ego never among them."""
    standing = [
        t for i, t in enumerate(record.tracks)
        if i != record.sdc and t.kind == VEHICLE and t.valid.any() and _stands(t)
    ]  # fmt: skip
    if not standing:
        return []
    poses = np.array([pose(t)[:3] for t in standing])
    lanes = Segments({name: lane.shape for name, lane in net.lanes.items() if lane.cars})
    hits = lanes.near(poses[:, :2], QUEUED, poses[:, 2])
    queued = set(hits.point[hits.turned < QUEUED_TURN].tolist())
    return [t for i, t in enumerate(standing) if i not in queued]


def _stands(track: ObjectTrack) -> bool:
    x, y = track.x[track.valid], track.y[track.valid]
    return float(np.hypot(x - x[0], y - y[0]).max()) <= STANDING


def pose(track: ObjectTrack) -> tuple[float, float, float, float, float]:
    """A standing object's x, y [m], heading [rad], length, width [m]: medians over what was seen."""
    keep = track.valid
    heading = track.heading[keep]
    mean = np.arctan2(np.median(np.sin(heading)), np.median(np.cos(heading)))
    x, y, length, width = (float(np.median(v[keep])) for v in (track.x, track.y, track.length, track.width))
    return x, y, float(mean), length, width


def track_log(record: Record, tracks: Sequence[ObjectTrack]) -> TrackLog:
    """Tracks on the scenario's clock."""
    time = np.asarray(STEP * np.arange(len(record.time)), np.float64)
    return TrackLog(time, {str(t.id): _logged(t) for t in tracks})


def _logged(track: ObjectTrack) -> LoggedTrack:
    kind = TRACK_KINDS[track.kind] if 0 <= track.kind < len(TRACK_KINDS) else ""
    *_, length, width = pose(track)
    return LoggedTrack(
        id=str(track.id), kind=kind if kind in KINDS else "other", valid=track.valid, x=track.x, y=track.y,
        heading=wrap(track.heading), speed=np.hypot(track.vx, track.vy), length=length, width=width,
    )  # fmt: skip


def _write_routes(
    record: Record, router: Router, tracks: Sequence[ObjectTrack], matched: Mapping[int, Sequence[Stretch]], path: Path
) -> None:
    """The routes of vehicles that are on the network when they are handed over or later, under their track ids."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>\n\n<routes>\n']
    for track in tracks:
        edges = router.route(matched.get(track.id, ()), record.current)
        if edges:
            lines.append(f'    <route id="{track.id}" edges="{" ".join(edges)}"/>\n')
    path.write_text("".join([*lines, "</routes>\n"]), encoding="utf-8", newline="\n")


def _write_crosswalks(record: Record, path: Path) -> None:
    """The crosswalks as filled polygons over the road, for sumo-gui; they rule no vehicle's way."""
    lines = ['<?xml version="1.0" encoding="UTF-8"?>\n\n<additional>\n']
    for area in record.areas:
        if area.kind == "crosswalk" and len(area.points) > 2:
            shape = " ".join(f"{x:.3f},{y:.3f}" for x, y in area.points[:, :2].tolist())
            lines.append(
                f'    <poly id="crosswalk{area.id}" type="crosswalk" color="230,230,230,160" fill="true" layer="1" '
                f'shape="{shape}"/>\n'
            )
    path.write_text("".join([*lines, "</additional>\n"]), encoding="utf-8", newline="\n")


def _scenario(record: Record, ego: ObjectTrack, parked: Sequence[ObjectTrack]) -> str:
    """The scenario file's text."""
    first = int(np.flatnonzero(ego.valid)[0])
    predicted = ", ".join(str(record.tracks[i].id) for i in record.to_predict) or "none"
    interest = ", ".join(map(str, record.objects_of_interest)) or "none"
    text = f"""\
# Converted from the record {record.scenario_id}: {len(record.time)} steps, the current one at \
{STEP * record.current:.1f} s.
# Objects of interest: {interest}. Tracks to predict: {predicted}.
schema = 1
network = "{NETWORK}"
tracks = "{TRACKS}"
additional = ["{CROSSWALKS}"]

[demand]
files = ["{ROUTES}"]
begin = 0.0

[ego]
id = "{ego.id}"

[window]
warm_up = {STEP * max(record.current - first, 0):.1f}
"""
    for track in parked:
        x, y, heading, length, width = pose(track)
        text += (
            f"\n[[parked]]  # track {track.id}\nx = {x:.3f}\ny = {y:.3f}\nheading = {heading:.4f}\n"
            f"length = {length:.3f}\nwidth = {width:.3f}\n"
        )
    return text
