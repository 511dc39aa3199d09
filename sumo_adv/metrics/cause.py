"""Explain in a sentence why an attempt led to a contact or a near miss, by comparing the ego with a careful driver.

============= ====================================================================================================
kind          meaning
============= ====================================================================================================
unforeseeable no danger shows to ``cc_human`` soon enough: it does not brake, or it brakes and is hit anyway, and no
              reference driver and no constant braking avoids the contact
steered_in    the ego left its way towards the adversary; on its way it would not have been hit
no_reaction   the ego neither braked nor steered away before the contact
late          the ego reacted more than 0.2 s after the careful driver
let_go        the ego braked and released the brake for more than 0.5 s before the contact, or stopped and drove on
too_little    the ego reacted in time, but not strongly enough
no_swerve     the ego braked in time, and no constant braking up to 0.774 g avoids the contact
braked_in     by braking, the ego came into the adversary's path: either keeping its speed would have been enough, or
              it braked in time and harder than would have been enough, and was hit
evaded        no contact: the ego reacted in time
============= ====================================================================================================

A reaction is a change that the attack caused. The ego brakes while it loses speed by at least 1 m/s2 more than it did
at the same time without the attack. The braking must last 0.2 s. It then continues while the ego loses speed or stands.
Braking for a red light is therefore no reaction. The ego steers if it leaves both its way without the attack and the
straight continuation of its heading by 0.375 m (the zone of wandering of UN R157).

The careful driver is ``cc_human`` (UN R157). It watches the ego as it drove, up to the contact. The adversary alarms
it, and 0.75 s later it would begin to brake; after 2 s without a danger, the next alarm counts as the first. If
``cc_human`` does not avoid the contact and another reference driver does, the ego is compared with that driver:
with ``manoeuvre`` if it is one of them, otherwise with the driver for one direction that begins to brake last.

``enough`` is the smallest constant braking from the same moment on that touches no vehicle in the kinematic
counterfactual (``reference/counterfactual.py``). It is searched in steps of 0.1 m/s2 up to 0.774 g. The adversary moves
as it did, whatever the ego does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from sumo_adv.datatypes import Floats, Verdict
from sumo_adv.metrics.avoidance import HAZARD_TO_MANOEUVRE_S
from sumo_adv.metrics.case import Case
from sumo_adv.metrics.preventability import encounter_of
from sumo_adv.metrics.reaction import braking_of, missed_on_its_way, steering_of
from sumo_adv.metrics.reference import BRAKERS, MANOEUVRE, SAME_DIRECTION_ONLY, Braker
from sumo_adv.metrics.reference.brakers import FULL_BRAKING_M_S2
from sumo_adv.metrics.reference.cc_human import HUMAN_REACTION_S, PERCEPTION_S, CcHuman
from sumo_adv.metrics.reference.counterfactual import Counterfactual
from sumo_adv.metrics.reference.view import View

IN_TIME_S = 0.2  # a reaction up to this much later than the careful driver's is still in time
CALM_S = 2.0  # a danger that shows after this time without one is a new danger
ZERO_IN_WORDS_S = 0.05  # shorter times read "0.0 s" in a sentence
BRAKING_STEP_M_S2 = 0.1  # between the constant brakings that are tried
COARSE_STEPS = 5  # every fifth braking is tried first
STOPPED_EGO_MAX_SPEED_M_S = 0.1  # a slower ego stands
CAREFUL = CcHuman.name
REACTION_DELAY_S = {name: braker.delay for name, braker in BRAKERS.items()}
REACTION_DELAY_S |= {MANOEUVRE: HAZARD_TO_MANOEUVRE_S - PERCEPTION_S}
"""Time from a reference driver's alarm until it acts [s]."""
DRIVER_WORDS = {CAREFUL: "the careful one", MANOEUVRE: "a driver that brakes and steers"}
"""How sentences name a reference driver."""


