"""Export a run as SUMO's floating car data (FCD), as a folder that SUMO plays, and as one tidy CSV.

FCD: The position of each vehicle's front bumper, step by step, as ``sumo --fcd-output`` writes it.

The folder holds network, vehicle types, trajectories and configuration. Plain ``sumo`` or ``sumo-gui`` plays it. SUMO's
``fcd-replay`` device moves each vehicle along its trajectory. Two properties of the device were measured with SUMO
1.28:

- A vehicle is inserted at a position on a lane. So a vehicle whose first position is beside the middle of a lane is
  inserted one step earlier.
- The device builds the route from the lanes in the file, which fails for a vehicle that drives against the traffic. So
  each vehicle has the same lane throughout. Its position does not depend on this lane.
"""

from __future__ import annotations

import math
import shutil
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import repeat
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from sumo_adv.datatypes import Role, Track
from sumo_adv.report.export.piece import ExportedRun, height_of
from sumo_adv.report.tables import quoted
from sumo_adv.road_users import RoadUser, road_user
from sumo_adv.simulation.network import NetworkLane, RoadMap, read_network
from sumo_adv.simulation.sumo_states import angle_deg_of, front_of
from sumo_adv.times import seconds_text

FCD_HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<fcd-export>\n'
CONFIGURATION, TYPES_FILE, TRAJECTORIES, VIEW = "replay.sumocfg", "types.add.xml", "replay.fcd.xml", "view.xml"
ROLE_GUI_COLOURS = {
    Role.EGO: "0,114,178",
    Role.ADVERSARY: "213,94,0",
    Role.BACKGROUND: "140,140,140",
    Role.OBSTACLE: "90,90,90",
}
OFF_CENTRE_M = 0.005  # farther from the lane's middle, a vehicle is inserted earlier
SEARCH_RADII_M = (10.0, 100.0, 1000.0, 100_000.0)
GUI_DELAY_MS = 100  # sumo-gui waits this long at each step
GUI_WIDTH_M = 120.0  # width of the road in sumo-gui's window
TRAJECTORY_HEADER = (
    "time_s,vehicle,role,x_m,y_m,heading_rad,speed_m_s,acceleration_m_s2,length_m,width_m,lane,driven_by_attack,"
    "distance_to_ego_m\n"
)


@dataclass(frozen=True, slots=True)
class TrajectoryRow:
    """A vehicle at one time.

    Attributes:
        time: The time [s].
        id: The vehicle's id.
        kind: The id of its vehicle type.
        x: x of the front bumper [m].
        y: y of the front bumper [m].
        angle: The heading as SUMO's angle [deg].
        speed: The speed [m/s].
        acceleration: The acceleration [m/s2].
        lane: The lane; '' off the road.
        position: The position on the lane [m].
        z: The height [m]; None in a flat network.
    """

    time: float
    id: str
    kind: str
    x: float
    y: float
    angle: float
    speed: float
    acceleration: float
    lane: str
    position: float
    z: float | None = None

    def text(self) -> str:
        """Return the FCD element."""
        z = "" if self.z is None else f'z="{self.z:.4f}" '
        return (
            f'        <vehicle id={quoteattr(self.id)} x="{self.x:.4f}" y="{self.y:.4f}" {z}angle="{self.angle:.4f}" '
            f'type={quoteattr(self.kind)} speed="{self.speed:.4f}" pos="{self.position:.4f}" '
            f'lane={quoteattr(self.lane)} slope="0.00" acceleration="{self.acceleration:.4f}"/>\n'
        )


def fcd(piece: ExportedRun) -> str:
    """Format the exported part as FCD. Off the road, ``lane`` is empty and ``pos`` is 0.

    Args:
        piece: What is exported.

    Returns:
        The XML.

    Raises:
        UsageError: The network cannot be read.
    """
    road = read_network(piece.network)
    rows = (row for track in piece.tracks for row in _track_rows(track, [road.lanes.get(name) for name in track.lane]))
    return _fcd_text(rows, piece)


