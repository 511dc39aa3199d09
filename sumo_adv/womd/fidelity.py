"""Measure how faithful a converted network is to its record.

The report covers lengths, deviations, connections, signals, vehicles and routes. Everything is measured on the finished
net.xml. Bike lanes are compared with lanes that bicycles may use, and all other lanes with lanes that cars may use.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.files import write_whole
from sumo_adv.womd.lines import MAX_CONNECTION_GAP_M, LineSegments, line_stations, resample
from sumo_adv.womd.matching import (
    MAX_MATCH_ANGLE_RAD,
    LaneGraph,
    MatchedStretch,
    SumoNet,
    match,
    net_graph,
    record_graph,
)
from sumo_adv.womd.record import BIKE, VEHICLE, ObjectTrack, Record
from sumo_adv.womd.scene import Router

if TYPE_CHECKING:
    from sumo_adv.womd.network import ConvertedNetwork, LanePiece

LANE_SAMPLE_STEP_M = 0.5  # between samples of a lane
FIRST_LANE_SEARCH_DISTANCE_M = 1.0  # radius of the first search for the nearest SUMO lane
MAX_LANE_DEVIATION_M = 20.0  # radius of the second search, and the largest deviation that is reported
SAME_DIRECTION_RAD = 0.8  # maximum angle at which a SUMO lane has the same direction
PIECE_END_TOLERANCE_M = 0.3  # a piece this near to a lane's end is its first or last
HALF_LANE_WIDTH_M = 1.75  # half width around a centre line that counts as the lane
MIN_LOGGED_SPEED_M_S = 1.0  # a faster logged vehicle counts as moving
MIN_DRIVEN_DISTANCE_M = 5.0  # a longer track counts as driven
# Lower bound, upper bound, colour.
DEVIATION_BANDS_M = ((0.1, 0.5, "#F0E442"), (0.5, 1.0, "#E69F00"), (1.0, np.inf, "#D55E00"))
DATASET_COLOUR, OUTSIDE_COLOUR, INSIDE_COLOUR, PICTURED_EGO_COLOUR = "#BBD7EA", "#333333", "#009E73", "#0072B2"
PICTURE_WIDTH_IN, MIN_PICTURE_HEIGHT_IN, MAX_PICTURE_HEIGHT_IN = 14.0, 6.0, 18.0  # inches; 100 dots an inch
FIDELITY_COLUMNS = (
    "record", "km", "kept %", "<0.1 m %", "<0.5 m %", "p99 m", "links", "signals", "inside %", "centre %", "broken",
    "junct. %", "traffic", "s",
)  # fmt: skip
LEGEND = """\
km of lanes, the share kept in SUMO, shares of samples so near to a SUMO lane, 99th percentile; connections and signal
lanes kept; logged moving vehicles inside a SUMO lane, within 1.75 m of a centre line of the record, both of their
direction; tracks whose lanes break in SUMO / in the record / driven; lane length inside junctions; random traffic:
vehicles, collisions, teleports; seconds to the network."""
Report = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Deviations:
    """Samples of all lanes.

    Attributes:
        xy: The places of the samples, ``(n, 2)`` [m].
        distance: The distance to the nearest SUMO lane of the same direction, ``(n,)`` [m], at most
            ``MAX_LANE_DEVIATION_M``.
    """

    xy: Floats
    distance: Floats


@dataclass(frozen=True, slots=True)
class Fidelity:
    """The fidelity of one record.

    Attributes:
        report: The report as plain values.
        deviations: The samples behind it.
        matched: The stretches of each vehicle's track by its id.
    """

    report: Mapping[str, Any]
    deviations: Deviations
    matched: Mapping[int, tuple[MatchedStretch, ...]]


def measure_fidelity(record: Record, net: SumoNet, converted: ConvertedNetwork) -> Fidelity:
    """Return every figure of the report except random traffic and computing time.

    Args:
        record: The record.
        net: The converted network.
        converted: The result of the conversion.

    Returns:
        The fidelity.
    """
    deviations = lane_deviations(record, net)
    graph = net_graph(net)
    tracks = [t for t in record.tracks if t.kind == VEHICLE]
    matched = {t.id: match(graph, t) for t in tracks}
    report = {
        "scenario_id": record.scenario_id, "steps": len(record.time), "current": record.current,
        "tracks": len(record.tracks), "lanes": len(record.lanes),
        **_lengths(record, converted.pieces), "deviation": _percentiles(deviations),
        "connectivity": connectivity(record, net, converted.pieces), "signals": _signals(record, net, converted.pieces),
        "vehicles": inside_lanes(record, net), "routes": _routes(record, Router(net), tracks, matched),
        "converter": dict(converted.report),
    }  # fmt: skip
    return Fidelity(report, deviations, matched)


def kept_lanes(record: Record) -> dict[int, Floats]:
    """Return the centre lines ``(n, 3)`` [m] of all lanes that have a length, by id."""
    return {
        i: lane.points
        for i, lane in record.lanes.items()
        if len(lane.points) > 1 and line_stations(lane.points)[-1] > 0
    }


def lane_deviations(record: Record, net: SumoNet) -> Deviations:
    """Sample all lanes every ``LANE_SAMPLE_STEP_M``, and measure the distance to SUMO's lanes."""
    places, distances = [np.empty((0, 2))], [np.empty(0)]
    for bikes in (False, True):
        lines = [p for i, p in kept_lanes(record).items() if (record.lanes[i].kind == BIKE) == bikes]
        if lines:
            samples = [resample(line, LANE_SAMPLE_STEP_M) for line in lines]
            xy, headings = (np.concatenate([s[k] for s in samples]) for k in (1, 2))
            usable = {n: lane.shape for n, lane in net.lanes.items() if (lane.bicycles if bikes else lane.cars)}
            segments, distance = LineSegments(usable), np.full(len(xy), MAX_LANE_DEVIATION_M)
            for radius in (FIRST_LANE_SEARCH_DISTANCE_M, MAX_LANE_DEVIATION_M):
                left = np.flatnonzero(distance == MAX_LANE_DEVIATION_M)
                hits = segments.near(xy[left], radius, headings[left])
                distance[left] = hits.where(hits.turned < SAME_DIRECTION_RAD).least(len(left), MAX_LANE_DEVIATION_M)
            places.append(xy)
            distances.append(distance)
    return Deviations(np.concatenate(places), np.concatenate(distances))


