"""Whether an encounter is dangerous by itself: then nothing that an adversary does to it means anything."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from sumo_adv.datatypes import Floats, Role, Track
from sumo_adv.episode.drive import Drive
from sumo_adv.metrics.boxes import first_contact, on_grid, overlaps
from sumo_adv.metrics.case import closest
from sumo_adv.metrics.criticality import ttc

LEAST = 2.0  # s the ego must stay
REACH = 30.0  # m between centres


def danger(
    tracks: Mapping[str, Track], drive: Drive, time: float, limit: float, candidates: Collection[str]
) -> tuple[str, frozenset[str]]:
    """Why an encounter at ``time`` [s] is passed over, else empty; and who is critical by itself (min TTC at most
    ``limit`` [s] unattacked).

    It is passed over where the ego leaves, collides, or anybody is critical.  A recording has no other encounter to
    offer: there those who are critical are only no candidates, and it is passed over where nobody else is left.
    Boxes that overlap in the log itself are its errors and do not count; of what is no vehicle only a contact does.
    """
    ego = tracks[str(drive.ego)]
    if ego.time[-1] < time + LEAST:
        return "the ego leaves the network at once", frozenset()
    grid = ego.time[ego.time >= time - 1e-6]
    near = [t for n, t in tracks.items() if n != ego.id and len(t.time) > 1 and closest(ego, t, time) < REACH]
    overlapping = _overlapping(drive, ego.id, grid)
    others = [t for t in near if t.id not in overlapping]
    if not others:
        return "", frozenset()
    me = on_grid([ego], grid)
    if np.isfinite(first_contact(me, on_grid(others, grid), grid)).any():
        return "the ego collides unattacked", frozenset()
    vehicles = [t for t in others if t.role is not Role.OBSTACLE]
    if not vehicles:
        return "", frozenset()
    least = np.nanmin(ttc(me, on_grid(vehicles, grid)), axis=-1, initial=math.inf)
    critical = frozenset(t.id for t, one in zip(vehicles, least.tolist(), strict=True) if one <= limit)
    if critical and (not drive.recorded() or critical.issuperset(candidates)):
        return f"critical unattacked: min TTC {float(least.min()):.2f} s", critical
    return "", critical


def _overlapping(drive: Drive, ego: str, grid: Floats) -> set[str]:
    """Whose recorded boxes overlap that of the ego in the log."""
    logged: Sequence[Track] = [] if drive.playback is None else drive.playback.logged()
    me = [t for t in logged if t.id == ego]
    if not me or len(logged) < 2:
        return set()
    others = [t for t in logged if t.id != ego]
    hit = np.asarray(overlaps(on_grid(me, grid), on_grid(others, grid)))
    return {t.id for t, row in zip(others, hit, strict=True) if row.any()}