class CauseKind(StrEnum):
    """The kind of cause; see the table at the top of the module."""

    UNFORESEEABLE = "unforeseeable"
    STEERED_IN = "steered_in"
    NO_REACTION = "no_reaction"
    LATE = "late"
    LET_GO = "let_go"
    TOO_LITTLE = "too_little"
    NO_SWERVE = "no_swerve"
    BRAKED_IN = "braked_in"
    EVADED = "evaded"


class Action(StrEnum):
    """The ego's first reaction."""

    BRAKED = "braked"
    STEERED = "steered"


@dataclass(frozen=True, slots=True)
class Cause:
    """Why a contact or near miss happened, in a sentence and in numbers.

    Times are simulation times [s]. A value is None if its question does not arise.

    Attributes:
        kind: The kind of cause.
        sentence: The cause in words.
        moment: When the contact happened or, without one, the minimum TTC.
        reference: The reference driver that the ego is compared with.
        alarm: When a danger showed to the reference driver.
        careful: When the reference driver began to act.
        began: When the ego first reacted.
        action: How the ego first reacted.
        braking: Mean deceleration [m/s2], from ``began`` or, if later, ``careful`` until the contact, the standstill or
            the end of braking.
        hardest: Maximum deceleration that lasted 0.2 s [m/s2].
        let_go: When the ego last released the brake for more than 0.5 s before the moment. If it had ``stopped``, when
            it drove on.
        stopped: Whether the ego stopped and drove on before the moment.
        held: Whether the same braking would have avoided the contact if the ego had held it.
        shift: How far the ego had left its way at the moment [m, left positive].
        enough: The smallest constant braking from ``careful`` on that avoids the contact [m/s2].
    """

    kind: CauseKind
    sentence: str
    moment: float
    reference: str = CAREFUL
    alarm: float | None = None
    careful: float | None = None
    began: float | None = None
    action: Action | None = None
    braking: float | None = None
    hardest: float | None = None
    let_go: float | None = None
    stopped: bool = False
    held: bool = False
    shift: float | None = None
    enough: float | None = None


def cause_of(case: Case, verdict: Verdict) -> Cause | None:
    """Return the cause of a contact or near miss.

    Args:
        case: The recorded attempt. Without ``case.unattacked``, the ego is compared with straight driving at constant
            speed.
        verdict: The verdict on the attempt.

    Returns:
        The cause; None if there was neither a contact nor a near miss, or if the adversary ran into the ego's back.
    """
    ego, adversary = case.ego, case.adversary
    contact = verdict.contact_time
    moment = contact if contact is not None else verdict.min_ttc_time
    if moment is None or verdict.rear_end or not (verdict.collided or verdict.critical):
        return None
    check = Counterfactual(encounter_of(case, moment))
    begin, dt = case.begin, check.given.dt
    reference = _reference(check, begin, moment, verdict)
    careful = reference.acts
    braking = braking_of(ego, case.unattacked, case.start, moment, reference.danger, careful)
    steering = steering_of(ego, adversary, case.unattacked, case.start, moment)
    first = 0 if careful is None else math.ceil((careful - begin) / dt - 1e-6)
    met = contact is not None and not check.unchanged().avoids[0]
    enough = _enough(check, first) if met and careful is not None else None
    found = Cause(
        CauseKind.EVADED, "", moment, reference.name, reference.alarm, careful, enough=enough,
        shift=None if steering is None else steering.shift,
    )  # fmt: skip
    if braking is not None:
        found = replace(
            found, began=braking.began, action=Action.BRAKED, braking=braking.mean, hardest=braking.hardest,
            let_go=braking.let_go, stopped=braking.stopped,
            held=braking.let_go is not None and _avoids(check, round((braking.began - begin) / dt), braking.mean),
        )  # fmt: skip
    if steering is not None and steering.away and (found.began is None or steering.began < found.began):
        found = replace(found, began=steering.began, action=Action.STEERED)
    into = contact is not None and steering is not None and not steering.away
    into = into and missed_on_its_way(case, moment)
    avoided = verdict.preventability is not None and bool(verdict.preventability.by)
    harder = enough is not None and _avoids(check, first, FULL_BRAKING_M_S2)
    found = replace(found, kind=_kind(found, contact is not None, into, avoided, harder))
    hopeless = found.kind is CauseKind.UNFORESEEABLE and careful is not None
    sentence = _all_the_same(found, check, begin) if hopeless else _sentence(found, contact is not None)
    in_loop = verdict.preventability is not None and verdict.preventability.simulated
    again = " When the adversary plans again, no reference driver avoids it." * (in_loop and not avoided)
    return replace(found, sentence=sentence + again)


