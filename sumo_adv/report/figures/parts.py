"""What pictures of an encounter are put together from: the road, vehicles as boxes, marks of time, a scale bar.

Colours are Okabe and Ito's, which colour-blind readers can tell apart.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats, Track
from sumo_adv.road_users import RoadUser, road_user

EGO, ADVERSARY, SUPPORT, OTHER = "#0072B2", "#D55E00", "#E69F00", "#8C8C8C"
ASPHALT, JUNCTION, EDGE, GROUND = "#E3E3E3", "#D8D8D8", "#FFFFFF", "#F7F7F4"
LEAST_EXTENT = 40.0  # m of the shown area
BARS = (500, 200, 100, 50, 20, 10, 5)  # m

Lanes = Sequence[tuple[Floats, float, bool]]
"""Centreline (n, 2) [m], width [m], inside a junction or not."""
View = tuple[float, float, float, float]
"""Left, bottom, width, height [m] of the shown area."""


@dataclass(frozen=True, slots=True)
class Style:
    """Sizes in points: text of marks and of the scale bar, lines of lanes, boxes and marks, and the marks themselves.

    ``away``: from a mark to its number. ``bar``: the scale bar's line. ``apart`` [m]: a mark is left out if it is
    that near to the last one.
    """

    text: float = 11.0
    lane: float = 1.8
    box: float = 1.2
    hollow: float = 1.4
    mark: float = 6.5
    mark_line: float = 1.8
    away: float = 13.0
    bar: float = 3.5
    apart: float = 0.0


LARGE = Style()


def shortened(text: str, most: int) -> str:
    """Text in one line of at most ``most`` characters, with nothing unprintable."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return line if len(line) <= most else line[: most - 1] + "…"


def closest_time(ego: Track, adversary: Track, start: float) -> float:
    """When the centres are closest from ``start`` on [s]; ``start`` if the two are never there together."""
    common = np.intersect1d(np.round(ego.time, 3), np.round(adversary.time, 3))
    common = common[common >= start - 5e-4]
    if common.size == 0:
        return start
    distance = np.hypot(
        np.interp(common, ego.time, ego.x) - np.interp(common, adversary.time, adversary.x),
        np.interp(common, ego.time, ego.y) - np.interp(common, adversary.time, adversary.y),
    )
    return float(common[np.argmin(distance)])


def pose_at(track: Track, time: float) -> tuple[float, float, float] | None:
    """x, y, heading at ``time``; None if the track is not there then."""
    if track.time.size == 0 or not track.time[0] - 0.051 <= time <= track.time[-1] + 0.051:
        return None
    heading = np.interp(time, track.time, np.unwrap(track.heading))
    return float(np.interp(time, track.time, track.x)), float(np.interp(time, track.time, track.y)), float(heading)


def draw_lanes(axes: Any, lanes: Lanes, style: Style = LARGE) -> None:
    """The road: lanes, and what is inside junctions below them."""
    from matplotlib.collections import PolyCollection

    for inside in (True, False):
        shapes = [lane_polygon(line, width) for line, width, internal in lanes if internal is inside and len(line) > 1]
        colour, edge = (JUNCTION, JUNCTION) if inside else (ASPHALT, EDGE)
        axes.add_collection(
            PolyCollection(
                shapes, facecolors=colour, edgecolors=edge, linewidths=style.lane, zorder=1 if inside else 2
            ),
            autolim=False,
        )


def lane_polygon(line: Floats, width: float) -> Floats:
    """Outline (2 n, 2) [m] of a lane from its centreline (n, 2) [m]; corners are mitred, at most threefold."""
    steps = np.diff(line, axis=0)
    lengths = np.maximum(np.hypot(steps[:, 0], steps[:, 1]), 1e-9)
    normals = np.column_stack((-steps[:, 1], steps[:, 0])) / lengths[:, None]
    before, after = np.vstack((normals[:1], normals)), np.vstack((normals, normals[-1:]))
    middle = before + after
    stretch = np.maximum((middle * middle).sum(axis=1), 4 / 9)
    offset = middle * (width / stretch)[:, None]
    return np.vstack((line + offset, (line - offset)[::-1]))


def draw_box(
    axes: Any,
    track: Track,
    time: float,
    colour: str,
    zorder: int,
    filled: bool = True,
    style: Style = LARGE,
) -> None:
    """The vehicle as it stands at ``time`` [s], a circle for a pedestrian; nothing if it is not there."""
    from matplotlib.patches import Circle, Polygon

    pose = pose_at(track, time)
    if pose is None:
        return
    x, y, heading = pose
    turn = np.array([[math.cos(heading), math.sin(heading)], [-math.sin(heading), math.cos(heading)]])
    half = np.array([track.length, track.width]) / 2
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half @ turn + (x, y)
    face, edge, width = (colour, "black", style.box) if filled else ("none", colour, style.hollow)
    if road_user(track) is RoadUser.PEDESTRIAN:
        axes.add_patch(Circle((x, y), half.max(), facecolor=face, edgecolor=edge, linewidth=width, zorder=zorder))
        return
    axes.add_patch(Polygon(corners, closed=True, facecolor=face, edgecolor=edge, linewidth=width, zorder=zorder))
    if filled:
        arrow = np.array([[0.92, 0.0], [0.35, 0.62], [0.35, -0.62]]) * half @ turn + (x, y)
        axes.add_patch(Polygon(arrow, closed=True, facecolor="white", edgecolor="none", zorder=zorder + 1))


def draw_marks(axes: Any, parts: Sequence[Track], trigger_time: float, style: Style = LARGE) -> None:
    """A dot each second since the trigger; the number on the side away from the other vehicle."""
    colours = (EGO, ADVERSARY)
    for track, counterpart, colour in zip(parts, reversed(parts), colours, strict=True):
        last = (math.inf, math.inf)
        for second in range(int(track.time[-1] - trigger_time + 0.02) + 1 if track.time.size else 0):
            pose = pose_at(track, trigger_time + second)
            if pose is None:
                continue
            x, y, heading = pose
            if math.dist(last, (x, y)) < style.apart:
                continue
            last = (x, y)
            away = pose_at(counterpart, trigger_time + second)
            side = 1.0
            if away is not None:
                left = (away[1] - y) * math.cos(heading) - (away[0] - x) * math.sin(heading)
                side = -1.0 if left > 0 else 1.0
            axes.plot([x], [y], "o", ms=style.mark, mfc="white", mec=colour, mew=style.mark_line, zorder=10)
            sideways = (-style.away * side * math.sin(heading), style.away * side * math.cos(heading))
            axes.annotate(
                f"{second}", (x, y), xytext=sideways, textcoords="offset points", ha="center", va="center",
                color=colour, fontsize=style.text, fontweight="bold", zorder=11,
                bbox={"boxstyle": "round,pad=0.12", "fc": "white", "ec": "none", "alpha": 0.8},
            )  # fmt: skip


def draw_scale_bar(axes: Any, view: View, height: float, style: Style = LARGE) -> None:
    """A bar of round length in the lower left corner of a map that is ``height`` inches high."""
    left, bottom, width, tall = view
    bar = next(b for b in BARS if b <= width / 5 or b == BARS[-1])
    x, y = left + 0.02 * width, bottom + 0.35 / height * tall
    halo = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}
    axes.plot([x, x + bar], [y, y], color="black", lw=style.bar, solid_capstyle="butt", zorder=12)
    axes.annotate(
        f"{bar} m", (x + bar / 2, y), xytext=(0, style.text), textcoords="offset points", ha="center", va="center",
        fontsize=style.text, zorder=12, bbox=halo,
    )  # fmt: skip
