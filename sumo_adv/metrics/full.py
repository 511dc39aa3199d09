"""The full verdict, for the attempt that counts: sensitivity, last moments, a reacting adversary, severity, RSS; and
which markings a vehicle's box centre crossed, from the geometry of lanes alone.

SUMO networks hold no paint: between lanes of one direction there is taken to be a broken line, towards a lane of the
other direction a centre line, and where the drivable area ends an edge.  Inside junctions there are none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Bools, Floats, LaneStrip, Limits, Track, Verdict
from sumo_adv.geometry import same_layer, wrap_below_pi
from sumo_adv.metrics.avoidance import DELAY, PERCEPTION, RAMP, REACTION, Manoeuvre, OnRoad, avoidance
from sumo_adv.metrics.boxes import at_time, on_grid, pick
from sumo_adv.metrics.contact import (
    OPPOSITE_DIRECTION,
    SAME_DIRECTION,
    CollisionClass,
    Impact,
    collision_class,
    contact_point,
    impact,
)
from sumo_adv.metrics.criticality import AVAILABLE_BRAKING_M_S2, exposure, pet, series
from sumo_adv.metrics.fault import SecondOpinion, rss_opinion
from sumo_adv.metrics.validity import MOST, Encounter, Kind, align, avoidable_by, hazard_of, judge

END = 1e-6  # m: a point nearest to a lane's very end lies before or past it


class Marking(StrEnum):
    """What was crossed."""

    LANE_LINE = "lane_line"
    CENTRE_LINE = "centre_line"
    ROAD_EDGE = "road_edge"


@dataclass(frozen=True, slots=True)
class Crossing:
    """The first step [s] at which the box centre is past a marking."""

    time: float
    kind: Marking


def markings_crossed(track: Track, strips: Sequence[LaneStrip], on_road: OnRoad | None = None) -> list[Crossing]:
    """All markings that the box centre crossed over a track, in order.

    A line between lanes is crossed where the centre is in another lane while it is still abreast of the one it was in
    last: driving on into the next lane of a road, or through a junction, crosses none.
    """
    open_road = [s for s in strips if not s.internal]
    abreast, offset, heading = _project(track, open_road)
    lane = _lane_of(abreast, offset, open_road)
    in_junctions = [s for s in strips if s.internal]
    inside = _lane_of(*_project(track, in_junctions)[:2], in_junctions) >= 0
    off = np.zeros(len(track.time), dtype=bool) if on_road is None else ~np.asarray(on_road(track.x, track.y))
    crossings: list[Crossing] = []
    held = -1
    for k, (time, place) in enumerate(zip(track.time.tolist(), lane.tolist(), strict=True)):
        if k and off[k] and not off[k - 1]:
            crossings.append(Crossing(time, Marking.ROAD_EDGE))
        if place < 0:
            held = -1 if inside[k] else held
            continue
        if held >= 0 and place != held and abreast[held, k]:
            turn = abs(float(wrap_below_pi(heading[place, k] - heading[held, k])))
            if turn < SAME_DIRECTION or turn > OPPOSITE_DIRECTION:
                crossings.append(Crossing(time, Marking.LANE_LINE if turn < SAME_DIRECTION else Marking.CENTRE_LINE))
        held = place
    return crossings


def _project(track: Track, strips: Sequence[LaneStrip]) -> tuple[Bools, Floats, Floats]:
    """For each strip and step ``(k, n)``: neither before nor past its ends, lateral offset [m], its direction [rad]."""
    shape = (len(strips), len(track.time))
    abreast, offset, heading = np.zeros(shape, dtype=bool), np.full(shape, np.inf), np.zeros(shape)
    for row, strip in enumerate(strips):
        a, step = strip.shape[:-1], np.diff(strip.shape, axis=0)
        length = np.maximum(np.hypot(step[:, 0], step[:, 1]), 1e-9)
        ux, uy = step[:, 0] / length, step[:, 1] / length
        px, py = track.x[:, None] - a[:, 0], track.y[:, None] - a[:, 1]
        along, across = px * ux + py * uy, py * ux - px * uy
        past = along - np.clip(along, 0.0, length)
        away = np.hypot(past, across)
        nearest = np.argmin(away, axis=1)
        at = (np.arange(len(nearest)), nearest)
        abreast[row] = ~(((nearest == 0) & (past[at] < -END)) | ((nearest == len(length) - 1) & (past[at] > END)))
        if strip.shape.shape[1] > 2:
            abreast[row] &= same_layer(strip.shape[nearest, 2], track.z)
        offset[row] = np.where(past[at] == 0, across[at], away[at])  # outside a bend's corner: to the corner itself
        heading[row] = np.arctan2(uy, ux)[nearest]
    return abreast, offset, heading


def _lane_of(abreast: Bools, offset: Floats, strips: Sequence[LaneStrip]) -> NDArray[np.intp]:
    """The strip with the nearest centre line, in its widths, at each step ``(n,)``; -1 where no strip holds it."""
    if not strips:
        return np.full(abreast.shape[1], -1)
    width = np.array([[s.width] for s in strips])
    share = np.where(abreast & (np.abs(offset) <= width / 2), np.abs(offset) / width, np.inf)
    best = np.asarray(share.argmin(axis=0))
    return np.where(np.isfinite(share.min(axis=0)), best, -1)


SENSITIVITY = 0.4  # s, earlier and later
REACTING = Manoeuvre(PERCEPTION + REACTION, 4.0, RAMP)  # an ordinary driver's braking once the hazard shows
EXPOSURE_TTC = 1.5  # s, threshold of TET and TIT
PAPER_EPSILON = 5.0  # m, the paper's collision threshold on centres, which it does not give: a car's length


@dataclass(frozen=True, slots=True)
class FullVerdict:
    """All figures of one attempt.  Times s, inf = never, None = the question does not arise (no collision)."""

    verdict: Verdict
    kind: Kind
    collision_class: CollisionClass | None
    impact: Impact | None
    rss: SecondOpinion | None
    sensitivity: Mapping[str, bool]  # careful_-0.4, careful_+0.4, manoeuvre_-0.4, manoeuvre_+0.4
    latest_careful: float | None  # s before contact at which braking as the careful driver must begin
    latest_manoeuvre: float | None  # s before contact at which some manoeuvre must begin
    reacting: str | None  # careful_driver | any_manoeuvre | unavoidable, the adversary braking too
    tet: float  # s with TTC <= 1.5 s
    tit: float  # s2
    min_headway: float
    max_btn: float
    max_required_lateral: float
    min_centre_distance: float
    conflict_point: tuple[float, float] | None


def full_judge(
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
) -> FullVerdict:
    """:func:`~sumo_adv.metrics.validity.judge` and everything that only the attempt that counts needs."""
    verdict = judge(
        ego, adversary, others, trigger_time=trigger_time, ttc_threshold=ttc_threshold, limits=limits, on_road=on_road,
        lane_half_width=lane_half_width, supports=supports,
    )  # fmt: skip
    e = align(ego, adversary, trigger_time, verdict.contact_time)
    stop = float(e.time[-1])
    hazard, kind = hazard_of(e, lane_half_width)
    measures = series(ego.between(trigger_time, stop), [adversary])
    tet, tit = exposure(measures["ttc"][0], EXPOSURE_TTC, e.dt)
    contact = verdict.contact_time
    careful, manoeuvre = (None, None) if contact is None else _latest(e, contact, on_road, others)
    return FullVerdict(
        verdict=verdict,
        kind=kind,
        collision_class=None if contact is None else collision_class(ego, adversary, contact),
        impact=None if contact is None else impact(ego, adversary, contact),
        rss=None if contact is None else rss_opinion(ego, adversary, contact),
        sensitivity={} if contact is None else _sensitivity(e, hazard, on_road, others),
        latest_careful=careful,
        latest_manoeuvre=manoeuvre,
        reacting=None if contact is None else avoidable_by(e, hazard, on_road, others, REACTING),
        tet=float(tet),
        tit=float(tit),
        min_headway=float(measures["headway"].min()),
        max_btn=_largest(measures["drac"]) / AVAILABLE_BRAKING_M_S2,
        max_required_lateral=_largest(measures["required_lateral"]),
        min_centre_distance=_nearest_centres(ego, adversary, measures["centre_distance"], contact),
        conflict_point=_conflict(ego, adversary, trigger_time, stop, contact),
    )


def _conflict(
    ego: Track, adversary: Track, start: float, stop: float, contact: float | None
) -> tuple[float, float] | None:
    """Where they met, or where their swept boxes came nearest in time."""
    if contact is None:
        return pet(ego.between(start, stop), adversary.between(start, stop)).point
    return contact_point(at_time(ego, contact), at_time(adversary, contact))


def _nearest_centres(ego: Track, adversary: Track, distances: Floats, contact: float | None) -> float:
    """Least distance of the centres [m] over the steps and, where they met, at the first contact."""
    least = float(distances.min())
    if contact is None:
        return least
    a, b = at_time(ego, contact), at_time(adversary, contact)
    return min(least, float(np.hypot(b.x - a.x, b.y - a.y)))


def _largest(values: Floats) -> float:
    return float(np.minimum(values, MOST).max())


def _sensitivity(e: Encounter, hazard: float, on_road: OnRoad | None, others: Sequence[Track]) -> dict[str, bool]:
    """Both tiers begun 0.4 s earlier and later."""
    avoided: dict[str, bool] = {}
    third = on_grid(others, e.time) if others else None
    for shift in (-SENSITIVITY, SENSITIVITY):
        answer = avoidance(
            e.ego, e.adversary, np.array([e.step_of(hazard)]), e.dt, delays=(DELAY + shift,),
            careful_delay=PERCEPTION + REACTION + shift, on_road=on_road, others=third,
        )  # fmt: skip
        avoided[f"careful_{shift:+.1f}"] = bool(answer["careful"][0])
        avoided[f"manoeuvre_{shift:+.1f}"] = bool(answer["manoeuvre"][0, 0])
    return avoided


def _latest(
    e: Encounter, contact: float, on_road: OnRoad | None, others: Sequence[Track]
) -> tuple[float | None, float | None]:
    """Seconds before contact of the last step at which acting at once still avoids, for both tiers; None = never."""
    steps = np.arange(e.trigger, e.last + 1)
    ego, adversary = (pick(b, np.zeros(len(steps), np.intp)) for b in (e.ego, e.adversary))
    answer = avoidance(
        ego, adversary, steps, e.dt, delays=(0.0,), careful_delay=0.0, on_road=on_road,
        others=on_grid(others, e.time) if others else None,
    )  # fmt: skip
    seconds: list[float | None] = []
    for works in (answer["careful"], answer["manoeuvre"][:, 0]):
        last = np.flatnonzero(works)
        seconds.append(float(contact - e.time[steps[last[-1]]]) if last.size else None)
    return seconds[0], seconds[1]
