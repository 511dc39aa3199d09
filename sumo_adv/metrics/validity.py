"""The gate verdict on one attempt: critical, feasible, rear-end, avoidable, valid, strict.

The search judges every attempt by :func:`judge`. ``metrics.full`` adds measures for the attempt that counts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats, Limits, Track, Verdict
from sumo_adv.errors import UsageError
from sumo_adv.metrics.avoidance import CAREFUL_BRAKING, PERCEPTION, REACTION, OnRoad, avoidance
from sumo_adv.metrics.boxes import at_time, first_contact, gap, on_grid
from sumo_adv.metrics.contact import CollisionClass, collision_class, rear_end
from sumo_adv.metrics.criticality import drac, pet, ttc
from sumo_adv.metrics.fault import fault as fault_of
from sumo_adv.metrics.gates import all_failed_gates
from sumo_adv.metrics.hazard import KINDS, Kind, hazard_index

MANOEUVRE_DELAY = 0.8  # s after the hazard shows at which a manoeuvre begins
MOST = 20.0  # m/s2, more than any car can do: larger required decelerations, unbounded at contact, are reported as this

__all__ = [
    "CAREFUL_BRAKING", "PERCEPTION", "REACTION", "CollisionClass", "Encounter", "Kind", "align", "avoidance",
    "careful_driver_avoids", "collision_class", "hazard_index", "hazard_time", "judge", "manoeuvre_avoids", "rear_end",
]  # fmt: skip


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
        b, stop = self.adversary, self.last + 1
        return Boxes(b.x[:, :stop], b.y[:, :stop], b.heading[:, :stop], b.speed[:, :stop], b.length, b.width)


def align(
    ego: Track, adversary: Track, trigger_time: float, end: float | None = None, contact_time: float | None = None
) -> Encounter:
    """Both tracks on their common grid, cut at the first contact after the trigger (computed unless given).

    Raises:
        UsageError: the tracks do not overlap in time after the trigger.
    """
    start = max(ego.time[0], adversary.time[0])
    stop = min(ego.time[-1], adversary.time[-1], np.inf if end is None else end)
    own, adversary_part = ego.between(start, stop), adversary.between(start, np.inf)
    count = len(own.time)
    trigger = int(np.searchsorted(own.time, trigger_time - 5e-4))
    if trigger >= count:
        raise UsageError(
            f"The tracks of {ego.id!r} and {adversary.id!r} have no step in common after the trigger at "
            f"{trigger_time:g} s; give tracks that begin before it."
        )
    dt = float(ego.time[1] - ego.time[0]) if len(ego.time) > 1 else 0.1
    if contact_time is None:
        after = slice(trigger, count)
        when = float(first_contact(_part(own, after), _part(adversary_part, after), own.time[after]))
        contact_time = when if np.isfinite(when) else None
    last = count - 1 if contact_time is None else int(np.searchsorted(own.time, contact_time + 1e-9) - 1)
    last = min(max(last, trigger), count - 1)
    every = slice(0, None)
    return Encounter(
        own.time[: last + 1], dt, _row(_part(own, slice(0, last + 1))), _row(_part(adversary_part, every)), trigger,
        last, contact_time,
    )  # fmt: skip


def _part(track: Track, part: slice) -> Boxes:
    return Boxes(track.x[part], track.y[part], track.heading[part], track.speed[part], track.length, track.width)


def _row(b: Boxes) -> Boxes:
    return Boxes(b.x[None], b.y[None], b.heading[None], b.speed[None], b.length, b.width)


def hazard_time(
    ego: Track,
    adversary: Track,
    *,
    trigger_time: float,
    contact_time: float | None = None,
    lane_half_width: float = 1.6,
) -> tuple[float, Kind]:
    """When the hazard shows [s], and the kind of encounter; see :func:`hazard_index`.

    The time lies between the trigger and the contact, or the closest approach if there is no contact.
    """
    return _hazard(align(ego, adversary, trigger_time, contact_time=contact_time), lane_half_width)


def _hazard(e: Encounter, lane_half_width: float) -> tuple[float, Kind]:
    adversary = e.until_last()
    last = e.last
    if e.contact_time is None:
        last = e.trigger + int(np.argmin(gap(e.ego, adversary)[0, e.trigger :]))
    index, kind = hazard_index(
        e.ego, adversary, np.array([e.trigger]), np.array([last]), e.dt, lane_half_width=lane_half_width
    )
    return float(e.time[index[0]]), KINDS[int(kind[0])]


def careful_driver_avoids(
    ego: Track, adversary: Track, hazard: float, *, shift: float = 0.0, horizon: float = 6.0
) -> bool:
    """Whether UN R157's careful and competent driver, braking 1.15 s + ``shift`` after ``hazard``, does not collide.

    The ego follows its recorded path, never ahead of its recorded motion. Past the end of a track, motion goes on at
    constant speed and heading; cut the ego's track at the contact.
    """
    e = align(ego, adversary, hazard)
    delay = max(PERCEPTION + REACTION + shift, 0.0)
    answer = avoidance(e.ego, e.adversary, np.array([e.trigger]), e.dt, delays=(), careful_delay=delay, horizon=horizon)
    return bool(answer["careful"][0])


def manoeuvre_avoids(
    ego: Track,
    adversary: Track,
    hazard: float,
    delay: float = MANOEUVRE_DELAY,
    on_road: OnRoad | None = None,
    others: Sequence[Track] = (),
) -> bool:
    """Whether some braking or shift, begun ``delay`` after ``hazard`` [s], avoids the collision.

    It must stay on the road and clear of the others.
    """
    e = align(ego, adversary, hazard)
    return bool(_escapes(e, e.trigger, (delay,), on_road, others)["manoeuvre"][0, 0])


def _escapes(
    e: Encounter, hazard: int, delays: Sequence[float], on_road: OnRoad | None, others: Sequence[Track]
) -> dict[str, Bools]:
    third = on_grid(others, e.time) if others else None
    return avoidance(
        e.ego, e.adversary, np.array([hazard]), e.dt, delays=delays, on_road=on_road, others=third
    )  # fmt: skip


def judge(
    ego: Track,
    adversary: Track,
    others: Sequence[Track],
    *,
    trigger_time: float,
    ttc_threshold: float = 1.0,
    limits: Limits = Limits(),  # noqa: B008 - frozen
    on_road: Callable[[Floats, Floats], Bools] | None = None,
    lane_half_width: float = 1.6,
    end: float | None = None,
    supports: Sequence[Track] = (),
) -> Verdict:
    """The gate verdict of one attempt, on recorded motion.

    The tracks lie on one grid and begin at least two steps before the trigger. The adversary's may go on past the
    contact with its planned motion. ``supports``: those of the others that are adversaries, too; their motion is judged
    by the gates as well. ``min_ttc``, ``min_distance``, ``max_drac`` and ``min_ttc_any`` run from the
    trigger to the first contact or ``end``. ``avoidable``, ``valid`` and ``strict`` are None without a collision.
    """
    e = align(ego, adversary, trigger_time, end)
    collided = e.contact_time is not None
    stop = e.contact_time if e.contact_time is not None else float(e.time[-1])
    times, until_last = ttc(e.ego, e.until_last())[0, e.trigger :], e.until_last()
    lowest = int(np.argmin(times))
    any_ttc = _least_ttc(e, others)
    threat = drac(e.ego, until_last)[0, e.trigger :]
    driven = trigger_time + e.dt / 2  # SUMO itself drove up to the state at the trigger
    gates = all_failed_gates(
        adversary, supports, limits, on_road=on_road, ego=ego, others=others, end=stop, start=driven
    )  # fmt: skip
    hazard, _ = _hazard(e, lane_half_width)
    from_behind = e.contact_time is not None and bool(rear_end(*(at_time(t, e.contact_time) for t in (ego, adversary))))
    avoidable = _avoidable(e, hazard, on_road, others) if collided else None
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
    x, y, heading, speed = (v[0, e.trigger :] for v in (e.ego.x, e.ego.y, e.ego.heading, e.ego.speed))
    ego = Boxes(x, y, heading, speed, e.ego.length, e.ego.width)
    return float(ttc(ego, on_grid(others, e.time[e.trigger :])).min())


def _avoidable(e: Encounter, hazard: float, on_road: OnRoad | None, others: Sequence[Track]) -> str:
    index = int(np.searchsorted(e.time, hazard - 5e-4))
    escapes = _escapes(e, index, (MANOEUVRE_DELAY,), on_road, others)
    if escapes["careful"][0]:
        return "careful_driver"
    return "any_manoeuvre" if escapes["manoeuvre"][0, 0] else "unavoidable"
