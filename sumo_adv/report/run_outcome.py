"""A run's ``outcome.json`` as an object with attributes: what ``Result.outcome`` is.

The verdict and the intents are the nouns of ``datatypes``. Times in s, distances in m, speeds in m/s; *never* is
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
    """The unattacked run over the time of the attempt that counts."""

    min_ttc: float
    collided: bool


@dataclass(frozen=True, slots=True)
class EncounterSummary:
    """Where and when the attack could begin.

    ranking: id, relation and risk of the vehicles that could attack, highest risk first. road: motorway, rural, urban
    or junction; ego_speed [m/s]; limit: the speed limit [m/s]; vehicles_near: within 70 m of the ego. None: not known.
    """

    time: float
    ranking: tuple[tuple[str, str, float], ...]
    road: str | None = None
    ego_speed: float | None = None
    limit: float | None = None
    vehicles_near: int | None = None

    def relation(self, vehicle: str) -> str | None:
        return next((relation for name, relation, _ in self.ranking if name == vehicle), None)


@dataclass(frozen=True, slots=True)
class SupportRecord:
    """What another adversary did beside the collider. role: block_left, block_right, slow, open or hide."""

    id: str
    role: str
    intent: str
    mode: str
    parameters: Mapping[str, float | None]


@dataclass(frozen=True, slots=True)
class AttemptRecord:
    """One attempt. mode: the planner's; kind: intent, relation and side of the ego that is hit.

    composition, supports: the label of an attack of several adversaries, and the others; empty with one adversary.
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

    best: the index of the attempt that counts. adversary, trigger_time [s], verdict: of this attempt, None without one.
    ego_driver: the name of the driver under test. cause: why it came to a contact or near miss, None where it did not.
    document: all of ``outcome.json``.
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
        return Level.NONE if self.verdict is None else self.verdict.level

    @property
    def relation(self) -> str | None:
        if self.encounter is None or self.adversary is None:
            return None
        return self.encounter.relation(self.adversary)


def outcome_of(document: Mapping[str, Any], file: Path) -> Outcome:
    """The content of ``outcome.json``; ``file`` is named in errors. Raises UsageError: it is not as we write it."""
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
            f"{file} is not as this program writes it ({type(error).__name__}: {error}); run it again."
        ) from error


def verdict_of(written: Mapping[str, Any]) -> Verdict:
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
    """The level of that name; ``Level.NONE`` without one, as a run without an attempt has none."""
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
