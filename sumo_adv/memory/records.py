"""The nouns of the memory bank: an intent as stored, a piece of evidence, the answer of a retrieval."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sumo_adv.datatypes import Acceleration, Planner, Verdict, acceleration_of
from sumo_adv.errors import BankError

RELATIONS = (
    "leader",
    "follower",
    "neighbour",
    "oncoming",
    "crossing_left",
    "crossing_straight",
    "crossing_right",
    "merging",
    "cyclist",
    "cyclist_hidden",
    "pedestrian",
    "pedestrian_hidden",
)
"""Where a BV can stand to the ego, or what it is; what ``applies`` of an intent is made of."""

STATUSES = ("active", "retired")

LARGEST = 1e9  # bound of the numbers of evidence in SI units: beyond any of an encounter, and squares stay finite
MOST_NUMBERS = 100  # in a relative state or among parameters


def named_numbers(value: Any) -> dict[str, float]:
    """``value`` as a dictionary, if it is a table of at most ``MOST_NUMBERS`` numbers within ``LARGEST``.

    Raises ValueError with a sentence for anything else.
    """
    if not isinstance(value, Mapping) or len(value) > MOST_NUMBERS:
        raise ValueError(f"relative and parameters must be tables of at most {MOST_NUMBERS} numbers")
    for name, number in value.items():
        if not isinstance(name, str) or len(name) > 100 or not is_number(number):
            raise ValueError(f"{str(name)[:40]!r} must be a finite number of at most {LARGEST:g}, under a short name")
    return dict(value)


def is_number(value: Any) -> bool:
    """Whether it is a number within ``LARGEST``; a whole number of any length compares exactly, and nan never does."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -LARGEST <= value <= LARGEST


def canonical(label: str) -> str:
    """A label without case, spaces, hyphens or other signs: ``"Cut-in "`` and ``"cut in"`` are one."""
    return "".join(c for c in label.casefold() if c.isalnum())


@dataclass(frozen=True, slots=True)
class IntentRecord:
    """One intent of the bank: the paper's phi_j. ``applies`` lists the relations it can be tried from, each once.

    Raises BankError for an empty label or description, or a relation or status that does not exist.
    """

    label: str
    description: str
    applies: tuple[str, ...]
    status: str = "active"

    def __post_init__(self) -> None:
        if not canonical(self.label):
            raise BankError(f"An intent needs a label with letters or digits, and {self.label!r} has none.")
        if not self.description.strip():
            raise BankError(f"The intent {self.label!r} needs a description: one to three sentences.")
        unknown = [relation for relation in self.applies if relation not in RELATIONS]
        if unknown or not self.applies:
            given = ", ".join(unknown) or "nothing"
            raise BankError(
                f"The intent {self.label!r} says it applies to {given}; use some of: {', '.join(RELATIONS)}."
            )
        if len(set(self.applies)) < len(self.applies):  # each costs a trial of every planner
            raise BankError(f"The intent {self.label!r} names a relation twice in what it applies to; name each once.")
        if self.status not in STATUSES:
            raise BankError(f"The intent {self.label!r} has the status {self.status!r}; it is active or retired.")


