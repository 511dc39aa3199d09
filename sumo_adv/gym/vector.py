"""Environments side by side, each in a process of its own: what ``gymnasium.make_vec`` makes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
from gymnasium.vector import AsyncVectorEnv

from sumo_adv.gym.core import Scenarios
from sumo_adv.gym.environments import AdversaryEnv, EgoEnv


def ego_vec(num_envs: int = 1, **options: Any) -> AsyncVectorEnv:
    """``sumo_adv/Ego-v0``, ``num_envs`` times; ``options`` are its arguments."""
    return _side_by_side(EgoEnv, num_envs, **options)


def adversary_vec(num_envs: int = 1, **options: Any) -> AsyncVectorEnv:
    """``sumo_adv/Adversary-v0``, ``num_envs`` times; ``options`` are its arguments."""
    return _side_by_side(AdversaryEnv, num_envs, **options)


def _side_by_side(
    make: Callable[..., gymnasium.Env[Any, Any]], num_envs: int, scenario: Scenarios | None = None, **options: Any
) -> AsyncVectorEnv:
    """Several scenarios are dealt out, so that each is opened as seldom as possible."""
    if scenario is None:
        return AsyncVectorEnv([partial(make, **options)] * num_envs)
    scenarios = [scenario] if isinstance(scenario, str | Path) else list(scenario)
    shares = [scenarios[k::num_envs] or scenarios[k % len(scenarios) :][:1] for k in range(num_envs)]
    return AsyncVectorEnv([partial(make, scenario=share, **options) for share in shares])
