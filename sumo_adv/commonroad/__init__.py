"""For people who bring a CommonRoad planner: the road and the traffic around the ego as objects of commonroad-io.

``PlannerEgo`` is the ego to subclass: its one method ``plan`` gets a ``Scene`` and returns a trajectory. ``Scenes``
makes the scenes alone, for a driver of your own that only wants CommonRoad's map or obstacles.
"""

from importlib.util import find_spec

from sumo_adv.errors import UsageError

if find_spec("commonroad") is None:
    raise UsageError(
        "sumo_adv.commonroad needs commonroad-io, which is not installed: pip install 'sumo-adv[commonroad]'."
    )

from sumo_adv.commonroad.ego import PlannerEgo
from sumo_adv.commonroad.scene import Predict, Scene, Scenes, constant_velocity

__all__ = ["PlannerEgo", "Predict", "Scene", "Scenes", "constant_velocity"]