def _kind(c: Cause, met: bool, into: bool, avoided: bool, harder: bool) -> CauseKind:
    """Choose the kind of cause.

    Args:
        c: The cause found so far.
        met: Whether there was a contact.
        into: Whether the ego steered into the contact.
        avoided: Whether some reference driver avoids the contact.
        harder: Whether braking at 0.774 g avoids the contact, too.
    """
    if into:
        return CauseKind.STEERED_IN
    if c.careful is None or (met and not avoided and c.enough is None):
        return CauseKind.UNFORESEEABLE
    if c.began is None:
        return CauseKind.NO_REACTION
    late = c.began > c.careful + IN_TIME_S + 1e-9
    if met and c.let_go is not None and (c.held or c.stopped or c.enough == 0.0 or not late):
        return CauseKind.LET_GO
    if met and c.action is Action.BRAKED and c.enough == 0.0:
        return CauseKind.BRAKED_IN
    if late:
        return CauseKind.LATE
    if not met:
        return CauseKind.EVADED
    if c.action is Action.STEERED:
        return CauseKind.TOO_LITTLE
    if c.enough is None:
        return CauseKind.NO_SWERVE
    return CauseKind.TOO_LITTLE if (c.braking or 0.0) < c.enough or harder else CauseKind.BRAKED_IN


# -- the careful driver ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _Reference:
    """When a reference driver was alarmed and acted.

    Attributes:
        name: The driver's name.
        alarm: When it was alarmed [s]; None if not before the moment.
        acts: When it acted [s]; None if not before the moment.
        danger: When the careful driver was alarmed [s]; if it was not, when this driver was.
    """

    name: str
    alarm: float | None
    acts: float | None
    danger: float | None


class _Watched(CcHuman):
    """The careful driver of one encounter, with a note of when the adversary alarmed it and when it began to brake.

    Both times start again after ``CALM_S`` without a danger.
    """

    def __init__(self, shape: tuple[int, int], dt: float, start: float) -> None:
        super().__init__(shape, dt)
        self._start = start
        self.first, self.brakes, self._dangerous_at = math.inf, math.inf, math.inf

    def step(self, view: View) -> Floats:
        now = self._now
        answer = super().step(view)
        if self.danger[0, 0]:
            if now - self._dangerous_at > CALM_S:
                self.first, self.brakes = math.inf, math.inf
            self._dangerous_at, self.first = now, min(self.first, now)
            acts = float(self._decided_at[0, 0]) + HUMAN_REACTION_S
            if np.isfinite(answer[0]) and now >= self._start - 1e-9 and now + self._dt > acts:
                self.brakes = min(self.brakes, max(acts, self._start))
        return answer


def _reference(check: Counterfactual, begin: float, moment: float, verdict: Verdict) -> _Reference:
    """Choose the reference driver that the ego is compared with."""
    start = float(check.time[check.given.start[0]])
    careful = _Watched(check.shape, check.given.dt, start)
    _watch(check, careful, moment - begin)
    alarm, brakes = begin + careful.first, begin + careful.brakes
    p = verdict.preventability
    avoided, alarms = ((), {}) if p is None else (p.by, dict(p.alarms))
    known = alarm if alarm < moment else None
    if brakes < moment and (CAREFUL in avoided or not avoided):
        return _Reference(CAREFUL, brakes - HUMAN_REACTION_S, brakes, known)
    alarms |= {MANOEUVRE: alarm} if alarm + REACTION_DELAY_S[MANOEUVRE] < moment else {}
    acts = {n: max(alarms[n] + REACTION_DELAY_S[n], begin + start) for n in avoided if n in alarms}
    for name in acts:
        if name in SAME_DIRECTION_ONLY:
            brakes_now = _watch(check, BRAKERS[name](check.shape, check.given.dt), moment - begin)
            acts[name] = begin + _last_onset(brakes_now, check)
    acts = {n: when for n, when in acts.items() if when < moment}
    if acts:
        name = MANOEUVRE if MANOEUVRE in acts else max(acts, key=lambda n: acts[n])
        own = acts[name] - REACTION_DELAY_S[name]
        return _Reference(name, own, acts[name], own if known is None else known)
    return _Reference(CAREFUL, known, brakes if brakes < moment else None, known)


