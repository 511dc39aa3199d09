"""When attacks may begin: some seconds after the trigger, and later if the paths meet only far ahead."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import Floats, Track
from sumo_adv.episode.encounter_detector import RankedVehicle
from sumo_adv.geometry import PATH_STEP
from sumo_adv.situation import MEET_AHEAD, Target

FORESEEN = 7.0  # s: longest time from the start of an attack until the ego, or the first of both, is at the conflict
MOST_SHIFT = 8.0  # s
AT_ONCE = 3.0  # m ahead within which no vehicle can slow down much


def delays(
    ranking: Sequence[RankedVehicle], tracks: Mapping[str, Track], ego_id: str, settings: Settings,
    *, both: bool = False,
) -> list[float]:  # fmt: skip
    """Seconds after the trigger at which attacks may begin.

    tracks: the unattacked motion from the trigger on; both: attacks begin before the adversary is at the conflict too.
    """
    soonest = min((_steps_to_conflict(c, tracks, ego_id, both) for c in ranking), default=0.0)
    shift = min(max(0.0, math.floor(soonest * settings.step_length - FORESEEN)), MOST_SHIFT)
    return [shift + d for d in settings.delays]


def _steps_to_conflict(ranked: RankedVehicle, tracks: Mapping[str, Track], ego_id: str, both: bool) -> float:
    """Steps until the unattacked ego can meet a ranked vehicle; 0 if it can at once."""
    conflicts = [w.conflict for w in ranked.ways if w.conflict is not None]
    if not ranked.meets_ahead or not conflicts:
        return 0.0
    ego = _travelled(tracks[ego_id])
    steps = [np.searchsorted(ego, c.ego_s) for c in conflicts]
    if both and ranked.id in tracks:
        bv = _travelled(tracks[ranked.id])
        steps += [np.searchsorted(bv, c.bv_s) for c in conflicts]
    return float(min(steps))


def _travelled(track: Track) -> Floats:
    """Metres since the track began, ``(n,)``."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(track.x), np.diff(track.y)))])


def spent(target: Target, lateral: float) -> bool:
    """Whether no attack by a crossing or merging vehicle is feasible any more.

    It is past the conflict, or it turns there with more than ``lateral`` [m/s2] at its speed. False for any other
    relation.
    """
    if target.relation not in MEET_AHEAD:
        return False
    k, square = max(int(target.station / PATH_STEP), 0), target.state.speed**2
    meeting = [w.path.curvature[k : k + round(AT_ONCE / PATH_STEP)] for w in target.ways if w.conflict is not None]
    return not any(square * float(np.abs(bends).max(initial=0.0)) <= lateral for bends in meeting)
