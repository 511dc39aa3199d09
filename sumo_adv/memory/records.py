"""The nouns of the memory bank: an intent as stored, a piece of evidence, a composed intent (an attack of several
adversaries by reference to the intents and modes of its parts), the answer of a retrieval."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sumo_adv.datatypes import MAX_ADVERSARIES, Acceleration, Duty, Planner, Verdict, acceleration_of
from sumo_adv.errors import BankError

RELATIONS = (
    "leader", "follower", "neighbour", "oncoming", "crossing_left", "crossing_straight", "crossing_right", "merging",
    "cyclist", "cyclist_hidden", "pedestrian", "pedestrian_hidden",
)  # fmt: skip
"""Where a BV can stand to the ego, or what it is; what ``applies`` of an intent is made of."""

STATUSES = ("active", "retired")
EVIDENCE_FLAGS = ("collided", "critical", "feasible", "rear_end", "valid", "strict")  # of evidence, as of a verdict

MAX_EVIDENCE_VALUE = 1e9  # in SI units: beyond any number of an encounter, and squares stay finite
MAX_EVIDENCE_NUMBERS = 100  # in a relative state or among parameters
COMPOSITION_KEY_PREFIX = "composition."  # keys of the bank's settings begin with it
MAX_FAILURES_IN_A_ROW = 20
MAX_COUNTED_ATTEMPTS = 2**53  # bound of the counts: JSON and TOML keep whole numbers up to it


def named_numbers(value: Any) -> dict[str, float]:
    """``value`` as a dictionary, if it is a table of at most ``MAX_EVIDENCE_NUMBERS`` numbers within
    ``MAX_EVIDENCE_VALUE``.

    Raises ValueError with a sentence for anything else.
    """
    if not isinstance(value, Mapping) or len(value) > MAX_EVIDENCE_NUMBERS:
        raise ValueError(f"relative and parameters must be tables of at most {MAX_EVIDENCE_NUMBERS} numbers")
    for name, number in value.items():
        if not isinstance(name, str) or len(name) > 100 or not is_number(number):
            bound = f"{MAX_EVIDENCE_VALUE:g}"
            raise ValueError(f"{str(name)[:40]!r} must be a finite number of at most {bound}, under a short name")
    return dict(value)


def is_number(value: Any) -> bool:
    """Whether it is a number within ``MAX_EVIDENCE_VALUE``; whole numbers compare exactly, and nan never does."""
    bound = MAX_EVIDENCE_VALUE
    return isinstance(value, int | float) and not isinstance(value, bool) and -bound <= value <= bound


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

    Raises BankError for a number that is not finite or beyond ``MAX_EVIDENCE_VALUE``, and for a value of another kind.
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


def evidence_of(verdict: Verdict, **fields: Any) -> Evidence:
    """Evidence from the verdict of the attempt that counts; ``fields``: the other fields of Evidence."""
    return Evidence(**{name: getattr(verdict, name) for name in ("min_ttc", *EVIDENCE_FLAGS)}, **fields)


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
class StoredIntent:
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
class Part:
    """What one adversary does: its duty, and the intent and the planner's mode by which it does it."""

    duty: Duty
    intent: str
    mode: str


@dataclass(frozen=True, slots=True)
class Composition:
    """A composed intent. ``parts``: the collider's first. ``succeeded``: attempts so far; ``failed``: since the last
    success.

    Raises BankError for an empty label or description, and for parts that are no collider with supports.
    """

    label: str
    description: str
    parts: tuple[Part, ...]
    succeeded: int = 0
    failed: int = 0

    def __post_init__(self) -> None:
        if not canonical(self.label) or not self.description.strip():
            raise BankError(f"The composition {self.label!r} needs a label and a description.")
        colliders = [part.duty is Duty.COLLIDER for part in self.parts]
        if not 2 <= len(colliders) <= MAX_ADVERSARIES or colliders != [True] + [False] * (len(colliders) - 1):
            raise BankError(
                f"The composition {self.label!r} must have 2 to {MAX_ADVERSARIES} parts: a collider, then supports."
            )

    @property
    def key(self) -> str:
        """The key under which the bank's settings have it."""
        return f"{COMPOSITION_KEY_PREFIX}{canonical(self.label)}"

    @property
    def hopeless(self) -> bool:
        """Whether many attempts in a row have failed."""
        return self.failed >= MAX_FAILURES_IN_A_ROW


def plain_composition(composition: Composition) -> dict[str, Any]:
    """A composition as the bank's settings and files have it."""
    parts = [{"role": str(p.duty), "intent": p.intent, "mode": p.mode} for p in composition.parts]
    return {
        "label": composition.label, "description": composition.description, "parts": parts,
        "succeeded": composition.succeeded, "failed": composition.failed,
    }  # fmt: skip


def composition_of(value: Any) -> Composition:
    """What ``plain_composition`` made. Raises ValueError or BankError, with what is wrong, for anything else."""
    table = _table(value, {"label": str, "description": str, "parts": list, "succeeded": int, "failed": int})
    rows = [_table(each, {"role": str, "intent": str, "mode": str}) for each in table["parts"]]
    if any(each["role"] not in list(Duty) for each in rows):
        raise ValueError(f"the role of a part of a composition must be one of {', '.join(Duty)}")
    if not all(0 <= table[name] < MAX_COUNTED_ATTEMPTS for name in ("succeeded", "failed")):
        raise ValueError("the counts of a composition must be whole numbers of 0 or more")
    parts = tuple(Part(Duty(each["role"]), each["intent"], each["mode"]) for each in rows)
    return Composition(table["label"], table["description"], parts, table["succeeded"], table["failed"])


def _table(value: Any, kinds: Mapping[str, type]) -> Mapping[str, Any]:
    """The value, if it is a table with exactly these keys and kinds of values."""
    if not isinstance(value, Mapping) or value.keys() != kinds.keys():
        raise ValueError(f"a table of a composition must hold {', '.join(kinds)} and nothing else")
    wrong = [key for key, kind in kinds.items() if not isinstance(value[key], kind) or isinstance(value[key], bool)]
    if wrong:
        raise ValueError(f"the value of {wrong[0]} in a composition is of another kind")
    return value


def counted(known: Composition | None, composition: Composition, attempts: Sequence[bool]) -> Composition | None:
    """The composition after attempts, True for each success; ``known``: as it was before. None if it is unknown and
    none succeeded, since only a success adds one."""
    if known is None and not any(attempts):
        return None
    after = known or replace(composition, succeeded=0, failed=0)
    for succeeded in attempts:
        after = replace(after, succeeded=after.succeeded + succeeded, failed=0 if succeeded else after.failed + 1)
    return after


def renamed(composition: Composition, label: str, into: str, modes: Mapping[str, str]) -> Composition:
    """The composition after the intent ``label`` was merged into another one; ``modes``: its modes' new names."""
    parts = tuple(
        replace(p, intent=into, mode=modes.get(p.mode, p.mode)) if canonical(p.intent) == canonical(label) else p
        for p in composition.parts
    )
    return replace(composition, parts=parts)
