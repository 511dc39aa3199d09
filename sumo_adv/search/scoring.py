"""Predicted rollouts judged by the verdict's own functions, and their scores.

The lower the score, the better. A feasible collision that is not a rear-end scores by which driver could have avoided
it and with how much time to spare. Unavoidable contacts, misses, infeasible motions, contacts with a third party
and rear-ends follow in this order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sumo_adv.datatypes import Bools, Boxes, Floats, Limits, Prediction, Proposal, Role
from sumo_adv.drivers.third_parties import braking
from sumo_adv.geometry import wrap_all
from sumo_adv.metrics.avoidance import avoidance, careful_after
from sumo_adv.metrics.boxes import between_steps, gap, on_grid, overlaps, pick, sweep, touching
from sumo_adv.metrics.contact import rear_end
from sumo_adv.metrics.criticality import ttc
from sumo_adv.metrics.gates import CLOCK_SLACK, kinematic_gates, near_pairs, off_road, third_party
from sumo_adv.metrics.hazard import hazard_index
from sumo_adv.search.rollouts import Rollouts, Touch
from sumo_adv.search.settings import ScoreSettings
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import Situation

GENTLY = 1.0  # m/s2: gentler braking does not count
ROAD_INSET = 0.05  # m; the judge's 0.15 would leave no room for the error of a prediction
ROAD_STRIDE = 4  # steps between two tests of the corners, which are slow; off the road a vehicle stays for longer
LEAST_STEPS = 3  # before a contact, for a hazard to show
MANOEUVRE = 1  # the place of the verdict's delay among ``manoeuvre_delays``


def judge_all(
    situation: Situation, proposals: Sequence[Proposal], rollouts: Rollouts, drivable: Drivable, limits: Limits,
    weights: ScoreSettings,
) -> list[tuple[float, Prediction]]:  # fmt: skip
    """The score and the prediction of each rollout, row by row."""
    n, steps = rollouts.ego[0].shape
    brakes = _brakes(rollouts.adversary[3], situation.dt)
    lengths = np.array([[situation.targets[p.bv].state.length] for p in proposals])
    widths = np.array([[situation.targets[p.bv].state.width] for p in proposals])
    ego = Boxes(*rollouts.ego, situation.ego.length, situation.ego.width)
    adversary = Boxes(*rollouts.adversary, lengths, widths)
    contact = _first(touching(ego, adversary))
    hit = contact < min(steps, situation.left + 1)
    smaller = Boxes(*rollouts.adversary, lengths - weights.graze, widths - weights.graze)
    firm = np.asarray(touching(ego, smaller).any(axis=1))
    end = int(min(steps - 1, situation.left))
    last = np.minimum(contact, end)
    end_time, at_contact = _ends(ego, adversary, last, hit, rollouts.time)
    judged = (rollouts.time > 0) & (rollouts.time <= end_time[:, None] + CLOCK_SLACK)  # the first state is SUMO's own
    before = np.array([situation.targets[p.bv].state.acceleration for p in proposals])
    third = _third_party(situation, proposals, adversary, rollouts.time, end_time)
    leaves = _leaves_road(adversary, judged, drivable)
    beyond = _beyond_limits(adversary, before, rollouts.time, judged, limits)
    rear = hit & rear_end(*at_contact)
    least, nearest = _least(ego, adversary, last)
    good = np.flatnonzero(hit & ~third & ~leaves & ~beyond & ~rear & (contact >= LEAST_STEPS))
    missed = weights.miss_by_ttc * np.minimum(least, 10.0) + weights.miss_by_gap * np.minimum(nearest, 30.0)
    score = np.where(hit, weights.unavoidable, weights.miss + missed)
    score = np.where(leaves, weights.off_road, np.where(beyond, weights.beyond_limits, score))
    score = np.where(third, weights.third_party, np.where(rear, weights.rear_end, score))
    delays = weights.manoeuvre_delays
    careful, manoeuvre, hazard = np.zeros(n, bool), np.zeros((n, len(delays)), bool), np.array(last)
    if len(good):
        found = _avoidable(situation, proposals, ego, adversary, good, last[good], drivable, weights)
        careful[good], late, nearly, manoeuvre[good], hazard[good] = found
        warning = (last[good] - hazard[good]) * situation.dt
        score[good] = _score(careful[good], late, nearly, manoeuvre[good], warning, weights)
        score[good] += np.where(firm[good], 0.0, weights.grazes)
    by_manoeuvre = manoeuvre[:, MANOEUVRE]
    return [
        (float(score[k]), Prediction(
            hit=bool(hit[k]), min_ttc=0.0 if hit[k] else float(least[k]), gap=float(nearest[k]),
            time=float(last[k] * situation.dt), spare=float((end - last[k]) * situation.dt),
            warning=float((last[k] - hazard[k]) * situation.dt),
            braking=float(brakes[k, : max(int(last[k]), 1)].mean()), careful=bool(careful[k]),
            manoeuvre=bool(by_manoeuvre[k]), third_party=bool(third[k]),
            off_road=bool(leaves[k]), beyond_limits=bool(beyond[k]),
        ))
        for k in range(n)
    ]  # fmt: skip


def _brakes(speed: Floats, dt: float) -> Bools:
    """Whether it brakes by more than ``GENTLY``, step by step."""
    return np.asarray(np.diff(speed, axis=1) / dt < -GENTLY)


def touch_of(situations: Mapping[float, Situation], proposals: Sequence[Proposal]) -> Touch:
    """A function that tells whether the ego and the BVs of these candidates touch."""
    states = [situations[p.delay].targets[p.bv].state for p in proposals]
    length, width = np.array([s.length for s in states]), np.array([s.width for s in states])
    mine = next(iter(situations.values())).ego
    reach = (np.hypot(length, width) + np.hypot(mine.length, mine.width)) / 2

    def touch(ego: Floats, adversary: Floats, rows: Bools) -> Bools:
        found = np.asarray(rows & (np.hypot(ego[0] - adversary[0], ego[1] - adversary[1]) < reach))
        k = np.flatnonzero(found)
        if len(k):
            (ax, ay, ah, av), (bx, by, bh, bv) = ego[:, k], adversary[:, k]
            one = Boxes(ax, ay, ah, av, mine.length, mine.width)
            found[k] = overlaps(one, Boxes(bx, by, bh, bv, length[k], width[k]))
        return found

    return touch


def _first(holds: Bools) -> Any:
    return np.where(holds.any(axis=1), holds.argmax(axis=1), holds.shape[1])


def _score(
    careful: Bools, late: Bools, nearly: Floats, manoeuvre: Bools, warning: Floats, weights: ScoreSettings
) -> Floats:
    """By which driver avoids it and with what to spare: winners at the verdict's very edge do not survive noise."""
    score = weights.unavoidable - weights.warned * np.clip(warning / weights.warned_enough, 0.0, 1.0)
    for k, value in enumerate(weights.by_manoeuvre):
        score = np.where(manoeuvre[:, k], value, score)
    score = score - nearly
    return np.where(careful, np.where(late, weights.by_late_careful, weights.by_careful), score)


