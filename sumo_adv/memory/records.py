"""The nouns of the memory bank: a stored intent, a piece of evidence, a composed intent, and the answer of a retrieval.

A composed intent is an attack by several adversaries. It refers to the intents and modes of its parts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from sumo_adv.datatypes import MAX_ADVERSARIES, Acceleration, Duty, Planner, Verdict, acceleration_of
from sumo_adv.errors import BankError

RELATIONS = (
    "leader", "follower", "neighbour", "oncoming", "crossing_left", "crossing_straight", "crossing_right", "merging",
    "cyclist", "cyclist_straight", "cyclist_hidden", "pedestrian", "pedestrian_hidden",
)  # fmt: skip
"""The possible relations of a BV to the ego, and kinds of BV. The field ``applies`` of an intent lists some of them."""

STATUSES = ("active", "retired")
EVIDENCE_FLAGS = ("collided", "critical", "feasible", "rear_end", "valid", "strict")  # of evidence and of a verdict

MAX_EVIDENCE_VALUE = 1e9  # in SI units; larger than any number of an encounter, but its square stays finite
MAX_EVIDENCE_NUMBERS = 100  # maximum count in a relative state or among parameters
COMPOSITION_KEY_PREFIX = "composition."  # beginning of the keys of compositions in the bank's settings
MAX_FAILURES_IN_A_ROW = 20
MAX_COUNTED_ATTEMPTS = 2**53  # bound of the counts; JSON and TOML keep whole numbers up to it


def named_numbers(value: Any) -> dict[str, float]:
    """Check that a value is a table of numbers.

    Args:
        value: The value to check.

    Returns:
        The table as a dictionary.

    Raises:
        ValueError: The value is no table of at most ``MAX_EVIDENCE_NUMBERS`` numbers within ``MAX_EVIDENCE_VALUE``.
    """
    if not isinstance(value, Mapping) or len(value) > MAX_EVIDENCE_NUMBERS:
        raise ValueError(f"relative and parameters must be tables of at most {MAX_EVIDENCE_NUMBERS} numbers")
    for name, number in value.items():
        if not isinstance(name, str) or len(name) > 100 or not is_number(number):
            bound = f"{MAX_EVIDENCE_VALUE:g}"
            raise ValueError(f"{str(name)[:40]!r} must be a finite number of at most {bound}, under a short name")
    return dict(value)


def is_number(value: Any) -> bool:
    """Return whether a value is a number within ``MAX_EVIDENCE_VALUE``. Whole numbers compare exactly; nan is none.

    Args:
        value: The value to check.
    """
    bound = MAX_EVIDENCE_VALUE
    return isinstance(value, int | float) and not isinstance(value, bool) and -bound <= value <= bound


def canonical(label: str) -> str:
    """Return a label without case, spaces, hyphens or other signs, so that ``"Cut-in "`` and ``"cut in"`` are equal.

    Args:
        label: The label.
    """
    return "".join(c for c in label.casefold() if c.isalnum())


@dataclass(frozen=True, slots=True)
class IntentRecord:
    """One intent of the bank: the paper's phi_j.

    Attributes:
        label: Its name.
        description: What the vehicle does, in one to three sentences.
        applies: The relations that it can be tried from, each once.
        status: ``active`` or ``retired``.

    Raises:
        BankError: The label or the description is empty, or a relation or status does not exist.
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
        if len(set(self.applies)) < len(self.applies):  # each relation costs a trial of every planner
            raise BankError(f"The intent {self.label!r} names a relation twice in what it applies to; name each once.")
        if self.status not in STATUSES:
            raise BankError(f"The intent {self.label!r} has the status {self.status!r}; it is active or retired.")


@dataclass(frozen=True, slots=True)
class SceneSignature:
    """What makes two scenes similar.

    Attributes:
        geometry: The geometry class, such as ``"crossing"``.
        relation: The relation of the BV to the ego.
        relative: The relative state, as named numbers in SI units.
        controller: The ego's controller.
    """

    geometry: str
    relation: str
    relative: Mapping[str, float]
    controller: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What one planner achieved once in one scene.

    Attributes:
        label: The label of the intent.
        planner_hash: The hash of the planner's text.
        scene: The scene.
        attempts: The number of attempts, 1 or more.
        min_ttc: The minimum TTC [s]; ``inf`` means never.
        collided: Whether ego and adversary collided.
        critical: Whether the attempt was critical.
        feasible: Whether the attempt was feasible.
        rear_end: Whether the adversary ran into the ego's rear.
        valid: Whether the collision is valid; None without a collision.
        strict: Whether the collision is strict; None without a collision.
        version: The version of the program.
        network: The road network.
        seed: The seed of the run.
        parameters: The planner's parameter values.
        acceleration: The acceleration of the attempt [m/s2].
        delay: The start of the attempt, as time after the trigger [s].
        created: The time stamp (ISO 8601, UTC), set by the bank and no part of the content.

    Raises:
        BankError: A number is not finite or beyond ``MAX_EVIDENCE_VALUE``, or a value has the wrong type.
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
        """Raise ValueError if a value cannot be used."""
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
        """Whether the bank counts this as a success: critical, feasible and not rear-end."""
        return self.critical and self.feasible and not self.rear_end


def evidence_of(verdict: Verdict, **fields: Any) -> Evidence:
    """Make evidence from a verdict.

    Args:
        verdict: The verdict on the attempt that counts.
        fields: The other fields of Evidence.
    """
    return Evidence(**{name: getattr(verdict, name) for name in ("min_ttc", *EVIDENCE_FLAGS)}, **fields)


