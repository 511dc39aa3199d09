"""Whether an encounter is dangerous without an attack. Then an attack on it would show nothing."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np

from sumo_adv.datatypes import Floats, Role, Track
from sumo_adv.episode.drive import Drive
from sumo_adv.metrics.boxes import first_contact, on_grid, overlaps
from sumo_adv.metrics.case import closest
from sumo_adv.metrics.criticality import ttc

LEAST = 2.0  # s from the trigger until which the ego must stay in the network
REACH = 30.0  # m between centres
AS_LOGGED = 0.1  # m: largest sum of the distances of ego and vehicle from their logged positions


class Danger(NamedTuple):
    """Why an encounter is passed over, or empty; the vehicles that are critical without an attack; since when [s] a
    vehicle is critical or collides."""

    why: str
    critical: frozenset[str]
    since: float = math.inf


def danger(tracks: Mapping[str, Track], drive: Drive, time: float, limit: float, candidates: Collection[str]) -> Danger:
    """Whether the encounter at ``time`` [s] is dangerous without an attack.

    tracks: the baseline; limit: the min TTC [s] from which a vehicle is critical; candidates: the ranked vehicles.

    An encounter is passed over if the ego leaves, collides, or a vehicle is critical.  A recording has few encounters:
    there a critical vehicle is only no candidate, and the encounter is passed over if no candidate is left.  Boxes that
    overlap at their logged positions are an error of the log: no collision, and the vehicle is no candidate.  For
    objects that are no vehicles only a contact counts.
    """
    ego = tracks[str(drive.ego)]
    if ego.time[-1] < time + LEAST:
        return Danger("the ego leaves the network at once", frozenset())
    grid = ego.time[ego.time >= time - 1e-6]
    near = [t for n, t in tracks.items() if n != ego.id and len(t.time) > 1 and closest(ego, t, time) < REACH]
    overlapping = _overlapping(drive, tracks, ego, grid)
    others = [t for t in near if t.id not in overlapping]
    if overlapping and overlapping.issuperset(candidates):
        return Danger("in the log itself it overlaps the ego", overlapping)
    if not others:
        return Danger("", overlapping)
    me = on_grid([ego], grid)
    contact = float(np.nanmin(first_contact(me, on_grid(others, grid), grid), initial=math.inf))
    vehicles = [t for t in others if t.role is not Role.OBSTACLE]
    by_step = ttc(me, on_grid(vehicles, grid)) if vehicles else np.full((0, len(grid)), np.inf)
    least = np.nanmin(by_step, axis=-1, initial=math.inf)
    critical = overlapping | frozenset(t.id for t, value in zip(vehicles, least, strict=True) if value <= limit)
    close = np.flatnonzero((by_step <= limit).any(axis=0))
    since = min(contact, float(grid[close[0]]) if len(close) else math.inf)
    if math.isfinite(contact):
        return Danger("the ego collides unattacked", critical, since)
    if critical and (not drive.recorded() or critical.issuperset(candidates)):
        return Danger(f"critical unattacked: min TTC {float(least.min(initial=math.inf)):.2f} s", critical, since)
    return Danger("", critical)


def _overlapping(drive: Drive, tracks: Mapping[str, Track], ego: Track, grid: Floats) -> frozenset[str]:
    """Vehicles that overlap the ego at the first step, or later while both are at their logged positions."""
    others = [t for t in tracks.values() if t.id != ego.id]
    logged = {} if drive.playback is None else {t.id: t for t in drive.playback.logged()}
    if not others or ego.id not in logged:
        return frozenset()
    me, them = on_grid([ego], grid), on_grid(others, grid)
    their = on_grid([logged.get(t.id, t) for t in others], grid)
    ego_logged = on_grid([logged[ego.id]], grid)
    ego_off = np.hypot(me.x - ego_logged.x, me.y - ego_logged.y)
    as_logged = ego_off + np.hypot(them.x - their.x, them.y - their.y) < AS_LOGGED
    touching = np.asarray(overlaps(me, them))
    fault = touching & as_logged
    fault[:, 0] = touching[:, 0]
    return frozenset(t.id for t, row in zip(others, fault, strict=True) if row.any())
