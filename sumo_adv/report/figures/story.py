"""What a figure or a film of a run shows: ego and adversaries with and without the attack, others, road, moments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.datatypes import Track
from sumo_adv.errors import UsageError
from sumo_adv.report.figures.parts import (
    ADVERSARY,
    EGO,
    LEAST_EXTENT,
    SUPPORT,
    Lanes,
    View,
    closest_time,
    pose_at,
)
from sumo_adv.report.page.read import RunRead, read_run
from sumo_adv.simulation.network import read_network

BEFORE, AFTER = 1.0, 1.5  # s shown before the trigger and after the decisive moment
MARGIN = 12.0  # m around the action


@dataclass(frozen=True, slots=True)
class Scene:
    """Vehicles over the shown time. ``adversary``: the collider; it and the supports also where they do not attack."""

    ego: Track
    adversary: Track
    others: Sequence[Track]
    supports: Sequence[Track] = ()

    def pair(self) -> tuple[Track, Track]:
        """Ego and collider."""
        return self.ego, self.adversary

    def coloured(self) -> tuple[tuple[Track, str], ...]:
        """Ego, collider and supports, each with its colour."""
        return (self.ego, EGO), (self.adversary, ADVERSARY), *((t, SUPPORT) for t in self.supports)


@dataclass(frozen=True, slots=True)
class Story:
    """A run's encounter. ``raw`` is None where there are no states of the unattacked run. ``intent``: the collider's,
    or the label of the composition.

    trigger: when the attack begins; decisive: contact, else closest approach; end: of what is shown [s].
    """

    name: str
    intent: str
    lanes: Lanes
    attacked: Scene
    raw: Scene | None
    trigger: float
    decisive: float
    end: float
    outcome: Mapping[str, Any]

    @property
    def collided(self) -> bool:
        """Whether the attack ended in a contact."""
        return bool(self.outcome["collided"])

    def view(self, widest: float) -> View:
        """The area around the paths of ego and adversaries, at least as wide as high, at most ``widest`` times."""
        scenes = [self.attacked] if self.raw is None else [self.attacked, self.raw]
        shown = [t.between(self.start, self.end) for scene in scenes for t, _ in scene.coloured()]
        tracks = [part for part in shown if part.time.size]
        x, y = (np.concatenate([getattr(t, axis) for t in tracks]) for axis in ("x", "y"))
        width = max(float(np.ptp(x)) + 2 * MARGIN, LEAST_EXTENT)
        height = max(float(np.ptp(y)) + 2 * MARGIN, LEAST_EXTENT * 0.4)
        width, height = max(width, height), max(height, width / widest)
        return float(x.max() + x.min() - width) / 2, float(y.max() + y.min() - height) / 2, width, height

    @property
    def start(self) -> float:
        """When what is shown begins [s]."""
        return self.trigger - BEFORE


def read_story(folder: Path) -> Story:
    """The story of the run in ``folder``. Raises UsageError: no run, no attempt in it, or a damaged file."""
    run = read_run(folder)
    if run.outcome.get("best") is None or not run.best:
        raise UsageError(f"The run in {folder} made no attempt, so there is nothing to draw.")
    try:
        return _story(run)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise UsageError(
            f"The run in {folder} is not as this program writes it ({type(error).__name__}: {error}); run it again."
        ) from error


def _story(run: RunRead) -> Story:
    ego, adversaries = run.outcome["ego"]["id"], [a["id"] for a in run.outcome["adversaries"]]
    trigger, verdict = float(run.outcome["trigger_time"]), run.outcome["outcome"]
    attacked = _scene(run.best, ego, adversaries)
    if attacked is None:
        raise UsageError(f"Ego or adversary is not in the states of the run in {run.folder}; run it again.")
    contact = verdict["contact_time"]
    decisive = closest_time(*attacked.pair(), trigger) if contact is None else float(contact)
    end = min(decisive + AFTER, float(max(t.time[-1] for t in attacked.pair())))
    network = run.folder / "inputs" / Path(run.manifest["network"]).name
    lanes: Lanes = ()
    if network.is_file():
        x, y, _ = pose_at(attacked.ego, decisive) or (float(attacked.ego.x[-1]), float(attacked.ego.y[-1]), 0.0)
        lanes = read_network(network).strips(x, y, 400.0)
    best = run.outcome["attempts"][run.outcome["best"]]
    intent = best.get("composition") or best["intent"]
    return Story(
        str(run.manifest["name"]), str(intent), lanes, attacked, _scene(run.raw, ego, adversaries), trigger, decisive,
        end, verdict,
    )  # fmt: skip


def _scene(tracks: Sequence[Track], ego: str, adversaries: Sequence[str]) -> Scene | None:
    by_id = {t.id: t for t in tracks}
    collider, *supports = adversaries
    if ego not in by_id or collider not in by_id:
        return None
    others = [t for t in tracks if t.id not in (ego, *adversaries)]
    return Scene(by_id[ego], by_id[collider], others, [by_id[name] for name in supports if name in by_id])
