"""How faithful a converted network is to its record: lengths, deviations, connections, signals, vehicles, routes.

Everything is measured on the finished net.xml. Bike lanes are compared with lanes that bicycles may use, all others
with lanes that cars may use.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.womd.matching import BIKE, LaneGraph, Stretch, match, net_graph, record_graph
from sumo_adv.womd.record import ObjectTrack, Record
from sumo_adv.womd.routes import Router
from sumo_adv.womd.segments import Segments, resample, stations
from sumo_adv.womd.sumonet import SumoNet

if TYPE_CHECKING:
    from sumo_adv.womd.network import ConvertedNetwork, Piece

SAMPLE_STEP = 0.5  # m between samples of a lane
NEAR = 1.0  # m within which a lane's own SUMO lane is looked for
FAR = 20.0  # m: deviations are not looked for beyond
ALONG = 0.8  # rad within which a SUMO lane leads the same way
MAX_GAP = 1.0  # m between a lane and its exit that still counts as a connection
ENDS = 0.3  # m within which a piece is a lane's first or last
WOMD_HALF_WIDTH = 1.75  # m about a centre line that counts as the lane
MOVING_SPEED = 1.0  # m/s from which a logged vehicle counts as moving
DRIVEN = 5.0  # m that a track must cover to count as driven
VEHICLE = 1  # index of TRACK_KINDS


@dataclass(frozen=True, slots=True)
class Deviations:
    """Samples of all lanes. xy ``(n, 2)`` m; distance ``(n,)`` m to the nearest SUMO lane of the same direction, at
    most ``FAR``; own ``(n,)`` m to the SUMO lane that is said to stand for it, ``FAR`` where that is over ``NEAR``."""

    xy: Floats
    distance: Floats
    own: Floats


@dataclass(frozen=True, slots=True)
class Fidelity:
    """The report of one record as plain values, the samples behind it, and every driven track's stretches."""

    report: Mapping[str, Any]
    deviations: Deviations
    matched: Mapping[int, tuple[Stretch, ...]]


def measure(record: Record, net: SumoNet, converted: ConvertedNetwork) -> Fidelity:
    """Every figure of the report but random traffic and the time it took."""
    deviations = lane_deviations(record, net, converted.pieces)
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
    """The centre lines ``(n, 3)`` of all lanes that have a length."""
    return {
        i: lane.points for i, lane in record.lanes.items() if len(lane.points) > 1 and stations(lane.points)[-1] > 0
    }


def lane_deviations(record: Record, net: SumoNet, pieces: Mapping[int, Sequence[Piece]]) -> Deviations:
    """Samples every ``SAMPLE_STEP`` m of all lanes, and how far SUMO's lanes are from them."""
    parts = []
    for bikes in (False, True):
        lines = {i: p for i, p in kept_lanes(record).items() if (record.lanes[i].kind == BIKE) == bikes}
        usable = {n: lane.shape for n, lane in net.lanes.items() if (lane.bicycles if bikes else lane.cars)}
        parts += [_deviations(lines, usable, net, pieces)] if lines else []
    return Deviations(*(np.concatenate([getattr(p, f) for p in parts]) for f in ("xy", "distance", "own")))


def _deviations(
    lines: Mapping[int, Floats], usable: Mapping[str, Floats], net: SumoNet, pieces: Mapping[int, Sequence[Piece]]
) -> Deviations:
    samples = {i: resample(p, SAMPLE_STEP) for i, p in lines.items()}
    xy = np.concatenate([s[1] for s in samples.values()])
    headings = np.concatenate([s[2] for s in samples.values()])
    segments = Segments(usable)
    distance = np.full(len(xy), FAR)
    for radius in (NEAR, FAR):
        left = np.flatnonzero(distance == FAR)
        hits = segments.near(xy[left], radius, headings[left])
        distance[left] = hits.where(hits.turned < ALONG).least(len(left), FAR)
    own = np.concatenate([_own(s, pieces.get(i, ()), net) for i, s in samples.items()])
    return Deviations(xy, distance, own)


def _own(sample: tuple[Floats, Floats, Floats], pieces: Sequence[Piece], net: SumoNet) -> Floats:
    """Distance of one lane's samples to the SUMO lanes of its pieces."""
    at, xy, _ = sample
    distance = np.full(len(at), FAR)
    for piece in pieces:
        over = np.flatnonzero((at >= piece.start - ENDS) & (at <= piece.end + ENDS))
        if len(over) and piece.sumo_lane in net.lanes:
            lane = Segments({0: net.lanes[piece.sumo_lane].shape})
            distance[over] = np.minimum(distance[over], lane.near(xy[over], NEAR).least(len(over), FAR))
    return distance


def _percentiles(deviations: Deviations) -> dict[str, float]:
    d = deviations.distance
    p50, p95, p99 = np.percentile(d, (50, 95, 99))
    shares = {f"within_{r:g}": float((d <= r).mean()) for r in (0.1, 0.5, 1.0)}
    own = {f"own_within_{r:g}": float((deviations.own <= r).mean()) for r in (0.1, 0.5)}
    return {
        "samples": len(d), **shares, **own, "p50": float(p50), "p95": float(p95), "p99": float(p99),
        "max": float(d.max()),
    }  # fmt: skip


def _lengths(record: Record, pieces: Mapping[int, Sequence[Piece]]) -> dict[str, float]:
    """Lane length, the share of it that pieces represent, and the share inside junctions."""
    whole = covered = inside = interpolating = 0.0
    for i, points in kept_lanes(record).items():
        length = float(stations(points)[-1])
        own = pieces.get(i, ())
        whole += length
        interpolating += length * record.lanes[i].interpolating
        covered += _union([(p.start, p.end) for p in own], length)
        inside += _union([(p.start, p.end) for p in own if p.internal], length)
    return {
        "lane_length": whole, "represented": covered / whole if whole else 0.0,
        "in_junctions": inside / whole if whole else 0.0, "interpolating": interpolating / whole if whole else 0.0,
    }  # fmt: skip


