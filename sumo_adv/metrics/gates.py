"""The gates: an adversary's motion must be possible, stay on the road, and touch no third party before the ego.

Each rule flags steps of boxes ``(..., steps)``. :func:`failed_gates` applies all rules to one recorded adversary, for
the verdict. The search applies the same rules to many predicted adversaries at once.

Each slack covers only what sampling at 0.1 s and rounding to a millimetre can cause.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats, Ints, Limits, Track
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.avoidance import ROAD_TOLERANCE_M, OnRoad
from sumo_adv.metrics.boxes import corners, first_contact, half_diagonal, on_grid, pick, row_of
from sumo_adv.road_users import is_unprotected

ACCELERATION_SLACK_M_S2 = 0.1  # a speed rounded to 5 mm/s over 0.1 s
LATERAL_SLACK_M_S2 = 0.1  # a heading rounded to 5e-4 rad over 0.2 s at 20 m/s
CURVATURE_SLACK_1_M = 0.01
JERK_SLACK_M_S3 = 3.0  # accelerations rounded to 0.1 m/s2 differ by up to 2 m/s3
DEFINED_CURVATURE_SPEED_M_S = 1.0  # at lower speeds, two poses 0.2 s apart do not define a curvature
REST_SPEED_M_S = 0.05  # a slower vehicle has come to rest, which ends any braking within one step
STEP_SLACK_M, STEP_SLACK_SHARE = 0.15, 0.05  # how far a step may differ from v dt, the latter as a share of it
SLIP_ANGLE_RAD, SLIP_SLACK_M = 0.05, 0.02  # sideways slip of the centre that no curve explains
LANE_CHANGE_SPEED_M_S = 1.2  # the lateral speed of SUMO's own lane changes (3.2 m in 3 s) with a small margin
CLOCK_SLACK_S = 5e-4  # times that differ by less are equal
GATES = ("longitudinal", "lateral", "friction_circle", "curvature", "jerk", "continuity", "off_road", "third_party")


@dataclass(frozen=True, slots=True)
class MotionDerivatives:
    """Derivatives of a motion, arrays ``(..., steps)``.

    Attributes:
        speed: Speed [m/s].
        acceleration: Longitudinal acceleration [m/s2].
        yaw_rate: Yaw rate [rad/s].
        lateral: Magnitude of the lateral acceleration [m/s2].
        curvature: Magnitude of the curvature [1/m].
        jerk: Longitudinal jerk [m/s3]; 0 at the first step.
    """

    speed: Floats
    acceleration: Floats
    yaw_rate: Floats
    lateral: Floats
    curvature: Floats
    jerk: Floats


def motion(track: Track) -> MotionDerivatives:
    """Return the derivatives ``(steps,)`` of a recorded track."""
    return derivatives(track.boxes(), track.acceleration, track.time)


def derivatives(b: Boxes, acceleration: Floats, time: Floats) -> MotionDerivatives:
    """Differentiate a motion.

    The yaw rate is the central difference of headings, one-sided at the ends. Lateral acceleration is |v yaw rate|.
    Curvature is |yaw rate / v| with |v| at least 1 m/s, so that turning on the spot shows and noise at standstill does
    not. The jerk of coming to rest (speed below 0.05 m/s) is 0.

    Args:
        b: Boxes ``(..., steps)``.
        acceleration: Accelerations of the same shape [m/s2].
        time: Times of the steps ``(steps,)`` [s].
    """
    jerk, turned, pace = np.zeros_like(b.heading), np.unwrap(b.heading, axis=-1), np.abs(b.speed)
    yaw_rate = np.gradient(turned, time, axis=-1) if len(time) > 1 else np.zeros_like(turned)
    jerk[..., 1:] = np.where(pace[..., 1:] < REST_SPEED_M_S, 0.0, np.diff(acceleration, axis=-1) / np.diff(time))
    size = np.abs(yaw_rate)
    curvature = size / np.maximum(pace, DEFINED_CURVATURE_SPEED_M_S)
    return MotionDerivatives(b.speed, acceleration, yaw_rate, pace * size, curvature, jerk)


def largest_acceleration(b: Boxes, acceleration: Floats, time: Floats) -> Floats:
    """Return the largest acceleration of each motion in any direction.

    Args:
        b: Boxes ``(..., steps)``.
        acceleration: Accelerations of the same shape [m/s2].
        time: Times of the steps ``(steps,)`` [s].

    Returns:
        The accelerations ``(...)`` [m/s2].
    """
    m = derivatives(b, acceleration, time)
    return np.asarray(np.hypot(m.acceleration, m.lateral).max(axis=-1))


def kinematic_gates(b: Boxes, acceleration: Floats, time: Floats, limits: Limits) -> dict[str, Bools]:
    """Find the steps that break the gates on the motion itself.

    Args:
        b: Boxes ``(..., steps)``.
        acceleration: Accelerations of the same shape [m/s2].
        time: Times of the steps ``(steps,)`` [s].
        limits: The limits of the motion.

    Returns:
        The steps ``(..., steps)`` that break each gate, by the gate's name.
    """
    m = derivatives(b, acceleration, time)
    friction = max(limits.braking, limits.acceleration, limits.lateral)
    return {
        "longitudinal": (m.acceleration < -limits.braking - ACCELERATION_SLACK_M_S2)
        | (m.acceleration > limits.acceleration + ACCELERATION_SLACK_M_S2),
        "lateral": m.lateral > limits.lateral + LATERAL_SLACK_M_S2,
        "friction_circle": np.hypot(m.acceleration, m.lateral) > friction + LATERAL_SLACK_M_S2,
        "curvature": m.curvature > limits.curvature + CURVATURE_SLACK_1_M,
        "jerk": np.abs(m.jerk) > limits.jerk + JERK_SLACK_M_S3,
        "continuity": _discontinuous(b, time, limits),
    }


def _discontinuous(b: Boxes, time: Floats, limits: Limits) -> Bools:
    """Find the steps ``(..., steps)`` that do not follow from their speeds and headings; never the first one.

    Along the mean heading, a step may differ from the mean speed by 0.15 m + 5 %. Across it, the box centre may move as
    far as it slips in the tightest curve allowed, plus 1.2 m/s. The speed may change by twice the acceleration limit
    and by 1.5 times the braking limit.
    """
    dt = np.diff(time)
    dx, dy = np.diff(b.x, axis=-1), np.diff(b.y, axis=-1)
    middle = b.heading[..., :-1] + wrap_below_pi(np.diff(b.heading, axis=-1)) / 2
    speed = (b.speed[..., 1:] + b.speed[..., :-1]) / 2
    c, s = np.cos(middle), np.sin(middle)
    along, across = dx * c + dy * s, np.abs(dy * c - dx * s)
    pace = np.abs(speed)
    curve = np.minimum(limits.curvature, limits.lateral / np.maximum(pace, DEFINED_CURVATURE_SPEED_M_S) ** 2)
    slip = pace * (curve * np.asarray(b.length) / 2 + SLIP_ANGLE_RAD) + LANE_CHANGE_SPEED_M_S
    change = np.diff(b.speed, axis=-1) / dt
    broken = np.zeros(b.x.shape, bool)
    broken[..., 1:] = np.abs(along - speed * dt) > STEP_SLACK_M + STEP_SLACK_SHARE * pace * dt
    broken[..., 1:] |= across > slip * dt + SLIP_SLACK_M
    broken[..., 1:] |= (change > 2 * limits.acceleration) | (change < -1.5 * limits.braking)
    return broken


def off_road(b: Boxes, judged: Bools, on_road: OnRoad, inset: float = ROAD_TOLERANCE_M) -> Bools:
    """Find the steps at which a corner is off the drivable area.

    Args:
        b: Boxes of any shape.
        judged: The steps to judge, in the shape of the positions.
        on_road: Returns which points are drivable.
        inset: The corners are drawn in by this on each side [m].

    Returns:
        A flag for each step, in the shape of the positions; False for steps that are not judged.
    """
    boxes = pick(b, judged)
    points = corners(replace(boxes, length=boxes.length - 2 * inset, width=boxes.width - 2 * inset))
    broken = np.zeros(b.x.shape, bool)
    broken[judged] = ~on_the_road(boxes, points, on_road).all(axis=-1)
    return broken


def on_the_road(boxes: Boxes, points: Floats, on_road: OnRoad) -> Bools:
    """Return which of the points ``(..., k, 2)`` of boxes ``(...)`` are drivable at the boxes' own heights."""
    x, y = points[..., 0], points[..., 1]
    if not np.ndim(boxes.z):
        return np.asarray(on_road(x, y))
    return np.asarray(on_road(x, y, np.broadcast_to(np.asarray(boxes.z)[..., None], x.shape)))


