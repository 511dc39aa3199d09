"""Every weight of the search, with its unit and its reason. Scores are without unit: the lower, the better.

The values were found on suites that no table reports. ``SearchSettings`` is passed to whatever needs a part of it.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class ScoreSettings:
    """From a predicted motion to a score (``scoring.py``)."""

    unavoidable: float = 1.3  # a contact that no reference driver avoids
    miss: float = 1.5  # no contact; more for each second of TTC and each metre of distance
    miss_by_ttc: float = 0.3  # 1/s, up to 10 s
    miss_by_gap: float = 0.1  # 1/m, up to 30 m
    off_road: float = 3.0  # leaves the road before the contact
    beyond_limits: float = 3.0  # moves as no vehicle can
    third_party: float = 4.0  # touches another vehicle first
    rear_end: float = 5.0  # runs into the back of the ego
    failed: float = 9.0  # the planner failed
    warned: float = 0.3  # taken off ``unavoidable`` in proportion to the warning: it is nearly avoidable
    warned_enough: float = 2.0  # s of warning from which on all of it is taken off
    manoeuvre_delays: tuple[float, ...] = (0.6, 0.8, 1.0, 1.4)  # s from the hazard to the start of a manoeuvre
    by_manoeuvre: tuple[float, ...] = (1.0, 0.6, 0.47, 0.34)  # by the longest of these delays that still avoids
    sooner: tuple[float, ...] = (0.25, 0.5, 0.75, 1.0)  # s earlier at which the careful driver would avoid it:
    nearly: tuple[float, ...] = (0.24, 0.18, 0.12, 0.06)  # taken off, so that the search goes towards brakes
    by_careful: float = 0.08  # the careful driver avoids it
    by_late_careful: float = 0.0  # the careful driver avoids it even if it reacts ``slower``
    slower: float = 0.4  # s
    graze: float = 0.3  # m; a contact that a box this much smaller does not make may become a near miss,
    grazes: float = 0.14  # which costs this
    turn_error: float = 0.02  # rad that a turning ego may have turned more or less than predicted


@dataclass(frozen=True, slots=True)
class PriceSettings:
    """What else counts when the search chooses (``search.py``): added to a candidate's score."""

    braked: float = 0.09  # a lower nominal score: the careful driver avoids the contact by braking alone
    clear: float = 0.35  # taken off then: of all predictions these come true most often
    harsh: float = 0.4  # times the share of steps in which the adversary brakes: traffic hardly brakes
    late: float = 0.06  # 1/s until the predicted contact: the later, the less sure
    at_the_end: float = 0.3  # a contact at the very end, if the ego's driver is unknown: it may come too late
    spare: float = 2.0  # s before the end from which on that costs nothing
    tried: float = 0.12  # for each attempt with the same vehicle, intent and mode
    same_motion: float = 1.0  # for each attempt that was predicted to move in the same way
    rank: float = 0.3  # for each place in a model's ranking


@dataclass(frozen=True, slots=True)
class SamplingSettings:
    """How many candidates are drawn, and where (``sampling.py``)."""

    redraw: int = 150  # candidates drawn at once after the first ones
    nearest: int = 10  # number of best candidates that are varied
    spread: float = 0.12  # of a parameter's range: standard deviation of a variation
    for_brakes: int = 750  # drawn at most for a contact that a brake avoids, where a manoeuvre avoids one already
    most: int = 2000  # drawn at most where nothing is avoidable,
    for_each_attempt: int = 300  # and this many more for each attempt
    before_first_attempt: int = 14  # times ``proposals``: drawn at most before the first attempt


@dataclass(frozen=True, slots=True)
class RobustnessSettings:
    """How candidates are weighed together with neighbours (``robustness.py``)."""

    spread: float = 0.04  # of a parameter's range: standard deviation of a neighbour
    neighbours: int = 5
    worst: float = 1.5  # a neighbour's score above it (a miss, a rear-end) counts as this
    own: float = 0.5  # weight of a candidate's own score; the rest is the mean over it and its neighbours
    rounds: int = 4  # until the chosen candidate is robust
    first: int = 3  # candidates that get neighbours at once before the first attempt,
    later: int = 8  # and after it


@dataclass(frozen=True, slots=True)
class CorrectionSettings:
    """How observed motions of the ego change scores (``correction.py``)."""

    share: float = 0.5  # of what is left of a prediction's weight goes to the observation, for each surprise
    worst: float = 2.5  # a score above it (a miss by far, a rear-end) counts as this
    at_once: int = 300  # the best candidates that one surprise corrects
    repeated: int = 240  # the best candidates predicted again where another driver model is believed


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """All weights of the search.

    proposals: candidates drawn before the first ranking. share: attempts for the versions of a mode together.
    reaches, avoidable: lower scores mean a contact that counts, and an avoidable one. few: with fewer
    avoidable candidates, intents that the library lacks are composed. diverse_every: each time this number of attempts
    is reached, the template that was tried least has its turn.
    """

    proposals: int = 80
    share: int = 8
    reaches: float = 1.5
    avoidable: float = 0.75
    few: int = 5
    diverse_every: int = 3
    score: ScoreSettings = field(default_factory=ScoreSettings)
    price: PriceSettings = field(default_factory=PriceSettings)
    sampling: SamplingSettings = field(default_factory=SamplingSettings)
    robustness: RobustnessSettings = field(default_factory=RobustnessSettings)
    correction: CorrectionSettings = field(default_factory=CorrectionSettings)
