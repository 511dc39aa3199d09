"""Judge an attempt: derive the verdict from its recorded motion, and the level that it reaches."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sumo_adv.datatypes import (
    AttackerResult,
    AttackerRole,
    Boxes,
    Floats,
    Limits,
    Preventability,
    Track,
    Verdict,
)
from sumo_adv.errors import UsageError
from sumo_adv.metrics.boxes import at_time, first_contact, gap, on_grid, row_of, some_steps
from sumo_adv.metrics.case import Case
from sumo_adv.metrics.contact import rear_end
from sumo_adv.metrics.criticality import drac, pet, ttc
from sumo_adv.metrics.fault import fault as fault_of
from sumo_adv.metrics.gates import all_failed_gates
from sumo_adv.metrics.levels import ahead_in_lane, blocking, level_of, stationary
from sumo_adv.metrics.preventability import preventability
from sumo_adv.metrics.realism import outside
from sumo_adv.metrics.severity import crash
from sumo_adv.road_users import is_unprotected

LARGEST_DRAC_M_S2 = 20.0  # beyond any car; the rate is unbounded at contact, so larger rates are capped


def judge_attempt(
    case: Case,
    *,
    ttc_threshold: float = 1.0,
    limits: Limits = Limits(),  # noqa: B008 - frozen
    support_limits: Callable[[Track], Limits] | None = None,
    driver: str | None = None,
    all_drivers: bool = True,
) -> Verdict:
    """Return the verdict on a recorded attempt.

    Args:
        case: The recorded attempt. Its tracks begin at least two steps before the attack.
        ttc_threshold: An attempt is critical if its minimum TTC is at most this [s].
        limits: The limits of the adversary's motion.
        support_limits: Returns the limits of a support's motion; None means those of the adversary.
        driver: The reference driver that drove the ego, if one did. It counts as one that has not avoided the
            collision.
        all_drivers: Whether to run every reference driver. Otherwise, only the drivers that the level depends on are
            run.

    Raises:
        UsageError: The tracks have no step in common after the attack begins.
    """
    pair = on_common_grid(case)
    contact, until_last = pair.contact_time, pair.until_last()
    collided = contact is not None
    stop = float(pair.time[-1]) if contact is None else contact
    times = ttc(pair.ego, until_last)[0, pair.trigger :]
    soonest = int(np.argmin(times))
    min_ttc = 0.0 if collided else float(times[soonest])
    threat = drac(pair.ego, until_last)[0, pair.trigger :]
    ego, adversary = case.ego, case.adversary
    gates = all_failed_gates(
        adversary, case.supports, limits, on_road=case.on_road, ego=ego, others=case.others, end=stop,
        start=case.start + pair.dt / 2,  # SUMO itself drove up to the state at the trigger
        support_limits=support_limits,
    )  # fmt: skip
    verdict = Verdict(
        min_ttc=min_ttc,
        min_distance=0.0 if collided else float(gap(pair.ego, until_last)[0, pair.trigger :].min()),
        collided=collided,
        critical=collided or min_ttc <= ttc_threshold,
        feasible=not gates,
        rear_end=contact is not None and bool(rear_end(at_time(ego, contact), at_time(adversary, contact))),
        failed_gates=gates,
        log_gates=case.log_gates,
        min_ttc_any=min(min_ttc, _least_ttc(pair, case.others)),
        min_pet=0.0 if collided else pet(ego.between(case.start, stop), adversary.between(case.start, stop)).pet,
        max_drac=float(np.minimum(threat, LARGEST_DRAC_M_S2).max()),
        fault=None if contact is None else fault_of(ego, adversary, contact),
        contact_time=contact,
        min_ttc_time=stop if collided else (float(pair.time[pair.trigger + soonest]) if min_ttc < np.inf else None),
    )
    if contact is None:
        return _with_level(verdict)
    prevention = None
    if verdict.counts or all_drivers:
        prevention = preventability(case, contact, driver=driver, until_avoided=not all_drivers)
    impact = crash(ego, adversary, contact)
    strange = outside(adversary, case.start, contact, ahead_in_lane(ego, adversary, case.lane_half_width))
    strange = () if is_unprotected(adversary) else strange  # the gates' limits are those of a person already
    return _with_level(
        replace(
            verdict, preventability=prevention, ego_stationary=stationary(ego, contact),
            ego_blocking=blocking(ego, contact), humanlike=not strange, beyond_human=strange,
            contact_side=str(impact.ego_side), delta_v=impact.ego_delta_v, adversary_delta_v=impact.adversary_delta_v,
            severity=str(impact.severity), injury_risk=impact.injury_risk, overlap=impact.overlap,
            impact_speed=impact.impact_speed,
        )
    )  # fmt: skip


def attackers_of(verdicts: Mapping[str, Verdict]) -> tuple[AttackerResult, ...]:
    """Return the result of each attacker of an attempt, the one whose verdict counts first.

    The verdict that counts is that of the attacker that the ego touches first or, without a contact, that of the one
    with the smallest minimum TTC.

    Args:
        verdicts: The verdict on each attacker, with the others among the other vehicles, by the attacker's id.
    """
    never = float("inf")
    times = {name: never if v.contact_time is None else v.contact_time for name, v in verdicts.items()}
    order = sorted(verdicts, key=lambda name: (times[name], verdicts[name].min_ttc))
    return tuple(
        AttackerResult(
            name, AttackerRole.TOUCHED if k == 0 and times[name] < never else AttackerRole.PLAYED,
            verdicts[name].min_ttc, verdicts[name].min_distance,
        )
        for k, name in enumerate(order)
    )  # fmt: skip


def with_answers(verdict: Verdict, answers: Preventability) -> Verdict:
    """Return the verdict with new results of reference drivers, and with the level that follows from them."""
    return _with_level(replace(verdict, preventability=answers))


def _with_level(verdict: Verdict) -> Verdict:
    """Set the level, which follows from everything else in the verdict."""
    return replace(verdict, level=level_of(verdict))


@dataclass(frozen=True, slots=True)
class Aligned:
    """The ego and the adversary of a case on one grid.

    Attributes:
        time: Times of the ego's steps ``(n,)`` [s].
        dt: Step [s].
        ego: The ego's boxes ``(1, n)``, up to the last step before the contact or the end.
        adversary: The adversary's boxes ``(1, m)``, to the end of its track.
        trigger: The step at which the attack begins.
        contact_time: When the two first touch [s]; None if they never do.
    """

    time: Floats
    dt: float
    ego: Boxes
    adversary: Boxes
    trigger: int
    contact_time: float | None

    def until_last(self) -> Boxes:
        """Return the adversary over the ego's steps."""
        return some_steps(self.adversary, slice(len(self.time)))


