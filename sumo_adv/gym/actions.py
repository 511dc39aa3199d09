"""The meaning of an agent's actions. All actions are numbers from -1 to 1; ``docs/gym.md`` has their table.

The ego has ``pedals`` (acceleration), ``controls`` (acceleration and steering) or ``lane`` (target speed and lane). The
adversary has ``endpoint`` (a place on its way with a speed and a time) or ``controls``, within the limits of an
adversary's motion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sumo_adv.datatypes import Endpoint, Limits, VehicleState
from sumo_adv.drivers import Action, LaneSpeed, Steer
from sumo_adv.drivers.protocol import MAX_ACCELERATION_M_S2, MAX_BRAKING_M_S2, MAX_STEERING_RAD, WHEELBASE_M
from sumo_adv.errors import UsageError
from sumo_adv.geometry import Path, Pose, wrap

Numbers = NDArray[Any]
EGO_ACTIONS: Mapping[str, int] = {"pedals": 1, "controls": 2, "lane": 2}
ADVERSARY_ACTIONS: Mapping[str, int] = {"endpoint": 4, "controls": 2}
"""The number of values of an action, by its kind."""

MAX_LATERAL_ACCELERATION_M_S2 = 6.0  # at full steering of the ego; about the limit of a car on a dry road
MAX_SPEED_LIMIT_FACTOR = 1.3  # of the speed limit; gives the highest target speed
PEDAL_ACCELERATION_M_S2, PEDAL_BRAKING_M_S2 = 3.0, 8.0  # maximum with ``pedals`` and ``lane``
LANE_CHANGE_THRESHOLD = 1 / 3  # above it, the second number of ``lane`` asks for the neighbouring lane
ENDPOINT_AHEAD_M = (5.0, 65.0)  # how far ahead an endpoint may be
ENDPOINT_ASIDE_M = 8.0  # how far to either side of the way it may be
ENDPOINT_TIME_S = (0.5, 5.0)  # how long the adversary takes to get there
CONTROL_LIMIT_SHARE = 0.95  # of a limit; controls use this share, so that rounding does not break a gate


def action_space(kinds: Mapping[str, int], kind: str) -> Any:
    """Return the space of a kind of actions.

    Args:
        kinds: The number of values of an action, by kind.
        kind: The kind.

    Raises:
        UsageError: There is no such kind.
    """
    if kind not in kinds:
        raise UsageError(f"There are no actions {kind!r}; choose {' or '.join(kinds)}.")
    return spaces.Box(-1.0, 1.0, (kinds[kind],), np.float32)


def checked_action(agent: str, numbers: Any, count: int) -> Numbers:
    """Return an agent's action as ``count`` numbers, ``(count,)``. Numbers beyond -1 and 1 are clipped later.

    Args:
        agent: The name of the agent, for messages.
        numbers: The action.
        count: The number of values.

    Raises:
        UsageError: The action has another shape, or a number that is not finite.
    """
    try:
        values = np.asarray(numbers, float)
    except (TypeError, ValueError) as error:
        raise UsageError(f"The action {numbers!r:.80} of the agent {agent!r} holds no numbers ({error}).") from error
    if values.shape != (count,):
        raise UsageError(
            f"The action of the agent {agent!r} has the shape {values.shape}; its space has the shape ({count},)."
        )
    if not np.isfinite(values).all():
        raise UsageError(
            f"The action of the agent {agent!r} is {values.tolist()}: its numbers must be finite, and a policy that "
            "gives NaN has failed in training."
        )
    return values


def ego_action(kind: str, numbers: Numbers, me: VehicleState, limit: float, dt: float) -> Action:
    """Return the ego's action for the next step.

    Args:
        kind: The kind of the action.
        numbers: The agent's action.
        me: The ego's state.
        limit: The speed limit [m/s].
        dt: The step length [s].
    """
    first, *others = (float(v) for v in np.clip(numbers, -1.0, 1.0))
    if kind == "pedals":
        speed = me.speed + first * (PEDAL_ACCELERATION_M_S2 if first > 0 else PEDAL_BRAKING_M_S2) * dt
        return LaneSpeed(None, max(min(speed, max(limit, me.speed - PEDAL_ACCELERATION_M_S2 * dt)), 0.0))
    second = others[0]
    if kind == "controls":
        acceleration = first * (MAX_ACCELERATION_M_S2 if first > 0 else MAX_BRAKING_M_S2)
        sharpest = min(
            MAX_STEERING_RAD, math.atan(MAX_LATERAL_ACCELERATION_M_S2 * WHEELBASE_M / max(me.speed, 1.0) ** 2)
        )
        return Steer(acceleration, second * sharpest)
    wished = (first + 1.0) / 2.0 * MAX_SPEED_LIMIT_FACTOR * limit
    speed = min(max(wished, me.speed - PEDAL_BRAKING_M_S2 * dt), me.speed + PEDAL_ACCELERATION_M_S2 * dt)
    return LaneSpeed(_lane(me, second), max(speed, 0.0))


def _lane(me: VehicleState, wish: float) -> int | None:
    """Return the index of the neighbouring lane that the agent asks for; None to stay, and always on a junction."""
    edge, _, index = me.lane.rpartition("_")
    if abs(wish) < LANE_CHANGE_THRESHOLD or edge.startswith(":") or not index.isdecimal():
        return None
    return max(0, int(index) + (1 if wish > 0 else -1))


def endpoint(numbers: Numbers, way: Path, station: float, fastest: float) -> Endpoint:
    """Return the endpoint of an adversary.

    Args:
        numbers: The agent's action.
        way: The adversary's way.
        station: The adversary's place on its way [m].
        fastest: The adversary's highest speed [m/s].
    """
    ahead, left, speed, time = (float(v) for v in np.clip(numbers, -1.0, 1.0))
    far, seconds = _between(ahead, *ENDPOINT_AHEAD_M), _between(time, *ENDPOINT_TIME_S)
    x, y, heading = (float(v) for v in way.at(np.asarray(station + far), left * ENDPOINT_ASIDE_M))
    return Endpoint(x, y, wrap(heading), _between(speed, 0.0, fastest), seconds)


def _between(share: float, low: float, high: float) -> float:
    """Map -1 to ``low`` and 1 to ``high``."""
    return low + (share + 1.0) / 2.0 * (high - low)


def controlled(numbers: Numbers, me: VehicleState, limits: Limits, fastest: float, dt: float) -> Pose:
    """Return the pose of an adversary after a step of acceleration and steering, within its limits.

    It moves on an arc of constant curvature. Its acceleration is constant, and differs from the previous one by no more
    than the jerk allows.

    Args:
        numbers: The agent's action.
        me: The adversary's state.
        limits: The limits of its motion.
        fastest: Its highest speed [m/s].
        dt: The step length [s].
    """
    first, second = (float(v) for v in np.clip(numbers, -1.0, 1.0))
    wished = CONTROL_LIMIT_SHARE * first * (limits.acceleration if first > 0 else limits.braking)
    change = CONTROL_LIMIT_SHARE * limits.jerk * dt
    acceleration = min(max(wished, me.acceleration - change), me.acceleration + change)
    speed = min(max(0.0, me.speed + acceleration * dt), max(fastest, me.speed))
    curvature = CONTROL_LIMIT_SHARE * second * min(limits.curvature, limits.lateral / max(speed, me.speed, 1.0) ** 2)
    travelled = (me.speed + speed) / 2.0 * dt
    turned = curvature * travelled
    direction = me.heading + turned / 2.0
    return Pose(
        me.x + travelled * math.cos(direction), me.y + travelled * math.sin(direction), wrap(me.heading + turned), speed
    )