def _percentiles(deviations: Deviations) -> dict[str, float]:
    """Return percentiles of the deviations, and the shares within limits."""
    d = deviations.distance
    p50, p95, p99 = np.percentile(d, (50, 95, 99))
    shares = {f"within_{r:g}": float((d <= r).mean()) for r in (0.1, 0.5, 1.0)}
    return {
        "samples": len(d), **shares, "p50": float(p50), "p95": float(p95), "p99": float(p99), "max": float(d.max()),
    }  # fmt: skip


def _lengths(record: Record, pieces: Mapping[int, Sequence[LanePiece]]) -> dict[str, float]:
    """Return the lane length, the share of it that pieces represent, and the share inside junctions."""
    whole = covered = inside = 0.0
    for i, points in kept_lanes(record).items():
        length = float(line_stations(points)[-1])
        own = pieces.get(i, ())
        whole += length
        covered += _union([(p.start, p.end) for p in own], length)
        inside += _union([(p.start, p.end) for p in own if p.internal], length)
    return {
        "lane_length": whole, "represented": covered / whole if whole else 0.0,
        "in_junctions": inside / whole if whole else 0.0,
    }  # fmt: skip


def _union(ranges: Sequence[tuple[float, float]], length: float) -> float:
    """Return how much of [0, length] the ranges cover together."""
    total, reached = 0.0, 0.0
    for start, end in sorted(ranges):
        start, end = max(start, reached), min(end, length)
        if end > start:
            total, reached = total + end - start, end
    return total


def connectivity(record: Record, net: SumoNet, pieces: Mapping[int, Sequence[LanePiece]]) -> dict[str, Any]:
    """Count the record's connections that can be driven in SUMO.

    A connection is a lane and its exit, less than ``MAX_CONNECTION_GAP_M`` apart. It is kept if SUMO leads from the
    lane's last piece to the exit's first piece.

    Args:
        record: The record.
        net: The converted network.
        pieces: The pieces of each lane by id.

    Returns:
        The numbers ``wanted`` and ``kept``, the ``share``, and the pairs that are ``lost``.
    """
    lines = kept_lanes(record)
    connections = [
        (i, e)
        for i, points in lines.items()
        for e in dict.fromkeys(record.lanes[i].exits)
        if e in lines and np.linalg.norm(points[-1] - lines[e][0]) < MAX_CONNECTION_GAP_M
    ]
    lost = [(a, b) for a, b in connections if not _joined(net, pieces.get(a, ()), pieces.get(b, ()))]
    total, kept = len(connections), len(connections) - len(lost)
    return {"wanted": total, "kept": kept, "share": kept / total if total else 1.0, "lost": lost}


