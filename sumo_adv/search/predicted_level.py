"""The level that predicted collisions reach, by the judge's own rules, in batches.

The reference drivers are ``cc_human`` and ``manoeuvre``. The others (``reg157``, ``rss``, ``fsm``) judge independently:
the search must not know them, so that their answers say something about it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats, Ints, Level
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.boxes import height_as, on_grid, pick, some_steps
from sumo_adv.metrics.gates import largest_acceleration
from sumo_adv.metrics.levels import STATIONARY_FOR_S, STATIONARY_SPEED_M_S
from sumo_adv.metrics.realism import envelope_left
from sumo_adv.metrics.reference.cc_human import CcHuman
from sumo_adv.metrics.reference.counterfactual import MIN_AFTER_CONTACT_S, Counterfactual, Encounters
from sumo_adv.metrics.severity import crash_of, hardness
from sumo_adv.road_users import is_unprotected, road_user
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation

MIN_MANOEUVRE_WARNING_S = 0.5  # from the alarm to the contact; no manoeuvre avoids a collision with less
BYSTANDER_DISTANCE_M = 60.0  # of the ego at the contact; nearer vehicles may be in a reference driver's way
PATH_AFTER_CONTACT_M = 60.0  # how far the ego's path is continued past the contact
PATH_POINT_SPACING_M = 2.0  # between two points of that continuation


@dataclass(frozen=True, slots=True)
class PredictedSeverity:
    """The severity of predicted collisions. Row k is collision k, and all arrays have the shape ``(n,)``.

    Attributes:
        level: The level, ``COLLISION`` or higher.
        warning: The time from the alarm of ``cc_human`` to the contact [s]; 0 without an alarm.
        delta_v: The ego's delta-v [m/s].
        hardness: 1 or more is hard enough for ``serious`` [-].
        human: Whether the adversary stays within the human envelope.
        careful: Whether ``cc_human`` avoids the collision.
        manoeuvre: Whether ``manoeuvre`` avoids the collision.
        sides: The side of the ego that is hit.
        acceleration: The adversary's largest acceleration up to the contact [m/s2].
    """

    level: Ints
    warning: Floats
    delta_v: Floats
    hardness: Floats
    human: Bools
    careful: Bools
    manoeuvre: Bools
    sides: list[str]
    acceleration: Floats


@dataclass(frozen=True, slots=True)
class Collisions:
    """Predicted collisions. Row k is collision k.

    Attributes:
        situations: The situations at the start of the attacks.
        bvs: The ids of the adversaries of each row, the collider's first.
        ego: The ego from the start of the attack on, ``(n, steps)``.
        adversary: The collider from the start of the attack on, ``(n, steps)``.
        last: The step of the contact, ``(n,)``.
        at_contact: The boxes of the ego and the collider at the contact, each ``(n,)``.
        supports: The first supports of all rows, then the second ones, each ``(n, steps)``.
    """

    situations: Sequence[Situation]
    bvs: Sequence[tuple[str, ...]]
    ego: Boxes
    adversary: Boxes
    last: Ints
    at_contact: tuple[Boxes, Boxes]
    supports: Sequence[Boxes] = ()


def danger_of(collisions: Collisions, drivable: Drivable) -> PredictedSeverity:
    """Judge the level of each predicted collision.

    All collisions are judged together, which takes less time than one by one.

    Args:
        collisions: The predicted collisions.
        drivable: Where vehicles can drive, for the evasive manoeuvres.

    Returns:
        The severity of each collision, row by row.
    """
    situations, ego, adversary, last = collisions.situations, collisions.ego, collisions.adversary, collisions.last
    n, dt = len(last), situations[0].dt
    onward = _onward(situations, ego, last)
    colliders = [situation.targets[bvs[0]].state for situation, bvs in zip(situations, collisions.bvs, strict=True)]
    small = np.array([is_unprotected(collider) for collider in colliders])
    check = _check(  # other vehicles may hide a pedestrian; reference drivers see supports
        collisions, onward, np.arange(n), with_others=bool(small.any()) or len(collisions.supports) > 0
    )
    normal = check.braking(CcHuman)
    contact = last * dt
    warning = np.where(normal.alarm < contact, contact - normal.alarm, 0.0)
    conclusive = (warning > 0.0) & ~check.unchanged().avoids
    careful = normal.avoids & conclusive
    if len(rows := np.flatnonzero(careful)):
        careful[rows] = _check(collisions, onward, rows, with_others=True).braking(CcHuman).avoids
    manoeuvre = careful.copy()
    if len(rows := np.flatnonzero(conclusive & ~careful & (warning >= MIN_MANOEUVRE_WARNING_S))):
        room = _check(collisions, onward, rows, with_others=True)
        manoeuvre[rows] = room.manoeuvring(normal.alarm[rows], drivable)[0].avoids
    impacts = [
        crash_of(*_single(collisions.at_contact, k), _yaw_rates(ego, adversary, k, int(last[k]), dt)) for k in range(n)
    ]
    delta_v = np.array([impact.ego_delta_v for impact in impacts])
    hard = np.array([
        hardness(impact, road_user(collider)) for impact, collider in zip(impacts, colliders, strict=True)
    ])  # fmt: skip
    human = small | _human(check, adversary, last, dt)
    span = np.arange(ego.x.shape[1])
    final = (span <= last[:, None]) & (span > last[:, None] - STATIONARY_FOR_S / dt)
    stands = (np.where(final, ego.speed, 0.0) < STATIONARY_SPEED_M_S).all(axis=1)
    level = np.full(n, int(Level.COLLISION))
    counts = conclusive & ~stands
    level[counts & manoeuvre] = Level.VALID
    level[counts & careful] = Level.STRICT
    level[counts & careful & human & (hard >= 1.0)] = Level.SERIOUS
    sides = [str(impact.ego_side) for impact in impacts]
    return PredictedSeverity(
        level, warning, delta_v, hard, human, careful, manoeuvre, sides, _strongest(adversary, last, dt)
    )


def _strongest(adversary: Boxes, last: Ints, dt: float) -> Floats:
    """Return each adversary's largest acceleration up to the contact [m/s2], ``(n,)``; ignore its later motion."""
    steps = np.minimum(np.arange(adversary.x.shape[1])[None, :], last[:, None])
    x, y, heading, speed = (
        np.take_along_axis(v, steps, axis=1) for v in (adversary.x, adversary.y, adversary.heading, adversary.speed)
    )
    until = replace(adversary, x=x, y=y, heading=heading, speed=speed, z=0.0)
    change = np.diff(speed, axis=1, prepend=speed[:, :1]) / dt
    return largest_acceleration(until, change, np.asarray(np.arange(steps.shape[1]) * dt, float))


