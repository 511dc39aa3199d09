"""The gate verdict on one attempt: critical, feasible, rear-end, avoidable, valid, strict; and when the hazard shows.

The search judges every attempt by :func:`judge`. ``metrics.full`` adds measures for the attempt that counts.

When the hazard shows depends on the kind of encounter. Lateral positions are taken in the frame of the ego's path: the
ego's recorded positions, at each point the nearest of them with its heading, which runs straight on at both ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Bools, Boxes, Floats, Limits, Track, Verdict
from sumo_adv.errors import UsageError
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.avoidance import DELAY, Manoeuvre, OnRoad, avoidance
from sumo_adv.metrics.boxes import at_time, first_contact, gap, on_grid, row_of, some_steps
from sumo_adv.metrics.contact import rear_end
from sumo_adv.metrics.criticality import drac, pet, ttc
from sumo_adv.metrics.fault import fault as fault_of
from sumo_adv.metrics.gates import all_failed_gates

LEFT_LANE_KEEPING = 0.375  # m towards the ego's path, UN R157
STOPPING = 3.0  # m/s2, a crossing vehicle that could still stop this gently shows no hazard
CORRIDOR_MARGIN = 0.3  # m beside the ego's half width
FIRST_TTC = 3.0  # s, where no other rule applies
SAME, OPPOSITE = np.pi / 4, 3 * np.pi / 4  # rad of heading difference


class Kind(StrEnum):
    """Geometry of an encounter at its contact or closest approach."""

    SAME_DIRECTION = "same_direction"
    ONCOMING = "oncoming"
    CROSSING = "crossing"
    OTHER = "other"


KINDS = tuple(Kind)


def path_frame(ego: Boxes, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Lateral offset [m, left positive] of points ``(N, K)`` from the ego's path ``(N, T)``, and the path's heading."""
    ox, oy = ego.x[:, :1], ego.y[:, :1]
    qx, qy, px, py = ego.x - ox, ego.y - oy, x - ox, y - oy
    cross = np.matmul(np.stack([px, py], -1), np.stack([qx, qy], -2))
    nearest = np.argmin((qx * qx + qy * qy)[:, None, :] - 2 * cross, axis=-1)
    rows = np.arange(len(x))[:, None]
    heading = np.broadcast_to(ego.heading, ego.x.shape)[rows, nearest]
    dx, dy = px - qx[rows, nearest], py - qy[rows, nearest]
    return dy * np.cos(heading) - dx * np.sin(heading), heading


