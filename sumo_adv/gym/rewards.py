"""What a step is worth. A reward is a function of a ``Transition``; give your own as ``reward=``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from sumo_adv.datatypes import Level, VehicleState, Verdict


@dataclass(frozen=True, slots=True)
class Transition:
    """One step of an environment, as a reward function gets it.

    seconds: that it lasted. ego, adversary: their states after it, None where it is gone or there is none. before: the
    ego's state before it. limit: the speed limit at the ego [m/s]. apart: from the ego's centre to the adversary's [m],
    0 only if their boxes overlap, inf without an adversary; apart_before: before the step. touched: the vehicle that
    the ego touches. off_road: an agent's vehicle, if its centre is off the road. ending: how the episode ended,
    empty while it goes on; see ``docs/gym.md``. verdict: on the attack, at the end of an episode with one.

    behind: how much less the ego has driven than in the same encounter unattacked, driven by SUMO's IDM [m], 0 if it
    has driven more; behind_before: before the step. unattacked: its speed there, now [m/s]. attacked: whether this
    episode has an adversary. followed: whether a vehicle in the ego's lane is at most 30 m behind it. delta_v: of the
    ego by the contact [m/s], 0 without one.
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

# of the ego, in seconds of driving at the speed limit
CONTACT_LOSS_S = 2.0  # loss by any contact,
LOSS_S_PER_DELTA_V = 4.0
"""And for each m/s of its delta-v: a serious one (2.24 m/s) costs 11, as much as standing for an episode."""
OFF_ROAD_LOSS_S = 20.0
BLOCKING_LOSS = 0.5  # a second, at less than half of the speed that it has unattacked, with a vehicle close behind
UNPENALISED_BRAKING_M_S2 = 2.0  # softer braking costs nothing,
NEEDLESS_BRAKING_LOSS = 0.1  # a second, for each m/s2 of harder braking where nothing attacks
MIN_SPEED_LIMIT_M_S = 10.0  # a lower speed limit counts as this

SERIOUS_COLLISION_GAIN = 10.0  # the adversary's gain by a serious collision
APPROACH_GAIN_PER_M = 0.02  # its gain for each metre nearer, at most: far below that of a collision


def ego_reward(t: Transition) -> float:
    """0 for driving as in the same encounter unattacked; what is lost against that, and the price of harm.

    A metre behind costs the time to drive it at the speed limit. Catching up wins it back.
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
    """Two for each level that the attack reaches (ten: serious), and a little for coming nearer before."""
    if t.ending:
        level = Level.NONE if t.verdict is None else t.verdict.level
        return SERIOUS_COLLISION_GAIN * level / Level.SERIOUS
    if t.adversary is None or t.ego is None:
        return 0.0
    return APPROACH_GAIN_PER_M * (t.apart_before - t.apart)
