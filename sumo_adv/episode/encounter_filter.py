"""Whether an encounter is dangerous by itself: then nothing that an adversary does to it means anything."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import numpy as np

from sumo_adv.datatypes import Floats, Role, Track
from sumo_adv.episode.drive import Drive
from sumo_adv.metrics.boxes import first_contact, on_grid, overlaps
from sumo_adv.metrics.case import closest
from sumo_adv.metrics.criticality import ttc

LEAST = 2.0  # s the ego must stay
REACH = 30.0  # m between centres
AS_LOGGED = 0.1  # m: both together are at most so far from where the log has them


def danger(
    tracks: Mapping[str, Track], drive: Drive, time: float, limit: float, candidates: Collection[str]
) -> tuple[str, frozenset[str]]:
    """Why an encounter at ``time`` [s] is passed over, else empty; and who is critical by itself (min TTC at most
    ``limit`` [s] unattacked).

    It is passed over where the ego leaves, collides, or anybody is critical.  A recording has no other encounter to
    offer: there those who are critical are only no candidates, and it is passed over where nobody else is left.
    Boxes that overlap where the log has them are its errors: no collision, but no candidate either.  Of what is no
    vehicle only a contact counts.
    """
    ego = tracks[str(drive.ego)]
    if ego.time[-1] < time + LEAST:
        return "the ego leaves the network at once", frozenset()
    grid = ego.time[ego.time >= time - 1e-6]
    near = [t for n, t in tracks.items() if n != ego.id and len(t.time) > 1 and closest(ego, t, time) < REACH]
    overlapping = _overlapping(drive, tracks, ego, grid)
    others = [t for t in near if t.id not in overlapping]
    if overlapping and overlapping.issuperset(candidates):
        return "in the log itself it overlaps the ego", overlapping
    if not others:
        return "", overlapping
    me = on_grid([ego], grid)
    if np.isfinite(first_contact(me, on_grid(others, grid), grid)).any():
        return "the ego collides unattacked", overlapping
    vehicles = [t for t in others if t.role is not Role.OBSTACLE]
    if not vehicles:
        return "", overlapping
    least = np.nanmin(ttc(me, on_grid(vehicles, grid)), axis=-1, initial=math.inf)
    critical = overlapping | frozenset(t.id for t, one in zip(vehicles, least.tolist(), strict=True) if one <= limit)
    if critical and (not drive.recorded() or critical.issuperset(candidates)):
        return f"critical unattacked: min TTC {float(least.min()):.2f} s", critical
    return "", critical


def _overlapping(drive: Drive, tracks: Mapping[str, Track], ego: Track, grid: Floats) -> frozenset[str]:
    """Who overlaps the ego at the first step, or later where both are as the log has them and it lets them overlap."""
    others = [t for t in tracks.values() if t.id != ego.id]
    logged = {} if drive.playback is None else {t.id: t for t in drive.playback.logged()}
    if not others or ego.id not in logged:
        return frozenset()
    me, them = on_grid([ego], grid), on_grid(others, grid)
    true = on_grid([logged.get(t.id, t) for t in others], grid)
    mine = on_grid([logged[ego.id]], grid)
    as_logged = np.hypot(me.x - mine.x, me.y - mine.y) + np.hypot(them.x - true.x, them.y - true.y) < AS_LOGGED
    touching = np.asarray(overlaps(me, them))
    fault = touching & as_logged
    fault[:, 0] = touching[:, 0]
    return frozenset(t.id for t, row in zip(others, fault, strict=True) if row.any())
