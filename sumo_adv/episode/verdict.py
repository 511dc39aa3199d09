"""The verdict on an attempt as soon as it was driven: gates, contact, and the kinematic check of reference drivers."""

from __future__ import annotations

from dataclasses import replace

from sumo_adv.config import Settings
from sumo_adv.datatypes import Track, Verdict
from sumo_adv.episode.attempt import Driven
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.task import FoundEncounter
from sumo_adv.metrics.case import make_case
from sumo_adv.metrics.levels import AVOIDS, COLLIDES, judged, with_level
from sumo_adv.metrics.validity import judge
from sumo_adv.simulation.tracks import tracks_of


def gate_verdict(
    drive: Drive, found: FoundEncounter, settings: Settings, trigger_step: int, bvs: tuple[str, ...], start: float,
    driven: Driven,
) -> Verdict | None:  # fmt: skip
    """The verdict on the attempt that began at ``start`` [s]; None if ego or collider left before it moved.

    Reference drivers are asked as far as the level depends on them; where a model reads what they did, all of them.
    ``bvs``: all adversaries, the collider first. ``trigger_step``: how many snapshots the recording had at the trigger.
    """
    assert drive.ego is not None
    first = first_judged(found, settings, trigger_step, start)
    logged = settings.limits.limits() if drive.follows_log() else None
    case = make_case(drive.tracks(*bvs, start=first), drive.ego, bvs, start, driven.beyond, logged)
    if case is None:
        return None
    half = found.half_lane(start)
    verdict = judge(
        case.ego, case.adversary, case.others, trigger_time=start, ttc_threshold=settings.critical_ttc,
        limits=settings.limits.of(case.adversary), on_road=found.drivable, lane_half_width=half,
        supports=case.supports,
    )  # fmt: skip
    verdict = replace(verdict, log_gates=case.log_gates)
    itself = own_reference(drive)
    verdict = with_level(
        verdict, case.ego, case.adversary, case.others, trigger_time=start, on_road=found.drivable,
        lane_half_width=half, unattacked=unattacked(found, settings),
        only_level=settings.player("modifier") is None and itself is None,
    )  # fmt: skip
    return verdict if itself is None else shown_to_collide(verdict, itself)


def shown_to_collide(verdict: Verdict, driver: str) -> Verdict:
    """The verdict on a collision of an ego that this reference driver drove: it does not avoid the collision."""
    prevention = verdict.preventability
    if prevention is None or prevention.answers.get(driver) != AVOIDS:
        return verdict
    answers = {**prevention.answers, driver: COLLIDES}
    return judged(replace(verdict, preventability=replace(prevention, answers=answers)))


def own_reference(drive: Drive) -> str | None:
    """The reference driver that drives the ego itself: in a collision of the ego it has not avoided it."""
    return getattr(drive.controller, "reference", None)


def first_judged(found: FoundEncounter, settings: Settings, trigger_step: int, start: float) -> int:
    """The recorded step from which an attempt that began at ``start`` [s] is judged: the history before it counts."""
    return max(0, trigger_step + settings.steps(start - found.time) - settings.steps(settings.history))


def unattacked(found: FoundEncounter, settings: Settings) -> Track | None:
    """The ego's motion without the attack, from the trigger on; None if it was only foreseen."""
    tracks = tracks_of(found.baseline, found.sizes, {}, settings.step_length, (found.ego,))
    return tracks[0] if tracks and len(tracks[0].time) > 1 else None