def _watch(check: Counterfactual, driver: Braker, moment: float) -> list[bool]:
    """Return in which steps up to ``moment`` [s from step 0] a driver that watches the recorded ego wants to brake."""
    station, speed = check.paths.station, np.broadcast_to(check.ego.speed, check.paths.station.shape)
    change = np.diff(speed, axis=1, prepend=speed[:, :1]) / check.given.dt
    steps = range(int(np.searchsorted(check.time, moment)))
    views = (check.views.at(k, station[:, k], speed[:, k], change[:, k]) for k in steps)
    return [bool(np.isfinite(driver.step(view)[0])) for view in views]


def _last_onset(brakes: Sequence[bool], check: Counterfactual) -> float:
    """Return when the last spell of braking begins [s from step 0], not before the start; ``inf`` if there is none."""
    start = int(check.given.start[0])
    onsets = [k for k in range(start, len(brakes)) if brakes[k] and (k == start or not brakes[k - 1])]
    return float(check.time[onsets[-1]]) if onsets else math.inf


def _enough(check: Counterfactual, first: int) -> float | None:
    """Return the smallest constant braking from the step ``first`` on that avoids the contact; 0 = keep the speed."""
    coarse = range(0, int(FULL_BRAKING_M_S2 / BRAKING_STEP_M_S2) + 1, COARSE_STEPS)
    found = next((k for k in coarse if _avoids(check, first, k * BRAKING_STEP_M_S2)), None)
    if found is None:
        return None
    finer = range(max(found - COARSE_STEPS + 1, 0), found)
    return round(next((k for k in finer if _avoids(check, first, k * BRAKING_STEP_M_S2)), found) * BRAKING_STEP_M_S2, 1)


def _avoids(check: Counterfactual, first: int, braking: float) -> bool:
    """Return whether the ego avoids the contact if it brakes constantly [m/s2] from the step ``first`` on."""
    station = check.paths.station[0]
    speed = np.broadcast_to(check.ego.speed, check.paths.station.shape)[0]
    since = np.maximum(check.time - check.time[first], 0.0)
    after = np.arange(check.steps) > first
    lasts = np.minimum(since, speed[first] / braking) if braking > 0.0 else since
    there = np.where(after, station[first] + speed[first] * lasts - braking * lasts**2 / 2, station)
    pace = np.where(after, np.maximum(speed[first] - braking * since, 0.0), speed)
    return bool(check.moving(there[None], pace[None]).avoids[0])


# -- the sentence ---------------------------------------------------------------------------------------------------


