"""Represent a run's ``outcome.json`` as an object with attributes; ``Result.outcome`` is one.

The verdict and the intents are the types of ``datatypes``. Times are in s, distances in m, speeds in m/s. *Never* is
``inf``, and None means that the question does not arise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

from sumo_adv.datatypes import Ending, Intent, Level, Preventability, Verdict, acceleration_of
from sumo_adv.errors import UsageError
from sumo_adv.metrics.cause import Action, Cause, CauseKind

MAY_BE_NEVER = ("min_ttc", "min_distance", "min_ttc_any", "min_pet")  # null in the file, inf here
LISTS = ("failed_gates", "log_gates", "beyond_human")


@dataclass(frozen=True, slots=True)
class Unattacked:
    """The unattacked run over the time of the attempt that counts.

    Attributes:
        min_ttc: The minimum TTC [s].
        collided: Whether the two vehicles collided.
    """

    min_ttc: float
    collided: bool


@dataclass(frozen=True, slots=True)
class EncounterSummary:
    """Where and when the attack could begin.

    Attributes:
        time: When the encounter was found [s].
        ranking: Id, relation and risk of the vehicles that could attack, highest risk first.
        road: Motorway, rural, urban or junction; None if unknown.
        ego_speed: The ego's speed [m/s]; None if unknown.
        limit: The speed limit [m/s]; None if unknown.
        vehicles_near: The number of vehicles within 70 m of the ego; None if unknown.
    """

    time: float
    ranking: tuple[tuple[str, str, float], ...]
    road: str | None = None
    ego_speed: float | None = None
    limit: float | None = None
    vehicles_near: int | None = None

    def relation(self, vehicle: str) -> str | None:
        """Return the relation of a vehicle to the ego; None if the vehicle is not in the ranking."""
        return next((relation for name, relation, _ in self.ranking if name == vehicle), None)


@dataclass(frozen=True, slots=True)
class SupportRecord:
    """What another adversary did beside the collider.

    Attributes:
        id: The adversary.
        role: block_left, block_right, slow, open or hide.
        intent: The label of its intent.
        mode: The mode of its planner.
        parameters: The planner's parameter values.
    """

    id: str
    role: str
    intent: str
    mode: str
    parameters: Mapping[str, float | None]


@dataclass(frozen=True, slots=True)
class AttemptRecord:
    """One attempt.

    Attributes:
        index: The number of the attempt, from 0.
        intent: The label of the collider's intent.
        adversary: The collider.
        mode: The mode of the collider's planner.
        trigger_time: When the attack begins [s].
        level: The level that the attempt reached.
        kind: Intent, relation and the side of the ego that is hit.
        min_ttc: The minimum TTC [s].
        min_distance: The minimum distance [m].
        collided: Whether ego and collider collided.
        critical: The verdict's flag of that name.
        feasible: Whether the adversary's motion is feasible.
        valid: Whether the collision is valid; None without a collision.
        strict: Whether the collision is strict; None without a collision.
        delta_v: The ego's delta-v [m/s]; None if unknown.
        failed_gates: The gates that the attempt failed.
        parameters: The parameter values of the collider's planner.
        ending: How the attempt ended.
        message: A sentence on the ending.
        composition: The label of an attack of several adversaries; empty with one adversary.
        supports: The other adversaries; empty with one adversary.
    """

    index: int
    intent: str
    adversary: str
    mode: str
    trigger_time: float
    level: Level
    kind: str
    min_ttc: float
    min_distance: float
    collided: bool
    critical: bool
    feasible: bool
    valid: bool | None
    strict: bool | None
    delta_v: float | None
    failed_gates: tuple[str, ...]
    parameters: Mapping[str, float | None]
    ending: str
    message: str
    composition: str = ""
    supports: tuple[SupportRecord, ...] = ()


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a run.

    Attributes:
        ending: How the run ended.
        reason: The ending as a sentence.
        network: The name of the run's input.
        seed: The seed.
        ego: The ego's id; None if there was no encounter and no ego was chosen.
        ego_driver: The name of the driver under test.
        adversary: The collider of the attempt that counts; None without an attempt.
        trigger_time: When the attack of the attempt that counts begins [s]; None without an attempt.
        encounter: The encounter that counts; None without one.
        intent: The intent of the encounter; None without an encounter.
        intents: The intents of the encounter, at most 10.
        unattacked: The unattacked run over the time of the attempt that counts; None if unknown.
        attempts: The attempts.
        best: The index of the attempt that counts; None without an attempt.
        verdict: The verdict on the attempt that counts; None without an attempt.
        cause: Why a contact or a near miss happened; None if there was none.
        timing: Times of parts of the run [s].
        notes: Sentences on the run.
        document: All of ``outcome.json``.
    """

    ending: Ending
    reason: str
    network: str
    seed: int
    ego: str | None
    ego_driver: str | None
    adversary: str | None
    trigger_time: float | None
    encounter: EncounterSummary | None
    intent: Intent | None
    intents: tuple[Intent, ...]
    unattacked: Unattacked | None
    attempts: tuple[AttemptRecord, ...]
    best: int | None
    verdict: Verdict | None
    cause: Cause | None
    timing: Mapping[str, float | None]
    notes: tuple[str, ...]
    document: Mapping[str, Any] = field(repr=False, compare=False)

    @property
    def level(self) -> Level:
        """The level of the attempt that counts; ``Level.NONE`` without an attempt."""
        return Level.NONE if self.verdict is None else self.verdict.level

    @property
    def relation(self) -> str | None:
        """The relation of the collider to the ego; None without an encounter or an attempt."""
        if self.encounter is None or self.adversary is None:
            return None
        return self.encounter.relation(self.adversary)


