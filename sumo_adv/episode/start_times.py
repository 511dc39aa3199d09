"""When attacks may begin: some seconds after the trigger, later where the ways meet only far ahead."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import Floats, Track
from sumo_adv.episode.encounter import Candidate
from sumo_adv.geometry import PATH_STEP
from sumo_adv.situation import MEET_AHEAD, Target

FORESEEN = 7.0  # s: an attack begins at most so long before the ego, or the first of both, is at the conflict
MOST_SHIFT = 8.0  # s
AT_ONCE = 3.0  # m ahead within which no vehicle becomes much slower


def delays(
    candidates: Sequence[Candidate], tracks: Mapping[str, Track], ego_id: str, settings: Settings, *, both: bool = False
) -> list[float]:
    """Seconds after the trigger, where the unattacked ``tracks`` begin; ``both``: before the others are at the conflict
    as well."""
    soonest = min((_meeting_time(c, tracks, ego_id, both) for c in candidates), default=0.0)
    shift = min(max(0.0, math.floor(soonest * settings.step_length - FORESEEN)), MOST_SHIFT)
    return [shift + d for d in settings.delays]


def _meeting_time(candidate: Candidate, tracks: Mapping[str, Track], ego_id: str, both: bool) -> float:
    """Steps until the unattacked ego can meet a candidate: none in its own lanes, else until it is at the conflict."""
    meets = [w.conflict for w in candidate.ways if w.conflict is not None]
    if not candidate.meets_ahead or not meets:
        return 0.0
    ego = _travelled(tracks[ego_id])
    found = [np.searchsorted(ego, c.ego_s) for c in meets]
    if both and candidate.id in tracks:
        other = _travelled(tracks[candidate.id])
        found += [np.searchsorted(other, c.bv_s) for c in meets]
    return float(min(found))


def _travelled(track: Track) -> Floats:
    """Metres since the track began, ``(n,)``."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(track.x), np.diff(track.y)))])


def spent(target: Target, lateral: float) -> bool:
    """Whether one that can meet the ego only where their ways do is past that place, or turns harder than ``lateral``
    [m/s2] as it comes, so that no attack is feasible that begins there."""
    if target.relation not in MEET_AHEAD:
        return False
    k, square = max(int(target.station / PATH_STEP), 0), target.state.speed**2
    meeting = [w.path.curvature[k : k + round(AT_ONCE / PATH_STEP)] for w in target.ways if w.conflict is not None]
    return not any(square * float(np.abs(bends).max(initial=0.0)) <= lateral for bends in meeting)
