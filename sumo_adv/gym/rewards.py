"""Rewards of a step. A reward is a function of a ``Transition``; pass your own as ``reward=``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sumo_adv.datatypes import Level, VehicleState, Verdict


@dataclass(frozen=True, slots=True)
class Transition:
    """One step of an environment, as a reward function gets it.

    Attributes:
        seconds: The duration of the step [s].
        ego: The ego's state after the step; None if it is gone.
        before: The ego's state before the step.
        adversary: The adversary's state after the step; None if it is gone or there is none.
        limit: The speed limit at the ego [m/s].
        apart: The distance from the ego's centre to the adversary's after the step [m]; 0 only if their boxes overlap,
            inf without an adversary.
        apart_before: The same before the step [m].
        touched: The vehicle that the ego touches; None if there is none.
        off_road: The agent's vehicle whose centre is off the road; None if there is none.
        ending: How the episode ended (``docs/gym.md``); empty while it continues.
        verdict: The verdict on the attack, at the end of an episode with one.
        behind: How much less the ego has driven than in the same encounter without an attack, driven by SUMO's IDM [m];
            0 if it has driven more.
        behind_before: The same before the step [m].
        unattacked: The ego's current speed without an attack [m/s].
        attacked: Whether the episode has an adversary.
        followed: Whether a vehicle in the ego's lane is at most 30 m behind it.
        delta_v: The ego's delta-v by the contact [m/s]; 0 without one.
    """

    seconds: float
    ego: VehicleState | None
    before: VehicleState
    adversary: VehicleState | None
    limit: float
    apart: float
    apart_before: float
    touched: str | None
    off_road: str | None
    ending: str = ""
    verdict: Verdict | None = None
    behind: float = 0.0
    behind_before: float = 0.0
    unattacked: float = 0.0
    attacked: bool = False
    followed: bool = False
    delta_v: float = 0.0


Reward = Callable[[Transition], float]

# the ego's rewards, in seconds of driving at the speed limit
CONTACT_LOSS_S = 2.0  # loss for any contact
LOSS_S_PER_DELTA_V = 4.0
"""The additional loss for each m/s of the contact's delta-v.

A serious contact (2.24 m/s) costs 11, as much as standing for an episode.
"""
OFF_ROAD_LOSS_S = 20.0
BLOCKING_LOSS = 0.5  # per second at less than half of its unattacked speed, with a vehicle close behind
UNPENALISED_BRAKING_M_S2 = 2.0  # softer braking costs nothing
NEEDLESS_BRAKING_LOSS = 0.1  # per second and m/s2 of harder braking, if nothing attacks
MIN_SPEED_LIMIT_M_S = 10.0  # lower speed limits are raised to this

SERIOUS_COLLISION_GAIN = 10.0  # the adversary's gain for a serious collision
APPROACH_GAIN_PER_M = 0.02  # its gain for each metre of approach; far below that for a collision


def ego_reward(t: Transition) -> float:
    """Return the ego's reward: 0 for driving as in the same encounter without an attack, minus losses and harm.

    Falling a metre behind costs the time to drive it at the speed limit. Catching up wins it back.

    Args:
        t: The step.
    """
    if t.ego is None:
        return 0.0
    worth = (t.behind_before - t.behind) / max(t.limit, MIN_SPEED_LIMIT_M_S)
    braking = (t.before.speed - t.ego.speed) / t.seconds if t.seconds else 0.0
    if not t.attacked:
        worth -= NEEDLESS_BRAKING_LOSS * max(braking - UNPENALISED_BRAKING_M_S2, 0.0) * t.seconds
    if t.followed and t.ego.speed < t.unattacked / 2:
        worth -= BLOCKING_LOSS * t.seconds
    if t.touched is not None:
        worth -= CONTACT_LOSS_S + LOSS_S_PER_DELTA_V * t.delta_v
    return worth - (OFF_ROAD_LOSS_S if t.off_road == t.ego.id else 0.0)


def adversary_reward(t: Transition) -> float:
    """Return the adversary's reward: two for each level that the attack reaches (ten: serious), and a little for
    approaching.

    Args:
        t: The step.
    """
    if t.ending:
        level = Level.NONE if t.verdict is None else t.verdict.level
        return SERIOUS_COLLISION_GAIN * level / Level.SERIOUS
    if t.adversary is None or t.ego is None:
        return 0.0
    return APPROACH_GAIN_PER_M * (t.apart_before - t.apart)