def _ends(ego: Boxes, adversary: Boxes, last: Any, hit: Bools, time: Floats) -> tuple[Floats, tuple[Boxes, Boxes]]:
    """When each rollout ends ``(n,)`` [s], and both boxes ``(n,)`` then.

    That is the exact first contact, which lies in the step to ``last`` ``(n,)``, or ``last`` without a hit.
    """
    before = np.maximum(last - 1, 0)
    steps = (np.arange(len(last))[:, None], np.stack([before, last], axis=1))
    share = np.where(hit, np.minimum(sweep(pick(ego, steps), pick(adversary, steps))[:, 0], 1.0), 1.0)
    at_contact = between_steps(ego, last, share), between_steps(adversary, last, share)
    return time[before] + share * (time[last] - time[before]), at_contact


def _least(ego: Boxes, adversary: Boxes, last: Any) -> tuple[Floats, Floats]:
    """Least TTC [s] and least box distance [m] up to the contact, every third step."""
    steps = np.arange(0, ego.x.shape[1], 3)
    shown = (np.arange(len(last))[:, None], steps[None, :])
    a, b = pick(ego, shown), pick(adversary, shown)
    before = steps[None, :] <= last[:, None]
    centres = np.where(before, np.hypot(a.x - b.x, a.y - b.y), np.inf)
    at = (np.arange(len(last)), centres.argmin(axis=1))
    return np.where(before, ttc(a, b), np.inf).min(axis=1), np.asarray(gap(pick(a, at), pick(b, at)))


