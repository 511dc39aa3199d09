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


Reward = Callable[[Transition], float]

CRASH = 10.0  # the ego's loss by a contact or by leaving the road: as much as ten seconds of driving
ROUGH = 0.01  # a second, for each (m/s2)^2 of acceleration
BEST = 10.0  # the adversary's gain by a serious collision
NEARER = 0.02  # its gain for each metre nearer, at most: far below that of a collision


def ego_reward(t: Transition) -> float:
    """One a second at the speed limit or above, less for a lower speed and for rough driving; a crash costs ten."""
    if t.ego is None:
        return 0.0
    crashed = t.touched is not None or t.off_road == t.ego.id
    progress = min(t.ego.speed / max(t.limit, 1.0), 1.0)
    acceleration = (t.ego.speed - t.before.speed) / t.seconds if t.seconds else 0.0
    return (progress - ROUGH * acceleration**2) * t.seconds - (CRASH if crashed else 0.0)


def adversary_reward(t: Transition) -> float:
    """Two for each level that the attack reaches (ten: serious), and a little for coming nearer before."""
    if t.ending:
        level = Level.NONE if t.verdict is None else t.verdict.level
        return BEST * level / Level.SERIOUS
    if t.adversary is None or t.ego is None:
        return 0.0
    return NEARER * (t.apart_before - t.apart)
