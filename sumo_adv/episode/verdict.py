"""Judge an attempt as soon as it was driven: gates, contact, and the kinematic check of reference drivers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from sumo_adv.config import Settings
from sumo_adv.datatypes import Proposal, Track, Verdict
from sumo_adv.episode.attempt import Driven
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.task import FoundEncounter
from sumo_adv.metrics.case import Case, make_case
from sumo_adv.metrics.reference.sight import SightLimits
from sumo_adv.metrics.verdict import attackers_of, judge_attempt
from sumo_adv.simulation.tracks import tracks_of


def verdict_of_attackers(
    drive: Drive, found: FoundEncounter, settings: Settings, trigger_step: int, proposal: Proposal, start: float,
    driven: Driven,
) -> Verdict | None:  # fmt: skip
    """Return the verdict that counts on the attempt that was just driven, with the result of each attacker.

    Each attacker is judged with the others among the other vehicles (``verdict_on``).

    Args:
        drive: The simulation, with its recording.
        found: The encounter.
        settings: The settings of the run.
        trigger_step: How many snapshots the recording had at the trigger.
        proposal: The candidate.
        start: When the attack began [s].
        driven: How the attempt went.

    Returns:
        The verdict; None if the ego or all attackers left before they moved.
    """
    verdicts = {}
    for name in proposal.attackers:
        bvs = (name, *(bv for bv in proposal.bvs if bv != name))
        verdict = verdict_on(drive, found, settings, trigger_step, bvs, start, driven)
        if verdict is not None:
            verdicts[name] = verdict
    attackers = attackers_of(verdicts)
    return replace(verdicts[attackers[0].id], attackers=attackers) if attackers else None


def verdict_on(
    drive: Drive, found: FoundEncounter, settings: Settings, trigger_step: int, bvs: tuple[str, ...], start: float,
    driven: Driven,
) -> Verdict | None:  # fmt: skip
    """Return the verdict on the attempt that was just driven.

    All reference drivers are checked if a model plays the modifier, because it reads their answers, or if a reference
    driver drives the ego. Otherwise they are checked as far as the level depends on them.

    Args:
        drive: The simulation, with its recording.
        found: The encounter.
        settings: The settings of the run.
        trigger_step: How many snapshots the recording had at the trigger.
        bvs: The adversaries, the collider first.
        start: When the attack began [s].
        driven: How the attempt went.

    Returns:
        The verdict; None if the ego or the collider left before it moved.
    """
    first = first_judged(found, settings, trigger_step, start)
    case = recorded_case(
        drive.tracks(*bvs, start=first), found, settings, bvs, start, driven.beyond, follows_log=drive.follows_log()
    )
    if case is None:
        return None
    driver = own_reference(drive)
    return judge_attempt(
        case, ttc_threshold=settings.critical_ttc, limits=settings.limits.of(case.adversary),
        support_limits=settings.limits.of, driver=driver,
        all_drivers=settings.player("modifier") is not None or driver is not None,
    )  # fmt: skip


def recorded_case(
    tracks: Sequence[Track], found: FoundEncounter, settings: Settings, bvs: Sequence[str], start: float,
    beyond: Mapping[str, Track], *, follows_log: bool,
) -> Case | None:  # fmt: skip
    """Return what the verdict on an attempt is based on.

    Args:
        tracks: The recorded motions from :func:`first_judged` on.
        found: The encounter.
        settings: The settings of the run.
        bvs: The adversaries, the collider first.
        start: When the attack began [s].
        beyond: The adversaries' planned motions after the last recorded step, by id.
        follows_log: Whether a log moved the vehicles up to ``start``.

    Returns:
        The case; None if the ego or the collider left before it moved.
    """
    return make_case(
        tracks, found.ego, bvs, start, beyond, logged=settings.limits.limits() if follows_log else None,
        on_road=found.drivable, lane_half_width=found.half_lane(start), unattacked=unattacked(found, settings),
        sight=sight_from(found, settings, start),
    )  # fmt: skip


def sight_from(found: FoundEncounter, settings: Settings, start: float) -> SightLimits | None:
    """Return how far the ego sees along its way, from its place at the start of an attack.

    Args:
        found: The encounter.
        settings: The settings of the run.
        start: When the attack begins [s].

    Returns:
        The limits; None if there are none.
    """
    calm = None if found.sight is None else unattacked(found, settings)
    return found.sight if found.sight is None or calm is None else found.sight.later(calm, start)


def own_reference(drive: Drive) -> str | None:
    """Return the reference driver that drives the ego itself.

    If the ego collides, this driver has not avoided the collision.

    Args:
        drive: The simulation.

    Returns:
        The name of the driver; None if the ego's driver is not a reference driver.
    """
    return getattr(drive.controller, "reference", None)


def first_judged(found: FoundEncounter, settings: Settings, trigger_step: int, start: float) -> int:
    """Return the recorded step from which an attempt is judged.

    The history before the attack counts.

    Args:
        found: The encounter.
        settings: The settings of the run.
        trigger_step: How many snapshots the recording had at the trigger.
        start: When the attack began [s].
    """
    return max(0, trigger_step + settings.steps(start - found.time) - settings.steps(settings.history))


def unattacked(found: FoundEncounter, settings: Settings) -> Track | None:
    """Return the ego's motion without the attack.

    Args:
        found: The encounter.
        settings: The settings of the run.

    Returns:
        The motion from the trigger on; None if it was only predicted.
    """
    tracks = tracks_of(found.baseline, found.sizes, {}, settings.step_length, (found.ego,))
    return tracks[0] if tracks and len(tracks[0].time) > 1 else None
