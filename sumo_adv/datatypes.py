"""The nouns. SI units, headings in rad counter-clockwise from +x in (-pi, pi], positions are box centres.

Nothing here imports anything of the project, and everything is frozen: a part that changes something returns a new
value.  Arrays inside a noun are never written to after it was made.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum, StrEnum
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.intp]
Acceleration = float | tuple[tuple[float, float], ...]
"""m/s2: a number, or 1 to ``MAX_KNOTS`` knots (s since the takeover, m/s2); linear between, constant outside."""

MAX_KNOTS = 4
MPH_M_S = 0.44704  # one mile per hour


class Role(StrEnum):
    """What a vehicle is in a run."""

    EGO = "ego"
    ADVERSARY = "adversary"
    BACKGROUND = "background"
    OBSTACLE = "obstacle"


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


class Ending(StrEnum):
    """How an episode ended; ``ENDING_SENTENCES`` says it in words."""

    CRITICAL = "critical"
    ATTEMPTS_EXHAUSTED = "attempts_exhausted"
    NO_ENCOUNTER = "no_encounter"
    EGO_LEFT = "ego_left"
    EGO_LOST = "ego_lost"
    MODEL_FAILED = "model_failed"
    BUDGET_EXHAUSTED = "budget_exhausted"
    PLANNER_FAILED = "planner_failed"
    SIMULATION_FAILED = "simulation_failed"
    INTERRUPTED = "interrupted"


ENDING_SENTENCES: Mapping[Ending, str] = {
    Ending.CRITICAL: "An attempt met the criterion.",
    Ending.ATTEMPTS_EXHAUSTED: "No attempt met the criterion.",
    Ending.NO_ENCOUNTER: "No encounter worth attacking was found in the time given.",
    Ending.EGO_LEFT: "The ego left the network before an encounter.",
    Ending.EGO_LOST: "The ego's controller was lost.",
    Ending.MODEL_FAILED: "The language model failed.",
    Ending.BUDGET_EXHAUSTED: "The budget of model calls, tokens or seconds is used up.",
    Ending.PLANNER_FAILED: "No planner could be run.",
    Ending.SIMULATION_FAILED: "The simulation failed.",
    Ending.INTERRUPTED: "The run was interrupted.",
}


FAILED_ENDINGS = frozenset({
    Ending.SIMULATION_FAILED, Ending.PLANNER_FAILED, Ending.MODEL_FAILED, Ending.BUDGET_EXHAUSTED, Ending.EGO_LOST,
    Ending.INTERRUPTED,
})  # fmt: skip
"""Endings of episodes that failed: they say nothing about the ego."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of an adversary's motion: those of a passenger car. Settings can change them."""

    braking: float = 8.0  # m/s2, positive
    acceleration: float = 4.0  # m/s2
    lateral: float = 4.0  # m/s2
    curvature: float = 0.2  # 1/m
    jerk: float = 12.0  # m/s3, longitudinal


def acceleration_at(acceleration: Acceleration, time: float) -> float:
    """The number [m/s2] that holds ``time`` [s] after the takeover."""
    if not isinstance(acceleration, tuple):
        return float(acceleration)
    times, values = zip(*acceleration, strict=True)
    return float(np.interp(time, times, values))


def acceleration_of(value: Any, limits: Limits | None = None) -> Acceleration:
    """An acceleration from what JSON holds: a number or a list of [time, m/s2]. Raises ValueError: it is neither, or
    beyond the limits where they are given; with a sentence."""
    knots = value if isinstance(value, list | tuple) else [[0.0, value]]
    if not 1 <= len(knots) <= MAX_KNOTS or not all(isinstance(k, list | tuple) and len(k) == 2 for k in knots):
        raise ValueError(f"acceleration must be a number or 1 to {MAX_KNOTS} knots [time, acceleration].")
    if not all(isinstance(n, int | float) and not isinstance(n, bool) and abs(n) < 1e6 for k in knots for n in k):
        raise ValueError("acceleration must be made of finite numbers.")
    times = [k[0] for k in knots]
    if times[0] < 0 or sorted(set(times)) != times:
        raise ValueError("The times of the acceleration knots must be 0 or more, and ascending.")
    if limits is not None:
        low, high = -limits.braking, limits.acceleration
        worst = next((k[1] for k in knots if not low <= k[1] <= high), None)
        if worst is not None:
            raise ValueError(f"The acceleration {worst:g} m/s2 is beyond the limits, {low:g} to {high:g}.")
    return tuple((float(t), float(a)) for t, a in knots) if isinstance(value, list | tuple) else float(value)


def plain_acceleration(acceleration: Acceleration) -> float | list[list[float]]:
    """An acceleration as JSON has it: a number or a list of [time, m/s2]."""
    return [list(k) for k in acceleration] if isinstance(acceleration, tuple) else acceleration