def _joined(net: SumoNet, before: Sequence[LanePiece], after: Sequence[LanePiece]) -> bool:
    """Return whether SUMO leads from a lane's last piece to another lane's first piece."""
    if not before or not after:
        return False
    end, start = max(p.end for p in before), min(p.start for p in after)
    last = {p.sumo_lane for p in before if p.end > end - PIECE_END_TOLERANCE_M}
    first = {p.sumo_lane for p in after if p.start < start + PIECE_END_TOLERANCE_M}
    return bool(first & last) or any(first.intersection(_onward(net, lane)) for lane in last)


def _onward(net: SumoNet, lane: str) -> set[str]:
    """Return the lanes after ``lane``, continuing through lanes shorter than ``MAX_CONNECTION_GAP_M``."""
    reached: set[str] = set()
    queue = list(net.following.get(lane, ()))
    while queue:
        here = queue.pop()
        if here not in reached:
            reached.add(here)
            queue += (
                net.following.get(here, ())
                if here in net.lanes and net.lanes[here].length < MAX_CONNECTION_GAP_M
                else ()
            )
    return reached


def _signals(record: Record, net: SumoNet, pieces: Mapping[int, Sequence[LanePiece]]) -> dict[str, int]:
    """Count the record's signal lanes, those ever seen in a known state, and those that a SUMO signal rules."""
    lanes = {s.lane for step in record.signals for s in step}
    seen = {s.lane for step in record.signals for s in step if s.state}
    ruled = {x for link in net.links if link.signal for x in (link.start, link.via, link.end)}
    ruled |= {o for lane in list(ruled) if lane.startswith(":") for o in net.following.get(lane, ()) if o[0] == ":"}
    mapped = {i for i in lanes if any(p.sumo_lane in ruled for p in pieces.get(i, ()))}
    return {"lanes": len(lanes), "known": len(seen), "mapped": len(mapped)}


def inside_lanes(record: Record, net: SumoNet) -> dict[str, float]:
    """Return how many logged positions of moving vehicles lie in lanes of their direction.

    A lane has a vehicle's direction if the vehicle's heading is within ``MAX_MATCH_ANGLE_RAD`` of it.

    Returns:
        The number of ``states``, the share ``inside`` a SUMO lane, and the share ``near_centre``, within 1.75 m of a
        centre line of the record.
    """
    xy, heading = _moving(record)
    if not len(xy):
        return {"states": 0, "inside": 1.0, "near_centre": 1.0}
    cars = {n: lane for n, lane in net.lanes.items() if lane.cars}
    half = np.array([lane.width / 2 for lane in cars.values()])
    lines = {i: p for i, p in kept_lanes(record).items() if record.lanes[i].kind != BIKE}
    near, inside = np.zeros(len(xy), bool), np.zeros(len(xy), bool)
    hits = LineSegments(lines).near(xy, HALF_LANE_WIDTH_M, heading)
    near[hits.point[hits.turned < MAX_MATCH_ANGLE_RAD]] = True
    hits = LineSegments({n: lane.shape for n, lane in cars.items()}).near(xy, float(half.max(initial=0.0)), heading)
    inside[hits.point[(hits.distance <= half[hits.line]) & (hits.turned < MAX_MATCH_ANGLE_RAD)]] = True
    return {"states": len(xy), "inside": float(inside.mean()), "near_centre": float(near.mean())}


def _moving(record: Record) -> tuple[Floats, Floats]:
    """Return the centres ``(n, 2)`` [m] and headings ``(n,)`` [rad] of all valid states of vehicles that move."""
    parts, headings = [np.empty((0, 2))], [np.empty(0)]
    for t in record.tracks:
        if t.kind == VEHICLE:
            moving = t.valid & (np.hypot(t.vx, t.vy) > MIN_LOGGED_SPEED_M_S)
            parts.append(np.stack([t.x[moving], t.y[moving]], axis=1))
            headings.append(t.heading[moving])
    return np.concatenate(parts), np.concatenate(headings)


def _routes(
    record: Record, router: Router, tracks: Sequence[ObjectTrack], matched: Mapping[int, tuple[MatchedStretch, ...]]
) -> dict[str, Any]:
    """Return the number of driven tracks, and the ids of those that break in SUMO, break in the record, or are on no
    lane.
    """
    own: LaneGraph = record_graph(record)
    driven = [t for t in tracks if np.hypot(np.diff(t.x[t.valid]), np.diff(t.y[t.valid])).sum() > MIN_DRIVEN_DISTANCE_M]
    broken = [t.id for t in driven if not router.unbroken(matched[t.id])]
    own_broken = [t.id for t in driven if len(match(own, t)) > 1]
    return {
        "driven": len(driven), "broken": broken, "own_broken": own_broken,
        "off_lanes": [t.id for t in driven if not matched[t.id]],
    }  # fmt: skip


