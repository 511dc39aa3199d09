"""All weights of the search, with their units and reasons. Scores have no unit; lower is better.

The values were tuned on suites that no table reports. ``SearchSettings`` is passed to every part that needs some of
them.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from sumo_adv.datatypes import Level

FULL_WARNING_S = 2.0  # from the alarm of ``cc_human`` to the contact; longer makes a collision no more avoidable
MAX_COUNTED_TTC_S, MAX_COUNTED_DISTANCE_M = 10.0, 30.0  # larger values are capped to these


@dataclass(frozen=True, slots=True)
class ScoreSettings:
    """How a predicted motion becomes a score (``scoring.py``)."""

    serious: float = 0.0  # the best score of each level
    strict: float = 0.3
    valid: float = 0.6
    collision: float = 0.9  # a contact that no reference driver avoids
    no_warning: float = 1.3  # a contact before which no danger shows
    miss: float = 1.5  # no contact; each second of TTC and each metre of distance adds to this
    miss_by_ttc: float = 0.3  # 1/s, up to ``MAX_COUNTED_TTC_S``
    miss_by_gap: float = 0.1  # 1/m, up to ``MAX_COUNTED_DISTANCE_M``
    near_miss: float = 1.0  # misses up to this much above ``miss`` are tried until an attempt is critical
    too_mild: float = 0.3  # added to a miss, times the missing share of the wanted delta-v
    contact: float = 0.3  # added to a miss for a contact, if a near miss is wanted
    off_road: float = 3.0  # leaves the road before the contact
    beyond_limits: float = 3.0  # moves as no vehicle can
    third_party: float = 4.0  # touches another vehicle first
    rear_end: float = 5.0  # runs into the back of the ego
    failed: float = 9.0  # the planner failed
    to_delta_v: float = 0.2  # added to a strict collision, times the missing share of a serious delta-v
    not_human: float = 0.06  # added to a strict collision if no human would drive like that
    to_warning: float = 0.2  # added to lower levels, times the missing share of ``warned_enough``
    to_delta_v_early: float = 0.05  # added to a valid collision, times the missing share of a serious delta-v
    warned_enough: float = FULL_WARNING_S  # s


@dataclass(frozen=True, slots=True)
class PriceSettings:
    """What is added to a candidate's score when the search chooses (``search.py``)."""

    harsh: float = 0.1  # times the share of steps in which the adversary brakes; traffic rarely brakes
    late: float = 0.02  # 1/s until the predicted contact; later contacts are less certain
    tried: float = 0.12  # for each attempt with the same vehicle, intent and mode
    rank: float = 0.03  # for each place in a model's ranking


@dataclass(frozen=True, slots=True)
class SamplingSettings:
    """How many candidates are drawn, and where (``sampling.py``)."""

    redraw: int = 150  # candidates drawn at once after the first ones
    nearest: int = 10  # number of best candidates that are varied
    spread: float = 0.12  # standard deviation of a variation, as a share of a parameter's range
    more: int = 450  # maximum number drawn after the first ones, if none reaches the goal with a margin
    around_chosen: int = 5  # variations of each candidate that a language model chose
    supported: int = 24  # candidates with a support drawn for each of the ``nearest``


@dataclass(frozen=True, slots=True)
class EvolutionSettings:
    """How candidates are drawn, and varied by the verdicts on attempts (``evolution.py``).

    Steps are shares of a parameter's range.
    """

    first: int = 48  # minimum number of candidates of generation 0
    anew: float = 0.25  # share of later candidates that are sampled from scratch
    parents: int = 10  # number of best elites that are varied
    pressure: float = 0.75  # weight of each of them, relative to the one before it
    step: float = 0.12  # standard deviation of a cell's first variations
    least_step: float = 0.02
    most_step: float = 0.3
    grow: float = 1.5  # step factor after a variation that is better than its parent
    shrink: float = 0.9  # step factor after one that is not; the step is steady if one in five is better
    near: float = 0.08  # standard deviation of the weights of nearby attempts in an elite's rating; 0: no averaging
    other_start: float = 0.2  # share of variations with another start
    accompany: float = 0.5  # share of candidates that gain or lose a support, if several adversaries are allowed
    support: float = 0.03  # price of each support; fewer adversaries are more likely in traffic


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """All weights of the search.

    Attributes:
        proposals: The number of candidates drawn before the first ranking.
        share: The maximum number of attempts for all versions of a mode together.
        reaches: Scores below this mean a contact that counts.
        avoidable: Scores below this mean an avoidable contact.
        spare: No better candidate is searched for once a score is this far below the one the goal's level needs.
        few: With fewer avoidable candidates, intents that the library lacks are composed.
        predicted: The maximum number of attempts that are chosen by prediction. Later ones vary attempts.
        score: How a prediction becomes a score.
        price: What is added to a score when the search chooses.
        sampling: How many candidates are drawn, and where.
        evolution: How candidates are varied by the verdicts on attempts.
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
        """Return the score below which a candidate promises more than a level.

        Args:
            reached: The level that attempts have reached.
        """
        weights = self.score
        near = weights.miss + weights.near_miss
        return {
            Level.NONE: near, Level.CRITICAL: weights.miss, Level.COLLISION: weights.collision,
            Level.VALID: weights.valid, Level.STRICT: weights.strict, Level.SERIOUS: weights.serious,
        }[reached]  # fmt: skip
