"""What an attempt that the front leads step by step has of its encounter, in the engine."""

from __future__ import annotations

from dataclasses import dataclass
from multiprocessing.connection import Connection

from sumo_adv.config import Settings
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.task import FoundEncounter
from sumo_adv.planners.answers import AskOne
from sumo_adv.simulation.network import RoadMap


@dataclass(frozen=True, slots=True)
class OpenEncounter:
    """An encounter at its trigger.

    trigger_step: how many snapshots the recording has. dialogue: to the front, which sends None at the end. ask_front:
    asks the planner of the attempt's proposal in its sandbox.
    """

    drive: Drive
    found: FoundEncounter
    settings: Settings
    road: RoadMap
    trigger_step: int
    dialogue: Connection
    ask_front: AskOne