def _sentence(c: Cause, met: bool) -> str:
    moment = "the contact" if met else "the minimum TTC"
    if c.kind is CauseKind.STEERED_IN:
        return f"Your driver steered into the adversary's path, {abs(c.shift or 0.0):.1f} m to the {_side(c)}."
    if c.kind is CauseKind.UNFORESEEABLE:
        unknown = c.alarm is None or c.moment - c.alarm < ZERO_IN_WORDS_S
        if unknown and c.began is not None:
            too_little = ", and what your driver did was not enough" * met
            return f"A careful driver would have seen no danger before {moment}{too_little}."
        if unknown or c.alarm is None:
            return f"No one could have known before {moment}."
        before = f"{c.moment - c.alarm:.1f} s before {moment}"
        if c.moment - c.alarm > HUMAN_REACTION_S + IN_TIME_S:
            return f"A careful driver would have seen a danger {before}, but none that made it brake."
        return f"No one could have known earlier than {before}."
    careful = DRIVER_WORDS.get(c.reference, f"the reference driver {c.reference}")
    if c.kind is CauseKind.NO_REACTION:
        behind = "" if c.careful is None else f", {c.moment - c.careful:.1f} s after {careful} began to act"
        return f"Your driver did not react before {moment}{behind}{_enough_words(c, met)}."
    did = _did(c, moment)
    after = (c.began or 0.0) - (c.careful or 0.0)
    later = f"{after:.1f} s after {careful}"
    if c.kind is CauseKind.LATE:
        return f"Your driver began to {did[0]} {later}, {did[1]}{_enough_words(c, met)}."
    if c.kind is CauseKind.EVADED:
        return f"Your driver {did[2]} in time, {did[1]}; there was no contact."
    if c.kind is CauseKind.LET_GO:
        let_go = f"{c.moment - (c.let_go or 0.0):.1f} s before {moment}"
        if c.stopped:
            return f"Your driver stopped, and drove on {let_go}."
        when = "in time" if after <= IN_TIME_S + 1e-9 else later
        enough = "; held, that braking would have been enough" * c.held
        return f"Your driver braked {when}, at {c.braking or 0.0:.1f} m/s2, and released the brake {let_go}{enough}."
    if c.kind is CauseKind.BRAKED_IN:
        return f"Your driver braked into the adversary's path, {did[1]}{_enough_words(c, met)}."
    if c.kind is CauseKind.NO_SWERVE:
        return f"Your driver braked in time, {did[1]}, and did not steer; braking alone would not have been enough."
    too = "too gently" if c.action is Action.BRAKED else "not far enough"
    if c.action is Action.BRAKED and c.enough is not None and (c.braking or 0.0) >= c.enough:
        return f"Your driver braked in time and at first too gently{_enough_words(c, met)}."
    return f"Your driver {did[2]} in time and {too}, {did[1]}{_enough_words(c, met)}."


def _all_the_same(c: Cause, check: Counterfactual, begin: float) -> str:
    """Say why a careful driver that brakes before the contact does not avoid it."""
    braked = f"A careful driver would have braked {c.moment - (c.careful or 0.0):.1f} s before the contact"
    station, speed, _ = check.roll_out(CcHuman)
    contact = float(check.moving(station, speed).contact[0])
    if not math.isfinite(contact):
        return f"{braked}, and would have avoided the adversary's recorded motion."
    pace = float(np.interp(contact, check.time, speed[0]))
    later = begin + contact - (c.careful or 0.0)
    hit = "standing" if pace < STOPPED_EGO_MAX_SPEED_M_S else f"at {pace:.1f} m/s"
    return f"{braked}, but would still have been hit {later:.1f} s later, {hit}."


def _did(c: Cause, moment: str) -> tuple[str, str, str]:
    """Return what the ego did: the verb, the amount, and the verb in the past tense."""
    if c.action is Action.STEERED:
        braking = "" if c.braking is None else f", braking at {c.braking:.1f} m/s2"
        return "steer away", f"by {abs(c.shift or 0.0):.1f} m to the {_side(c)}{braking}", "steered away"
    let_go = "" if c.let_go is None else f", and released the brake {c.moment - c.let_go:.1f} s before {moment}"
    return "brake", f"at {c.braking or 0.0:.1f} m/s2{let_go}", "braked"


def _side(c: Cause) -> str:
    return "left" if (c.shift or 0.0) > 0.0 else "right"


def _enough_words(c: Cause, met: bool) -> str:
    if not met:
        return "; there was no contact"
    if c.enough is None:
        return "; braking alone would not have been enough"
    how = f"{c.enough:.1f} m/s2" if c.enough > 0.0 else "keeping its speed"
    braking = "" if c.began is not None and c.action is Action.BRAKED else "braking at " if c.enough > 0.0 else ""
    return f"; {braking}{how} would have been enough"