def on_common_grid(case: Case) -> Aligned:
    """Put both tracks on their common grid; the ego's track ends at the first contact after the attack begins.

    Args:
        case: The recorded attempt.

    Raises:
        UsageError: The tracks do not overlap in time after the attack begins.
    """
    ego, adversary = case.ego, case.adversary
    together = ego.between(case.begin, min(ego.time[-1], adversary.time[-1]))
    time, own, foe = together.time, row_of(together), row_of(adversary.between(case.begin, np.inf))
    count = len(time)
    trigger = int(np.searchsorted(time, case.start - 5e-4))
    if trigger >= count:
        raise UsageError(
            f"The tracks of {ego.id!r} and {adversary.id!r} have no step in common after the trigger at "
            f"{case.start:g} s; give tracks that begin before it."
        )
    dt = float(ego.time[1] - ego.time[0]) if len(ego.time) > 1 else 0.1
    after = slice(trigger, count)
    when = float(first_contact(some_steps(own, after), some_steps(foe, after), time[after])[0])
    if not np.isfinite(when):
        return Aligned(time, dt, own, foe, trigger, None)
    last = min(max(int(np.searchsorted(time, when + 1e-9) - 1), trigger), count - 1)
    return Aligned(time[: last + 1], dt, some_steps(own, slice(last + 1)), foe, trigger, when)


def _least_ttc(pair: Aligned, others: Sequence[Track]) -> float:
    """Return the ego's minimum TTC to any other vehicle from the start of the attack on [s]."""
    if not others:
        return float("inf")
    after = slice(pair.trigger, None)
    return float(ttc(some_steps(pair.ego, after), on_grid(others, pair.time[after])).min())