def _check(collisions: Collisions, onward: Floats, rows: Ints, *, with_others: bool = False) -> Counterfactual:
    """Set up the counterfactual of some rows.

    The ego moves as predicted until the contact. The adversary also follows its plan after the contact.

    Args:
        collisions: The predicted collisions.
        onward: Points of the ego's way past the contact, ``(n, P, 2)`` [m].
        rows: The rows to judge.
        with_others: Whether the vehicles nearby take part, which may leave a reference driver no room.
    """
    last, situation = collisions.last[rows], collisions.situations[0]
    until, more = int(last.max()) + 1, round(MIN_AFTER_CONTACT_S / situation.dt)
    ego, adversary = (some_rows(b, rows) for b in (collisions.ego, collisions.adversary))
    given = Encounters(
        some_steps(ego, slice(0, until)), some_steps(adversary, slice(0, until + more)), np.zeros(len(last), np.intp),
        last, situation.dt, _others(collisions, rows) if with_others else None, situation.road.lane_width / 2,
        onward[rows], last + more,
    )  # fmt: skip
    return Counterfactual(given)


def _onward(situations: Sequence[Situation], ego: Boxes, last: Ints) -> Floats:
    """Continue the ego's way past the contact: its unattacked path, displaced by the ego's offset, as points ``(n, P,
    2)``.
    """
    ahead = np.arange(PATH_POINT_SPACING_M, PATH_AFTER_CONTACT_M, PATH_POINT_SPACING_M)
    points = np.full((len(last), len(ahead), 2), np.nan)
    for row, k in enumerate(last.tolist()):
        path = situations[row].baseline.path
        station, offset = path.project(float(ego.x[row, k]), float(ego.y[row, k]))
        x, y, _ = path.at(station + ahead, np.full(len(ahead), offset))
        points[row] = np.stack([x, y], axis=-1)
    return points


