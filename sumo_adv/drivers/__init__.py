"""Ego controllers: who drives the vehicle under test.

``make_ego`` makes one by name; the engine's step loop shows it an ``Observation`` and carries out the ``Action`` it
returns. A user's own driver is any class with ``reset(seed)`` and ``act(observation)``: see ``examples/``.
"""

from sumo_adv.drivers.bicycle import apply_steer
from sumo_adv.drivers.careful_controller import CarefulEgo
from sumo_adv.drivers.external import ExternalEgo
from sumo_adv.drivers.lattice_controller import LatticeEgo
from sumo_adv.drivers.protocol import Action, EgoController, LaneSpeed, Observation, Pose, Road, Steer
from sumo_adv.drivers.registry import make_ego
from sumo_adv.drivers.replay import ReplayEgo
from sumo_adv.drivers.sumo_driven import SumoEgo
from sumo_adv.drivers.user import UserEgo

__all__ = [
    "Action",
    "CarefulEgo",
    "EgoController",
    "ExternalEgo",
    "LaneSpeed",
    "LatticeEgo",
    "Observation",
    "Pose",
    "ReplayEgo",
    "Road",
    "Steer",
    "SumoEgo",
    "UserEgo",
    "apply_steer",
    "make_ego",
]
