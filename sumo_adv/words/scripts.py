"""Check whether the adversary of a draft can play its script, and write the script as a part of a scenario."""

from __future__ import annotations

from typing import NamedTuple

from sumo_adv.datatypes import Limits
from sumo_adv.errors import UsageError
from sumo_adv.files import toml_lines
from sumo_adv.planners.trajectory import USUAL_ACCELERATION_M_S2
from sumo_adv.road_users import limits_of
from sumo_adv.script import Action, Script, Verb, tunable
from sumo_adv.situation import fastest_of
from sumo_adv.words.roads import Net, VehicleRoute

LANE_SIDES = {"left": 1, "right": -1}


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


def check_actions(
    script: Script, who: str, speed: float, limits: Limits, beside: tuple[int, int], horizon: float
) -> None:  # fmt: skip
    """Check that a vehicle can play the actions of a script: its speeds and accelerations, its lanes and its times.

    Args:
        script: The script.
        who: The vehicle, for messages.
        speed: Its speed when the attack begins [m/s].
        limits: The limits of its motion.
        beside: How many lanes are to its right and to its left.
        horizon: The time within which all actions must begin [s].

    Raises:
        UsageError: It cannot. The message is one sentence that names the action.
    """
    most = min(limits.acceleration, USUAL_ACCELERATION_M_S2)
    right, left = beside
    now, begin, end, lanes = speed, 0.0, 0.0, 0
    for k, action in enumerate(script.actions):
        this = f"Action {k + 1} of the script ({action.verb})"
        begin = _begins(action, begin, end)
        if begin > horizon:
            raise UsageError(f"{this} begins after {begin:.0f} s at the earliest, and it must within {horizon:.0f} s.")
        rate, seconds = action.number("rate").default, action.number("seconds").default
        wanted = action.number("speed").default if action.verb in (Verb.SPEED, Verb.BRAKE) else now
        if action.verb in (Verb.BRAKE, Verb.STOP_FOR) and rate > limits.braking:
            raise UsageError(f"{this} brakes with {rate:g} m/s2, and {who} can with {limits.braking:g} at most.")
        if wanted > now and rate > most and action.verb is Verb.SPEED:
            raise UsageError(f"{this} speeds up with {rate:g} m/s2, and {who} can with {most:g} at most.")
        if wanted > fastest_of(speed):
            raise UsageError(
                f"{this} goes for {wanted:g} m/s, and {who}, which drives {speed:.1f} m/s when the attack begins, can "
                f"go for {fastest_of(speed):.1f} at most."
            )
        match action.verb:
            case Verb.SPEED:
                now, seconds = wanted, abs(wanted - now) / rate
            case Verb.BRAKE:
                now, seconds = min(now, wanted), max(now - wanted, 0.0) / rate
            case Verb.STOP_FOR:
                now, seconds = 0.0, now / rate + seconds
            case Verb.LANE_CHANGE:
                lanes += LANE_SIDES[str(action.side)]
                if not -right <= lanes <= left:
                    there = f"{left} on its left and {right} on its right"
                    raise UsageError(f"{this} has no lane to its {action.side}: {who} has {there}.")
            case Verb.TURN:
                seconds = 0.0
        if now == 0.0 and action.verb in (Verb.LANE_CHANGE, Verb.LATERAL_OFFSET, Verb.TURN):
            raise UsageError(f"{this} begins when {who} stands: let it drive on first (speed).")
        end = begin + seconds


def script_tables(script: Script) -> str:
    """Return a script as tables of a scenario file.

    Args:
        script: The script.
    """
    lines = ["", "[[scripts]]", *toml_lines({"applies": list(script.applies)})]
    for action in script.actions:
        lines += ["", "[[scripts.actions]]", *toml_lines(action.model_dump(mode="json", exclude_defaults=True))]
    return "\n".join([*lines, ""])


def _begins(action: Action, begin: float, end: float) -> float:
    """Return when an action begins at the earliest [s], where the last one begins and ends at the given times."""
    if action.when is None or action.when.value is None:
        return end
    if action.when.kind == "time":
        return max(begin, tunable(action.when.key, action.when.value).default)
    return begin


def _check_turn(script: Script, who: str, drive: VehicleRoute, net: Net) -> None:
    """Check that a script turns as the vehicle's route does at its first junction."""
    wanted = next((str(action.side) for action in script.actions if action.verb is Verb.TURN), "straight on")
    turns = net.turn(drive)
    if turns is not None and wanted != turns:
        raise UsageError(
            f"The script goes {wanted} where the route of {who} goes {turns} from edge '{drive.edges[0]}': give it "
            "the turn of the route, or another route."
        )
