"""The trained ego as a driver: ``sumo-adv run SCENARIO --ego trained_ego:TrainedEgo`` in the folder of its file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stable_baselines3 import PPO

from sumo_adv.gym import PolicyDriver

FILE = "trained_ego.zip"
ENVIRONMENT: dict[str, Any] = {"actions": "lane", "observations": "vector", "vehicles": 6, "interval": 0.2}


class TrainedEgo(PolicyDriver):
    """Drives as the policy in ``file``."""

    name = "trained_ego"

    def __init__(self, file: str = FILE) -> None:
        model = PPO.load(Path(file), device="cpu")
        super().__init__(lambda seen: model.predict(seen, deterministic=True)[0], **ENVIRONMENT)