def _third_party(
    situation: Situation, proposals: Sequence[Proposal], adversary: Boxes, time: Floats, end: Floats
) -> Bools:
    """Whether the adversary touches another vehicle before ``end`` ``(n,)`` [s], also if that vehicle brakes for it."""
    tracks = situation.traffic.others
    touched = np.zeros(len(proposals), bool)
    if not tracks:
        return touched
    around, driven = on_grid(tracks, np.asarray(situation.time + time)), slice(1, None)
    mine, theirs, when = _steps(adversary, driven), _steps(around, driven), time[driven]
    rows, others = near_pairs(mine, theirs, when, end)
    is_other = np.array([t.id for t in tracks])[others] != np.array([p.bv for p in proposals])[rows]
    rows, others = rows[is_other], others[is_other]
    meets = third_party(_rows(mine, rows), _rows(theirs, others), when, end[rows])
    rows, others = rows[meets], others[meets]
    reacts = np.array([situation.traffic.reacting and t.role is not Role.OBSTACLE for t in tracks])[others]
    touched[rows[~reacts]] = True
    rows, others = rows[reacts], others[reacts]
    if len(rows):
        steps = slice(0, int(np.searchsorted(time, end[rows].max())) + 1)
        mine = _steps(_rows(adversary, rows), steps)
        braked = braking(_rows(around, others), mine, situation.road.lane_width, situation.dt)
        meets = third_party(_steps(mine, driven), _steps(braked, driven), time[steps][driven], end[rows])
        touched[rows[meets]] = True
    return touched


def _leaves_road(adversary: Boxes, judged: Bools, drivable: Drivable) -> Bools:
    """Whether a corner leaves the carriageway at the first driven step or every fourth after it, ``(n,)``."""
    looked_at = judged & (np.arange(judged.shape[1]) % ROAD_STRIDE == 1)
    return np.asarray(off_road(adversary, looked_at, drivable, ROAD_INSET).any(axis=1))


def _beyond_limits(adversary: Boxes, before: Floats, time: Floats, judged: Bools, limits: Limits) -> Bools:
    """Whether a kinematic gate fails ``(n,)``; ``before``: the acceleration at the trigger ``(n,)`` [m/s2]."""
    change = np.diff(adversary.speed, axis=1) / np.diff(time)
    acceleration = np.concatenate([before[:, None], change], axis=1)
    broken = kinematic_gates(adversary, acceleration, time, limits)
    return np.asarray((np.any(list(broken.values()), axis=0) & judged).any(axis=1))


def _avoidable(
    situation: Situation, proposals: Sequence[Proposal], ego: Boxes, adversary: Boxes, good: Any, last: Any,
    drivable: Drivable, weights: ScoreSettings,
) -> tuple[Bools, Bools, Floats, Bools, Any]:  # fmt: skip
    """Whether the careful driver avoids it, also if slower; what is taken off where it nearly does; whether some
    manoeuvre does, by delay (evaluated only where the careful driver does not); the step of the hazard."""
    a, b = _cut(_rows(ego, good), last, situation.dt), _rows(adversary, good)
    start, dt = np.zeros(len(good), np.intp), situation.dt
    half = situation.road.lane_width / 2
    path, until = _held(_rows(ego, good), last), slice(0, int(last.max()) + 1)
    hazard, _ = hazard_index(_steps(path, until), _steps(b, until), start, last, dt, lane_half_width=half)
    leads = (0.0, weights.slower, *(-t for t in weights.sooner))
    careful, late, *sooner = careful_after(a, b, hazard, dt, leads)
    careful, hazard = _surely(careful, a, b, path, hazard, last, dt, half, weights.turn_error)
    nearly = np.where(sooner, np.array(weights.nearly)[:, None], 0.0).max(axis=0)
    manoeuvre = np.zeros((len(good), len(weights.manoeuvre_delays)), bool)
    time = np.asarray(situation.time + np.arange(ego.x.shape[1]) * dt, float)
    names = np.array([proposals[k].bv for k in good])

    def where(rows: Any) -> tuple[Boxes, Boxes, Any, float]:
        return _rows(a, rows), _rows(b, rows), hazard[rows], dt

    others_of = {bv: [t for t in situation.traffic.others if t.id != bv] for bv in np.unique(names)}
    around = {bv: on_grid(tracks, time) for bv, tracks in others_of.items() if tracks}
    for bv, others in around.items():  # they may leave no room
        rows = np.flatnonzero((names == bv) & careful)
        if len(rows):
            careful[rows] = careful_after(*where(rows), (0.0,), others=others)[0]
    for bv in np.unique(names[~careful]):
        rows = np.flatnonzero((names == bv) & ~careful)
        manoeuvre[rows] = _manoeuvre(*where(rows), drivable, around.get(bv), weights.manoeuvre_delays)
    return careful, careful & late, nearly, manoeuvre, hazard