def third_party(adversary: Boxes, other: Boxes, time: Floats, end: Floats) -> Bools:
    """Return whether each adversary touches the other vehicle of its row.

    A contact that exists at the first step does not count, because some boxes in logs overlap all the time.

    Args:
        adversary: n adversaries, arrays ``(n, steps)``.
        other: One other vehicle for each ``(n, steps)``.
        time: Times of the steps ``(steps,)`` [s].
        end: Only contacts before this count ``(n,)`` [s].

    Returns:
        A flag for each row ``(n,)``.
    """
    when = first_contact(adversary, other, time)
    return np.asarray((when > time[0]) & (when < end))


def near_pairs(adversary: Boxes, others: Boxes, time: Floats, end: Floats) -> tuple[Ints, Ints]:
    """Find the pairs of adversaries and other vehicles that may touch.

    Pairs that are too far apart at every step to touch even between steps are left out. These are most pairs, so
    :func:`third_party` has little left to judge.

    Args:
        adversary: n adversaries, arrays ``(n, steps)``.
        others: m other vehicles, arrays ``(m, steps)``.
        time: Times of the steps ``(steps,)`` [s].
        end: Only contacts until this count ``(n,)`` [s].

    Returns:
        The pairs' rows in ``adversary`` and in ``others``.
    """
    reach, reaches = _reach(adversary), _reach(others)
    stops = np.searchsorted(time, end, side="right") + 1
    rows = []
    for k, stop in enumerate(stops):
        dx, dy = others.x[:, :stop] - adversary.x[k, :stop], others.y[:, :stop] - adversary.y[k, :stop]
        near = dx * dx + dy * dy <= ((reaches + reach[k]) ** 2)[:, None]
        rows.append(np.flatnonzero(near.any(axis=1)))
    counts = [len(r) for r in rows]
    return np.repeat(np.arange(len(rows)), counts), np.concatenate([np.zeros(0, np.intp), *rows])


