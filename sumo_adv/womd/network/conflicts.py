"""Where vehicles on two lanes would be in each other's way: crossings, and the overlap after a split or before a merge.

Strands are sampled every metre; samples of two strands that come near each other, at the same height, are a conflict.
How near depends on the angle: lanes side by side may be close, a crossing vehicle needs its width and more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sumo_adv.datatypes import Floats
from sumo_adv.geometry import wrap
from sumo_adv.womd.network.polyline import at, headings
from sumo_adv.womd.network.strands import Strand

STEP = 1.0  # m between samples
OVERPASS = 3.0  # m of height that keep two lanes apart
BESIDE = 1.2  # m, lanes of one direction with nearer centres overlap
ACROSS = 2.6  # m, the same for lanes at a right angle
OPPOSITE = np.deg2rad(150.0)  # lanes that head against each other share their ground (left-turn lanes of both sides)
JOINT = 8.0  # m around the joint of a lane and its exit where they are near by nature


@dataclass(frozen=True, slots=True)
class Conflicts:
    """Pairs of near samples, arrays ``(n,)``: strand a at station sa [m] is near strand b at sb; each pair once."""

    a: NDArray[np.intp]
    sa: Floats
    b: NDArray[np.intp]
    sb: Floats


def find_conflicts(strands: tuple[Strand, ...]) -> Conflicts:
    """All conflicts between strands that motor vehicles use."""
    owner, station, place, heading = _samples(strands)
    if not len(owner):
        nothing = np.empty(0)
        return Conflicts(nothing.astype(np.intp), nothing, nothing.astype(np.intp), nothing)
    pairs = cKDTree(place[:, :2]).query_pairs(ACROSS, output_type="ndarray")
    i, j = pairs[:, 0], pairs[:, 1]
    apart = (owner[i] != owner[j]) & (np.abs(place[i, 2] - place[j, 2]) < OVERPASS)
    i, j = i[apart], j[apart]
    distance = np.hypot(*(place[i, :2] - place[j, :2]).T)
    angle = np.abs(wrap(heading[i] - heading[j]))
    near = (distance < BESIDE + (ACROSS - BESIDE) * np.sin(angle)) & (angle < OPPOSITE)
    i, j = i[near], j[near]
    natural = _at_joint(strands, owner, station, i, j) | _at_joint(strands, owner, station, j, i)
    i, j = i[~natural], j[~natural]
    return Conflicts(owner[i], station[i], owner[j], station[j])


def _samples(strands: tuple[Strand, ...]) -> tuple[NDArray[np.intp], Floats, Floats, Floats]:
    owners, stations, places, directions = [], [], [], []
    for strand in strands:
        if strand.bike:
            continue
        own_stations = np.linspace(0.0, strand.length, max(2, int(strand.length / STEP) + 1))
        owners.append(np.full(len(own_stations), strand.number, dtype=np.intp))
        stations.append(own_stations)
        places.append(at(strand.points, strand.along, own_stations))
        directions.append(headings(strand.points, strand.along, own_stations))
    if not owners:
        return np.empty(0, dtype=np.intp), np.empty(0), np.empty((0, 3)), np.empty(0)
    return np.concatenate(owners), np.concatenate(stations), np.vstack(places), np.concatenate(directions)


def _at_joint(
    strands: tuple[Strand, ...], owner: NDArray[np.intp], station: Floats, i: NDArray[np.intp], j: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Whether strand of ``j`` is an exit of that of ``i`` and both samples lie near where they meet."""
    linked = np.zeros((len(strands), len(strands)), dtype=bool)
    for strand in strands:
        linked[strand.number, list(strand.exits)] = True
    length = np.array([strand.length for strand in strands])
    return linked[owner[i], owner[j]] & (length[owner[i]] - station[i] + station[j] < JOINT)
