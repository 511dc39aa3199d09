"""What logged vehicles tell of a signal that the record does not: a vehicle that drives over a stop line has green.

Green lasts from when the vehicle last stood (if it did not, from ``LEAD`` before) until just after its front is over
the line; short breaks between two vehicles are green too. Yellow follows.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.geometry import wrap
from sumo_adv.womd.network.roads import Link
from sumo_adv.womd.record import TRACK_KINDS, Record

VEHICLE = TRACK_KINDS.index("vehicle")
LEAD, TAIL = 4.0, 1.0  # s of green before and after a vehicle that did not stand drives over the line
JOIN = 5.0  # s of a break that is green too
YELLOW = 3.0  # s
STANDING = 1.0  # m/s
BESIDE = 1.5  # m from a link's line at most
TURNED = 0.5  # rad between a vehicle and the link at the line
FOLLOWED, SHARE = 12.0, 0.6  # m, or that share of it, that a vehicle must follow a link to have taken it


@dataclass(frozen=True, slots=True)
class Traffic:
    """All vehicles of a record: fronts, centres ``(k, n, 2)`` m; heading rad, speed m/s, valid ``(k, n)``; step s."""

    fronts: Floats
    centres: Floats
    heading: Floats
    speed: Floats
    valid: Bools
    step: float


def logged_traffic(record: Record) -> Traffic:
    """The record's vehicles."""
    tracks = [t for t in record.tracks if t.kind == VEHICLE]
    shape = (len(tracks), len(record.time))
    x, y, heading, length, vx, vy = (
        np.array([getattr(t, name) for t in tracks], float).reshape(shape)
        for name in ("x", "y", "heading", "length", "vx", "vy")
    )
    centres = np.stack([x, y], axis=-1)
    fronts = centres + 0.5 * length[..., None] * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    step = float(record.time[1] - record.time[0]) if len(record.time) > 1 else 0.1
    valid = np.array([t.valid for t in tracks], bool).reshape(shape)
    return Traffic(fronts, centres, heading, np.hypot(vx, vy), valid, step)


def witnessed_letters(traffic: Traffic, links: Sequence[Link]) -> list[str]:
    """A letter a step (g, y or r) for links that have one signal; empty if no vehicle drove off on any of them."""
    green = np.zeros(traffic.valid.shape[1], bool)
    for link in links:
        for vehicle, over in _drives(traffic, link):
            stood = np.flatnonzero((traffic.speed[vehicle, :over] < STANDING) & traffic.valid[vehicle, :over])
            begin = int(stood[-1]) if len(stood) else over - round(LEAD / traffic.step)
            green[max(begin, 0) : over + round(TAIL / traffic.step)] = True
    if not green.any():
        return []
    on = np.flatnonzero(green)
    for a, b in pairwise(on):
        if b - a <= JOIN / traffic.step:
            green[a:b] = True
    letters = np.where(green, "g", "r")
    for end in np.flatnonzero(green[:-1] & ~green[1:]) + 1:
        after = letters[end : end + round(YELLOW / traffic.step)]
        after[after == "r"] = "y"
    return [str(letter) for letter in letters]


def _drives(traffic: Traffic, link: Link) -> Iterator[tuple[int, int]]:
    """Vehicles that take a link, each with the step at which its front is over the line."""
    from shapely import LineString, distance, line_locate_point, points

    line = LineString(link.shape)
    way = link.shape[min(2, len(link.shape) - 1)] - link.shape[0]
    way /= np.hypot(*way)
    off = traffic.fronts - link.shape[0]
    along, aside = off @ way, off @ np.array([-way[1], way[0]])
    straight = np.abs(wrap(traffic.heading - np.arctan2(way[1], way[0]))) < TURNED
    over = (along[:, :-1] <= 0.0) & (along[:, 1:] > 0.0) & traffic.valid[:, :-1] & traffic.valid[:, 1:]
    over &= straight[:, 1:] & (np.abs(aside[:, 1:]) < BESIDE)
    for vehicle, step in np.argwhere(over):
        later = traffic.centres[vehicle, step + 1 :][traffic.valid[vehicle, step + 1 :]]
        at = line_locate_point(line, points(later))
        inside = (at > 0.0) & (at < line.length)
        near = distance(line, points(later)) < BESIDE
        if near[inside].all() and at.max() > min(FOLLOWED, SHARE * line.length):
            yield int(vehicle), int(step) + 1
