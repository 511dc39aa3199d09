"""Just enough of an OpenDRIVE reader to say where the lanes' centre lines are; shares no code with the program."""

from __future__ import annotations

import math
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

STEP = 1.0  # m


def lane_centres(file: Path) -> list[NDArray[np.float64]]:
    """Centre lines (n, 2) [m] of all lanes: to the right of the reference line, or to the left where traffic drives
    there. netconvert makes a road of each direction."""
    centres = []
    for road in ElementTree.parse(file).getroot().iter("road"):
        length = float(road.get("length", "nan"))
        stations = np.append(np.arange(0.0, length, STEP), length - 1e-6)
        poses = np.array([_pose(road, s) for s in stations])
        side, sign = ("left", 1) if road.get("rule") == "LHT" else ("right", -1)
        lanes = road.findall(f"lanes/laneSection/{side}/lane")
        assert lanes and lanes == road.findall("lanes/laneSection/*/lane[@type!='none']")
        edge = np.zeros(len(stations))
        for lane in sorted(lanes, key=lambda lane: sign * int(lane.get("id", "0"))):
            width = np.array([_width(lane, s) for s in stations])
            away = sign * (edge + width / 2)
            x, y, heading = poses.T
            centres.append(np.column_stack((x - away * np.sin(heading), y + away * np.cos(heading))))
            edge += width
    return centres


def _pose(road: Element, s: float) -> tuple[float, float, float]:
    """x, y [m] and heading [rad] of the reference line at a station."""
    pieces = [g for g in road.iterfind("planView/geometry") if float(g.get("s", "nan")) <= s + 1e-9]
    values = [float(pieces[-1].get(k, "nan")) for k in ("s", "x", "y", "hdg", "length")]
    start, x, y, heading, length = values
    u, v, turned = s - start, 0.0, 0.0
    shape = pieces[-1][0]
    if shape.tag == "paramPoly3":
        p = u / length if shape.get("pRange", "normalized") == "normalized" else u
        a = {k: float(shape.get(k, "nan")) for k in ("aU", "bU", "cU", "dU", "aV", "bV", "cV", "dV")}
        u, v = (a[f"a{k}"] + a[f"b{k}"] * p + a[f"c{k}"] * p**2 + a[f"d{k}"] * p**3 for k in "UV")
        du, dv = (a[f"b{k}"] + 2 * a[f"c{k}"] * p + 3 * a[f"d{k}"] * p**2 for k in "UV")
        turned = math.atan2(dv, du)
    else:
        assert shape.tag == "line"
    c, q = math.cos(heading), math.sin(heading)
    return x + u * c - v * q, y + u * q + v * c, heading + turned


def _width(lane: Element, s: float) -> float:
    """m, from the last polynomial that begins before the station."""
    piece = [w for w in lane.iterfind("width") if float(w.get("sOffset", "nan")) <= s + 1e-9][-1]
    d = s - float(piece.get("sOffset", "nan"))
    return sum(float(piece.get(k, "nan")) * d**i for i, k in enumerate("abcd"))