def _reach(b: Boxes) -> Floats:
    """Return how far a box reaches from its centre at the nearest step [m].

    It is half the diagonal of the box plus half its longest step.
    """
    step = np.hypot(np.diff(b.x, axis=1), np.diff(b.y, axis=1))
    longest = np.fmax.reduce(step, axis=1, initial=0.0)  # steps at which the vehicle is absent are NaN
    return np.asarray(np.broadcast_to(half_diagonal(b), b.x.shape)[:, 0] + longest / 2)


def failed_gates(
    adversary: Track,
    limits: Limits,
    *,
    on_road: OnRoad | None,
    ego: Track,
    others: Sequence[Track],
    end: float | None,
    start: float | None = None,
) -> tuple[str, ...]:
    """Return the gates that an adversary fails.

    Args:
        adversary: The adversary's track.
        limits: The limits of its motion.
        on_road: Returns which points are drivable; None leaves out that gate. The gate is also left out for a
            pedestrian or cyclist, because both may be beside the road.
        ego: The ego's track.
        others: The tracks of third parties.
        end: The first contact with the ego [s]; None for the end of the shorter track.
        start: The trigger [s]. By default, it is the third state, so that the first steps are judged against two states
            of history.

    Returns:
        The names of the gates that the motion between ``start`` and ``end`` fails, in the order of ``GATES``.
    """
    start = float(adversary.time[min(2, len(adversary.time) - 1)]) if start is None else start
    end = float(min(ego.time[-1], adversary.time[-1])) if end is None else end
    judged = (adversary.time >= start - CLOCK_SLACK_S) & (adversary.time <= end + CLOCK_SLACK_S)
    judged[0] = judged[0] and len(judged) == 1  # the first state has no derivative of its own
    if not judged.any():
        return ()
    boxes = adversary.boxes()
    broken = kinematic_gates(boxes, adversary.acceleration, adversary.time, limits)
    failed = {name for name, steps in broken.items() if (steps & judged).any()}
    on_the_carriageway = None if is_unprotected(adversary) else on_road
    if on_the_carriageway is not None and off_road(boxes, judged, on_the_carriageway).any():
        failed.add("off_road")
    if _touches(adversary.between(start, end), others, end):
        failed.add("third_party")
    return tuple(name for name in GATES if name in failed)


