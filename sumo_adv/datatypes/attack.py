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
    """What an adversary does in an attack. Exactly one is the collider; the others support it."""

    COLLIDER = "collider"  # it is to collide with the ego
    BLOCK_LEFT = "block_left"  # it takes the room into which the ego would swerve to the left
    BLOCK_RIGHT = "block_right"  # the same to the right
    SLOW = "slow"  # it holds the ego up from ahead
    HIDE = "hide"  # it keeps between the ego and the collider
    OPEN = "open"  # it makes room into which the collider can go


MAX_ADVERSARIES = 3  # of an attack: a collider and two supports


class Relation(StrEnum):
    """How a background vehicle stands to the ego when an encounter begins."""

    LEADER = "leader"  # ahead of the ego in its lane
    FOLLOWER = "follower"  # behind it in its lane
    NEIGHBOUR = "neighbour"  # in a lane beside, the same way
    ONCOMING = "oncoming"  # beyond the centre line
    CROSSING = "crossing"  # on a path that crosses the ego's
    MERGING = "merging"  # on a path that joins the ego's


@dataclass(frozen=True, slots=True)
class ModeChoice:
    """One way to carry an intent out, as an analyzer chose it: the planner's mode, some or all of its numbers, and the
    start, ``delay`` [s] after the trigger."""

    mode: str
    parameters: Mapping[str, float]
    delay: float


@dataclass(frozen=True, slots=True)
class Intent:
    """What an adversary tries: the paper's phi with y_acc. ``acceleration``: see ``Acceleration``. ``ways``: how, in
    the order in which to try them; empty where the analyzer leaves that open."""

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
    """One number a planner may be tuned by. ``low <= default <= high``."""

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
    """Python text that computes an endpoint: the paper's f_phi, one mode of one intent."""

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
        """Parameter values as the planner's author set them."""
        return {p.name: p.default for p in self.parameters}


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Where the adversary should be, and when: y_T in the paper. World frame; ``time`` in s from now."""

    x: float
    y: float
    heading: float
    speed: float
    time: float


@dataclass(frozen=True, slots=True)
class Prediction:
    """What the rollout of a candidate comes to. Times in s, distances in m.

    failure: why the planner failed; the other fields then mean nothing. hit: whether ego and adversary touch.
    min_ttc, gap: least time to collision and least distance of the boxes up to the contact. time: until the contact, or
    until the end. warning: from the alarm of ``cc_human`` to the contact. braking: share of the steps up to the contact
    in which the adversary brakes. level: that the collision reaches, by the reference drivers ``careful`` (cc_human)
    and ``manoeuvre``, which avoid it or not; delta_v: of the ego [m/s]; acceleration: the adversary's largest [m/s2];
    human: it stays within the human envelope; side: of the ego that is hit. third_party, off_road, beyond_limits: why
    the contact does not count.
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
        """Whether the candidate fails whatever the ego does."""
        return bool(self.failure) or self.third_party or self.off_road or self.beyond_limits


@dataclass(frozen=True, slots=True)
class Arrival:
    """How the ego arrives when an attack begins, compared with the encounter as it was found.

    earlier: by how much it is ahead of its place, in time [s]; negative = behind. pace: its speed over the speed found.
    """

    earlier: float = 0.0
    pace: float = 1.0


AS_FOUND = Arrival()


@dataclass(frozen=True, slots=True)
class Proposal:
    """One candidate: which vehicle, with which planner and parameters, how long after the trigger.

    ``course``: driven as it stands instead of by the planner, which then only names the author. ``score``: what the
    search goes by, lower is better. ``duty``: what the vehicle does in the attack; ``supports``: what the other
    adversaries do, each a candidate of its own with the same delay and without supports. ``composition``: the label of
    the composed intent that they carry out together, empty for a single adversary. ``arrival``: how the ego arrives,
    other than found only in a neighbour of an attack.
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

    def as_adversary(self) -> dict[str, str]:
        """What the vehicle does in the attack, as files and events have it."""
        return {"id": self.bv, "role": str(self.duty), "intent": self.label, "mode": self.planner.mode}

    def unscored(self) -> Proposal:
        """The same candidate without what was predicted of it; ``score`` then means nothing."""
        return replace(self, prediction=None)

    @property
    def family(self) -> tuple[str, str, str]:
        """What the tuner spreads its tries over: vehicle, intent and mode, and the composition if there is one."""
        return (self.bv, self.composition or self.label, self.planner.mode)


@dataclass(frozen=True, slots=True)
class NamedScenario:
    """What an attempt shows, in the names of three lists (``scenario_names.py``).

    Attributes:
        motion: What the adversary does, in a few words.
        nhtsa: The number of the pre-crash scenario in NHTSA's typology, None if none fits.
        iso_34502: The traffic disturbance of ISO 34502, empty at crossings and if none fits.
        euro_ncap: The scenario of Euro NCAP, empty if none fits.
    """

    motion: str
    nhtsa: int | None = None
    iso_34502: str = ""
    euro_ncap: str = ""


@dataclass(frozen=True, slots=True)
class Attempt:
    """One closed-loop run against the real ego."""

    index: int
    phase: str  # tuner | analyzer | modifier
    proposal: Proposal
    trigger_time: float
    verdict: Verdict
    ending: str  # contact | passed | time_limit | ego_left | ego_lost | planner_failed | crashed
    message: str = ""
    diagnosis: Diagnosis | None = None
    kind: str = ""  # intent, relation and side of the ego that is hit
    scenario: NamedScenario | None = None  # what it shows; None if the ego or the adversary was gone at once


@dataclass(frozen=True, slots=True)
class LibraryEntry:
    """One intent of the behaviour library with its planners. ``applies``: relations it can be tried from."""

    label: str
    description: str
    applies: tuple[str, ...]
    planners: tuple[Planner, ...]
    source: str = "memory"  # memory | generated
