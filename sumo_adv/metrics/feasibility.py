"""Was the adversary's motion possible: the gates, on raw poses from the trigger to first contact.

Yaw rate is a central difference of raw headings (one-sided at the ends), jerk a difference of the recorded acceleration
over one step.  The slacks are what sampling at 0.1 s and rounding to a millimetre can cause, no more.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats, Limits, Track
from sumo_adv.metrics.boxes import corners, first_contact, on_grid, wrap

ACCELERATION_SLACK = 0.1  # m/s2: a speed rounded to 5 mm/s over 0.1 s
LATERAL_SLACK = 0.1  # m/s2: a heading rounded to 5e-4 rad over 0.2 s at 20 m/s
CURVATURE_SLACK = 0.01  # 1/m
JERK_SLACK = 3.0  # m/s3: accelerations rounded to 0.1 m/s2 differ by up to 2 m/s3
CRAWL = 1.0  # m/s, below it curvature is not defined by two poses 0.2 s apart
REST = 0.05  # m/s, coming to rest ends every braking in one step
ROAD_TOLERANCE = 0.15  # m a corner may be off the drivable area
STEP_SLACK, STEP_SHARE = 0.15, 0.05  # m, and share of v dt, by which a step may differ from the mean speed
SIDEWAYS = 1.2  # m/s: the lateral speed of SUMO's own lane changes (3.2 m in 3 s) and a little more
GATES = (
    "longitudinal", "lateral", "friction_circle", "curvature", "jerk", "continuity", "off_road", "third_party",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Motion:
    """Derivatives of a track, each ``(n,)``: speed m/s, acceleration m/s2, yaw rate rad/s, jerk m/s3 (first is 0)."""

    speed: Floats
    acceleration: Floats
    yaw_rate: Floats
    lateral: Floats
    curvature: Floats
    jerk: Floats


def motion(track: Track) -> Motion:
    """Differentiate a track's raw poses: yaw rate central, lateral = v |yaw rate|, curvature = |yaw rate| / v.

    Below 1 m/s curvature takes v = 1 m/s: what turns on the spot still shows, noise at standstill does not.
    Jerk on coming to rest (speed below 0.05 m/s) is 0.
    """
    dt = np.diff(track.time)
    heading = np.unwrap(track.heading)
    yaw_rate = np.gradient(heading, track.time) if len(heading) > 1 else np.zeros(len(heading))
    jerk = np.zeros(len(heading))
    jerk[1:] = np.where(track.speed[1:] < REST, 0.0, np.diff(track.acceleration) / dt)
    size = np.abs(yaw_rate)
    return Motion(
        track.speed, track.acceleration, yaw_rate, track.speed * size, size / np.maximum(track.speed, CRAWL), jerk
    )


def failed_gates(
    adversary: Track,
    limits: Limits,
    *,
    on_road: Callable[[Floats, Floats], Bools] | None,
    ego: Track,
    others: Sequence[Track],
    end: float | None,
    start: float | None = None,
) -> tuple[str, ...]:
    """Names of the gates (of ``GATES``) that the adversary's motion fails between ``start`` and ``end`` [s].

    ``start`` (the trigger) defaults to the third state: two states of history come before it, and the first steps are
    judged against them.  ``end`` is the first contact with the ego, None for the end of the ego's track.
    ``on_road(x, y)`` tells whether points are drivable; None leaves the gate out.
    """
    start = float(adversary.time[min(2, len(adversary.time) - 1)]) if start is None else start
    end = float(min(ego.time[-1], adversary.time[-1])) if end is None else end
    judged = (adversary.time >= start - 5e-4) & (adversary.time <= end + 5e-4)
    judged[0] = judged[0] and len(judged) == 1  # the first state has no derivative of its own
    if not judged.any():
        return ()
    failed = _limits_failed(motion(adversary), limits, judged)
    failed["continuity"] = _jumps(adversary, limits, judged)
    failed["off_road"] = on_road is not None and _off_road(adversary, judged, on_road)
    failed["third_party"] = _third_party(adversary, others, start, end)
    return tuple(name for name in GATES if failed[name])


def _limits_failed(m: Motion, limits: Limits, judged: Bools) -> dict[str, bool]:
    acceleration, lateral = m.acceleration[judged], m.lateral[judged]
    friction = max(limits.braking, limits.acceleration, limits.lateral)
    return {
        "longitudinal": bool(
            (acceleration < -limits.braking - ACCELERATION_SLACK).any()
            or (acceleration > limits.acceleration + ACCELERATION_SLACK).any()
        ),
        "lateral": bool((lateral > limits.lateral + LATERAL_SLACK).any()),
        "friction_circle": bool((np.hypot(acceleration, lateral) > friction + LATERAL_SLACK).any()),
        "curvature": bool((m.curvature[judged] > limits.curvature + CURVATURE_SLACK).any()),
        "jerk": bool((np.abs(m.jerk[judged]) > limits.jerk + JERK_SLACK).any()),
    }


def _jumps(track: Track, limits: Limits, judged: Bools) -> bool:
    """Whether a step is not what its speeds and headings say: too long or short, backwards, sideways, or a speed jump.

    Along the mean heading a step may differ from the mean speed by 0.15 m + 5 %; across it by the slip of a box centre
    in the tightest curve allowed, plus 1.2 m/s.  Speed may change by what the acceleration limits allow.
    """
    if len(track.time) < 2:
        return False
    dt = np.diff(track.time)
    into = judged[1:]
    dx, dy = np.diff(track.x), np.diff(track.y)
    middle = track.heading[:-1] + wrap(np.diff(track.heading)) / 2
    speed = (track.speed[1:] + track.speed[:-1]) / 2
    along = dx * np.cos(middle) + dy * np.sin(middle)
    across = np.abs(dy * np.cos(middle) - dx * np.sin(middle))
    curve = np.minimum(limits.curvature, limits.lateral / np.maximum(speed, CRAWL) ** 2)
    slip = speed * (curve * track.length / 2 + 0.05) + SIDEWAYS
    change = np.diff(track.speed) / dt
    bad = np.abs(along - speed * dt) > STEP_SLACK + STEP_SHARE * speed * dt
    bad |= across > slip * dt + 0.02
    bad |= (change > 2 * limits.acceleration) | (change < -1.5 * limits.braking)
    return bool((bad & into).any())


def _off_road(track: Track, judged: Bools, on_road: Callable[[Floats, Floats], Bools]) -> bool:
    """Whether a corner of the box, drawn in by ``ROAD_TOLERANCE`` on each side, leaves the drivable area."""
    box = Boxes(
        track.x[judged], track.y[judged], track.heading[judged], track.speed[judged],
        track.length - 2 * ROAD_TOLERANCE, track.width - 2 * ROAD_TOLERANCE,
    )  # fmt: skip
    points = corners(box)
    return not bool(np.asarray(on_road(points[..., 0], points[..., 1])).all())


def _third_party(adversary: Track, others: Sequence[Track], start: float, end: float) -> bool:
    """Whether the adversary touches another vehicle before ``end``; contacts it had at the start do not count."""
    part = adversary.between(start, end)
    if not others or len(part.time) < 2:
        return False
    grid = on_grid(others, part.time)
    keep = np.hypot(grid.x - part.x, grid.y - part.y) < 30.0
    rows = np.flatnonzero(keep.any(axis=1))
    if not rows.size:
        return False
    size = [np.asarray(v)[rows] for v in (grid.length, grid.width)]
    near = replace(
        grid,
        x=grid.x[rows],
        y=grid.y[rows],
        heading=grid.heading[rows],
        speed=grid.speed[rows],
        length=size[0],
        width=size[1],
    )
    when = first_contact(part.boxes(), near, part.time)
    return bool(((when > part.time[0]) & (when < end)).any())
