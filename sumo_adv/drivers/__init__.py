"""Drivers of the ego, the vehicle under test: controllers that drive it, and models that predict it.

``make_ego`` makes a controller by name. In each step, the controller gets an ``Observation`` and returns an ``Action``.
A user's own driver is any class with ``reset(seed)`` and ``act(observation)``: see ``examples/``.
"""

from sumo_adv.drivers.careful import CarefulEgo
from sumo_adv.drivers.lattice_ego import LatticeEgo
from sumo_adv.drivers.protocol import (
    Action,
    Conflict,
    EgoController,
    Lane,
    LaneSpeed,
    Observation,
    PlannedPose,
    Pose,
    Road,
    SpeedLimit,
    Steer,
    StopLine,
    Vehicle,
    apply_steer,
    model_of,
)
from sumo_adv.drivers.registry import ExternalEgo, UserEgo, make_ego
from sumo_adv.drivers.sumo_driven import ReplayEgo, SumoEgo

__all__ = [
    "Action",
    "CarefulEgo",
    "Conflict",
    "EgoController",
    "ExternalEgo",
    "Lane",
    "LaneSpeed",
    "LatticeEgo",
    "Observation",
    "PlannedPose",
    "Pose",
    "ReplayEgo",
    "Road",
    "SpeedLimit",
    "Steer",
    "StopLine",
    "SumoEgo",
    "UserEgo",
    "Vehicle",
    "apply_steer",
    "make_ego",
    "model_of",
]
