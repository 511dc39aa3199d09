"""What a cell keeps of motion: the unattacked run's outcome, and samples of speed and acceleration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sumo_adv.datatypes import Role, Track
from sumo_adv.episode.episode import Episode
from sumo_adv.episode.task import FoundEncounter
from sumo_adv.metrics.boxes import on_grid
from sumo_adv.metrics.criticality import ttc
from sumo_adv.metrics.full import PAPER_EPSILON
from sumo_adv.simulation.tracks import tracks_of

NEAR = 60.0  # m from the ego's middle: traffic for comparison
MOST_SAMPLES = 2000  # numbers of a kind that a cell keeps


def unattacked(episode: Episode) -> dict[str, Any] | None:
    """The raw run as an outcome: the ego and the vehicle of the shortlist that comes nearest, from the trigger on."""
    encounter = episode.found
    if encounter is None:
        return None
    tracks = _raw(episode, encounter)
    ego = tracks[encounter.ego].between(encounter.time, encounter.time + episode.settings.duration)
    others = [tracks[n].between(encounter.time, float(ego.time[-1])) for n, _, _ in encounter.ranking if n in tracks]
    others = [t for t in others if len(t.time) > 1]
    least, apart = np.inf, np.inf
    if others:
        me, them = on_grid([ego], ego.time), on_grid(others, ego.time)
        least = float(np.nanmin(ttc(me, them), initial=np.inf))
        apart = float(np.nanmin(np.hypot(them.x - me.x, them.y - me.y), initial=np.inf))
    return {
        "min_ttc": _number(least), "collided": least == 0.0, "critical": least <= episode.settings.critical_ttc,
        "feasible": True, "rear_end": False, "valid": None, "strict": None, "avoidable": None, "failed_gates": [],
        "paper_centre_distance": {
            "minimum": _number(apart), "epsilon": PAPER_EPSILON, "within": apart <= PAPER_EPSILON
        },
    }  # fmt: skip


def motion_of(episode: Episode) -> dict[str, Any]:
    """Speeds [m/s] and accelerations [m/s2], step by step: of the adversary of the attempt that counts up to the
    contact, and of the unattacked traffic near the ego in the same window. Empty without an attempt."""
    encounter, best, k, prefix = episode.found, episode.best, episode.refinement.best, episode.prefix
    if encounter is None or best is None or k is None or prefix is None:
        return {}
    result, step = episode.refinement.results[k], episode.settings.step_length
    sizes = {**prefix.sizes, **result.sizes}
    own = tracks_of([*prefix.snapshots[-2:], *result.snapshots], sizes, {}, step, [best.proposal.bv])
    contact = best.verdict.contact_time
    start = result.start + step / 2
    moved = [t.between(start, np.inf if contact is None else contact) for t in own]
    end = max((float(t.time[-1]) for t in moved if len(t.time)), default=start)
    return {"adversary": _samples(moved), "raw": _samples(_near(episode, encounter, start, end))}


def _raw(episode: Episode, encounter: FoundEncounter) -> dict[str, Track]:
    before = episode.prefix.snapshots[-2:] if episode.prefix is not None else []
    sizes = {**(episode.prefix.sizes if episode.prefix is not None else {}), **encounter.sizes}
    tracks = tracks_of(
        [*before, *encounter.baseline], sizes, episode.task.roles(encounter.ego), episode.settings.step_length
    )
    return {t.id: t for t in tracks}


def _near(episode: Episode, encounter: FoundEncounter, start: float, end: float) -> list[Track]:
    tracks = _raw(episode, encounter)
    ego = tracks[encounter.ego].between(start, end)
    if not len(ego.time):
        return []
    x, y = float(ego.x.mean()), float(ego.y.mean())
    window = [t.between(start, end) for t in tracks.values() if t.role is Role.BACKGROUND]
    return [t for t in window if len(t.time) and float(np.hypot(t.x - x, t.y - y).min()) < NEAR]


def _samples(tracks: Sequence[Track]) -> dict[str, list[float]]:
    samples: dict[str, list[float]] = {}
    for name in ("speed", "acceleration"):
        values = np.concatenate([getattr(t, name) for t in tracks]) if tracks else np.empty(0)
        stride = max(1, -(-len(values) // MOST_SAMPLES))
        samples[name] = [round(float(v), 2) for v in values[::stride]]
    return samples


def _number(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
