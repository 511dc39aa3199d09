"""For people who bring a CommonRoad planner: the road and the traffic around the ego as objects of commonroad-io.

``PlannerEgo`` is the ego to subclass: its one method ``plan`` gets a ``Scene`` and returns a trajectory. ``Scenes``
makes the scenes alone, for a driver of your own that only wants CommonRoad's map or obstacles.
"""

from importlib import import_module

from sumo_adv.errors import UsageError

try:
    import_module("commonroad.geometry.shape")  # which 2026.1 no longer has
except ImportError as error:
    raise UsageError(
        f"sumo_adv.commonroad needs commonroad-io, 2022.1 to 2024.3 ({error}): pip install 'sumo-adv[commonroad]'."
    ) from error

from sumo_adv.commonroad.ego import PlannerEgo
from sumo_adv.commonroad.scene import Predict, Scene, Scenes, constant_velocity

__all__ = ["PlannerEgo", "Predict", "Scene", "Scenes", "constant_velocity"]