def hazard_index(
    ego: Boxes,
    adversary: Boxes,
    trigger_index: NDArray[np.integer],
    contact_index: NDArray[np.integer],
    *,
    lane_half_width: float = 1.6,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The step at which the hazard shows and the kind (index into ``KINDS``), both ``(N,)``, of ``(N, T)`` states.

    Same direction (headings within 45 degrees at contact): the first step, after the last maximum of its lateral
    offset, at which the adversary has come 0.375 m closer to the ego's path.  Oncoming (over 135 degrees): the
    start of the final spell before contact in which its box is over the edge of the ego's lane.  Crossing (between, or
    a vehicle that turned into the ego's direction): the start of the final spell in which it could not stop at 3 m/s2
    short of the corridor of the ego's path.  A same-direction adversary that never drifted closer (a leader that
    brakes) is *other*: the first 2D TTC < 3 s, else the contact.  Never
    before ``trigger_index`` nor after ``contact_index``.
    """
    rows = np.arange(len(contact_index))
    trigger, contact = np.asarray(trigger_index), np.asarray(contact_index)
    steps = np.arange(ego.x.shape[1])
    inside = (steps >= trigger[:, None]) & (steps <= contact[:, None])
    lateral, path_heading = path_frame(ego, adversary.x, adversary.y)
    offset = np.abs(lateral)
    turn = np.abs(wrap_below_pi(np.broadcast_to(adversary.heading, offset.shape) - path_heading))
    facing = np.abs(wrap_below_pi(np.broadcast_to(adversary.heading - ego.heading, offset.shape)))[rows, contact]
    peak = _last(np.where(inside, offset, -np.inf))
    kind = np.where(facing < SAME, 0, np.where(facing > OPPOSITE, 1, 2))
    kind = np.where((kind == 0) & (turn[rows, peak] > SAME), 2, kind)

    drifted = inside & (steps > peak[:, None]) & (offset <= offset[rows, peak][:, None] - LEFT_LANE_KEEPING)
    reach = adversary.length / 2 * np.abs(np.sin(turn)) + adversary.width / 2 * np.abs(np.cos(turn))
    nearest = np.maximum(offset - reach, 0.0)
    over = _final_spell(nearest < lane_half_width, trigger, contact)
    entry = _final_spell(nearest <= ego.width / 2 + CORRIDOR_MARGIN, trigger, contact)
    committed = _final_spell(_cannot_stop(adversary, entry), trigger, contact)

    soon = inside & (ttc(ego, adversary) < FIRST_TTC)
    kind = np.where((kind == 0) & ~drifted.any(axis=1), KINDS.index(Kind.OTHER), kind)
    first_soon = np.where(soon.any(axis=1), soon.argmax(axis=1), contact)
    return np.choose(kind, [drifted.argmax(axis=1), over, committed, first_soon]), kind


def _last(values: Floats | Bools) -> NDArray[np.intp]:
    """Index of the last maximum of each row."""
    return np.asarray(values.shape[1] - 1 - values[:, ::-1].argmax(axis=1))


def _final_spell(holds: Bools, low: NDArray[np.integer], high: NDArray[np.integer]) -> NDArray[np.intp]:
    """Start of the uninterrupted spell of ``holds`` that runs up to ``high``; ``high`` itself is taken to hold."""
    steps = np.arange(holds.shape[1])
    broken = ~holds & (steps >= low[:, None]) & (steps < high[:, None])
    return np.where(broken.any(axis=1), _last(broken) + 1, low)


def _cannot_stop(adversary: Boxes, entry: NDArray[np.intp]) -> Bools:
    """Whether at each step ``(N, T)`` the way left to the step ``entry`` is no more than v^2 / 2a; true from it on."""
    step = np.hypot(np.diff(adversary.x), np.diff(adversary.y))
    travelled = np.concatenate([np.zeros((len(entry), 1)), np.cumsum(step, axis=1)], axis=1)
    left = travelled[np.arange(len(entry)), entry][:, None] - travelled
    return np.asarray(left <= adversary.speed * adversary.speed / (2 * STOPPING) + 1e-6)  # a micrometre of rounding


MOST = 20.0  # m/s2, more than any car can do: larger required decelerations, unbounded at contact, are reported as this


@dataclass(frozen=True, slots=True)
class Encounter:
    """Ego and adversary on one grid as boxes ``(1, n)``: the ego to the contact, the adversary to its track's end."""

    time: Floats  # (n,) [s], of the ego's part
    dt: float
    ego: Boxes
    adversary: Boxes
    trigger: int
    last: int  # the last step before the contact, or of the track
    contact_time: float | None

    def until_last(self) -> Boxes:
        """The adversary over the ego's steps."""
        return some_steps(self.adversary, slice(self.last + 1))

    def step_of(self, time: float) -> int:
        """The step at a time [s] of the grid."""
        return int(np.searchsorted(self.time, time - 5e-4))


def align(ego: Track, adversary: Track, trigger_time: float, contact_time: float | None = None) -> Encounter:
    """Both tracks on their common grid, cut at the first contact after the trigger (computed unless given).

    Raises UsageError: the tracks do not overlap in time after the trigger.
    """
    start = max(ego.time[0], adversary.time[0])
    together = ego.between(start, min(ego.time[-1], adversary.time[-1]))
    time, own, foe = together.time, row_of(together), row_of(adversary.between(start, np.inf))
    count = len(time)
    trigger = int(np.searchsorted(time, trigger_time - 5e-4))
    if trigger >= count:
        raise UsageError(
            f"The tracks of {ego.id!r} and {adversary.id!r} have no step in common after the trigger at "
            f"{trigger_time:g} s; give tracks that begin before it."
        )
    dt = float(ego.time[1] - ego.time[0]) if len(ego.time) > 1 else 0.1
    if contact_time is None:
        after = slice(trigger, count)
        when = float(first_contact(some_steps(own, after), some_steps(foe, after), time[after])[0])
        contact_time = when if np.isfinite(when) else None
    last = count - 1 if contact_time is None else int(np.searchsorted(time, contact_time + 1e-9) - 1)
    last = min(max(last, trigger), count - 1)
    return Encounter(time[: last + 1], dt, some_steps(own, slice(last + 1)), foe, trigger, last, contact_time)


