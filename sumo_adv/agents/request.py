"""What a model makes of an attack that is asked for in words: scripts, and demands on vehicles that attack together.

The analyzer asks for them only if there is a request (``run --ask``). A script is checked with what the situation knows
of the vehicle: its relation, its limits, the lanes beside it and its ways.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pydantic import BaseModel, Field

from sumo_adv.agents.scene_text import Aliases
from sumo_adv.agents.teams import ATTACKING, Team, Teamwork
from sumo_adv.asked import Asked, Attacker
from sumo_adv.datatypes import Intent, Limits
from sumo_adv.errors import UsageError
from sumo_adv.llm.prompts import sanitize
from sumo_adv.planners.script_checks import Walker, check_actions, check_walker_script
from sumo_adv.road_users import RoadUser, limits_of, road_user
from sumo_adv.script import Script, Verb
from sumo_adv.situation import Situation, Target, mirrored

MAX_SCRIPTS = 3  # maximum number in one answer
STRAIGHT_ON = ("straight", "none")  # movements of the ways that a script without a turn takes

# The two classes below are sent to the model as a JSON schema, with their names and docstrings.


class Scripted(BaseModel):
    """A vehicle and the script that it plays."""

    bv: str
    script: Script
    reason: str = Field(default="", max_length=2000)


class Demand(BaseModel):
    """One of the vehicles that attack together, and what must be true of it, without level and within. attacks: false
    for one that only plays its part, so that touching it is no success."""

    bv: str
    attacks: bool = True
    asked: Asked = Asked()


@dataclass(frozen=True, slots=True)
class ReadRequest:
    """What a model reads in a request.

    Attributes:
        asked: What an attack must show. Of several attackers, what the one that touches the ego must show.
        why_not: Why the request cannot be played in the encounter; empty if it can.
        scripts: The scripts of vehicles, in the order in which to try them.
        attackers: The vehicles that attack together, each with its own demands; empty for one.
    """

    asked: Asked
    why_not: str = ""
    scripts: tuple[Script, ...] = ()
    attackers: tuple[Attacker, ...] = ()


def script_fault(
    scripted: Scripted, situation: Situation, aliases: Aliases, limits: Limits, teamwork: Teamwork | None,
    allowed: Sequence[str],
) -> str | None:  # fmt: skip
    """Return the fault of a script as a sentence for the model.

    Args:
        scripted: The script with its vehicle.
        situation: The situation.
        aliases: The aliases of its vehicles.
        limits: The limits of a car.
        teamwork: What may be composed; None for one adversary.
        allowed: The labels of the only behaviours that may be chosen; empty allows all, and scripts.

    Returns:
        The fault; None if the vehicle can play the script.
    """
    if allowed:
        return f"Only these behaviours are allowed here, and no script: {', '.join(allowed)}."
    name = sanitize(scripted.bv)
    if scripted.bv not in aliases.bvs:
        return f"There is no vehicle '{name}' that may have a script; there are {', '.join(aliases.bvs)}."
    bv = aliases.bvs[scripted.bv]
    if teamwork is not None and not teamwork.may_collide(bv):
        return f"{name} may only be a support, so it can have no script."
    target, script = situation.targets[bv], scripted.script
    if not set(script.applies) & set(target.applies()):
        return (
            f"The script does not apply to {name} from where it is: its applies must have one of "
            f"{', '.join(target.applies())}."
        )
    user, speed = road_user(target.state), target.state.speed
    try:
        if user is not RoadUser.VEHICLE:
            check_walker_script(script, name, Walker(user, speed, None, crosses=True), situation.horizon)
            return None
        check_actions(script, name, speed, limits_of(target.state, limits), _lanes_beside(target), situation.horizon)
    except UsageError as error:
        return str(error)
    return _turn_fault(script, name, target)


def demands_fault(
    demands: Sequence[Demand], attacking: Sequence[str], teams: Sequence[Team], teamwork: Teamwork | None
) -> str | None:  # fmt: skip
    """Return the fault of the demands on several attackers as a sentence for the model.

    Args:
        demands: The demands; empty for one attacker.
        attacking: The aliases of the vehicles that have an intent or a script.
        teams: The compositions of the same answer.
        teamwork: What may be composed; None for one adversary.

    Returns:
        The fault; None if they are usable.
    """
    names = [demand.bv for demand in demands]
    if not names:
        return None
    if teamwork is None:
        return "Only one vehicle may attack here, so attackers must be empty."
    if len(set(names)) < len(names) or not 2 <= len(names) <= teamwork.most:
        return f"attackers must be empty, or have 2 to {teamwork.most} different vehicles."
    if not any(demand.attacks for demand in demands):
        return "One of attackers must attack, and all of them have attacks false."
    idle = [sanitize(name) for name in names if name not in attacking]
    if idle:
        return f"{idle[0]} is one of attackers, so give it an intent or a script."
    if others := [sanitize(name) for name in attacking if name not in names]:
        return f"{others[0]} has an intent or a script, so it must be one of attackers."
    if any(demand.asked.level is not None or demand.asked.within is not None for demand in demands):
        return "level and within hold for all attackers: give them in asked, not in attackers."
    for team in teams:
        if {m.bv for m in team.parts if m.role in ATTACKING} != set(names):
            return f"In the composition '{sanitize(team.label)}', exactly the attackers must be collider and attack."
    return None


def script_intent(scripted: Scripted, aliases: Aliases) -> Intent:
    """Return a script as an intent.

    Args:
        scripted: The usable script with its vehicle.
        aliases: The aliases of the vehicles.
    """
    script = scripted.script
    reason = sanitize(scripted.reason)
    return Intent(aliases.bvs[scripted.bv], script.label, script.description, "high", 0.0, reason, "generated")


def attackers_of(demands: Sequence[Demand], bvs: Mapping[str, str]) -> tuple[Attacker, ...]:
    """Return the vehicles that attack together.

    Args:
        demands: The usable demands.
        bvs: The ids of the vehicles by alias.
    """
    return tuple(Attacker(id=bvs[demand.bv], attacks=demand.attacks, asked=demand.asked) for demand in demands)


def _lanes_beside(target: Target) -> tuple[int, int]:
    """Return how many lanes are to the right and to the left of a vehicle, as a script counts them.

    In left-hand traffic, left and right are exchanged.
    """
    sides = [target.hand * offset for offset, _ in target.sides]
    return sum(side < 0.0 for side in sides), sum(side > 0.0 for side in sides)


def _turn_fault(script: Script, name: str, target: Target) -> str | None:
    """Return the fault of a script whose turn the ways of a vehicle lack; None if they have it."""
    movements = dict.fromkeys(mirrored(way.movement, target.hand) for way in target.ways)
    wanted = next((str(action.side) for action in script.actions if action.verb is Verb.TURN), None)
    if wanted is not None and wanted not in movements:
        return f"The script turns {wanted}, and {name} has no such way from where it is: {', '.join(movements)}."
    if wanted is None and len(movements) > 1 and not set(STRAIGHT_ON) & set(movements):
        return f"The script goes straight on, and {name} can only go {' or '.join(movements)}: give it the action turn."
    return None