def all_failed_gates(
    adversary: Track,
    supports: Sequence[Track],
    limits: Limits,
    *,
    on_road: OnRoad | None,
    ego: Track,
    others: Sequence[Track],
    end: float,
    start: float,
    support_limits: Callable[[Track], Limits] | None = None,
) -> tuple[str, ...]:
    """Return the gates that the adversary or one of its supports fails; see :func:`failed_gates`.

    Adversaries that touch each other fail ``third_party``. So does a support that touches the ego first.

    Args:
        adversary: The track of the vehicle that collides with the ego.
        supports: The tracks of the supports, which are among the ``others``, too.
        limits: The limits of the adversary's motion.
        on_road: Returns which points are drivable; None leaves out that gate.
        ego: The ego's track.
        others: The tracks of all vehicles near the ego.
        end: When the judged motion ends [s].
        start: When the judged motion begins [s].
        support_limits: Returns the limits of a support's motion; None means those of the adversary.
    """
    failed = set(failed_gates(adversary, limits, on_road=on_road, ego=ego, others=others, end=end, start=start))
    for support in supports:
        third = [ego, adversary, *(t for t in others if t.id != support.id)]
        own = limits if support_limits is None else support_limits(support)
        failed |= set(failed_gates(support, own, on_road=on_road, ego=ego, others=third, end=end, start=start))
    return tuple(name for name in GATES if name in failed)


def _touches(adversary: Track, others: Sequence[Track], end: float) -> bool:
    """Return whether the adversary touches any of the others before ``end`` [s]."""
    if not others or len(adversary.time) < 2:
        return False
    boxes, around, time = row_of(adversary), on_grid(others, adversary.time), adversary.time
    row, column = near_pairs(boxes, around, time, np.array([end]))
    return bool(third_party(pick(boxes, row), pick(around, column), time, np.array(end)).any())


OFF_ROAD_INSETS_M = (0.25, 0.5, 0.75)  # a box is made smaller by these to find how far it is off the road
TAKE_OVER_S = 0.15  # a gate that fails this soon after the start failed at the take-over already


def explained_gates(
    adversary: Track, others: Sequence[Track], failed: Sequence[str], limits: Limits, on_road: OnRoad | None,
    start: float, end: float,
) -> list[str]:  # fmt: skip
    """Explain each failed gate in a sentence.

    Args:
        adversary: The adversary's track.
        others: The tracks of third parties.
        failed: The names of the failed gates.
        limits: The limits of the motion.
        on_road: Returns which points are drivable.
        start: When the judged motion begins [s].
        end: When the judged motion ends [s].

    Returns:
        A sentence for each gate of ``failed`` that the motion shows.
    """
    track = adversary.between(start - 2 * TAKE_OVER_S, end)
    if len(track.time) < 3:
        return []
    boxes, judged = track.boxes(), (track.time >= start - CLOCK_SLACK_S) & (track.time <= end + CLOCK_SLACK_S)
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
    if times[0] <= TAKE_OVER_S:
        return "already at the take-over"
    return f"{times[0]:.1f} s after its start" + (f", until {times[-1]:.1f} s" if times[-1] > times[0] + 0.05 else "")


def _off_road(track: Track, judged: Bools, on_road: OnRoad, start: float) -> list[str]:
    boxes = track.boxes()
    steps = off_road(boxes, judged, on_road)
    if not steps.any():
        return []
    enough = next((i for i in OFF_ROAD_INSETS_M if not off_road(boxes, judged, on_road, i).any()), None)
    amount = f"more than {OFF_ROAD_INSETS_M[-1]:g}" if enough is None else f"up to {enough:g}"
    k = int(np.flatnonzero(steps)[0])
    points = corners(pick(boxes, k))
    outside = ~on_the_road(pick(boxes, k), points, on_road)
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
