"""Check whether a road user can play a script: its speeds and accelerations, its lanes or places, and its times."""

from __future__ import annotations

import math
from typing import NamedTuple

from sumo_adv.datatypes import Limits
from sumo_adv.errors import UsageError
from sumo_adv.planners.trajectory import USUAL_ACCELERATION_M_S2
from sumo_adv.road_users import UNPROTECTED_SPEEDS_M_S, RoadUser
from sumo_adv.script import Action, Script, Verb, tunable
from sumo_adv.situation import fastest_of

LANE_SIDES = {"left": 1, "right": -1}
TURNS_BACK_M = (-3.5, 5.5)  # from the middle of the ego's way, as it is walked over; a walker may turn back there
TURN_BACK_S = {RoadUser.PEDESTRIAN: 1.5, RoadUser.CYCLIST: 5.0}  # of a half turn, roughly
MIN_WALK_M = 0.1


class Walker(NamedTuple):
    """A pedestrian or cyclist when the attack begins.

    Attributes:
        user: Its kind.
        speed: Its speed [m/s].
        offset: Its place to the left of the middle of the ego's way [m]; None if it is unknown.
        crosses: Whether it goes, or can go at once, straight across the ego's way.
    """

    user: RoadUser
    speed: float
    offset: float | None
    crosses: bool


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
    _check_user(script, who, RoadUser.VEHICLE)
    most = min(limits.acceleration, USUAL_ACCELERATION_M_S2)
    right, left = beside
    now, begin, end, lanes = speed, 0.0, 0.0, 0
    for k, action in enumerate(script.actions):
        this = f"Action {k + 1} of the script ({action.verb})"
        begin = _begins(action, begin, end)
        _check_begin(this, begin, horizon)
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


def check_walker_script(script: Script, who: str, walker: Walker, horizon: float) -> None:
    """Check that a pedestrian or cyclist can play a script: its speeds, its places and its times.

    Args:
        script: The script.
        who: The pedestrian or cyclist, for messages.
        walker: What it does before.
        horizon: The time within which all actions must begin [s].

    Raises:
        UsageError: It cannot. The message is one sentence that names the action.
    """
    user = walker.user
    _check_user(script, who, user)
    known = walker.offset is not None
    place, over = walker.offset or 0.0, -math.copysign(1.0, walker.offset or 0.0)  # over: to the left or to the right
    pace, begin, end = walker.speed, 0.0, 0.0
    aside, turned = not walker.crosses, False
    for k, action in enumerate(script.actions):
        this = f"Action {k + 1} of the script ({action.verb})"
        begin = _begins(action, begin, end)
        _check_begin(this, begin, horizon)
        seconds = action.number("seconds").default if action.verb is Verb.WAIT else 0.0
        if action.verb in (Verb.WALK_TO, Verb.SPEED):
            pace = script.pace(action) if action.verb is Verb.WALK_TO else action.number("speed").default
            if pace > UNPROTECTED_SPEEDS_M_S[user]:
                raise UsageError(
                    f"{this} goes at {pace:g} m/s, and a {user} can at {UNPROTECTED_SPEEDS_M_S[user]:g} at most."
                )
        match action.verb:
            case Verb.WALK_TO:
                to = action.number("offset").default
                if known and (to - place) * over < MIN_WALK_M:
                    turns = "it has turned back already" if turned else "give turn_back before it"
                    raise UsageError(f"{this} leads to {to:g} m, which lies behind {who} at {place:g} m: {turns}.")
                place, seconds = to, abs(to - place) / pace if known else 0.0
                aside = aside and (k > 0 or action.when is not None)
            case Verb.TURN_BACK:
                least, farthest = TURNS_BACK_M
                if aside:
                    raise UsageError(f"{this} needs a way across from the beginning: let {who} walk_to first, at once.")
                if pace == 0.0:
                    raise UsageError(f"{this} begins when {who} has not gone yet: let it walk_to first.")
                if known and not least <= place * over <= farthest:
                    raise UsageError(
                        f"{this} begins when {who} is at {place:g} m, and it can turn back from {-least:g} m before "
                        f"the middle of the ego's way to {farthest:g} m beyond it."
                    )
                over, turned, seconds = -over, True, TURN_BACK_S[user]
        end = begin + seconds


def _begins(action: Action, begin: float, end: float) -> float:
    """Return when an action begins at the earliest [s], where the last one begins and ends at the given times."""
    if action.when is None or action.when.value is None:
        return end
    if action.when.kind == "time":
        return max(begin, tunable(action.when.key, action.when.value).default)
    return begin


def _check_begin(this: str, begin: float, horizon: float) -> None:
    """Check that an action begins within the horizon."""
    if begin > horizon:
        raise UsageError(f"{this} begins after {begin:.0f} s at the earliest, and it must within {horizon:.0f} s.")


def _check_user(script: Script, who: str, user: RoadUser) -> None:
    """Check that a script is for the kind of road user that plays it."""
    if script.user != user:
        raise UsageError(f"The script begins from {', '.join(script.applies)}, and {who} is a {user}.")
