"""Every weight of the search, with its unit and its reason. Scores are without unit: the lower, the better.

The values were found on suites that no table reports. ``SearchSettings`` is passed to whatever needs a part of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from sumo_adv.datatypes import Level

FULL_WARNING_S = 2.0  # from the alarm of ``cc_human`` to the contact: more makes a collision no more avoidable
MAX_COUNTED_TTC_S, MAX_COUNTED_DISTANCE_M = 10.0, 30.0  # what is farther from a contact counts as this


@dataclass(frozen=True, slots=True)
class ScoreSettings:
    """From a predicted motion to a score (``scoring.py``)."""

    serious: float = 0.0  # where each level begins
    strict: float = 0.3
    valid: float = 0.6
    collision: float = 0.9  # a contact that no reference driver avoids
    no_warning: float = 1.3  # a contact before which no danger shows
    miss: float = 1.5  # no contact; more for each second of TTC and each metre of distance
    miss_by_ttc: float = 0.3  # 1/s, up to ``MAX_COUNTED_TTC_S``
    miss_by_gap: float = 0.1  # 1/m, up to ``MAX_COUNTED_DISTANCE_M``
    near_miss: float = 1.0  # a miss that costs no more is tried, as long as no attempt has been critical
    too_mild: float = 0.3  # added to a miss: the share of the delta-v that is wanted and missing
    contact: float = 0.3  # added to a miss where a near miss is wanted
    off_road: float = 3.0  # leaves the road before the contact
    beyond_limits: float = 3.0  # moves as no vehicle can
    third_party: float = 4.0  # touches another vehicle first
    rear_end: float = 5.0  # runs into the back of the ego
    failed: float = 9.0  # the planner failed
    to_delta_v: float = 0.2  # added to a strict one: the share of a serious delta-v that is missing
    not_human: float = 0.06  # added to a strict collision if no person would drive so
    to_warning: float = 0.2  # added to lower ones: the share of ``warned_enough`` that is missing
    to_delta_v_early: float = 0.05  # added to a valid one: the share of a serious delta-v that is missing
    warned_enough: float = FULL_WARNING_S


@dataclass(frozen=True, slots=True)
class PriceSettings:
    """What else counts when the search chooses (``search.py``): added to a candidate's score."""

    harsh: float = 0.1  # times the share of steps in which the adversary brakes: traffic hardly brakes
    late: float = 0.02  # 1/s until the predicted contact: the later, the less sure
    tried: float = 0.12  # for each attempt with the same vehicle, intent and mode
    rank: float = 0.03  # for each place in a model's ranking


@dataclass(frozen=True, slots=True)
class SamplingSettings:
    """How many candidates are drawn, and where (``sampling.py``)."""

    redraw: int = 150  # candidates drawn at once after the first ones
    nearest: int = 10  # number of best candidates that are varied
    spread: float = 0.12  # of a parameter's range: standard deviation of a variation
    more: int = 450  # drawn at most beside the first ones, where none reaches the goal with something to spare
    around_chosen: int = 5  # variations of each candidate that a model chose
    supported: int = 24  # candidates with a support that are drawn from each of the ``nearest``


@dataclass(frozen=True, slots=True)
class EvolutionSettings:
    """How candidates are drawn and varied by what attempts came to (``evolution.py``). Steps are shares of a
    parameter's range."""

    first: int = 48  # candidates of generation 0 at least
    anew: float = 0.25  # share of later candidates that are drawn anew
    parents: int = 10  # best elites that are varied,
    pressure: float = 0.75  # each this much less often than the one before it
    step: float = 0.12  # standard deviation of a cell's first variations
    least_step: float = 0.02
    most_step: float = 0.3
    grow: float = 1.5  # after a variation that is better than its parent,
    shrink: float = 0.9  # and after one that is not: steady at one better one in five
    near: float = 0.08  # attempts within about this share of the ranges count for an elite's worth; 0: its own alone
    other_start: float = 0.2  # share of variations with another start
    accompany: float = 0.5  # where several adversaries are allowed: share of candidates with a support more or fewer
    support: float = 0.03  # the price of each support: fewer adversaries are more likely in traffic


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """All weights of the search.

    proposals: candidates drawn before the first ranking. share: attempts for the versions of a mode together, where a
    modifier may write new ones. reaches, avoidable: lower scores mean a contact that counts, and an avoidable one.
    spare: what a candidate's score must be below that of its level, so that no better one is looked for. few: with
    fewer avoidable candidates, intents that the library lacks are composed. predicted: attempts at most
    that are chosen by prediction; later ones vary attempts.
    """

    proposals: int = 80
    share: int = 8
    reaches: float = 1.5
    avoidable: float = 0.9
    spare: float = 0.15
    few: int = 5
    predicted: int = 3
    score: ScoreSettings = field(default_factory=ScoreSettings)
    price: PriceSettings = field(default_factory=PriceSettings)
    sampling: SamplingSettings = field(default_factory=SamplingSettings)
    evolution: EvolutionSettings = field(default_factory=EvolutionSettings)

    def bound(self, reached: Level) -> float:
        """The score below which a candidate promises more than the level ``reached``."""
        weights = self.score
        near = weights.miss + weights.near_miss
        return {
            Level.NONE: near, Level.CRITICAL: weights.miss, Level.COLLISION: weights.collision,
            Level.VALID: weights.valid, Level.STRICT: weights.strict, Level.SERIOUS: weights.serious,
        }[reached]  # fmt: skip