@dataclass(frozen=True, slots=True)
class SceneSignature:
    """What made two scenes alike: geometry class (e.g. ``"crossing"``), relation of the BV to the ego, relative state
    (named numbers, SI), and the ego's controller."""

    geometry: str
    relation: str
    relative: Mapping[str, float]
    controller: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What one planner once achieved in one scene. ``min_ttc`` [s], ``inf`` = never; ``valid`` and ``strict`` are None
    where there was no collision; ``acceleration`` [m/s2] and ``delay`` [s] are those of the attempt, ``parameters``
    the planner's tuned values. ``created`` (ISO 8601, UTC) is set by the bank and no part of the content.

    Raises BankError for a number that is not finite or beyond ``LARGEST``, and for a value of another kind.
    """

    label: str
    planner_hash: str
    scene: SceneSignature
    attempts: int
    min_ttc: float
    collided: bool
    critical: bool
    feasible: bool
    rear_end: bool
    valid: bool | None
    strict: bool | None
    version: str
    network: str
    seed: int
    parameters: Mapping[str, float] = field(default_factory=dict)
    acceleration: Acceleration = 0.0
    delay: float = 0.0
    created: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        try:
            self._check()
        except ValueError as error:
            raise BankError(
                f"The evidence for {str(self.label)[:80]!r} cannot be used: {str(error).rstrip('.')}."
            ) from error

    def _check(self) -> None:
        scene = self.scene
        texts = (self.label, self.planner_hash, scene.geometry, scene.relation, scene.controller, self.version,
                 self.network, self.created)  # fmt: skip
        if not all(isinstance(text, str) for text in texts):
            raise ValueError("its names must be texts")
        named_numbers(scene.relative)
        named_numbers(self.parameters)
        if not all(isinstance(n, int) and -(2**63) <= n < 2**63 for n in (self.attempts, self.seed)):
            raise ValueError("attempts and seed must be whole numbers of 64 bits")
        if self.attempts < 1:
            raise ValueError("attempts must be 1 or more")
        if self.min_ttc != math.inf and not (is_number(self.min_ttc) and self.min_ttc >= 0.0):
            raise ValueError("min_ttc must be a number of 0 or more")
        if not is_number(self.delay):
            raise ValueError("delay must be a finite number")
        flags = (self.collided, self.critical, self.feasible, self.rear_end)
        if not all(isinstance(f, bool) for f in flags) or not {self.valid, self.strict} <= {True, False, None}:
            raise ValueError("its flags must be yes or no")
        acceleration_of(self.acceleration)

    @property
    def success(self) -> bool:
        """What the bank counts as success: critical, feasible and not rear-end."""
        return self.critical and self.feasible and not self.rear_end


def evidence_of(
    verdict: Verdict,
    *,
    label: str,
    planner_hash: str,
    scene: SceneSignature,
    attempts: int,
    version: str,
    network: str,
    seed: int,
    parameters: Mapping[str, float] | None = None,
    acceleration: Acceleration = 0.0,
    delay: float = 0.0,
) -> Evidence:
    """Evidence from the verdict of the attempt that counts; the other arguments are Evidence's fields."""
    return Evidence(
        label=label,
        planner_hash=planner_hash,
        scene=scene,
        attempts=attempts,
        min_ttc=verdict.min_ttc,
        collided=verdict.collided,
        critical=verdict.critical,
        feasible=verdict.feasible,
        rear_end=verdict.rear_end,
        valid=verdict.valid,
        strict=verdict.strict,
        version=version,
        network=network,
        seed=seed,
        parameters=dict(parameters or {}),
        acceleration=acceleration,
        delay=delay,
    )


@dataclass(frozen=True, slots=True)
class Retrieval:
    """The answer to "is this intent known?". ``hit`` is the label within ``epsilon``, or None; ``distance`` that of
    the nearest (0 for the same label, 1 = nothing in common, also for an empty bank); ``nearest`` is sorted, at most
    five (label, distance). ``band``: the distance is so near to epsilon, within a tenth of it, that the caller may
    have the first three of ``nearest`` confirmed."""

    hit: str | None
    distance: float
    epsilon: float
    nearest: Sequence[tuple[str, float]]
    band: bool = False


@dataclass(frozen=True, slots=True)
class Source:
    """All that a bank holds about one intent, as it is exported, imported and built.

    ``planners``: retired ones too, by mode; ``retired``: hashes of those; ``merged_into``: the label of the intent that
    took over this one's planners and evidence.
    """

    intent: IntentRecord
    planners: tuple[Planner, ...]
    retired: frozenset[str] = frozenset()
    evidence: tuple[Evidence, ...] = ()
    merged_into: str | None = None


@dataclass(frozen=True, slots=True)
class LabelStatistics:
    """Counts for one intent; ``attempts`` is the sum over its evidence."""

    planners: int
    evidence: int
    successes: int
    collisions: int
    valid: int
    attempts: int

    @property
    def failures(self) -> int:
        """Evidence that is no success."""
        return self.evidence - self.successes


@dataclass(frozen=True, slots=True)
class BankStatistics:
    """Counts over the whole bank."""

    intents: int
    active: int
    planners: int
    evidence: int
    by_label: Mapping[str, LabelStatistics]
