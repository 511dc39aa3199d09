"""One picture of an attempt: what ego and adversaries did and would have done on the road, and where they came closest.

Its parts (road, vehicles as boxes, marks of time, a scale bar) are those of other figures, too. Colours are Okabe and
Ito's, which colour-blind readers can tell apart. The file's bytes depend on the arguments and the version of matplotlib
alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Floats, LaneStrip, Role, Track, Verdict
from sumo_adv.files import write_whole
from sumo_adv.road_users import RoadUser, road_user
from sumo_adv.simulation.layers import covers

EGO_COLOUR, ADVERSARY_COLOUR, SUPPORT_COLOUR, OTHER_COLOUR = "#0072B2", "#D55E00", "#E69F00", "#8C8C8C"
ASPHALT_COLOUR, JUNCTION_COLOUR, EDGE_COLOUR, GROUND_COLOUR = "#E3E3E3", "#D8D8D8", "#FFFFFF", "#F7F7F4"
MIN_EXTENT_M = 40.0  # minimum width of the shown area
SCALE_BARS_M = (500, 200, 100, 50, 20, 10, 5)
"""The lengths that a scale bar may have [m]."""
MapView = tuple[float, float, float, float]
"""The shown area: left, bottom, width and height [m]."""
ENCOUNTER_WIDTH_IN, MIN_ENCOUNTER_HEIGHT_IN, MAX_ENCOUNTER_HEIGHT_IN = 16.0, 6.0, 14.0  # inches; 100 dots an inch
ENCOUNTER_HEAD_IN, MAP_WIDTH_SHARE = 1.5, 0.935  # inches above and below the map; its share of the width
MAX_TITLE_CHARACTERS = 130  # more do not fit
ACTION_MARGIN_M = 12.0  # margin around the paths
SHOWN_BEFORE_TRIGGER_S = 1.0  # the shown paths begin this long before the trigger


@dataclass(frozen=True, slots=True)
class Style:
    """The sizes of a map's drawing.

    Attributes:
        text: The text of time marks and of the scale bar [pt].
        lane: The edge lines of lanes [pt].
        box: The outlines of filled boxes [pt].
        hollow: The outlines of boxes that are not filled [pt].
        mark: The diameter of time marks [pt].
        mark_line: The outlines of time marks [pt].
        away: The distance from a mark to its number [pt].
        bar: The line of the scale bar [pt].
        apart: A mark is left out if it is nearer than this to the last one [m].
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
    """Return the text as one line of at most ``most`` characters; unprintable characters become spaces."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return line if len(line) <= most else line[: most - 1] + "…"


def closest_time(ego: Track, adversary: Track, start: float) -> float:
    """Find the time at which the centres of two vehicles are closest.

    Args:
        ego: The one vehicle.
        adversary: The other vehicle.
        start: The time from which on they are compared [s].

    Returns:
        The time [s]; ``start`` if there is no common time from then on.
    """
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
    """Return x [m], y [m] and heading [rad] at ``time`` [s], or None if the track does not cover that time."""
    if track.time.size == 0 or not track.time[0] - 0.051 <= time <= track.time[-1] + 0.051:
        return None
    heading = np.interp(time, track.time, np.unwrap(track.heading))
    return float(np.interp(time, track.time, track.x)), float(np.interp(time, track.time, track.y)), float(heading)


def draw_lanes(axes: Any, lanes: Sequence[LaneStrip], style: Style = LARGE) -> None:
    """Draw the surfaces of lanes; lanes inside junctions lie under the others."""
    from matplotlib.collections import PolyCollection

    for inside in (True, False):
        shapes = [lane_polygon(s.shape, s.width) for s in lanes if s.internal is inside and len(s.shape) > 1]
        colour, edge = (JUNCTION_COLOUR, JUNCTION_COLOUR) if inside else (ASPHALT_COLOUR, EDGE_COLOUR)
        axes.add_collection(
            PolyCollection(
                shapes, facecolors=colour, edgecolors=edge, linewidths=style.lane, zorder=1 if inside else 2
            ),
            autolim=False,
        )


def lane_polygon(line: Floats, width: float) -> Floats:
    """Compute the outline of a lane. Its corners are mitred, to at most three times the half width.

    Args:
        line: The centreline ``(n, 2)``, or ``(n, 3)`` with heights [m].
        width: The width of the lane [m].

    Returns:
        The outline ``(2 n, 2)`` [m].
    """
    line = line[:, :2]
    steps = np.diff(line, axis=0)
    lengths = np.maximum(np.hypot(steps[:, 0], steps[:, 1]), 1e-9)
    normals = np.column_stack((-steps[:, 1], steps[:, 0])) / lengths[:, None]
    before, after = np.vstack((normals[:1], normals)), np.vstack((normals, normals[-1:]))
    middle = before + after
    stretch = np.maximum((middle * middle).sum(axis=1), 4 / 9)
    offset = middle * (width / stretch)[:, None]
    return np.vstack((line + offset, (line - offset)[::-1]))


def seen_from_above(lanes: Sequence[LaneStrip], tracks: Sequence[Track], time: float) -> list[Track]:
    """Return the tracks that no lane passes over at ``time`` [s]."""
    uncovered = []
    for track in tracks:
        pose = pose_at(track, time)
        z = np.interp(time, track.time, np.broadcast_to(track.z, track.time.shape)) if pose is not None else 0.0
        if pose is None or not any(covers(s.shape, s.width, pose[0], pose[1], float(z)).any() for s in lanes):
            uncovered.append(track)
    return uncovered


def draw_box(
    axes: Any, track: Track, time: float, colour: str, zorder: int, filled: bool = True, style: Style = LARGE
) -> None:
    """Draw a vehicle as a box, or a pedestrian as a circle; draw nothing if the track does not cover the time.

    Args:
        axes: The axes of the map.
        track: The vehicle.
        time: When it is shown [s].
        colour: The colour of the fill, or of the outline if it is not filled.
        zorder: The drawing order; an arrow on a filled box is one higher.
        filled: Whether the box is filled.
        style: The line widths.
    """
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
    """Draw a dot on each path for every second since the trigger.

    The number of a dot stands on the side away from the other vehicle.

    Args:
        axes: The axes of the map.
        parts: The tracks of ego and adversary.
        trigger_time: When the attack begins [s].
        style: The sizes.
    """
    colours = (EGO_COLOUR, ADVERSARY_COLOUR)
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


def draw_scale_bar(axes: Any, view: MapView, height: float, style: Style = LARGE) -> None:
    """Draw a bar of round length in the lower left corner.

    Args:
        axes: The axes of the map.
        view: The shown area.
        height: The height of the map [in].
        style: The sizes.
    """
    left, bottom, width, tall = view
    bar = next(b for b in SCALE_BARS_M if b <= width / 5 or b == SCALE_BARS_M[-1])
    x, y = left + 0.02 * width, bottom + 0.35 / height * tall
    halo = {"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}
    axes.plot([x, x + bar], [y, y], color="black", lw=style.bar, solid_capstyle="butt", zorder=12)
    axes.annotate(
        f"{bar} m", (x + bar / 2, y), xytext=(0, style.text), textcoords="offset points", ha="center", va="center",
        fontsize=style.text, zorder=12, bbox=halo,
    )  # fmt: skip


def load_matplotlib() -> None:
    """Import what pictures need ahead of time, while the program waits anyway; importing takes 0.3 s."""
    import matplotlib.backends.backend_agg
    import matplotlib.collections
    import matplotlib.figure
    import matplotlib.lines
    import matplotlib.patches  # noqa: F401


def draw_encounter(
    target: Path,
    *,
    lanes: Sequence[LaneStrip],
    ego: Track,
    adversary: Track,
    others: Sequence[Track],
    raw_ego: Track | None,
    raw_adversary: Track | None,
    trigger_time: float,
    verdict: Verdict,
    title: str,
) -> None:
    """Write a picture of an encounter as a PNG, 1600 px wide.

    Args:
        target: The file.
        lanes: The lanes around the encounter.
        ego: The ego's attacked motion.
        adversary: The collider's attacked motion.
        others: The other vehicles. Those with an adversary's role are drawn as supports.
        raw_ego: The ego's unattacked motion; None if unknown.
        raw_adversary: The collider's unattacked motion; None if unknown.
        trigger_time: When the attack begins [s], on the tracks' clock.
        verdict: The verdict on the attempt.
        title: The title. It is not parsed as mathematics, and it is cut to one line.

    Raises:
        OSError: The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shown = decisive_time(ego, adversary, trigger_time, verdict)
    ego_part, adversary_part = (
        track.between(trigger_time - SHOWN_BEFORE_TRIGGER_S, math.inf) for track in (ego, adversary)
    )
    supports = [track for track in others if track.role is Role.ADVERSARY]
    support_parts = [support.between(trigger_time - SHOWN_BEFORE_TRIGGER_S, math.inf) for support in supports]
    view = _view((ego_part, adversary_part, *support_parts), (ego, adversary, *supports), shown)
    height = ENCOUNTER_HEAD_IN + ENCOUNTER_WIDTH_IN * MAP_WIDTH_SHARE * view[3] / view[2]
    figure = Figure(figsize=(ENCOUNTER_WIDTH_IN, height), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes(
        (0.055, 0.65 / height, MAP_WIDTH_SHARE, 1.0 - ENCOUNTER_HEAD_IN / height), facecolor=GROUND_COLOUR
    )
    draw_lanes(axes, lanes)
    for raw, colour in ((raw_ego, EGO_COLOUR), (raw_adversary, ADVERSARY_COLOUR)):
        if raw is not None:
            part = raw.between(trigger_time, ego.time[-1])
            axes.plot(part.x, part.y, color=colour, alpha=0.45, lw=1.6, ls=(0, (4, 3)), zorder=4)
    for track in seen_from_above(lanes, others, shown):
        draw_box(axes, track, shown, OTHER_COLOUR if track.role is not Role.ADVERSARY else SUPPORT_COLOUR, zorder=5)
    for support, part in zip(supports, support_parts, strict=True):
        axes.plot(part.x, part.y, color=SUPPORT_COLOUR, lw=1.8, zorder=5, solid_capstyle="round")
        draw_box(axes, support, trigger_time, SUPPORT_COLOUR, zorder=5, filled=False)
    for track, part, colour in ((ego, ego_part, EGO_COLOUR), (adversary, adversary_part, ADVERSARY_COLOUR)):
        axes.plot(part.x, part.y, color=colour, lw=2.2, zorder=6, solid_capstyle="round")
        draw_box(axes, track, trigger_time, colour, zorder=5, filled=False)
        draw_box(axes, track, shown, colour, zorder=8)
    draw_marks(axes, (ego_part, adversary_part), trigger_time)
    _frame(axes, view, height)
    corner = _free_corner((ego_part, adversary_part), view)
    unattacked = raw_ego is not None or raw_adversary is not None
    groups = unattacked, bool(supports), len(others) > len(supports)
    _legend(axes, groups, verdict, shown - trigger_time, corner)
    line = shortened(title, MAX_TITLE_CHARACTERS)
    figure.text(0.055, 1.0 - 0.15 / height, line, ha="left", va="top", fontsize=15, parse_math=False)
    _draw_summary(figure, verdict, height)
    write_whole(target, lambda part: figure.savefig(part, format="png", metadata={"Software": None}))


def decisive_time(ego: Track, adversary: Track, trigger_time: float, verdict: Verdict) -> float:
    """Return the time at which filled boxes are drawn [s]: the contact or, without one, the closest approach."""
    if verdict.contact_time is not None:
        return verdict.contact_time
    return closest_time(ego, adversary, trigger_time)


def _view(parts: Sequence[Track], tracks: Sequence[Track], shown: float) -> MapView:
    """Compute the shown area from the paths until 1.5 s after the decisive moment."""
    paths = [(part.x[keep], part.y[keep]) for part in parts if (keep := part.time <= shown + 1.5).any()]
    boxes = [pose for track in tracks if (pose := pose_at(track, shown)) is not None]
    x, y = (np.concatenate([*(path[k] for path in paths), [box[k] for box in boxes]]) for k in (0, 1))
    if x.size == 0:
        return -MIN_EXTENT_M / 2, -MIN_EXTENT_M / 4, MIN_EXTENT_M, MIN_EXTENT_M / 2
    width = max(float(np.ptp(x)) + 2 * ACTION_MARGIN_M, MIN_EXTENT_M)
    height = max(float(np.ptp(y)) + 2 * ACTION_MARGIN_M, MIN_EXTENT_M * 0.4)
    inside_width, tallest = ENCOUNTER_WIDTH_IN * MAP_WIDTH_SHARE, MAX_ENCOUNTER_HEIGHT_IN - ENCOUNTER_HEAD_IN
    width = max(width, height * inside_width / tallest)
    height = max(height, width * (MIN_ENCOUNTER_HEIGHT_IN - ENCOUNTER_HEAD_IN) / inside_width)
    return float(x.max() + x.min() - width) / 2, float(y.max() + y.min() - height) / 2, width, height


def _frame(axes: Any, view: MapView, height: float) -> None:
    left, bottom, width, tall = view
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlim=(left, left + width), ylim=(bottom, bottom + tall))
    axes.set_xlabel("x [m]", fontsize=12)
    axes.set_ylabel("y [m]", fontsize=12)
    axes.tick_params(labelsize=11)
    axes.ticklabel_format(useOffset=False, style="plain")
    draw_scale_bar(axes, view, height - ENCOUNTER_HEAD_IN)


