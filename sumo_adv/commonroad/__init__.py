"""Drive the ego with a CommonRoad planner: the road and the traffic around the ego as objects of commonroad-io.

To use a planner, subclass ``PlannerEgo``. Its method ``plan`` gets a ``Scene`` and returns a trajectory. A driver that
only needs CommonRoad's map or obstacles can use ``Scenes`` to make the scenes alone.
"""

from importlib import import_module

from sumo_adv.errors import UsageError

try:
    import_module("commonroad.geometry.shape")  # commonroad-io 2026.1 no longer has this module
except ImportError as error:
    raise UsageError(
        f"sumo_adv.commonroad needs commonroad-io, 2022.1 to 2024.3 ({error}): pip install 'sumo-adv[commonroad]'."
    ) from error

from sumo_adv.commonroad.ego import PlannerEgo
from sumo_adv.commonroad.scene import Predict, Scene, Scenes, constant_velocity

__all__ = ["PlannerEgo", "Predict", "Scene", "Scenes", "constant_velocity"]
