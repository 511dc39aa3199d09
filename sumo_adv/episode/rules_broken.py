"""Find who passed a red light, and who ignored the other's right of way, before the ego and the adversary collided."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sumo_adv.datatypes import Attempt
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.metrics.fault import ADVERSARY_PARTY, EGO_PARTY
from sumo_adv.simulation.sumo_states import Snapshot
from sumo_adv.situation import ReferencePath, Signal, Situation

BOTH, NONE = "both", "none"
AT_CONFLICT_M = 20.0  # m; farther from where the two ways meet, a contact has nothing to do with the right of way there
FIRST_BY_SIGN = "MOo"  # SUMO's letters of connections that need not give way
MINOR_GREEN, MAJOR_GREEN = "g", "G"
RED, YELLOW = "ru", "yY"  # SUMO's letters


@dataclass(frozen=True, slots=True)
class LightPassed:
    """The moment at which a vehicle passed its stop line.

    Attributes:
        time: The time [s].
        letter: SUMO's letter of the light then.
    """

    time: float
    letter: str


@dataclass(frozen=True, slots=True)
class RulesBroken:
    """The rules that were broken, and by whom: ``adversary``, ``ego``, ``both`` or ``none``.

    Attributes:
        red_light: Who passed a stop line at a light that was red then.
        right_of_way: Who did not give way where the two ways meet, although a sign or a minor green demanded it.
    """

    red_light: str
    right_of_way: str


def rules_broken(attempt: Attempt, result: AttemptResult, found: FoundEncounter) -> RulesBroken | None:
    """Return which rules were broken before a contact, and by whom.

    Args:
        attempt: The attempt.
        result: The result of the attempt.
        found: The encounter.

    Returns:
        The rules; None without a contact, or if the encounter has no situation with the adversary at that start.
    """
    p, contact = attempt.proposal, attempt.verdict.contact_time
    situation = found.situations.get(p.delay)
    if contact is None or situation is None or p.bv not in situation.targets:
        return None
    before = [s for s in result.snapshots if result.start <= s.time <= contact]
    signals = situation.traffic.signals
    red = {
        name: red_light_at(vehicle, signals.get(vehicle, ()), before) is not None
        for name, vehicle in ((ADVERSARY_PARTY, p.bv), (EGO_PARTY, found.ego))
    }
    return RulesBroken(_by(red[ADVERSARY_PARTY], red[EGO_PARTY]), _not_yielding(situation, p.bv, found.ego, before))


def light_at_line(vehicle: str, signals: Sequence[Signal], snapshots: Sequence[Snapshot]) -> LightPassed | None:
    """Return what the next light shows a vehicle when it passes its stop line.

    A snapshot has the states of all links of a light. The vehicle's link is one of those that showed its letter at
    first, so its letter is known while all of them show the same.

    Args:
        vehicle: The id of the vehicle.
        signals: The lights ahead of the vehicle at the first snapshot, nearest first.
        snapshots: The states from then on.

    Returns:
        The time and the letter. None if the vehicle has no light ahead or does not pass the line, or if the letter is
        not known at that time.
    """
    if not signals:
        return None
    light, distance, letter = signals[0]
    gone, last, links, first = 0.0, None, list[int](), ""
    for snapshot in snapshots:
        if vehicle not in snapshot.raw:
            continue
        x, y = snapshot.raw[vehicle][:2]
        gone += 0.0 if last is None else math.hypot(x - last[0], y - last[1])
        last, state = (x, y), snapshot.lights.get(light, first)
        if not first:
            first, links = state, [k for k, shown in enumerate(state) if shown == letter]
        if gone > distance:
            letters = {state[k] for k in links} if state != first else {letter}
            return LightPassed(snapshot.time, letters.pop()) if len(letters) == 1 else None
    return None


def red_light_at(vehicle: str, signals: Sequence[Signal], snapshots: Sequence[Snapshot]) -> float | None:
    """Return when a vehicle passes its stop line on red.

    Args:
        vehicle: The id of the vehicle.
        signals: The lights ahead of the vehicle at the first snapshot, nearest first.
        snapshots: The states from then on.

    Returns:
        The time [s]; None if the vehicle does not pass the line on red, or if this is not known.
    """
    passed = light_at_line(vehicle, signals, snapshots)
    return passed.time if passed is not None and passed.letter in RED else None


def _by(adversary: bool, ego: bool) -> str:
    return BOTH if adversary and ego else ADVERSARY_PARTY if adversary else EGO_PARTY if ego else NONE


def _not_yielding(situation: Situation, bv: str, ego: str, before: Sequence[Snapshot]) -> str:
    """Return who had to give way where the two ways meet."""
    seen = [s.raw[bv][:2] for s in before if bv in s.raw]
    if not seen:
        return NONE
    x, y = seen[-1]
    ways = [way for way in situation.targets[bv].ways if way.conflict is not None]
    way = min(ways, key=lambda w: abs(w.path.project(x, y)[1]), default=None)
    if way is None or way.conflict is None or math.hypot(way.conflict.x - x, way.conflict.y - y) > AT_CONFLICT_M:
        return NONE
    letters = [_letter(situation, name) for name in (bv, ego)]
    if all(letters):  # traffic lights control the junction
        yields = [letter == MINOR_GREEN for letter in letters]
        return _by(yields[0] and letters[1] == MAJOR_GREEN, yields[1] and letters[0] == MAJOR_GREEN)
    return _by(*_by_sign(way, situation.road.rule))


def _letter(situation: Situation, vehicle: str) -> str:
    """Return SUMO's letter of a vehicle's next light when the attack begins; empty without a light."""
    signals = situation.traffic.signals.get(vehicle, ())
    return signals[0][2] if signals else ""


def _by_sign(way: ReferencePath, rule: str) -> tuple[bool, bool]:
    """Return whether the adversary and the ego have to give way. SUMO's letter for the ego is ``rule``."""
    ego_yields = bool(rule) and rule not in FIRST_BY_SIGN and way.before_ego
    return way.gives_way and not ego_yields, ego_yields