def _union(ranges: Sequence[tuple[float, float]], length: float) -> float:
    """How much of [0, length] the ranges cover together."""
    total, reached = 0.0, 0.0
    for start, end in sorted(ranges):
        start, end = max(start, reached), min(end, length)
        if end > start:
            total, reached = total + end - start, end
    return total


def wanted_connections(record: Record) -> list[tuple[int, int]]:
    """Pairs of a lane and its exit, both with a length and less than ``MAX_GAP`` m apart."""
    lines = kept_lanes(record)
    return [
        (i, e)
        for i, points in lines.items()
        for e in dict.fromkeys(record.lanes[i].exits)
        if e in lines and np.linalg.norm(points[-1] - lines[e][0]) < MAX_GAP
    ]


def connectivity(record: Record, net: SumoNet, pieces: Mapping[int, Sequence[Piece]]) -> dict[str, Any]:
    """How many of the record's connections can be driven in SUMO, from a lane's last piece to the next one's first."""
    connections = wanted_connections(record)
    lost = [(a, b) for a, b in connections if not _joined(net, pieces.get(a, ()), pieces.get(b, ()))]
    total, kept = len(connections), len(connections) - len(lost)
    return {"wanted": total, "kept": kept, "share": kept / total if total else 1.0, "lost": lost}


def _joined(net: SumoNet, before: Sequence[Piece], after: Sequence[Piece]) -> bool:
    if not before or not after:
        return False
    end, start = max(p.end for p in before), min(p.start for p in after)
    last = {p.sumo_lane for p in before if p.end > end - ENDS}
    first = {p.sumo_lane for p in after if p.start < start + ENDS}
    return bool(first & last) or any(first.intersection(_onward(net, lane)) for lane in last)


def _onward(net: SumoNet, lane: str) -> set[str]:
    """The lanes after ``lane``, and those after them where they are shorter than ``MAX_GAP`` m."""
    reached: set[str] = set()
    queue = list(net.following.get(lane, ()))
    while queue:
        here = queue.pop()
        if here not in reached:
            reached.add(here)
            queue += net.following.get(here, ()) if here in net.lanes and net.lanes[here].length < MAX_GAP else ()
    return reached


def _signals(record: Record, net: SumoNet, pieces: Mapping[int, Sequence[Piece]]) -> dict[str, int]:
    """Signal lanes of the record, those ever seen in a known state, and those that a SUMO signal rules."""
    lanes = {s.lane for step in record.signals for s in step}
    seen = {s.lane for step in record.signals for s in step if s.state}
    ruled = {x for link in net.links if link.signal for x in (link.start, link.via, link.end)}
    ruled |= {o for lane in list(ruled) if lane.startswith(":") for o in net.following.get(lane, ()) if o[0] == ":"}
    mapped = {i for i in lanes if any(p.sumo_lane in ruled for p in pieces.get(i, ()))}
    return {"lanes": len(lanes), "known": len(seen), "mapped": len(mapped)}


def inside_lanes(record: Record, net: SumoNet) -> dict[str, float]:
    """Logged positions of moving vehicles: the share inside a SUMO lane, and within 1.75 m of a WOMD centre line."""
    xy = _moving(record)
    if not len(xy):
        return {"states": 0, "inside": 1.0, "near_centre": 1.0}
    cars = {n: lane for n, lane in net.lanes.items() if lane.cars}
    half = np.array([lane.width / 2 for lane in cars.values()])
    lines = {i: p for i, p in kept_lanes(record).items() if record.lanes[i].kind != BIKE}
    near = Segments(lines).near(xy, WOMD_HALF_WIDTH).least(len(xy), FAR) <= WOMD_HALF_WIDTH
    inside = _within(Segments({n: lane.shape for n, lane in cars.items()}), half, xy)
    return {"states": len(xy), "inside": float(inside.mean()), "near_centre": float(near.mean())}


def _within(segments: Segments, half: Floats, xy: Floats) -> Bools:
    inside = np.zeros(len(xy), bool)
    if len(half):
        hits = segments.near(xy, float(half.max()))
        inside[hits.point[hits.distance <= half[hits.line]]] = True
    return inside


def _moving(record: Record) -> Floats:
    """Centres ``(n, 2)`` of all valid states of vehicles that move."""
    parts = [np.empty((0, 2))]
    for t in record.tracks:
        if t.kind == VEHICLE:
            moving = t.valid & (np.hypot(t.vx, t.vy) > MOVING_SPEED)
            parts.append(np.stack([t.x[moving], t.y[moving]], axis=1))
    return np.concatenate(parts)


def travelled(track: ObjectTrack) -> float:
    """How far a track goes while it is seen, m."""
    return float(np.hypot(np.diff(track.x[track.valid]), np.diff(track.y[track.valid])).sum())


def _routes(
    record: Record, router: Router, tracks: Sequence[ObjectTrack], matched: Mapping[int, tuple[Stretch, ...]]
) -> dict[str, Any]:
    """Driven tracks, those with edges that break in SUMO, and those that break on the record's own graph."""
    own: LaneGraph = record_graph(record)
    driven = [t for t in tracks if travelled(t) > DRIVEN]
    broken = [t.id for t in driven if not router.unbroken(matched[t.id])]
    own_broken = [t.id for t in driven if len(match(own, t)) > 1]
    return {
        "driven": len(driven), "broken": broken, "own_broken": own_broken,
        "off_lanes": [t.id for t in driven if not matched[t.id]],
    }  # fmt: skip