def draw_fidelity(target: Path, record: Record, net: SumoNet, fidelity: Fidelity) -> None:
    """Draw the record, the network and their deviations as a PNG, 1400 px wide.

    Args:
        target: The file to write.
        record: The record.
        net: The converted network.
        fidelity: The fidelity.

    Raises:
        OSError: The file cannot be written.
    """
    from matplotlib.figure import Figure

    lines = [points[:, :2] for points in kept_lanes(record).values()]
    points = np.concatenate(lines or [np.zeros((1, 2))])
    low, high = points.min(axis=0) - 10.0, points.max(axis=0) + 10.0
    height = float(
        np.clip(
            PICTURE_WIDTH_IN * (high[1] - low[1]) / (high[0] - low[0]), MIN_PICTURE_HEIGHT_IN, MAX_PICTURE_HEIGHT_IN
        )
    )
    figure = Figure(figsize=(PICTURE_WIDTH_IN, height + 1.0), dpi=100, facecolor="white")
    axes = figure.add_axes((0.05, 0.05, 0.93, 0.86))
    _lines(axes, lines, DATASET_COLOUR, 5.0, f"lanes of the record ({len(lines)})")
    for internal, colour, name in (
        (False, OUTSIDE_COLOUR, "SUMO lanes"),
        (True, INSIDE_COLOUR, "SUMO lanes inside junctions"),
    ):
        _lines(axes, [a.shape for a in net.lanes.values() if a.internal == internal], colour, 0.8, name)
    for start, end, colour in DEVIATION_BANDS_M:
        d = fidelity.deviations
        chosen = d.xy[(d.distance > start) & (d.distance <= end)]
        name = f"{start:g} to {end:g} m off" if np.isfinite(end) else f"over {start:g} m off"
        axes.plot(*chosen.T, "o", ms=4, color=colour, zorder=5, label=f"{name} ({len(chosen)} samples)")
    ego = record.tracks[record.sdc]
    axes.plot(
        ego.x[ego.valid],
        ego.y[ego.valid],
        color=PICTURED_EGO_COLOUR,
        lw=1.8,
        ls=(0, (3, 2)),
        zorder=4,
        label="ego's log",
    )
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    axes.set_aspect("equal")
    axes.legend(loc="best", fontsize=9)
    figure.text(0.05, 0.96, _title(fidelity), fontsize=12, va="top", parse_math=False)
    write_whole(target, lambda part: figure.savefig(part, format="png", metadata={"Software": None}))


def _lines(axes: Any, lines: list[Any], colour: str, width: float, name: str) -> None:
    from matplotlib.collections import LineCollection

    axes.add_collection(LineCollection(lines, colors=colour, linewidths=width, label=name))


def _title(fidelity: Fidelity) -> str:
    """Return the title of the picture."""
    r = fidelity.report
    return (
        f"{r['scenario_id']}: {r['lane_length'] / 1000:.2f} km of lanes, {100 * r['represented']:.1f} % represented; "
        f"within 0.1 m {100 * r['deviation']['within_0.1']:.2f} %, 0.5 m {100 * r['deviation']['within_0.5']:.2f} %; "
        f"connections {r['connectivity']['kept']} of {r['connectivity']['wanted']}"
    )


def row(report: Report) -> tuple[str, ...]:
    """Return one record's cells of the table; ``LEGEND`` explains them."""
    d, c, s, v, r = (report[k] for k in ("deviation", "connectivity", "signals", "vehicles", "routes"))
    t = report["traffic"]
    return (
        report["scenario_id"], f"{report['lane_length'] / 1000:.2f}", _percent(report["represented"]),
        _percent(d["within_0.1"]), _percent(d["within_0.5"]), f"{d['p99']:.3f}", f"{c['kept']}/{c['wanted']}",
        f"{s['mapped']}/{s['lanes']}", _percent(v["inside"]), _percent(v["near_centre"]),
        f"{len(r['broken'])}/{len(r['own_broken'])}/{r['driven']}", _percent(report["in_junctions"]),
        "-" if t is None else f"{t['vehicles']}/{t['collisions']}/{t['teleports']}",
        f"{report['seconds']['network']:.2f}",
    )  # fmt: skip


def _percent(share: float) -> str:
    return f"{100 * share:.2f}"
