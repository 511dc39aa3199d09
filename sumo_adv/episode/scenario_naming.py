"""Name the scenario of an attempt, from its result and the encounter.

``words/naming.py`` has the rules.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import NamedScenario, Proposal, RoadClass, Track, Verdict
from sumo_adv.episode.rules_broken import AT_CONFLICT_M, red_light_at
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.geometry import Path
from sumo_adv.simulation.tracks import tracks_of
from sumo_adv.situation import Situation, Target
from sumo_adv.words.motion import Course, Scene, follow
from sumo_adv.words.naming import BEYOND_M, NamingContext, decisive, named

WHILE_CHANGING_S = 1.0  # s after the decisive moment; a lane change in this time was under way


def scenario_of(
    proposal: Proposal, verdict: Verdict, result: AttemptResult, found: FoundEncounter, settings: Settings
) -> NamedScenario | None:
    """Name the scenario that an attempt shows.

    Args:
        proposal: The candidate that was tried.
        verdict: The verdict on the attempt.
        result: The result of the attempt.
        found: The encounter.
        settings: The settings of the run.

    Returns:
        The scenario; None if the ego or the adversary left at once, or if the encounter has no situation with the
        adversary at that start.
    """
    situation = found.situations.get(proposal.delay)
    target = None if situation is None else situation.targets.get(proposal.bv)
    if situation is None or target is None:
        return None
    last = math.inf if verdict.contact_time is None else verdict.contact_time
    tracks = {
        name: track.between(result.start, last)
        for name, track in result.tracks(settings.step_length, found.ego, proposal.bv).items()
    }
    if len(tracks) < 2:
        return None
    first = found.first.targets.get(proposal.bv, target)
    path, contact = situation.baseline.path, verdict.collided
    side = verdict.contact_side or "" if contact else None
    course = follow(
        Scene(
            tracks[found.ego], tracks[proposal.bv], (), path, first.relation, first.hidden, side, result.start,
            hand=situation.frame.hand,
        )
    )  # fmt: skip
    if course is None:
        return None
    k = decisive(course, contact)
    place = found.place
    signals = situation.traffic.signals
    around = NamingContext(
        first.relation, first.hidden,
        junction=_at_a_junction(found, target, course, k),
        signalised=bool(signals.get(found.ego) or signals.get(proposal.bv)),
        red=_passes_red(situation, result, last, found.ego, proposal.bv),
        geometry=None if place is None else place.geometry,
        changes_lane=_changes_lane(found, settings, float(course.ego.time[k])),
        ego_turn=_turn(path, course, k), movements=frozenset(way.movement for way in target.ways),
        hand=situation.frame.hand,
    )  # fmt: skip
    return named(course, around, contact=contact)


def _at_a_junction(found: FoundEncounter, target: Target, course: Course, k: int) -> bool:
    """Return whether the two meet at a junction at which ways meet."""
    if target.relation == "crossing" or (found.place is not None and found.place.road is RoadClass.JUNCTION):
        return True
    crossings = [way.conflict for way in target.ways if way.conflict is not None and way.conflict.kind == "crossing"]
    return any(abs(c.ego_s - float(course.ego_along.s[k])) < AT_CONFLICT_M for c in crossings)


def _passes_red(situation: Situation, result: AttemptResult, last: float, *vehicles: str) -> bool:
    """Return whether one of the vehicles passes its stop line on red."""
    before = [s for s in result.snapshots if result.start <= s.time <= last]
    signals = situation.traffic.signals
    return any(red_light_at(name, signals.get(name, ()), before) is not None for name in vehicles)


def _turn(path: Path, course: Course, k: int) -> float:
    """Return how much the ego's path turns from the take-over to ``BEYOND_M`` past the decisive moment [rad]."""
    first, last = path.at(np.array([course.ego_along.s[0], course.ego_along.s[k] + BEYOND_M]))[2]
    return float(last - first)


def _changes_lane(found: FoundEncounter, settings: Settings, until: float) -> bool:
    """Return whether the ego changes to another lane of its edge without an attack."""
    tracks: list[Track] = tracks_of(found.baseline, found.sizes, {}, settings.step_length, (found.ego,))
    lanes = [lane for t in tracks for lane in t.between(-math.inf, until + WHILE_CHANGING_S).lane]
    return any(a != b and a.rpartition("_")[0] == b.rpartition("_")[0] != "" for a, b in pairwise(lanes))