def _track_rows(track: Track, lanes: Iterable[NetworkLane | None]) -> Iterator[TrajectoryRow]:
    """Yield a row for each state; ``lanes`` are the lanes on which SUMO has the vehicle."""
    kind = _type_name(track)
    for k, lane in zip(range(len(track.time)), lanes, strict=False):
        x, y = front(track, k)
        position = lane.position_of(lane.station_at(x, y)) if lane else 0.0
        yield TrajectoryRow(
            float(track.time[k]), track.id, kind, x, y, angle_deg_of(float(track.heading[k])), float(track.speed[k]),
            float(track.acceleration[k]), lane.id if lane else "", position,
            height_of(track, k) if np.ndim(track.z) else None,
        )  # fmt: skip


def _fcd_text(rows: Iterable[TrajectoryRow], piece: ExportedRun) -> str:
    """Format rows by time; a step without vehicles is left out."""
    steps: dict[int, list[TrajectoryRow]] = defaultdict(list)
    for row in rows:
        steps[round(row.time / piece.step)].append(row)
    parts = [FCD_HEAD]
    for step in sorted(steps):
        parts.append(f'    <timestep time="{seconds_text(steps[step][0].time)}">\n')
        parts += [row.text() for row in steps[step]]
        parts.append("    </timestep>\n")
    parts.append("</fcd-export>\n")
    return "".join(parts)


def front(track: Track, k: int) -> tuple[float, float]:
    """Return the middle of the front bumper [m], which is SUMO's reference point."""
    return front_of(float(track.x[k]), float(track.y[k]), float(track.heading[k]), track.length)


def _type_name(track: Track) -> str:
    return f"{track.role}_{track.length:.2f}x{track.width:.2f}"


def write_replay(folder: Path, piece: ExportedRun) -> None:
    """Write a folder that SUMO plays.

    Args:
        folder: The folder.
        piece: What is exported.

    Raises:
        UsageError: The network cannot be read.
    """
    road = read_network(piece.network)
    network = "net.net.xml.gz" if piece.network.suffix == ".gz" else "net.net.xml"
    rows = [row for track in piece.tracks for row in _rows(track, road, piece)]
    begin = min(row.time for row in rows)
    shutil.copyfile(piece.network, folder / network)
    (folder / TRAJECTORIES).write_text(_fcd_text(rows, piece), encoding="utf-8")
    (folder / TYPES_FILE).write_text(_types(piece), encoding="utf-8")
    (folder / VIEW).write_text(_view(piece, road), encoding="utf-8")
    (folder / CONFIGURATION).write_text(_configuration(piece, network, begin), encoding="utf-8")


def _rows(track: Track, road: RoadMap, piece: ExportedRun) -> Iterator[TrajectoryRow]:
    """Yield the rows of a vehicle, all on one lane, with an earlier first row if it begins beside the lane's middle."""
    home = _home(track, road)
    first, *others = _track_rows(track, repeat(home))
    heading = float(track.heading[0])
    point = home.point_at(home.station_of(first.position))
    if math.dist(point[:2], (first.x, first.y)) > OFF_CENTRE_M or math.cos(point[2] - heading) < math.cos(1e-3):
        before = first.time - piece.step
        yield replace(first, time=before) if before >= 0 else first
    yield first
    yield from others


def _home(track: Track, road: RoadMap) -> NetworkLane:
    """Return the vehicle's first lane outside junctions or, without one, the lane nearest to where it begins."""
    for name in track.lane:
        lane = road.lanes.get(name)
        if lane is not None and not lane.internal:
            return lane
    x, y = float(track.x[0]), float(track.y[0])
    near: list[NetworkLane] = next((lanes for radius in SEARCH_RADII_M if (lanes := road.lanes_near(x, y, radius))), [])
    return min(near, key=lambda lane: float(np.min(np.hypot(lane.shape[:, 0] - x, lane.shape[:, 1] - y))))


def _types(piece: ExportedRun) -> str:
    """Declare a vehicle type for each role and size; it may drive anywhere, and its size is the recorded one."""
    by_name = {_type_name(track): track for track in piece.tracks}
    lines = [
        f'    <vType id={quoteattr(name)} vClass="ignoring" length="{track.length:.2f}" width="{track.width:.2f}" '
        f'minGap="0" maxSpeed="100" guiShape="{_shape(track)}" color="{ROLE_GUI_COLOURS[track.role]}"/>\n'
        for name, track in sorted(by_name.items())
    ]
    return "<additional>\n" + "".join(lines) + "</additional>\n"


