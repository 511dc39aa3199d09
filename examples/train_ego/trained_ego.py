"""The trained ego as a driver: ``sumo-adv run SCENARIO --ego trained_ego:TrainedEgo`` in this folder.

The policy is a small network in numpy: it needs neither torch nor stable-baselines3.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sumo_adv.gym import PolicyDriver

FILE = Path(__file__).with_name("trained_ego.npz")
VEHICLES = 8
ENVIRONMENT: dict[str, Any] = {
    "actions": "pedals", "observations": "vector", "vehicles": VEHICLES, "danger": True, "interval": 0.3
}  # fmt: skip
"""What the environment and the driver must have in common."""

OWN, DANGER, PATH, OTHER = 9, 2, 20, 13  # numbers in an observation: of the ego, a danger, the path, each vehicle
FIRST = OWN + DANGER + PATH
ROW = OTHER + 2  # what the network sees of a vehicle: its numbers, the ego's speed and the speed limit
_OWN = (4, 3, 3, 3, 1, 4, 1, 1, 4)  # observations are shares of the largest values; these bring them to about 1
_DANGER = (2, 2)
_PATH = (2.4, 12.0) * 10
_OTHER = (1, 4, 20, 1, 1, 4, 3, 2.5, 6, 20, 4, 7.5, 4)
SCALE = np.array([*_OWN, *_DANGER, *_PATH, *_OTHER * VEHICLES], np.float32)
CUT = 5.0
PEDALS = np.array([-1.0, -0.4, 0.0, 1.0], np.float32)
"""Between these it chooses: a Gaussian that is cut at full acceleration soon forgets to try the brake."""

Numbers = NDArray[np.float32]


class Network:
    """From an observation to a pedal: the vehicles, one by one and the most of each feature, then all together."""

    def __init__(self, weights: Mapping[str, Numbers]) -> None:
        self.weights = dict(weights)

    def __call__(self, seen: Numbers) -> Numbers:
        """The best of ``PEDALS``, ``(1,)``."""
        return PEDALS[[int(np.argmax(self.logits(seen)))]]

    def logits(self, seen: Numbers) -> Numbers:
        """Logarithms of the chances of ``PEDALS``, but for a constant."""
        w = self.weights
        x = np.clip(seen * SCALE, -CUT, CUT)
        vehicles = x[FIRST:].reshape(VEHICLES, OTHER)
        rows = np.concatenate([vehicles, np.broadcast_to(x[[0, 5]], (VEHICLES, 2))], axis=1)
        for k in (0, 2):
            rows = np.tanh(rows @ w[f"encoder.{k}.weight"].T + w[f"encoder.{k}.bias"])
        x = np.concatenate([x[:FIRST], rows.max(axis=0)])
        for k in (0, 2):
            x = np.tanh(w[f"policy.{k}.weight"] @ x + w[f"policy.{k}.bias"])
        logits: Numbers = w["action.weight"] @ x + w["action.bias"]
        return logits


class TrainedEgo(PolicyDriver):
    """Drives as the policy in ``file``."""

    name = "trained_ego"
    forkable = True

    def __init__(self, file: str | Path = FILE) -> None:
        with np.load(file) as weights:
            super().__init__(Network(weights), **ENVIRONMENT)
