"""Find how the ego reacted to an attack: how it braked and steered, compared with its motion without the attack."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sumo_adv.datatypes import Bools, Track
from sumo_adv.metrics.boxes import at_time, row_of
from sumo_adv.metrics.case import Case
from sumo_adv.metrics.preventability import encounter_of
from sumo_adv.metrics.reference.cc_human import WANDERING_M
from sumo_adv.metrics.reference.counterfactual import Counterfactual
from sumo_adv.metrics.reference.view import EgoPaths

REACTION_BRAKING_M_S2 = 1.0  # braking that exceeds that without the attack by this is a reaction
MIN_DECELERATION_M_S2 = 0.5  # an ego that decelerates less does not brake
MIN_BRAKING_DURATION_S = 0.2
MAX_BRAKING_PAUSE_S = 0.5  # a shorter pause does not end the braking
STANDS_BELOW_M_S, DRIVES_ABOVE_M_S = 0.1, 1.0
MIN_SIDE_MOVEMENT_M = 0.03  # a movement to the side begins once the ego is this far beside its way


@dataclass(frozen=True, slots=True)
class Braking:
    """The ego's braking that exceeds its braking without the attack.

    Attributes:
        began: When it began [s].
        mean: Mean deceleration [m/s2].
        hardest: Maximum deceleration over ``MIN_BRAKING_DURATION_S`` [m/s2].
        let_go: When it ended [s]; None if it lasts to the moment. If the ego stopped, when it drove on.
        stopped: Whether the ego stopped and drove on before the moment.
    """

    began: float
    mean: float
    hardest: float
    let_go: float | None
    stopped: bool


@dataclass(frozen=True, slots=True)
class Steering:
    """How the ego left its way.

    Attributes:
        began: When it began to leave its way [s].
        shift: How far it had left its way at the moment [m, left positive].
        away: Whether it steered away from the adversary, or the adversary was straight ahead or behind.
    """

    began: float
    shift: float
    away: bool


def braking_of(
    ego: Track, unattacked: Track | None, start: float, moment: float, alarm: float | None, careful: float | None
) -> Braking | None:
    """Find the ego's braking that lasts beyond the alarm.

    Args:
        ego: The ego's track.
        unattacked: The ego's motion without the attack; None = at constant speed.
        start: When the attack begins [s].
        moment: The time of the contact or near miss [s].
        alarm: When a danger showed [s]; None = all braking counts. Standing always counts.
        careful: When the careful driver acted [s]; the mean deceleration is taken from then on.

    Returns:
        The braking; None if there is none.
    """
    driven = ego.between(start, moment)
    if len(driven.time) < 2:
        return None
    dt = float(np.diff(driven.time).min())
    change, stands = np.diff(driven.speed) / dt, driven.speed[1:] < STANDS_BELOW_M_S
    usual, pace = np.zeros(len(change)), np.full(len(driven.time), driven.speed[0])
    if unattacked is not None and len(unattacked.time) > 1:
        pace = np.interp(driven.time, unattacked.time, unattacked.speed)
        known = driven.time[1:] <= unattacked.time[-1] + 5e-4
        usual = np.where(known, np.diff(pace) / dt, 0.0)
    loses = change <= -MIN_DECELERATION_M_S2
    brakes = _lasting(loses & (usual - change >= REACTION_BRAKING_M_S2), round(MIN_BRAKING_DURATION_S / dt))
    brakes |= stands & (pace[1:] >= DRIVES_ABOVE_M_S)
    spells = [
        (begun, ended) for begun, ended in _spells(brakes, loses | stands, round(MAX_BRAKING_PAUSE_S / dt))
        if alarm is None or driven.time[ended] >= alarm - 5e-4 or bool(stands[begun:ended].any())
    ]  # fmt: skip
    if not spells:
        return None
    first, until, let_go = spells[0][0], spells[-1][1], None
    still = first + np.flatnonzero(driven.speed[first:] < STANDS_BELOW_M_S)
    stopped = bool(len(still)) and float(driven.speed[-1]) >= STANDS_BELOW_M_S
    if len(still):
        until = int(still[0])
        let_go = float(driven.time[still[-1]]) if stopped else None
    else:
        followed = [float(driven.time[begun]) for begun, _ in spells[1:]] + [moment]
        pause = MAX_BRAKING_PAUSE_S + 1e-9
        gaps = [end for (_, end), then in zip(spells, followed, strict=True) if then - driven.time[end] > pause]
        if gaps:
            until, let_go = gaps[-1], float(driven.time[gaps[-1]])
    since = first if careful is None else max(first, int(np.searchsorted(driven.time, careful - 5e-4)))
    since = since if since < until else first
    mean = float(driven.speed[since] - driven.speed[until]) / max((until - since) * dt, dt)
    hold = max(round(MIN_BRAKING_DURATION_S / dt), 1)
    hardest = max(-float(change[k : k + hold].mean()) for k in range(first, max(spells[-1][1] - hold, first) + 1))
    return Braking(float(driven.time[first]), mean, hardest, let_go, stopped)


def _lasting(holds: Bools, least: int) -> Bools:
    """Remove the spells of fewer than ``least`` steps."""
    kept = holds.copy()
    for first, last in _spells(holds, np.zeros(len(holds), bool), 0):
        kept[first:last] = last - first >= least
    return kept


def _spells(holds: Bools, on: Bools, pause: int) -> list[tuple[int, int]]:
    """Return the first step of each spell and the step after its last one.

    A spell begins when ``holds`` is true. It continues while ``on`` is true, and over a ``pause`` of at most that many
    steps.
    """
    spells: list[tuple[int, int]] = []
    for k in range(len(holds)):
        goes_on = bool(spells) and spells[-1][1] == k and bool(on[k])
        if not holds[k] and not goes_on:
            continue
        if spells and k - spells[-1][1] <= pause:
            spells[-1] = (spells[-1][0], k + 1)
        else:
            spells.append((k, k + 1))
    return spells


def steering_of(ego: Track, adversary: Track, unattacked: Track | None, start: float, moment: float) -> Steering | None:
    """Find how the ego left its way.

    The ego leaves its way if it leaves both its way without the attack and the straight continuation of its heading.

    Args:
        ego: The ego's track.
        adversary: The adversary's track.
        unattacked: The ego's motion without the attack, if known.
        start: When the attack begins [s].
        moment: The time of the contact or near miss [s].

    Returns:
        The steering; None if the ego kept its way within ``WANDERING_M``.
    """
    driven = ego.between(start, moment)
    if len(driven.time) < 2:
        return None
    x, y, h = float(driven.x[0]), float(driven.y[0]), float(driven.heading[0])
    straight = (driven.y - y) * math.cos(h) - (driven.x - x) * math.sin(h)
    left = straight
    if unattacked is not None:
        left = EgoPaths(row_of(unattacked)).locate(driven.x[None], driven.y[None])[1][0]
        left = left - left[0]  # relative to the ego's first offset from that way
    least = np.where(np.abs(left) < np.abs(straight), left, straight)
    least = np.where(left * straight > 0.0, least, 0.0)
    if abs(least[-1]) < WANDERING_M:
        return None
    side = float(np.sign(least[-1]))
    still = np.flatnonzero(least * side < MIN_SIDE_MOVEMENT_M)
    began = float(driven.time[min(int(still[-1]) + 1 if len(still) else 0, len(driven.time) - 1)])
    then, foe = at_time(driven, began), at_time(adversary, began)
    there = (foe.y - then.y) * np.cos(then.heading) - (foe.x - then.x) * np.sin(then.heading)
    ahead = abs(float(there)) < (ego.width + adversary.width) / 2
    return Steering(began, float(least[-1]), bool(ahead or np.sign(there) != side))


def missed_on_its_way(case: Case, moment: float) -> bool:
    """Return whether the ego would not have been hit if it had kept its way.

    The ego is moved to its way without the attack, as far along it at each time as it was.

    Args:
        case: The recorded attempt.
        moment: When the ego was hit [s].
    """
    ego, unattacked = case.ego, case.unattacked
    after = ego.time > case.start
    if unattacked is not None:
        way = EgoPaths(row_of(unattacked))
        station, left, _ = (v[0] for v in way.locate(ego.x[None], ego.y[None]))
        x, y, heading = (v[0] for v in way.poses(station[None]))
        first = float(left[int(np.argmax(after))])
        x, y = x - first * np.sin(heading), y + first * np.cos(heading)
    else:
        k = int(np.argmax(after))
        heading = np.full(len(ego.time), float(ego.heading[k]))
        along = (ego.x - ego.x[k]) * np.cos(heading) + (ego.y - ego.y[k]) * np.sin(heading)
        x, y = ego.x[k] + along * np.cos(heading), ego.y[k] + along * np.sin(heading)
    kept = replace(
        ego, x=np.where(after, x, ego.x), y=np.where(after, y, ego.y), heading=np.where(after, heading, ego.heading)
    )  # fmt: skip
    return bool(Counterfactual(encounter_of(replace(case, ego=kept), moment)).unchanged().avoids[0])