def _others(collisions: Collisions, rows: Ints) -> Boxes | None:
    """Return the supports and the vehicles near each row's contact, ``(n, K, steps)``.

    Absent vehicles are NaN. The result is None if there are no such vehicles.
    """
    steps = collisions.ego.x.shape[1]
    boxes_of: dict[tuple[int, tuple[str, ...]], Boxes] = {}
    names = [(id(collisions.situations[k]), collisions.bvs[k]) for k in rows.tolist()]
    for key, row in zip(names, rows.tolist(), strict=True):
        if key in boxes_of:
            continue
        situation, (_, bvs) = collisions.situations[row], key
        same = rows[[n == key for n in names]]
        ex, ey = (q[same, collisions.last[same]] for q in (collisions.ego.x, collisions.ego.y))
        tracks = [
            t for t in situation.traffic.others
            if t.id not in bvs and (np.hypot(t.x[:, None] - ex, t.y[:, None] - ey) < BYSTANDER_DISTANCE_M).any()
        ]  # fmt: skip
        time = np.asarray(situation.time + np.arange(steps) * situation.dt, float)
        boxes_of[key] = on_grid(tracks, time)
    most = max(len(b.x) for b in boxes_of.values()) + len(collisions.supports)
    if not most:
        return None
    motion, size = np.full((5, len(rows), most, steps), np.nan), np.zeros((2, len(rows), most, 1))
    for row, key in enumerate(names):
        b = boxes_of[key]
        motion[:, row, : len(b.x)] = b.x, b.y, b.heading, b.speed, np.broadcast_to(b.z, b.x.shape)
        size[:, row, : len(b.x)] = b.length, b.width
    for place, b in enumerate(collisions.supports, start=most - len(collisions.supports)):
        height = np.broadcast_to(b.z, b.x.shape)[rows]
        motion[:, :, place] = b.x[rows], b.y[rows], b.heading[rows], b.speed[rows], height
        size[:, :, place] = np.asarray(b.length)[rows], np.asarray(b.width)[rows]
    x, y, heading, speed, z = motion
    return Boxes(x, y, heading, speed, size[0], size[1], z if np.nan_to_num(z).any() else 0.0)


def _human(check: Counterfactual, adversary: Boxes, last: Ints, dt: float) -> Bools:
    """Return which adversaries stay within the human envelope until the contact."""
    excused = check.views.in_lane_ahead(check.paths.station)[:, 0]
    steps = min(adversary.x.shape[1], excused.shape[1])
    judged = np.arange(steps) <= last[:, None]
    left = envelope_left(
        some_steps(adversary, slice(0, steps)), np.arange(steps) * dt, judged, excused[:, :steps]
    )  # fmt: skip
    return np.asarray(~np.any(list(left.values()), axis=0))


def _yaw_rates(ego: Boxes, adversary: Boxes, row: int, step: int, dt: float) -> tuple[float, float]:
    """Return the yaw rates [rad/s] of both vehicles over the step to the contact."""
    before = max(step - 1, 0)
    first, second = (wrap_below_pi(float(b.heading[row, step] - b.heading[row, before])) for b in (ego, adversary))
    return first / dt, second / dt


def _single(boxes: tuple[Boxes, Boxes], row: int) -> tuple[Boxes, Boxes]:
    """Return a row of both boxes as 0-d arrays with plain sizes."""
    a, b = (pick(box, np.array(row)) for box in boxes)
    return tuple(replace(v, length=float(v.length), width=float(v.width)) for v in (a, b))  # type: ignore[return-value]


def some_rows(b: Boxes, rows: Ints) -> Boxes:
    """Select rows of boxes.

    Args:
        b: Boxes of shape ``(n, steps)``, with sizes of shape ``(n, 1)`` or plain numbers.
        rows: The indices of the rows.

    Returns:
        The selected rows.
    """
    length, width = (v if np.ndim(v) == 0 else np.asarray(v)[rows] for v in (b.length, b.width))
    return Boxes(b.x[rows], b.y[rows], b.heading[rows], b.speed[rows], length, width, height_as(b, lambda z: z[rows]))