@dataclass(frozen=True, slots=True)
class Boxes:
    """Oriented, moving boxes. All arrays broadcast against one another (any shape, often ``(time,)`` or ``(n, time)``).
    x, y: centre [m]; heading [rad]; speed [m/s] along the heading; length, width [m]; z: height of the road under it
    [m], a number where all is flat (see ``geometry.same_layer``)."""

    x: Floats
    y: Floats
    heading: Floats
    speed: Floats
    length: Floats | float
    width: Floats | float
    z: Floats | float = 0.0


@dataclass(frozen=True, slots=True)
class Track:
    """One vehicle's motion on a regular time grid. Arrays are ``(n,)``. time [s]; x, y box centre [m]; heading [rad];
    speed [m/s]; acceleration [m/s2]; lane: SUMO lane ids ('' = off); z: height of the road [m], a number where all is
    flat."""

    id: str
    role: Role
    time: Floats
    x: Floats
    y: Floats
    heading: Floats
    speed: Floats
    acceleration: Floats
    length: float
    width: float
    lane: tuple[str, ...] = ()
    z: Floats | float = 0.0

    def boxes(self) -> Boxes:
        """The track as boxes over time."""
        return Boxes(self.x, self.y, self.heading, self.speed, self.length, self.width, self.z)

    def between(self, start: float, end: float) -> Track:
        """The part with ``start <= time <= end`` (with half a millisecond of slack)."""
        return self.picked(np.flatnonzero((self.time >= start - 5e-4) & (self.time <= end + 5e-4)))

    def picked(self, keep: Ints) -> Track:
        """The states at these places."""
        lane = tuple(self.lane[i] for i in keep) if self.lane else ()
        return Track(
            self.id, self.role, self.time[keep], self.x[keep], self.y[keep], self.heading[keep], self.speed[keep],
            self.acceleration[keep], self.length, self.width, lane,
            self.z[keep] if isinstance(self.z, np.ndarray) else self.z,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class LaneStrip:
    """One lane as a strip of ground.

    Attributes:
        shape: Its centreline in the direction of traffic, ``(n, 2)``, or ``(n, 3)`` with heights [m].
        width: Its width [m].
        internal: Whether it is inside a junction.
    """

    shape: Floats
    width: float
    internal: bool


class RoadClass(StrEnum):
    """Where the ego is when an attack may begin; ``episode/encounter_detector.py`` has the rules."""

    MOTORWAY = "motorway"
    RURAL = "rural"
    URBAN = "urban"
    JUNCTION = "junction"


@dataclass(frozen=True, slots=True)
class RoadPlace:
    """What surrounds the ego when an attack may begin. road: None off the network. limit: the speed limit [m/s], None
    off the network. speed: the ego's [m/s]. vehicles_near: how many vehicles are within 70 m of it."""

    road: RoadClass | None
    limit: float | None
    speed: float
    vehicles_near: int


@dataclass(frozen=True, slots=True)
class VehicleState:
    """One vehicle at one time. x, y box centre [m]; heading [rad]; speed [m/s]; acceleration [m/s2]; z: height of the
    road under it [m]."""

    id: str
    x: float
    y: float
    heading: float
    speed: float
    acceleration: float
    length: float
    width: float
    lane: str
    z: float = 0.0


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
    source: str
    parameters: tuple[Parameter, ...]
    origin: str  # seed | expert | a model's name | person
    parent: str | None = None

    @property
    def hash(self) -> str:
        """SHA-256 of the source, hexadecimal."""
        return _sha256(self.source)

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


class Level(IntEnum):
    """How far an attempt came; see ``metrics/levels.py``."""

    NONE = 0
    CRITICAL = 1
    COLLISION = 2
    VALID = 3
    STRICT = 4
    SERIOUS = 5

    def __str__(self) -> str:
        """The level in lower case."""
        return self.name.lower()


@dataclass(frozen=True, slots=True)
class Preventability:
    """Which reference drivers avoid a collision.

    Attributes:
        answers: By driver, ``avoids``, ``collides`` or ``not_applicable``, by the kinematic check: the adversary moves
            as recorded and planned.
        alarms: By driver, when a danger first showed to it [s], only of those before the contact.
        inconclusive: None, or why the check says nothing: no_hazard | unchanged_ego_misses | no_plan.
        in_loop: By driver, ``avoids`` or ``collides`` by the check in the loop: the adversary plans again. Empty if the
            collision was not checked so; only drivers that avoid it in the kinematic check are asked.
    """

    answers: Mapping[str, str]
    alarms: Mapping[str, float]
    inconclusive: str | None = None
    in_loop: Mapping[str, str] = field(default_factory=dict)

    @property
    def simulated(self) -> bool:
        """Whether drivers were asked in the loop."""
        return bool(self.in_loop)

    @property
    def by(self) -> tuple[str, ...]:
        """The drivers that avoid it in each check that was made."""
        avoids = (name for name, answer in self.answers.items() if answer == "avoids")
        return tuple(name for name in avoids if not self.in_loop or self.in_loop.get(name) == "avoids")


@dataclass(frozen=True, slots=True)
class Verdict:
    """What one attempt came to, as ``metrics/verdict.py`` judges it. Times s, distances m, never = ``inf``; None = the
    question does not arise."""

    min_ttc: float
    min_distance: float
    collided: bool
    critical: bool
    feasible: bool
    rear_end: bool
    failed_gates: tuple[str, ...] = ()
    log_gates: tuple[str, ...] = ()  # broken by the log of the adversary before the take-over; they do not count
    min_ttc_any: float = float("inf")
    min_pet: float = float("inf")
    max_drac: float = 0.0
    fault: str | None = None
    contact_time: float | None = None
    min_ttc_time: float | None = None
    level: Level = Level.NONE
    preventability: Preventability | None = None
    ego_stationary: bool | None = None
    ego_blocking: bool | None = None
    humanlike: bool | None = None
    beyond_human: tuple[str, ...] = ()  # signals outside the human envelope
    contact_side: str | None = None  # of the ego: front | rear | left | right
    delta_v: float | None = None  # m/s, of the ego
    adversary_delta_v: float | None = None
    overlap: float | None = None  # of the narrower of the two touching faces, a share
    severity: str | None = None  # negligible | minor | moderate | severe
    injury_risk: float | None = None
    impact_speed: float | None = None  # m/s, at which a pedestrian or cyclist is hit; None for a vehicle
    misfits: tuple[str, ...] = ()  # differences from the attack that was asked for, a sentence each

    @property
    def counts(self) -> bool:
        """Whether the attempt can reach a level: the motion is feasible, and the adversary does not run into the ego's
        back."""
        return self.feasible and not self.rear_end

    @property
    def valid(self) -> bool | None:
        """Whether the collision is valid; None without a collision."""
        return self.level >= Level.VALID if self.collided else None

    @property
    def strict(self) -> bool | None:
        """Whether the collision is strict; None without a collision."""
        return self.level >= Level.STRICT if self.collided else None


@dataclass(frozen=True, slots=True)
class DriverModel:
    """How the ego's driver is predicted: which rules it follows, and the numbers of its car following.

    kind: ``krauss``, ``idm``, ``eidm``, ``careful`` or ``replay``. acceleration, deceleration, hardest_braking: all
    positive [m/s2]; tau: headway [s]; min_gap: gap at standstill [m]; speed: desired speed [m/s]. known: False if the
    model is an assumption.
    """

    kind: str
    acceleration: float
    deceleration: float
    tau: float
    min_gap: float
    speed: float
    known: bool = True
    hardest_braking: float = 9.0  # SUMO's emergencyDecel of cars


@dataclass(frozen=True, slots=True)
class PrescribedMotion:
    """An adversary's motion given in advance: its box centre, one pose a step from the step after the takeover on. x, y
    [m]; heading [rad]; speed [m/s]: arrays ``(n,)``."""

    x: Floats
    y: Floats
    heading: Floats
    speed: Floats


@dataclass(frozen=True, slots=True)
class ObservedMotion:
    """How the ego went in an attempt: station on its path [m], offset from it [m, left positive] and speed [m/s] by
    step from the takeover, ``(n,)``. ``seen``: the number of steps that were seen, the rest is at an even speed."""

    s: Floats
    d: Floats
    v: Floats
    seen: int = 0


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
class Diagnosis:
    """What an attempt showed, for the modifier. Times in s after its start.

    time: of the nearest approach; ego_frame, bv_frame: the other's centre ahead and to the left of the one named [m];
    early: by how much the BV was there before the ego where their paths come together (negative: late), None if the
    paths never do; ego_reaction: when the ego began to brake, None = never; ego_braking [m/s2, positive] and ego_shift
    [m sideways]: the most it did; bound: names of the limits that the BV reached.
    """

    time: float
    ego_frame: tuple[float, float]
    bv_frame: tuple[float, float]
    ego_speed: float
    bv_speed: float
    early: float | None
    ego_reaction: float | None
    ego_braking: float
    ego_shift: float
    bound: tuple[str, ...]


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


@dataclass(frozen=True, slots=True)
class LibraryEntry:
    """One intent of the behaviour library with its planners. ``applies``: relations it can be tried from."""

    label: str
    description: str
    applies: tuple[str, ...]
    planners: tuple[Planner, ...]
    source: str = "memory"  # memory | generated