def _surely(
    careful: Bools, ego: Boxes, adversary: Boxes, path: Boxes, hazard: Any, last: Any, dt: float, half: float,
    turn_error: float,
) -> tuple[Bools, Any]:  # fmt: skip
    """Which contacts the careful driver avoids also if a turning ego has turned a little more or less than predicted:
    that moves a far vehicle sideways by metres, and its hazard may show seconds later. And the steps of the hazards,
    later where that matters."""
    unsure = np.minimum(np.abs(wrap_all(path.heading[:, -1] - path.heading[:, 0])), turn_error)
    rows = np.flatnonzero(careful & (unsure > 0.1 * turn_error))
    if not len(rows):
        return careful, hazard
    lasts = last[rows]
    until = slice(0, int(lasts.max()) + 1)
    mine, other = _steps(_rows(path, rows), until), _steps(_rows(adversary, rows), until)
    latest = hazard[rows]
    for turn in (-unsure[rows, None], unsure[rows, None]):
        turned = replace(mine, heading=mine.heading + turn)
        shows, _ = hazard_index(turned, other, lasts * 0, lasts, dt, lane_half_width=half)
        latest = np.maximum(latest, shows)
    later = latest > hazard[rows]
    late, found, hazard = rows[later], careful.copy(), hazard.copy()
    if len(late):
        found[late] = careful_after(_rows(ego, late), _rows(adversary, late), latest[later], dt, (0.0,))[0]
    lost = ~found[late]
    hazard[late[lost]] = latest[later][lost]
    return found, hazard


def _manoeuvre(
    ego: Boxes, adversary: Boxes, hazard: Any, dt: float, drivable: Drivable, others: Boxes | None,
    delays: Sequence[float],
) -> Bools:  # fmt: skip
    """Whether some manoeuvre avoids it, by delay."""
    return avoidance(
        ego, adversary, hazard, dt, delays=tuple(delays), careful=False, on_road=drivable, others=others
    )["manoeuvre"]  # fmt: skip


def _cut(b: Boxes, last: Any, dt: float) -> Boxes:
    """Motions that go straight on at an even speed after the step ``last``, as the judge has them."""
    steps = np.arange(b.x.shape[1])[None, :]
    k = (np.arange(len(last))[:, None], np.minimum(steps, last[:, None]))
    over = np.maximum(steps - last[:, None], 0) * dt * b.speed[k]
    heading = b.heading[k]
    x, y = b.x[k] + over * np.cos(heading), b.y[k] + over * np.sin(heading)
    return Boxes(x, y, heading, b.speed[k], b.length, b.width)


def _held(b: Boxes, last: Any) -> Boxes:
    """Motions that end at the step ``last``, as the path has them that the judge measures offsets from."""
    k = (np.arange(len(last))[:, None], np.minimum(np.arange(b.x.shape[1])[None, :], last[:, None]))
    return Boxes(b.x[k], b.y[k], b.heading[k], b.speed[k], b.length, b.width)


def _rows(b: Boxes, rows: Any) -> Boxes:
    size = [v if np.ndim(v) == 0 else np.asarray(v)[rows] for v in (b.length, b.width)]
    return Boxes(b.x[rows], b.y[rows], b.heading[rows], b.speed[rows], *size)


def _steps(b: Boxes, steps: slice) -> Boxes:
    return Boxes(b.x[:, steps], b.y[:, steps], b.heading[:, steps], b.speed[:, steps], b.length, b.width)
