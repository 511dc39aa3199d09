"""When a danger shows to the careful driver of the verdict, in words with its numbers for prompts."""

from __future__ import annotations

from sumo_adv.agents.prompts import Prompts
from sumo_adv.metrics.avoidance import DELAY
from sumo_adv.metrics.reference import brakers, cc_human


def danger_words(prompts: Prompts) -> str:
    """The rules by which a danger shows, and when the reference drivers then act."""
    numbers = {
        "perception": cc_human.PERCEPTION, "drift": cc_human.WANDERING, "reach": cc_human.DANGER,
        "hard": cc_human.HARD_BRAKING, "following": cc_human.FOLLOWING, "own": cc_human.OWN_BRAKING,
        "reaction": cc_human.REACTION, "facing": cc_human.FACING_SIGHT, "facing_margin": cc_human.FACING_MARGIN,
        "alarm": cc_human.ALARM_BRAKING, "short": cc_human.STOPPING_SHORT, "crossing": cc_human.CROSSING_SIGHT,
        "crossing_margin": cc_human.CROSSING_MARGIN, "ramp": brakers.RAMP, "full": round(brakers.FULL_BRAKING, 1),
        "steers": round(DELAY - cc_human.PERCEPTION, 2),
    }  # fmt: skip
    return prompts.piece("danger", **{name: f"{number:g}" for name, number in numbers.items()})