def _legend(axes: Any, groups: tuple[bool, bool, bool], verdict: Verdict, after: float, corner: str) -> None:
    """Draw the legend; ``groups`` says whether there are unattacked motions, supports and other vehicles."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    moment = "contact" if verdict.contact_time is not None else "closest approach"
    entries: list[Any] = [
        Patch(facecolor=EGO_COLOUR, edgecolor="black", label=f"ego at {moment} ({after:.1f} s)"),
        Patch(facecolor=ADVERSARY_COLOUR, edgecolor="black", label=f"adversary at {moment}"),
        Patch(facecolor="none", edgecolor="black", label="at the trigger"),
        Line2D([], [], color="black", marker="o", mfc="white", lw=2.2, label="attacked, s since the trigger"),
    ]
    raw, supports, others = groups
    if supports:
        entries.append(Patch(facecolor=SUPPORT_COLOUR, edgecolor="black", label="support"))
    if raw:
        entries.append(Line2D([], [], color="black", alpha=0.5, lw=1.6, ls=(0, (4, 3)), label="unattacked"))
    if others:
        entries.append(Patch(facecolor=OTHER_COLOUR, edgecolor="black", label="other vehicles"))
    axes.legend(handles=entries, loc=corner, fontsize=11, framealpha=0.93).set_zorder(20)


def _free_corner(parts: Sequence[Track], view: MapView) -> str:
    """Choose the upper corner of the map that contains less of the paths."""
    left, bottom, width, tall = view
    x = (np.concatenate([part.x for part in parts]) - left) / width
    high = np.concatenate([part.y for part in parts]) > bottom + 0.55 * tall
    busy_right, busy_left = np.count_nonzero(high & (x > 0.7)), np.count_nonzero(high & (x < 0.3))
    return "upper right" if busy_right <= busy_left else "upper left"


def _draw_summary(figure: Any, verdict: Verdict, height: float) -> None:
    """Write the figures of the verdict under the title."""

    def number(value: float, unit: str) -> str:
        return "never" if math.isinf(value) else f"{value:.2f} {unit}"

    end = "collision" if verdict.collided else "no contact"
    words = [f"min TTC {number(verdict.min_ttc, 's')}", f"min distance {number(verdict.min_distance, 'm')}", end]
    if verdict.preventability is not None:
        hit = verdict.impact_speed
        hard = f"delta-v {verdict.delta_v:.1f} m/s" if hit is None else f"hit at {hit:.1f} m/s"
        words.append(f"{verdict.level}, {hard}")
        words.append(f"preventable by {', '.join(verdict.preventability.by) or 'no reference driver'}")
    words += ["not feasible"] if not verdict.feasible else []
    words += ["rear-end"] if verdict.rear_end else []
    text = "  ·  ".join(words)
    figure.text(0.055, 1.0 - 0.47 / height, text, ha="left", va="top", fontsize=12, color="#333333", parse_math=False)