@dataclass(frozen=True, slots=True)
class Retrieval:
    """The answer to the question whether an intent is known.

    Attributes:
        hit: The label of the nearest intent if it lies within ``epsilon``, otherwise None.
        distance: The distance of the nearest intent: 0 for the same label, 1 if nothing is in common or the bank is
            empty.
        epsilon: The distance up to which an intent counts as known.
        nearest: At most five labels with their distances, nearest first.
        band: Whether the distance lies within a tenth of epsilon from epsilon. The caller may then have the first three
            of ``nearest`` confirmed.
    """

    hit: str | None
    distance: float
    epsilon: float
    nearest: Sequence[tuple[str, float]]
    band: bool = False


@dataclass(frozen=True, slots=True)
class StoredIntent:
    """All that a bank holds about one intent, as it is exported, imported and built.

    Attributes:
        intent: The intent.
        planners: Its planners by mode, including retired ones.
        retired: The hashes of the retired planners.
        evidence: The evidence about it.
        merged_into: The label of the intent that took over its planners and evidence; None if it was not merged.
    """

    intent: IntentRecord
    planners: tuple[Planner, ...]
    retired: frozenset[str] = frozenset()
    evidence: tuple[Evidence, ...] = ()
    merged_into: str | None = None


@dataclass(frozen=True, slots=True)
class Part:
    """What one adversary of a composition does.

    Attributes:
        duty: Its duty.
        intent: The label of its intent.
        mode: The mode of its planner.
    """

    duty: Duty
    intent: str
    mode: str


@dataclass(frozen=True, slots=True)
class Composition:
    """A composed intent.

    Attributes:
        label: Its name.
        description: What the vehicles do.
        parts: The parts, the collider's first.
        succeeded: The number of successful attempts so far.
        failed: The number of failures since the last success.

    Raises:
        BankError: The label or the description is empty, or the parts are no collider with supports.
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
        """Its key in the bank's settings."""
        return f"{COMPOSITION_KEY_PREFIX}{canonical(self.label)}"

    @property
    def hopeless(self) -> bool:
        """Whether ``MAX_FAILURES_IN_A_ROW`` attempts in a row have failed."""
        return self.failed >= MAX_FAILURES_IN_A_ROW


def plain_composition(composition: Composition) -> dict[str, Any]:
    """Return a composition in the form of the bank's settings and files.

    Args:
        composition: The composition.
    """
    parts = [{"role": str(p.duty), "intent": p.intent, "mode": p.mode} for p in composition.parts]
    return {
        "label": composition.label, "description": composition.description, "parts": parts,
        "succeeded": composition.succeeded, "failed": composition.failed,
    }  # fmt: skip


def composition_of(value: Any) -> Composition:
    """Return the composition that ``plain_composition`` turned into a table.

    Args:
        value: The table.

    Raises:
        ValueError: The table has wrong keys or values.
        BankError: The composition is not a possible one.
    """
    table = _table(value, {"label": str, "description": str, "parts": list, "succeeded": int, "failed": int})
    rows = [_table(each, {"role": str, "intent": str, "mode": str}) for each in table["parts"]]
    if any(each["role"] not in list(Duty) for each in rows):
        raise ValueError(f"the role of a part of a composition must be one of {', '.join(Duty)}")
    if not all(0 <= table[name] < MAX_COUNTED_ATTEMPTS for name in ("succeeded", "failed")):
        raise ValueError("the counts of a composition must be whole numbers of 0 or more")
    parts = tuple(Part(Duty(each["role"]), each["intent"], each["mode"]) for each in rows)
    return Composition(table["label"], table["description"], parts, table["succeeded"], table["failed"])


def _table(value: Any, kinds: Mapping[str, type]) -> Mapping[str, Any]:
    """Return the value if it is a table with exactly these keys and types; otherwise raise ValueError."""
    if not isinstance(value, Mapping) or value.keys() != kinds.keys():
        raise ValueError(f"a table of a composition must hold {', '.join(kinds)} and nothing else")
    wrong = [key for key, kind in kinds.items() if not isinstance(value[key], kind) or isinstance(value[key], bool)]
    if wrong:
        raise ValueError(f"the value of {wrong[0]} in a composition has the wrong type")
    return value


def counted(known: Composition | None, composition: Composition, attempts: Sequence[bool]) -> Composition | None:
    """Count attempts with a composition.

    Args:
        known: The composition so far; None if it is unknown.
        composition: The composition that was attempted.
        attempts: True for each success, False for each failure, in order.

    Returns:
        The composition with its new counts. It is None if the composition is unknown and no attempt succeeded, because
        only a success adds one.
    """
    if known is None and not any(attempts):
        return None
    after = known or replace(composition, succeeded=0, failed=0)
    for succeeded in attempts:
        after = replace(after, succeeded=after.succeeded + succeeded, failed=0 if succeeded else after.failed + 1)
    return after


def renamed(composition: Composition, label: str, into: str, modes: Mapping[str, str]) -> Composition:
    """Return the composition after an intent was merged into another one.

    Args:
        composition: The composition.
        label: The label of the merged intent.
        into: The label of the intent that took it over.
        modes: The new names of its modes.
    """
    parts = tuple(
        replace(p, intent=into, mode=modes.get(p.mode, p.mode)) if canonical(p.intent) == canonical(label) else p
        for p in composition.parts
    )
    return replace(composition, parts=parts)
