"""Check whether the adversary of a draft can play its script, and write the script as a part of a scenario."""

from __future__ import annotations

from typing import NamedTuple

from sumo_adv.datatypes import Limits
from sumo_adv.errors import UsageError
from sumo_adv.files import toml_lines
from sumo_adv.planners.script_checks import check_actions
from sumo_adv.road_users import limits_of
from sumo_adv.script import Script, Verb
from sumo_adv.words.roads import Net, VehicleRoute


class Body(NamedTuple):
    """The size of a vehicle [m]."""

    length: float
    width: float


def check_script(
    script: Script, who: str, speed: float, size: tuple[float, float], drive: VehicleRoute, net: Net, horizon: float
) -> None:  # fmt: skip
    """Check that a vehicle can play a script: its speeds and accelerations, its lanes and turns, and its times.

    Args:
        script: The script.
        who: The vehicle, for messages.
        speed: Its speed when the attack begins [m/s].
        size: Its length and width [m].
        drive: Its way.
        net: The network.
        horizon: The time within which all actions must begin [s].

    Raises:
        UsageError: It cannot. The message is one sentence that names the action.
    """
    check_actions(script, who, speed, limits_of(Body(*size), Limits()), net.lanes_beside(drive), horizon)
    _check_turn(script, who, drive, net)


def script_tables(script: Script) -> str:
    """Return a script as tables of a scenario file.

    Args:
        script: The script.
    """
    lines = ["", "[[scripts]]", *toml_lines({"name": script.name or None, "applies": list(script.applies)})]
    for action in script.actions:
        lines += ["", "[[scripts.actions]]", *toml_lines(action.model_dump(mode="json", exclude_defaults=True))]
    return "\n".join([*lines, ""])


def _check_turn(script: Script, who: str, drive: VehicleRoute, net: Net) -> None:
    """Check that a script turns as the vehicle's route does at its first junction."""
    wanted = next((str(action.side) for action in script.actions if action.verb is Verb.TURN), "straight on")
    turns = net.turn(drive)
    if turns is not None and wanted != turns:
        raise UsageError(
            f"The script goes {wanted} where the route of {who} goes {turns} from edge '{drive.edges[0]}': give it "
            "the turn of the route, or another route."
        )