def outcome_of(document: Mapping[str, Any], file: Path) -> Outcome:
    """Convert the content of ``outcome.json``.

    Args:
        document: The content.
        file: The file that errors name.

    Returns:
        The outcome.

    Raises:
        UsageError: The content is not as this program writes it.
    """
    try:
        ego, adversaries, verdict = document["ego"], document["adversaries"], document["outcome"]
        raw, encounter, intent = document["raw"], document["encounter"], document["intent"]
        return Outcome(
            Ending(document["ending"]), str(document["reason"]), str(document["network"]), int(document["seed"]),
            ego["id"], ego["controller"], adversaries[0]["id"] if adversaries else None, document["trigger_time"],
            None if encounter is None else _encounter(encounter), None if intent is None else _intent(intent),
            tuple(_intent(i) for i in document["intents"]),
            None if raw is None else Unattacked(_time(raw["min_ttc"]), bool(raw["collided"])),
            tuple(_attempt(a) for a in document["attempts"]), document["best"],
            None if verdict is None else verdict_of(verdict), _cause(verdict), dict(document["timing"] or {}),
            tuple(document["notes"]), dict(document),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise UsageError(
            f"{file} is not as this program writes it ({type(error).__name__}: {error}); rerun it."
        ) from error


def verdict_of(written: Mapping[str, Any]) -> Verdict:
    """Convert the key ``outcome`` of ``outcome.json`` to a verdict."""
    names = {f.name for f in fields(Verdict)} & written.keys()
    values = {name: written[name] for name in names}
    values |= {name: _time(written[name]) for name in MAY_BE_NEVER}
    values |= {name: tuple(written[name]) for name in LISTS}
    values["level"] = level_named(written["level"])
    if written["references"] is not None:
        values["preventability"] = Preventability(
            written["references"], written["alarms"], written["inconclusive"], written["in_loop"]
        )
    return Verdict(**values)


def _cause(written: Mapping[str, Any] | None) -> Cause | None:
    cause = (written or {}).get("cause")
    if cause is None:
        return None
    values = {f.name: cause[f.name] for f in fields(Cause)}
    action = None if values["action"] is None else Action(values["action"])
    return Cause(**{**values, "kind": CauseKind(values["kind"]), "action": action})


def level_named(name: str | None) -> Level:
    """Return the level of that name; ``Level.NONE`` without a name, as a run without an attempt has none."""
    return Level[name.upper()] if name else Level.NONE


def _time(value: float | None) -> float:
    return math.inf if value is None else float(value)


def _encounter(written: Mapping[str, Any]) -> EncounterSummary:
    ranking = tuple((str(r["id"]), str(r["relation"]), float(r["risk"])) for r in written["ranking"])
    place = {name: written.get(name) for name in ("road", "ego_speed", "limit", "vehicles_near")}
    return EncounterSummary(float(written["time"]), ranking, **place)


def _intent(written: Mapping[str, Any]) -> Intent:
    return Intent(
        written["bv"], written["label"], written["description"], written["risk"],
        acceleration_of(written["acceleration"]), written["reason"], written["source"],
    )  # fmt: skip


def _attempt(a: Mapping[str, Any]) -> AttemptRecord:
    return AttemptRecord(
        int(a["index"]), a["intent"], a["adversaries"][0], a["planner"]["mode"], a["trigger_time"],
        level_named(a["level"]), a["kind"], _time(a["min_ttc"]), _time(a["min_distance"]), a["collided"],
        a["critical"], a["feasible"], a["valid"], a["strict"], a["delta_v"], tuple(a["failed_gates"]),
        a["parameters"], a["ending"], a["message"], a.get("composition", ""),
        tuple(
            SupportRecord(q["id"], q["role"], q["intent"], q["mode"], q["parameters"]) for q in a.get("supports", ())
        ),
    )  # fmt: skip
