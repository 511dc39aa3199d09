"""Generate safety-critical scenarios in SUMO, online, by retrieval-augmented generation.

From Python:

- ``sumo_adv.run("priority_crossing")`` attacks in one encounter. ``sumo_adv.load("runs/priority_crossing-0")`` reads a
  run again (``api.py``).
- ``sumo_adv.batch("plan.toml", out="campaigns/first")``, ``sumo_adv.hunt("motorway", minutes=30)`` and
  ``sumo_adv.crash_rate("straight_2lane", ego="idm")`` make many runs (``api_batch.py``). ``sumo_adv.rate`` is
  a package.
- A driver of your own needs ``Observation`` and the actions ``Steer``, ``Pose`` and ``LaneSpeed``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sumo_adv.api import Result, judge, load, run
    from sumo_adv.api_batch import Campaign, batch, crash_rate, hunt
    from sumo_adv.drivers import LaneSpeed, Observation, PlannedPose, Pose, Steer

__version__ = "0.4.0"
__all__ = [
    "Campaign", "LaneSpeed", "Observation", "PlannedPose", "Pose", "Result", "Steer", "__version__", "batch",
    "crash_rate", "hunt", "judge", "load", "run",
]  # fmt: skip

_HOMES = {
    **dict.fromkeys(("Result", "judge", "load", "run"), "sumo_adv.api"),
    **dict.fromkeys(("Campaign", "batch", "crash_rate", "hunt"), "sumo_adv.api_batch"),
    **dict.fromkeys(("LaneSpeed", "Observation", "PlannedPose", "Pose", "Steer"), "sumo_adv.drivers"),
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used; importing the package itself loads nothing."""
    if name not in _HOMES:
        raise AttributeError(f"module 'sumo_adv' has no attribute '{name}'")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
