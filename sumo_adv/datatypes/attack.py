"""Intents, planners, candidates and attempts."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import lru_cache

from sumo_adv.datatypes.motion import Acceleration, PrescribedMotion
from sumo_adv.datatypes.verdict import Diagnosis, Level, Verdict


class Duty(StrEnum):
    """What an adversary does in an attack. Exactly one adversary is the collider; the others attack as well, or support
    it."""

    COLLIDER = "collider"  # it tries to collide with the ego
    ATTACK = "attack"  # it tries the same, with an intent and a planner of its own
    PLAY = "play"  # it plays the part that the scene gives it, with an intent and a planner of its own
    BLOCK_LEFT = "block_left"  # it takes the room into which the ego would swerve to the left
    BLOCK_RIGHT = "block_right"  # the same to the right
    SLOW = "slow"  # it holds the ego up from ahead
    HIDE = "hide"  # it keeps between the ego and the collider
    OPEN = "open"  # it makes room into which the collider can go


MAX_ADVERSARIES = 3  # in one attack: a collider and two others
MAX_WAIT_S = 3.0  # how long an attacker may wait after the start of the attack


class Relation(StrEnum):
    """Where a background vehicle is relative to the ego when an encounter begins."""

    LEADER = "leader"  # ahead of the ego in its lane
    FOLLOWER = "follower"  # behind it in its lane
    NEIGHBOUR = "neighbour"  # in an adjacent lane of the same direction
    ONCOMING = "oncoming"  # beyond the centre line
    CROSSING = "crossing"  # on a path that crosses the ego's
    MERGING = "merging"  # on a path that joins the ego's


@dataclass(frozen=True, slots=True)
class ModeChoice:
    """One way to carry out an intent, as an analyzer chose it.

    Attributes:
        mode: The planner's mode.
        parameters: Values of some or all of the planner's parameters, by name.
        delay: The start of the attack after the trigger [s].
    """

    mode: str
    parameters: Mapping[str, float]
    delay: float


@dataclass(frozen=True, slots=True)
class Intent:
    """What an adversary tries to do: the paper's phi with y_acc.

    Attributes:
        bv: The id of the background vehicle.
        label: The name of the intent.
        description: The intent in words.
        risk: How dangerous the analyzer considers it: low, medium or high.
        acceleration: The intended acceleration [m/s2].
        reason: Why the analyzer chose it.
        source: Where the intent comes from: memory or generated.
        ways: Ways to carry it out, in the order in which to try them. It is empty if the analyzer leaves that open.
    """

    bv: str
    label: str
    description: str
    risk: str  # low | medium | high
    acceleration: Acceleration
    reason: str = ""
    source: str = "memory"  # memory | generated
    ways: tuple[ModeChoice, ...] = ()


@dataclass(frozen=True, slots=True)
class Parameter:
    """One numeric parameter of a planner, with ``low <= default <= high``."""

    name: str
    default: float
    low: float
    high: float
    unit: str
    meaning: str = ""


@lru_cache(maxsize=1024)
def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class Planner:
    """Python source that computes an endpoint: the paper's f_phi. A planner is one mode of one intent."""

    label: str
    mode: str
    text: str
    parameters: tuple[Parameter, ...]
    origin: str  # seed | expert | a model's name | person
    parent: str | None = None

    @property
    def hash(self) -> str:
        """SHA-256 of the text, hexadecimal."""
        return _sha256(self.text)

    def defaults(self) -> dict[str, float]:
        """Return the default parameter values, by name."""
        return {p.name: p.default for p in self.parameters}


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Where the adversary should be, and when: y_T in the paper.

    Attributes:
        x: The x position in the world frame [m].
        y: The y position in the world frame [m].
        heading: The heading [rad].
        speed: The speed [m/s].
        time: The time from now [s].
    """

    x: float
    y: float
    heading: float
    speed: float
    time: float


@dataclass(frozen=True, slots=True)
class Prediction:
    """The outcome that the rollout of a candidate predicts.

    Attributes:
        failure: Why the planner failed, or empty. After a failure, the other fields have no meaning.
        hit: Whether the ego and the adversary touch.
        min_ttc: The minimum TTC up to the contact or the end [s].
        gap: The distance between the boxes when their centres are nearest, up to the contact or the end [m].
        time: The time until the contact or, if there is none, until the end [s].
        warning: The time from the alarm of ``cc_human`` to the contact [s].
        braking: The share of the steps up to the contact in which the adversary brakes.
        level: The level that the collision reaches.
        delta_v: The ego's delta-v [m/s].
        acceleration: The adversary's largest acceleration [m/s2].
        human: Whether the adversary stays within the human envelope.
        careful: Whether the reference driver ``cc_human`` avoids the collision.
        manoeuvre: Whether the reference driver ``manoeuvre`` avoids the collision.
        side: The side of the ego that is hit.
        third_party: Whether a third party is involved, so that the contact does not count.
        off_road: Whether an adversary leaves the road, so that the contact does not count.
        beyond_limits: Whether an adversary exceeds the limits, so that the contact does not count.
    """

    failure: str = ""
    hit: bool = False
    min_ttc: float = math.inf
    gap: float = math.inf
    time: float = 0.0
    warning: float = 0.0
    braking: float = 0.0
    level: Level = Level.NONE
    delta_v: float = 0.0
    acceleration: float = 0.0
    human: bool = True
    careful: bool = False
    manoeuvre: bool = False
    side: str = ""
    third_party: bool = False
    off_road: bool = False
    beyond_limits: bool = False

    @property
    def hopeless(self) -> bool:
        """Whether the candidate fails, however the ego reacts."""
        return bool(self.failure) or self.third_party or self.off_road or self.beyond_limits


@dataclass(frozen=True, slots=True)
class Arrival:
    """How the ego arrives when an attack begins, compared with the encounter as it was found.

    Attributes:
        earlier: How far the ego is ahead of its original place, in time [s]; negative if it is behind.
        pace: The ratio of the ego's speed to its original speed.
    """

    earlier: float = 0.0
    pace: float = 1.0


AS_FOUND = Arrival()


@dataclass(frozen=True, slots=True)
class Proposal:
    """One candidate: a vehicle, a planner with parameter values, and a start time.

    Attributes:
        bv: The id of the background vehicle.
        label: The label of the intent.
        planner: The planner that drives the vehicle.
        parameters: The planner's parameter values, by name.
        acceleration: The intended acceleration [m/s2].
        delay: The start of the attack after the trigger [s].
        by: What proposed the candidate.
        score: The search's score; lower is better.
        prediction: The predicted outcome, or None.
        course: A motion that is driven as given, or None. If there is one, the planner only names its author.
        duty: What the vehicle does in the attack.
        wait: How long after the start of the attack the planner is asked for the first time [s]. Until then, the
            vehicle goes straight on in its lane at its speed.
        supports: The candidates of the other adversaries, other attackers included. Each has the same delay and no
            supports.
        composition: The label of the composed intent that all adversaries carry out together; empty for a single one.
        arrival: How the ego arrives. It differs from ``AS_FOUND`` only in a neighbour of an attack.
    """

    bv: str
    label: str
    planner: Planner
    parameters: Mapping[str, float]
    acceleration: Acceleration
    delay: float  # s after the trigger
    by: str = "tuner"
    score: float = float("nan")
    prediction: Prediction | None = None
    course: PrescribedMotion | None = None
    duty: Duty = Duty.COLLIDER
    wait: float = 0.0  # s after the delay
    supports: tuple[Proposal, ...] = ()
    composition: str = ""
    arrival: Arrival = AS_FOUND

    @property
    def members(self) -> tuple[Proposal, ...]:
        """All adversaries, the collider first."""
        return (self, *self.supports)

    @property
    def bvs(self) -> tuple[str, ...]:
        """The ids of all adversaries, the collider's first."""
        return tuple(p.bv for p in self.members)

    @property
    def attackers(self) -> tuple[str, ...]:
        """The ids of the adversaries that attack, the collider's first; supports are not among them."""
        return tuple(p.bv for p in self.members if p.duty in (Duty.COLLIDER, Duty.ATTACK))

    def led_by(self, bv: str) -> Proposal:
        """Return the same attack with another one of its attackers as the collider.

        Args:
            bv: The id of the attacker.
        """
        if bv == self.bv:
            return self
        lead = next(p for p in self.supports if p.bv == bv)
        alone = replace(self, duty=Duty.ATTACK, supports=(), composition="")
        return replace(
            self, bv=bv, label=lead.label, planner=lead.planner, parameters=lead.parameters,
            acceleration=lead.acceleration, course=lead.course, wait=lead.wait,
            supports=(alone, *(p for p in self.supports if p.bv != bv)),
        )  # fmt: skip

    def without(self, bv: str) -> Proposal:
        """Return the attack without one of the adversaries that are not the collider.

        Args:
            bv: The id of that adversary.
        """
        return replace(self, supports=tuple(p for p in self.supports if p.bv != bv))

    def as_adversary(self) -> dict[str, str]:
        """Return the vehicle's id, role, intent and mode as files and events contain them."""
        return {"id": self.bv, "role": str(self.duty), "intent": self.label, "mode": self.planner.mode}

    def unscored(self) -> Proposal:
        """Return the same candidate without its prediction. The ``score`` of the result has no meaning."""
        return replace(self, prediction=None)

    @property
    def family(self) -> tuple[str, str, str]:
        """The group over which the tuner spreads its attempts: vehicle, composition (or else the intent), and mode."""
        return (self.bv, self.composition or self.label, self.planner.mode)