def hazard_of(e: Encounter, lane_half_width: float = 1.6) -> tuple[float, Kind]:
    """When the hazard shows [s], and the kind of encounter; see :func:`hazard_index`.

    The time lies between the trigger and the contact, or the closest approach if there is no contact.
    """
    adversary, last = e.until_last(), e.last
    if e.contact_time is None:
        last = e.trigger + int(np.argmin(gap(e.ego, adversary)[0, e.trigger :]))
    index, kind = hazard_index(
        e.ego, adversary, np.array([e.trigger]), np.array([last]), lane_half_width=lane_half_width
    )
    return float(e.time[index[0]]), KINDS[int(kind[0])]


def avoidable_by(
    e: Encounter, hazard: float, on_road: OnRoad | None, others: Sequence[Track], reacting: Manoeuvre | None = None
) -> str:
    """``careful_driver``, ``any_manoeuvre`` or ``unavoidable``; ``hazard``: when it shows [s]; ``reacting``: the
    adversary, too, brakes."""
    answer = avoidance(
        e.ego, e.adversary, np.array([e.step_of(hazard)]), e.dt, delays=(DELAY,), on_road=on_road,
        others=on_grid(others, e.time) if others else None, reacting=reacting,
    )  # fmt: skip
    if answer["careful"][0]:
        return "careful_driver"
    return "any_manoeuvre" if answer["manoeuvre"][0, 0] else "unavoidable"


def judge(
    ego: Track,
    adversary: Track,
    others: Sequence[Track],
    *,
    trigger_time: float,
    ttc_threshold: float = 1.0,
    limits: Limits = Limits(),  # noqa: B008 - frozen
    on_road: OnRoad | None = None,
    lane_half_width: float = 1.6,
    supports: Sequence[Track] = (),
) -> Verdict:
    """The gate verdict of one attempt, on recorded motion.

    The tracks lie on one grid and begin at least two steps before the trigger. The adversary's may go on past the
    contact with its planned motion. ``supports``: those of the others that are adversaries, too; their motion is judged
    by the gates as well. ``min_ttc``, ``min_distance``, ``max_drac`` and ``min_ttc_any`` run from the
    trigger to the first contact or the end. ``avoidable``, ``valid`` and ``strict`` are None without a collision.
    """
    e = align(ego, adversary, trigger_time)
    collided = e.contact_time is not None
    stop = e.contact_time if e.contact_time is not None else float(e.time[-1])
    until_last = e.until_last()
    times = ttc(e.ego, until_last)[0, e.trigger :]
    lowest = int(np.argmin(times))
    any_ttc = _least_ttc(e, others)
    threat = drac(e.ego, until_last)[0, e.trigger :]
    driven = trigger_time + e.dt / 2  # SUMO itself drove up to the state at the trigger
    gates = all_failed_gates(
        adversary, supports, limits, on_road=on_road, ego=ego, others=others, end=stop, start=driven
    )  # fmt: skip
    hazard, _ = hazard_of(e, lane_half_width)
    from_behind = e.contact_time is not None and bool(rear_end(*(at_time(t, e.contact_time) for t in (ego, adversary))))
    avoidable = avoidable_by(e, hazard, on_road, others) if collided else None
    valid = not gates and not from_behind and avoidable != "unavoidable" if collided else None
    min_ttc = 0.0 if collided else float(times[lowest])
    return Verdict(
        min_ttc=min_ttc,
        min_distance=0.0 if collided else float(gap(e.ego, until_last)[0, e.trigger :].min()),
        collided=collided,
        critical=collided or min_ttc <= ttc_threshold,
        feasible=not gates,
        rear_end=from_behind,
        valid=valid,
        strict=bool(valid) and avoidable == "careful_driver" if collided else None,
        avoidable=avoidable,
        failed_gates=gates,
        min_ttc_any=min(min_ttc, any_ttc),
        min_pet=0.0 if collided else pet(ego.between(trigger_time, stop), adversary.between(trigger_time, stop)).pet,
        max_drac=float(np.minimum(threat, MOST).max()),
        fault=None if e.contact_time is None else fault_of(ego, adversary, e.contact_time),
        contact_time=e.contact_time,
        hazard_time=hazard if collided or min_ttc < np.inf else None,
        min_ttc_time=stop if collided else (float(e.time[e.trigger + lowest]) if min_ttc < np.inf else None),
    )


def _least_ttc(e: Encounter, others: Sequence[Track]) -> float:
    """The ego's least TTC with any other vehicle, from the trigger on."""
    if not others:
        return float("inf")
    after = slice(e.trigger, None)
    return float(ttc(some_steps(e.ego, after), on_grid(others, e.time[after])).min())
