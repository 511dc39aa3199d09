"""A planner that is our own answers where its attempt runs, instead of over two connections in its sandbox.

Its answers are the same to the last bit (``planners/trusted.py``); what fails here is asked of the sandbox, for its
sentence.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NoReturn

from sumo_adv.datatypes import Proposal, acceleration_at
from sumo_adv.errors import SandboxError
from sumo_adv.planners.answers import Answer, Told, world_endpoint
from sumo_adv.planners.road import road_of
from sumo_adv.planners.trusted import InProcessSession, is_own
from sumo_adv.situation import Situation

Ask = Callable[[Told], Answer | str]
ROAD = "road"


def answers(proposal: Proposal, situation: Situation, elsewhere: Ask) -> Ask:
    """Who answers in an attempt: the proposal's planner, if it is ours; ``elsewhere`` if not, and where it fails."""
    if proposal.course is not None or not is_own(proposal.planner):
        return elsewhere
    session = InProcessSession(proposal.planner, {ROAD: road_of(situation, proposal.bv)}, _nowhere)

    def ask(told: Told) -> Answer | str:
        acceleration = acceleration_at(proposal.acceleration, told[0]["time"])
        try:
            end = session.endpoint(ROAD, *told, proposal.parameters, acceleration, situation.horizon)
            return Answer(world_endpoint(situation, end))
        except SandboxError:
            return elsewhere(told)

    return ask


def _nowhere() -> NoReturn:
    raise SandboxError("It failed, and is asked elsewhere.")