@dataclass(frozen=True, slots=True)
class NamedScenario:
    """The scenario that an attempt shows, named by three catalogues (``scenario_names.py``).

    Attributes:
        motion: What the adversary does, in a few words.
        nhtsa: The number of the pre-crash scenario in NHTSA's typology, or None if none fits.
        iso_34502: The traffic disturbance of ISO 34502. It is empty at crossings and if none fits.
        euro_ncap: The scenario of Euro NCAP, or empty if none fits.
    """

    motion: str
    nhtsa: int | None = None
    iso_34502: str = ""
    euro_ncap: str = ""


@dataclass(frozen=True, slots=True)
class Attempt:
    """One closed-loop simulation of a candidate against the real ego."""

    index: int
    phase: str  # tuner | analyzer | modifier
    proposal: Proposal
    trigger_time: float
    verdict: Verdict
    ending: str  # contact | passed | time_limit | ego_left | ego_lost | planner_failed | crashed
    message: str = ""
    diagnosis: Diagnosis | None = None
    kind: str = ""  # intent, relation and side of the ego that is hit
    scenario: NamedScenario | None = None  # None if the ego or the adversary left at once


@dataclass(frozen=True, slots=True)
class LibraryEntry:
    """One intent of the behaviour library with its planners.

    Attributes:
        label: The name of the intent.
        description: The intent in words.
        applies: The relations from which the intent can be tried.
        planners: Its planners.
        source: Where the intent comes from: memory or generated.
    """

    label: str
    description: str
    applies: tuple[str, ...]
    planners: tuple[Planner, ...]
    source: str = "memory"  # memory | generated
