"""Environments for gymnasium and PettingZoo: agents drive the ego, the adversary, or both.

Importing this package registers ``sumo_adv/Ego-v0`` and ``sumo_adv/Adversary-v0``. ``parallel_env`` makes the
environment with both agents. ``docs/gym.md`` describes them. The package needs the extra ``gym``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sumo_adv.errors import UsageError

try:
    from gymnasium.envs.registration import register
except ImportError as error:
    if error.name != "gymnasium":
        raise
    raise UsageError(
        "The environments need the package gymnasium, which is not installed: pip install 'sumo-adv[gym]'."
    ) from error

if TYPE_CHECKING:
    from sumo_adv.gym.environments import AdversaryEnv, EgoEnv
    from sumo_adv.gym.parallel import BothEnv, parallel_env
    from sumo_adv.gym.policy import PolicyDriver
    from sumo_adv.gym.rewards import Transition, adversary_reward, ego_reward

__all__ = [
    "AdversaryEnv", "BothEnv", "EgoEnv", "PolicyDriver", "Transition", "adversary_reward", "ego_reward", "parallel_env",
]  # fmt: skip

_HOMES = {
    **dict.fromkeys(("AdversaryEnv", "EgoEnv"), "sumo_adv.gym.environments"),
    **dict.fromkeys(("BothEnv", "parallel_env"), "sumo_adv.gym.parallel"),
    "PolicyDriver": "sumo_adv.gym.policy",
    **dict.fromkeys(("Transition", "adversary_reward", "ego_reward"), "sumo_adv.gym.rewards"),
}

_ENVIRONMENTS = "sumo_adv.gym.environments"
register("sumo_adv/Ego-v0", f"{_ENVIRONMENTS}:EgoEnv", vector_entry_point=f"{_ENVIRONMENTS}:ego_vec")
register("sumo_adv/Adversary-v0", f"{_ENVIRONMENTS}:AdversaryEnv", vector_entry_point=f"{_ENVIRONMENTS}:adversary_vec")


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that registering loads nothing else."""
    if name not in _HOMES:
        raise AttributeError(f"module 'sumo_adv.gym' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)
