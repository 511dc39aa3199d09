"""The nouns of the memory bank: an intent as stored, a piece of evidence, the answer of a retrieval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from sumo_adv.datatypes import Acceleration, Planner, Verdict
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
)
"""Where a BV can stand to the ego; what ``applies`` of an intent is made of."""

STATUSES = ("active", "retired")


def canonical(label: str) -> str:
    """A label without case, spaces, hyphens or other signs: ``"Cut-in "`` and ``"cut in"`` are one."""
    return "".join(c for c in label.casefold() if c.isalnum())


@dataclass(frozen=True, slots=True)
class IntentRecord:
    """One intent of the bank: the paper's phi_j. ``applies`` lists the relations it can be tried from.

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
    where there was no collision; ``acceleration`` [m/s2] and ``delay`` [s] are what it was driven with, ``parameters``
    the planner's tuned values. ``created`` (ISO 8601, UTC) is set by the bank and no part of the content."""

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
    five (label, distance). ``band``: the distance is so near to epsilon, within a tenth of it, that whoever asks may
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
