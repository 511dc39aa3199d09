"""How a run ends, and how an attempt is judged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum


class Ending(StrEnum):
    """How an episode ended. ``ENDING_SENTENCES`` has a sentence for each."""

    GOAL_MET = "critical"  # this text in files predates the levels
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
    Ending.GOAL_MET: "An attempt met the criterion.",
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
"""Endings of episodes that failed. Such an episode says nothing about the ego."""


class Level(IntEnum):
    """The level that an attempt reached; see ``metrics/levels.py``."""

    NONE = 0
    CRITICAL = 1
    COLLISION = 2
    VALID = 3
    STRICT = 4
    SERIOUS = 5

    def __str__(self) -> str:
        """Return the level's name in lower case."""
        return self.name.lower()


@dataclass(frozen=True, slots=True)
class Preventability:
    """Which reference drivers avoid a collision.

    Attributes:
        answers: The result of the kinematic check, by driver: ``avoids``, ``collides`` or ``not_applicable``. In this
            check, the adversary moves as recorded and planned.
        alarms: The time at which a danger first showed [s], by driver. Only times before the contact are included.
        inconclusive: Why the check says nothing: no_hazard, unchanged_ego_misses or no_plan. None if it is conclusive.
        in_loop: The result of the closed-loop check, by driver: ``avoids`` or ``collides``. In this check, the
            adversary plans again. Only drivers that avoid the collision in the kinematic check are tested. Empty if
            there was no closed-loop check.
    """

    answers: Mapping[str, str]
    alarms: Mapping[str, float]
    inconclusive: str | None = None
    in_loop: Mapping[str, str] = field(default_factory=dict)

    @property
    def simulated(self) -> bool:
        """Whether there was a closed-loop check."""
        return bool(self.in_loop)

    @property
    def by(self) -> tuple[str, ...]:
        """The drivers that avoid the collision in every check that was made."""
        avoids = (name for name, answer in self.answers.items() if answer == "avoids")
        return tuple(name for name in avoids if not self.in_loop or self.in_loop.get(name) == "avoids")


class AttackerRole(StrEnum):
    """What an attacker did in an attempt."""

    TOUCHED = "touched"  # the ego touched it first
    FORCED = "forced"  # it did not touch the ego, but without its attack the ego touches no adversary
    PLAYED = "played"  # neither, or that was not simulated


@dataclass(frozen=True, slots=True)
class AttackerResult:
    """The result of one of the attackers of an attempt.

    Attributes:
        id: The id of the vehicle.
        role: What it did.
        min_ttc: The minimum TTC between it and the ego [s]; 0 after a contact, ``inf`` means never.
        min_distance: The minimum distance between it and the ego [m]; 0 after a contact.
    """

    id: str
    role: AttackerRole
    min_ttc: float
    min_distance: float


@dataclass(frozen=True, slots=True)
class Verdict:
    """The verdict of ``metrics/verdict.py`` on one attempt.

    Times are in s and distances in m. The value ``inf`` means that something never happens, and None that a field does
    not apply.
    """

    min_ttc: float
    min_distance: float
    collided: bool
    critical: bool
    feasible: bool
    rear_end: bool
    failed_gates: tuple[str, ...] = ()
    log_gates: tuple[str, ...] = ()  # violated by the adversary's log before the takeover; they do not count
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
    misfits: tuple[str, ...] = ()  # differences from the requested attack, one sentence each
    attackers: tuple[AttackerResult, ...] = ()  # the collider, which this verdict is on, first

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
class Diagnosis:
    """Measurements of an attempt for the modifier. Times are in s after the attempt's start.

    Attributes:
        time: The time of the nearest approach [s].
        ego_frame: The BV's centre at that time, ahead and to the left of the ego [m].
        bv_frame: The ego's centre at that time, ahead and to the left of the BV [m].
        ego_speed: The ego's speed at that time [m/s].
        bv_speed: The BV's speed at that time [m/s].
        early: How long before the ego the BV is where their paths meet [s]; negative if it is later. None if the paths
            never meet.
        ego_reaction: The time at which the ego began to brake [s]; None if it never did.
        ego_braking: The ego's hardest braking [m/s2], positive.
        ego_shift: The ego's largest sideways displacement [m].
        bound: The names of the limits that the BV reached.
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
