"""The judged part of a recording: the ego, the adversary with its further plan, and the vehicles near."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Floats, Limits, Track
from sumo_adv.metrics.log_noise import log_breaches, smoothed

NEAR = 60.0  # m between centres: vehicles that never come that near are no third party
LEAST_STATES = 4  # a vehicle that is there for less has no motion to judge


@dataclass(frozen=True, slots=True)
class Case:
    """The arguments of both verdicts. ``adversary``: the collider; it goes on past a contact as it was planned, and so
    do the ``supports``, which are among the ``others``, too.

    log_gates: the gates that the log of the adversary breaks before the take-over; empty if no log moved it."""

    ego: Track
    adversary: Track
    others: tuple[Track, ...]
    log_gates: tuple[str, ...] = ()
    supports: tuple[Track, ...] = ()


def make_case(
    tracks: Sequence[Track], ego: str, adversaries: Sequence[str], start: float, beyond: Mapping[str, Track],
    logged: Limits | None = None,
) -> Case | None:  # fmt: skip
    """The case of one attempt that began at ``start`` [s]; None where the ego or the collider is gone before it moved.

    ``tracks`` lie on one grid and begin some steps before ``start``. ``adversaries``: their ids, the collider's first;
    ``beyond``: their planned motions from the last recorded step on. ``logged``: the vehicles' limits, if a log moved
    them up to ``start``; the noise there is smoothed, because the gates judge what the adversaries add.
    """
    named = {t.id: t for t in tracks}
    ego_track, adversary_track = named.get(ego), named.get(adversaries[0])
    if ego_track is None or adversary_track is None:
        return None
    ego_track, adversary_track = unbroken(ego_track, start), unbroken(adversary_track, start)
    if any(not len(t.time) or t.time[-1] <= start for t in (ego_track, adversary_track)):
        return None
    others = tuple(
        t for n, t in named.items()
        if n not in (ego, *adversaries) and len(t.time) >= LEAST_STATES and closest(ego_track, t, start) < NEAR
    )  # fmt: skip
    breaches = () if logged is None else log_breaches(adversary_track, start, logged)
    helpers = [unbroken(named[n], start) for n in adversaries[1:] if n in named]
    driven = [t if logged is None else smoothed(t, start, logged) for t in (adversary_track, *helpers) if len(t.time)]
    adversary_track, *helpers = (joined(t, beyond[t.id]) if t.id in beyond else t for t in driven)
    return Case(ego_track, adversary_track, (*others, *helpers), breaches, tuple(helpers))


def unbroken(track: Track, time: float) -> Track:
    """The stretch of a track around ``time`` [s] in which no step is left out (recorded vehicles may be unseen)."""
    step = float(np.diff(track.time).min()) if len(track.time) > 1 else 0.0
    breaks = np.flatnonzero(np.diff(track.time) > 1.5 * step)
    if not len(breaks):
        return track
    ends, begins = track.time[breaks], track.time[breaks + 1]
    before, after = begins[begins <= time + 5e-4], ends[ends >= time - 5e-4]
    return track.between(before[-1] if len(before) else -math.inf, after[0] if len(after) else math.inf)


def closest(ego: Track, other: Track, time: float) -> float:
    """Least distance of the centres [m] at common times from ``time`` on; inf if there are none."""
    common, i, j = np.intersect1d(np.round(ego.time, 3), np.round(other.time, 3), return_indices=True)
    i, j = i[common >= time - 1e-6], j[common >= time - 1e-6]
    return float(np.min(np.hypot(ego.x[i] - other.x[j], ego.y[i] - other.y[j]))) if len(i) else math.inf


def joined(track: Track, more: Track) -> Track:
    """One track after the other; lane ids are dropped."""

    def both(name: str) -> Floats:
        return np.concatenate([getattr(track, name), getattr(more, name)])

    return Track(
        track.id, track.role, both("time"), both("x"), both("y"), both("heading"), both("speed"),
        both("acceleration"), track.length, track.width,
    )  # fmt: skip
