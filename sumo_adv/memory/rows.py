"""Rows of the bank to nouns and back: every SELECT and INSERT of the four tables."""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from sumo_adv.datatypes import Planner, acceleration_at
from sumo_adv.errors import BankError
from sumo_adv.memory import content_check
from sumo_adv.memory.records import Evidence, IntentRecord, canonical
from sumo_adv.memory.schema import REPAIR

_EVIDENCE_COLUMNS = (
    "geometry, relation, relative, controller, parameters, acceleration, knots, delay, attempts, min_ttc,"
    " collided, critical, feasible, rear_end, valid, strict, version, network, seed, created"
)

_PLANNER_COLUMNS = "mode, source, parameters, parent, origin"

MERGED = content_check.MERGED  # settings ``merged.<key>``: the label of the intent into which this one was merged


@dataclass(slots=True)
class Content:
    """What a bank holds, in RAM. Keys are canonical labels; lists and dicts are in order of age."""

    intents: dict[str, IntentRecord] = field(default_factory=dict)
    planners: dict[str, list[Planner]] = field(default_factory=dict)
    retired: set[tuple[str, str]] = field(default_factory=set)  # (key, hash) of retired planners
    evidence: list[Evidence] = field(default_factory=list)
    settings: dict[str, Any] = field(default_factory=dict)


def load(connection: sqlite3.Connection) -> Content:
    """Everything, from one consistent view of the file. Raises BankError for content that no bank can have."""
    connection.execute("BEGIN")
    try:
        return read(connection)
    finally:
        connection.execute("COMMIT")


def read(connection: sqlite3.Connection) -> Content:
    """Everything; to be called within a transaction. Raises BankError for content that no bank can have."""
    content = Content()
    keys: dict[int, str] = {}
    for id_, key, *rest in connection.execute(
        "SELECT id, key, label, description, applies, status FROM intents ORDER BY id"
    ):
        with _named(connection, f"row {id_} of its intents"):
            record = content_check.intent(key, *rest)
        keys[id_] = key
        content.intents[key] = record
        content.planners[key] = []
    for row, id_, status, planner_hash, *rest in connection.execute(
        f"SELECT id, intent, status, hash, {_PLANNER_COLUMNS} FROM planners ORDER BY id"
    ):
        key = keys[id_]
        with _named(connection, f"row {row} of its planners"):
            planner = content_check.planner(content.intents[key].label, planner_hash, *rest)
        content.planners[key].append(planner)
        if status == "retired":
            content.retired.add((key, planner.hash))
    for row, id_, planner_hash, *values in connection.execute(
        f"SELECT id, intent, planner, {_EVIDENCE_COLUMNS} FROM evidence ORDER BY id"
    ):
        with _named(connection, f"row {row} of its evidence"):
            content.evidence.append(content_check.evidence(content.intents[keys[id_]].label, planner_hash, values))
    content.settings = read_settings(connection)
    return content


@contextmanager
def _named(connection: sqlite3.Connection, row: str) -> Iterator[None]:
    """Within it, a faulty row raises a BankError that names the file and the row."""
    try:
        yield
    except (ValueError, TypeError, RecursionError, BankError) as error:
        fault = str(error).rstrip(".")
        path = connection.execute("PRAGMA database_list").fetchone()[2]
        raise BankError(f"The memory bank {path} is damaged in {row}: {fault[:300]}; {REPAIR}.") from error


def read_settings(connection: sqlite3.Connection) -> dict[str, Any]:
    """All settings, by key. Raises BankError for a value that cannot be one."""
    settings = {}
    for key, value in connection.execute("SELECT key, value FROM settings ORDER BY key"):
        with _named(connection, f"its setting {str(key)[:80]!r}"):
            settings[key] = content_check.setting(key, value)
    return settings


def insert_intent(connection: sqlite3.Connection, record: IntentRecord, now: str) -> None:
    """Add an intent unless one of that label, in any spelling, is there."""
    connection.execute(
        "INSERT INTO intents (key, label, description, applies, status, created) VALUES (?, ?, ?, ?, ?, ?)"
        " ON CONFLICT (key) DO NOTHING",
        (canonical(record.label), record.label, record.description, _json(record.applies), record.status, now),
    )


def read_intent(connection: sqlite3.Connection, label: str) -> IntentRecord | None:
    """The intent of that label in any spelling, as stored."""
    key = canonical(label)
    row = connection.execute("SELECT label, description, applies, status FROM intents WHERE key = ?", (key,)).fetchone()
    return None if row is None else content_check.intent(key, *row)


