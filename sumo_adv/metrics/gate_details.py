"""Which gates an adversary fails, in words: when, where and by how much. For the modifier."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sumo_adv.datatypes import Bools, Floats, Limits, Track
from sumo_adv.metrics.avoidance import OnRoad
from sumo_adv.metrics.boxes import corners, first_contact, on_grid, pick, row_of
from sumo_adv.metrics.gates import CLOCK_SLACK, derivatives, kinematic_gates, off_road

INSETS = (0.25, 0.5, 0.75)  # m by which a box is made smaller to see how far it is off the road
AT_ONCE = 0.15  # s after the start: what fails by then was so at the take-over


def explained_gates(
    adversary: Track, others: Sequence[Track], failed: Sequence[str], limits: Limits, on_road: OnRoad | None,
    start: float, end: float,
) -> list[str]:  # fmt: skip
    """A sentence for each gate of ``failed`` that the motion between ``start`` and ``end`` [s] shows."""
    track = adversary.between(start - 2 * AT_ONCE, end)
    if len(track.time) < 3:
        return []
    boxes, judged = track.boxes(), (track.time >= start - CLOCK_SLACK) & (track.time <= end + CLOCK_SLACK)
    motion = derivatives(boxes, track.acceleration, track.time)
    broken = kinematic_gates(boxes, track.acceleration, track.time, limits)
    shown: dict[str, tuple[Floats, str, float]] = {
        "longitudinal": (motion.acceleration, "m/s2 along its way", limits.braking),
        "lateral": (motion.lateral, "m/s2 sideways", limits.lateral),
        "friction_circle": (np.hypot(motion.acceleration, motion.lateral), "m/s2 in all", limits.braking),
        "curvature": (motion.curvature, "1/m of curvature", limits.curvature),
        "jerk": (motion.jerk, "m/s3 of jerk", limits.jerk),
    }
    sentences = []
    for gate, (values, unit, limit) in shown.items():
        if gate in failed and (steps := broken[gate] & judged).any():
            worst = float(values[steps][np.abs(values[steps]).argmax()])
            sentences.append(f"{gate}: {worst:.2g} {unit} (limit {limit:g}) {_when(steps, track, start)}.")
    if "continuity" in failed and (steps := broken["continuity"] & judged).any():
        sentences.append(f"continuity: its positions do not follow from its speed {_when(steps, track, start)}.")
    if "off_road" in failed and on_road is not None:
        sentences += _off_road(track, judged, on_road, start)
    if "third_party" in failed:
        sentences += _third_party(track, others, start, end)
    return sentences


def _when(steps: Bools, track: Track, start: float) -> str:
    times = track.time[steps] - start
    if times[0] <= AT_ONCE:
        return "already at the take-over"
    return f"{times[0]:.1f} s after its start" + (f", until {times[-1]:.1f} s" if times[-1] > times[0] + 0.05 else "")


def _off_road(track: Track, judged: Bools, on_road: OnRoad, start: float) -> list[str]:
    boxes = track.boxes()
    steps = off_road(boxes, judged, on_road)
    if not steps.any():
        return []
    enough = next((i for i in INSETS if not off_road(boxes, judged, on_road, i).any()), None)
    amount = f"more than {INSETS[-1]:g}" if enough is None else f"up to {enough:g}"
    k = int(np.flatnonzero(steps)[0])
    at = replace(boxes, x=boxes.x[k : k + 1], y=boxes.y[k : k + 1], heading=boxes.heading[k : k + 1])
    points = corners(at)[0]
    outside = ~np.asarray(on_road(points[..., 0], points[..., 1]))
    dx, dy = points[..., 0] - track.x[k], points[..., 1] - track.y[k]
    left = np.cos(track.heading[k]) * dy - np.sin(track.heading[k]) * dx
    side = "left" if left[outside].mean() > 0 else "right"
    return [f"off_road: its {side} side is {amount} m off the road {_when(steps, track, start)}."]


def _third_party(track: Track, others: Sequence[Track], start: float, end: float) -> list[str]:
    if not others:
        return []
    grid = on_grid(others, track.time)
    repeated = pick(row_of(track), np.zeros(len(others), np.intp))
    contact = first_contact(repeated, grid, track.time)
    k = int(np.argmin(np.where(contact > track.time[0], contact, np.inf)))
    if not track.time[0] < contact[k] <= end:
        return []
    i = min(int(np.searchsorted(track.time, contact[k])), len(track.time) - 1)
    dx, dy = grid.x[k, i] - track.x[i], grid.y[k, i] - track.y[i]
    cos, sin = np.cos(track.heading[i]), np.sin(track.heading[i])
    ahead, left = cos * dx + sin * dy, cos * dy - sin * dx
    along, across = "ahead" if ahead > 0 else "behind", "left" if left > 0 else "right"
    place = f"{abs(ahead):.1f} m {along}, {abs(left):.1f} m {across} of it"
    return [f"third_party: it touches another vehicle ({place}) {contact[k] - start:.1f} s after its start."]
