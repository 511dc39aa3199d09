"""What an agent's action means. All actions are numbers from -1 to 1; ``docs/gym.md`` has their table.

The ego has ``pedals`` (acceleration), ``controls`` (acceleration and steering) or ``lane`` (target speed and lane). The
adversary has ``endpoint`` (a place on its way with a speed and a time) or ``controls`` within the limits of an
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
"""Kind -> how many numbers an action has."""

MAX_LATERAL_ACCELERATION_M_S2 = 6.0  # full steering of the ego; about what a car on a dry road can do
MAX_SPEED_LIMIT_FACTOR = 1.3  # of the speed limit: the highest target speed
PEDAL_ACCELERATION_M_S2, PEDAL_BRAKING_M_S2 = 3.0, 8.0  # most acceleration and braking with ``pedals`` and ``lane``
LANE_CHANGE_THRESHOLD = 1 / 3  # beyond it the second number of ``lane`` asks for the lane beside
ENDPOINT_AHEAD_M = (5.0, 65.0)  # m ahead: where an endpoint may be
ENDPOINT_ASIDE_M = 8.0  # m to either side of the way
ENDPOINT_TIME_S = (0.5, 5.0)  # s until it is there
CONTROL_LIMIT_SHARE = 0.95  # of a limit: what controls use, so that rounding does not break a gate


def action_space(kinds: Mapping[str, int], kind: str) -> Any:
    """The space of a kind of actions. Raises UsageError: there is no such kind."""
    if kind not in kinds:
        raise UsageError(f"There are no actions {kind!r}; choose {' or '.join(kinds)}.")
    return spaces.Box(-1.0, 1.0, (kinds[kind],), np.float32)


def checked_action(agent: str, numbers: Any, count: int) -> Numbers:
    """An agent's action as ``count`` numbers ``(count,)``. Numbers beyond -1 and 1 are cut by what uses them.

    Raises UsageError: it has another shape, or a number that is not finite.
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
    """The ego's action for the next step; ``limit``: of its speed [m/s]."""
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
    """The index of the lane beside that is wished for; None: stay, also on a junction."""
    edge, _, index = me.lane.rpartition("_")
    if abs(wish) < LANE_CHANGE_THRESHOLD or edge.startswith(":") or not index.isdecimal():
        return None
    return max(0, int(index) + (1 if wish > 0 else -1))


def endpoint(numbers: Numbers, way: Path, station: float, fastest: float) -> Endpoint:
    """The endpoint of an adversary that is at a ``station`` [m] of its way; ``fastest``: its highest speed [m/s]."""
    ahead, left, speed, time = (float(v) for v in np.clip(numbers, -1.0, 1.0))
    far, seconds = _between(ahead, *ENDPOINT_AHEAD_M), _between(time, *ENDPOINT_TIME_S)
    x, y, heading = (float(v) for v in way.at(np.asarray(station + far), left * ENDPOINT_ASIDE_M))
    return Endpoint(x, y, wrap(heading), _between(speed, 0.0, fastest), seconds)


def _between(share: float, low: float, high: float) -> float:
    return low + (share + 1.0) / 2.0 * (high - low)


def controlled(numbers: Numbers, me: VehicleState, limits: Limits, fastest: float, dt: float) -> Pose:
    """The pose of an adversary after a step of acceleration and steering, within its limits.

    It moves on an arc of constant curvature, with even acceleration that changes no faster than the jerk allows.
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