def insert_planner(
    connection: sqlite3.Connection, label: str, planner: Planner, now: str, status: str = "active"
) -> None:
    """Add a planner to an intent that exists, unless it has that source already. Raises BankError."""
    try:
        content_check.parameters_of(planner)
    except ValueError as error:
        raise BankError(f"The planner cannot be kept: {error}.") from error
    parameters = [list(asdict(parameter).values()) for parameter in planner.parameters]
    connection.execute(
        "INSERT INTO planners (intent, mode, source, parameters, hash, parent, origin, status, created)"
        " SELECT id, ?, ?, ?, ?, ?, ?, ?, ? FROM intents WHERE key = ?"
        " ON CONFLICT (intent, hash) DO NOTHING",
        (
            planner.mode, planner.source, _json(parameters), planner.hash, planner.parent, planner.origin,
            status, now, canonical(label),
        ),
    )  # fmt: skip


def read_planner(connection: sqlite3.Connection, label: str, planner_hash: str) -> tuple[Planner, str] | None:
    """One planner of an intent, as stored, and its status."""
    row = connection.execute(
        f"SELECT planners.status, intents.label, hash, {_PLANNER_COLUMNS} FROM planners"
        " JOIN intents ON intents.id = planners.intent WHERE key = ? AND hash = ?",
        (canonical(label), planner_hash),
    ).fetchone()
    return None if row is None else (content_check.planner(*row[1:]), row[0])


def insert_evidence(connection: sqlite3.Connection, evidence: Evidence, now: str, *, wake: bool = True) -> None:
    """Add evidence about an intent and a planner that exist; with ``wake`` a success makes both active again."""
    scene = evidence.scene
    values = (
        scene.geometry, scene.relation, _json(scene.relative), scene.controller, _json(evidence.parameters),
        acceleration_at(evidence.acceleration, 0.0),
        _json(evidence.acceleration) if isinstance(evidence.acceleration, tuple) else None,
        evidence.delay, evidence.attempts,
        None if math.isinf(evidence.min_ttc) else evidence.min_ttc,
        evidence.collided, evidence.critical, evidence.feasible, evidence.rear_end, evidence.valid, evidence.strict,
        evidence.version, evidence.network, evidence.seed, now,
    )  # fmt: skip
    key = canonical(evidence.label)
    connection.execute(
        f"INSERT INTO evidence (intent, planner, {_EVIDENCE_COLUMNS})"
        f" SELECT id, ?, {', '.join('?' * len(values))} FROM intents WHERE key = ?",
        (evidence.planner_hash, *values, key),
    )
    if wake and evidence.success:
        connection.execute("UPDATE intents SET status = 'active' WHERE key = ? AND status != 'active'", (key,))
        connection.execute(
            "UPDATE planners SET status = 'active' WHERE hash = ? AND status != 'active'"
            " AND intent = (SELECT id FROM intents WHERE key = ?)",
            (evidence.planner_hash, key),
        )


def resolve(settings: Mapping[str, Any], label: str) -> str:
    """The label of the intent that took this one over, of that one if it was merged too, and so on; else ``label``."""
    seen: set[str] = set()
    while (key := canonical(label)) not in seen and isinstance(into := settings.get(f"{MERGED}{key}"), str):
        seen.add(key)
        label = into
    return label


def write_setting(connection: sqlite3.Connection, key: str, value: object) -> None:
    """Set one setting, a JSON value."""
    connection.execute(
        "INSERT INTO settings VALUES (?, ?) ON CONFLICT (key) DO UPDATE SET value = excluded.value", (key, _json(value))
    )


def canonical_items(content: Content) -> Iterator[list[Any]]:
    """The content as JSON-able lists, without row numbers and time stamps."""
    for record in content.intents.values():
        yield ["intent", asdict(record)]
    for key, planners in content.planners.items():
        for planner in planners:
            yield ["planner", asdict(planner), (key, planner.hash) in content.retired]
    for evidence in content.evidence:
        plain = asdict(evidence)
        del plain["created"]
        yield ["evidence", plain]
    for key, value in content.settings.items():
        yield ["setting", key, value]


def stored(evidence: Evidence, label: str, now: str) -> Evidence:
    """Evidence as it reads back: under the intent's own label, with its time stamp and plain dicts."""
    scene = replace(evidence.scene, relative=dict(evidence.scene.relative))
    return replace(evidence, label=label, scene=scene, parameters=dict(evidence.parameters), created=now)


def _json(value: object) -> str:
    plain = dict(value) if isinstance(value, Mapping) else value
    try:
        return json.dumps(plain, sort_keys=True, allow_nan=False)
    except ValueError:
        raise BankError("The memory bank keeps finite numbers only; infinity or not-a-number was given.") from None