def _shape(track: Track) -> str:
    user = road_user(track)
    if user is not RoadUser.VEHICLE:
        return "pedestrian" if user is RoadUser.PEDESTRIAN else "bicycle"
    if track.role is Role.OBSTACLE:
        return "passenger/van"
    return "passenger" if track.length < 6.5 else "truck"


def _view(piece: ExportedRun, road: RoadMap) -> str:
    """Place the view over the closest approach or, without an adversary, the ego's middle; it follows no vehicle."""
    ego = piece.track(piece.ego)
    x, y = float(ego.x[len(ego.x) // 2]), float(ego.y[len(ego.y) // 2])
    if piece.adversary is not None:
        adversary = piece.track(piece.adversary)
        gap = np.hypot(
            ego.x - np.interp(ego.time, adversary.time, adversary.x),
            ego.y - np.interp(ego.time, adversary.time, adversary.y),
        )
        k = int(np.argmin(gap))
        x, y = float(ego.x[k]), float(ego.y[k])
    extent = np.ptp(np.vstack([lane.shape for lane in road.lanes.values()]), axis=0)
    zoom = 100.0 * max(1.0, float(max(extent) / GUI_WIDTH_M))  # sumo-gui's zoom, in percent of the network's extent
    return (
        '<viewsettings>\n    <scheme name="real world"/>\n'
        f'    <viewport x="{x:.2f}" y="{y:.2f}" zoom="{zoom:.0f}"/>\n'
        f'    <delay value="{GUI_DELAY_MS}"/>\n</viewsettings>\n'
    )


def _configuration(piece: ExportedRun, network: str, begin: float) -> str:
    return f"""<configuration>
    <input>
        <net-file value="{network}"/>
        <additional-files value="{TYPES_FILE}"/>
    </input>
    <time>
        <begin value="{seconds_text(begin)}"/>
        <end value="{seconds_text(piece.end + piece.step)}"/>
        <step-length value="{piece.step:g}"/>
    </time>
    <processing>
        <time-to-teleport value="-1"/>
        <collision.action value="none"/>
        <insertion-checks value="none"/>
    </processing>
    <fcd_replay_device>
        <device.fcd-replay.files value="{TRAJECTORIES}"/>
    </fcd_replay_device>
    <report>
        <xml-validation value="never"/>
        <no-step-log value="true"/>
        <no-warnings value="true"/>
    </report>
    <gui_only>
        <gui-settings-file value="{VIEW}"/>
        <start value="true"/>
    </gui_only>
</configuration>
"""


def table(piece: ExportedRun) -> str:
    """Format the exported part as one CSV, by time and then by first appearance.

    x and y are box centres. The distance is between centres and is empty while the ego does not exist.
    ``driven_by_attack`` is 1 for an adversary after the takeover, otherwise 0.

    Args:
        piece: What is exported.

    Returns:
        The CSV.
    """
    ego = piece.track(piece.ego)
    rows: list[tuple[float, int, str]] = []
    for order, track in enumerate(piece.tracks):
        distance = np.hypot(
            track.x - np.interp(track.time, ego.time, ego.x), track.y - np.interp(track.time, ego.time, ego.y)
        )
        there = (track.time > ego.time[0] - piece.step / 2) & (track.time < ego.time[-1] + piece.step / 2)
        for k, time in enumerate(track.time.tolist()):
            numbers = f"{track.x[k]:.4f},{track.y[k]:.4f},{track.heading[k]:.6f},{track.speed[k]:.4f}"
            driven = track.role is Role.ADVERSARY and piece.takeover is not None and time > piece.takeover + 5e-4
            text = (
                f"{seconds_text(time)},{quoted(track.id)},{track.role},{numbers},{track.acceleration[k]:.4f},{track.length:.2f},"
                f"{track.width:.2f},{quoted(track.lane[k])},{int(driven)},{f'{distance[k]:.4f}' if there[k] else ''}\n"
            )
            rows.append((time, order, text))
    rows.sort(key=lambda row: row[:2])
    return TRAJECTORY_HEADER + "".join(row[2] for row in rows)
