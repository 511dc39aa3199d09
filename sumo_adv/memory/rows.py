"""Convert rows of the bank to nouns and back: all SELECTs and INSERTs of the four tables, and checks of the content."""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from sumo_adv.datatypes import Parameter, Planner, acceleration_at, acceleration_of
from sumo_adv.errors import BankError
from sumo_adv.memory.migrations import REPAIR_ADVICE
from sumo_adv.memory.records import (
    COMPOSITION_KEY_PREFIX,
    EVIDENCE_FLAGS,
    Evidence,
    IntentRecord,
    SceneSignature,
    canonical,
    composition_of,
    is_number,
)
from sumo_adv.parsing import parse_json

MAX_SETTING_BRACKETS = 100  # settings use a few; about 1,000 nested ones exceed Python's recursion limit
MERGED_KEY_PREFIX = "merged."  # ``merged.<key>`` holds the label of the intent that this one was merged into
EPSILON_KEY_PREFIX = "epsilon."
_EVIDENCE_COLUMNS = (
    "geometry", "relation", "relative", "controller", "parameters", "acceleration", "knots", "delay", "attempts",
    "min_ttc", *EVIDENCE_FLAGS, "version", "network", "seed", "created",
)  # fmt: skip
_PLANNER_COLUMNS = "mode, source, parameters, parent, origin"


# From columns to nouns, as if the program had written the file. Each function raises ValueError, TypeError,
# RecursionError or BankError with a text that names the fault.


def _intent(key: str, label: str, description: str, applies: str, status: str) -> IntentRecord:
    """Return the intent of a row; ``key`` is its label in canonical form."""
    if key != canonical(label):
        raise ValueError(f"the key of the intent {label[:80]!r} is not that of its label")
    relations = parse_json(applies)
    if not isinstance(relations, list) or not all(isinstance(each, str) for each in relations):
        raise ValueError(f"the intent {label[:80]!r} must apply to a list of relations")
    return IntentRecord(label, description, tuple(relations), status)


def _planner(
    label: str, planner_hash: str, mode: str, text: str, parameters: str, parent: str | None, origin: str
) -> Planner:
    """Return the planner of a row, for the intent ``label``."""
    table = parse_json(parameters)
    if not isinstance(table, list) or not all(isinstance(each, list) and 5 <= len(each) <= 6 for each in table):
        raise ValueError("the parameters of a planner must be lists of name, default, low, high, unit and meaning")
    made = Planner(label, mode, text, tuple(Parameter(*each) for each in table), origin, parent)
    if made.hash != planner_hash:
        raise ValueError(f"the planner {mode[:80]!r} has a text that does not match its hash")
    _check_parameters(made)
    return made


def _check_parameters(made: Planner) -> None:
    """Check that parameters have texts, finite numbers in order, and different names."""
    names = [p.name for p in made.parameters]
    texts = [text for p in made.parameters for text in (p.name, p.unit, p.meaning)]
    if not all(isinstance(text, str) for text in texts) or len(set(names)) < len(names):
        raise ValueError(f"the planner {made.mode[:80]!r} has a parameter without a name, unit or meaning of its own")
    for p in made.parameters:
        if not all(map(is_number, (p.default, p.low, p.high))) or not p.low <= p.default <= p.high:
            raise ValueError(f"the parameter {p.name[:40]!r} must have finite numbers with low <= default <= high")


def _evidence(label: str, planner_hash: str, values: Sequence[Any]) -> Evidence:
    """Return the evidence of a row of ``_EVIDENCE_COLUMNS``, about the intent ``label``."""
    row = dict(zip(_EVIDENCE_COLUMNS, values, strict=True))
    relative = parse_json(row.pop("relative"))
    scene = SceneSignature(row.pop("geometry"), row.pop("relation"), relative, row.pop("controller"))
    knots, parameters = row.pop("knots"), parse_json(row.pop("parameters"))
    if knots is not None:
        row["acceleration"] = acceleration_of(parse_json(knots))
    if row["min_ttc"] is None:
        row["min_ttc"] = math.inf
    row |= {name: None if row[name] is None else bool(row[name]) for name in EVIDENCE_FLAGS}
    return Evidence(label=label, planner_hash=planner_hash, scene=scene, parameters=parameters, **row)


def _setting(key: str, text: str) -> Any:
    """Return the value of a setting."""
    if text.count("[") + text.count("{") > MAX_SETTING_BRACKETS:
        raise ValueError("it nests deeper than a setting does")
    value = parse_json(text)
    if key.startswith(MERGED_KEY_PREFIX) and not isinstance(value, str):
        raise ValueError("it must be the label of an intent")
    if key.startswith(EPSILON_KEY_PREFIX):
        ok = isinstance(value, dict) and is_number(value.get("epsilon")) and isinstance(value.get("calibrated_on"), str)
        if not ok:
            raise ValueError("it must hold a number, epsilon, and a text, calibrated_on")
    if key.startswith(COMPOSITION_KEY_PREFIX) and key != composition_of(value).key:
        raise ValueError("its key must be that of its label")
    return value


@dataclass(slots=True)
class Content:
    """The content of a bank in memory. Keys are canonical labels; lists and dicts are in order of age.

    Attributes:
        intents: The intents by key.
        planners: The planners of each intent, including retired ones, by key.
        retired: The (key, hash) of each retired planner.
        evidence: All evidence.
        settings: The settings, by their own keys.
    """

    intents: dict[str, IntentRecord] = field(default_factory=dict)
    planners: dict[str, list[Planner]] = field(default_factory=dict)
    retired: set[tuple[str, str]] = field(default_factory=set)
    evidence: list[Evidence] = field(default_factory=list)
    settings: dict[str, Any] = field(default_factory=dict)


def read_snapshot(connection: sqlite3.Connection) -> Content:
    """Read everything, from one consistent view of the file.

    Args:
        connection: The connection to the bank.

    Raises:
        BankError: The content is not that of a bank.
    """
    with connection:
        connection.execute("BEGIN")
        return read(connection)


def read(connection: sqlite3.Connection) -> Content:
    """Read everything, within a transaction of the caller.

    Args:
        connection: The connection to the bank.

    Raises:
        BankError: The content is not that of a bank.
    """
    content = Content()
    keys: dict[int, str] = {}
    for id_, key, *rest in connection.execute(
        "SELECT id, key, label, description, applies, status FROM intents ORDER BY id"
    ):
        with _named(connection, f"row {id_} of its intents"):
            record = _intent(key, *rest)
        keys[id_] = key
        content.intents[key] = record
        content.planners[key] = []
    for row, id_, status, planner_hash, *rest in connection.execute(
        f"SELECT id, intent, status, hash, {_PLANNER_COLUMNS} FROM planners ORDER BY id"
    ):
        key = keys[id_]
        with _named(connection, f"row {row} of its planners"):
            planner = _planner(content.intents[key].label, planner_hash, *rest)
        content.planners[key].append(planner)
        if status == "retired":
            content.retired.add((key, planner.hash))
    for row, id_, planner_hash, *values in connection.execute(
        f"SELECT id, intent, planner, {', '.join(_EVIDENCE_COLUMNS)} FROM evidence ORDER BY id"
    ):
        with _named(connection, f"row {row} of its evidence"):
            content.evidence.append(_evidence(content.intents[keys[id_]].label, planner_hash, values))
    content.settings = read_settings(connection)
    return content


@contextmanager
def _named(connection: sqlite3.Connection, row: str) -> Iterator[None]:
    """Raise errors about a faulty row as a BankError that names the file and the row."""
    try:
        yield
    except (ValueError, TypeError, RecursionError, BankError) as error:
        fault = str(error).rstrip(".")
        path = connection.execute("PRAGMA database_list").fetchone()[2]
        raise BankError(f"The memory bank {path} is damaged in {row}: {fault[:300]}; {REPAIR_ADVICE}.") from error


def read_settings(connection: sqlite3.Connection) -> dict[str, Any]:
    """Read all settings by key.

    Args:
        connection: The connection to the bank.

    Raises:
        BankError: A setting has a wrong value.
    """
    settings = {}
    for key, value in connection.execute("SELECT key, value FROM settings ORDER BY key"):
        with _named(connection, f"its setting {str(key)[:80]!r}"):
            settings[key] = _setting(key, value)
    return settings


def insert_intent(connection: sqlite3.Connection, record: IntentRecord, now: str) -> None:
    """Add an intent unless the bank has one with that label in any spelling.

    Args:
        connection: The connection to the bank.
        record: The intent.
        now: The time stamp of the row.
    """
    connection.execute(
        "INSERT INTO intents (key, label, description, applies, status, created) VALUES (?, ?, ?, ?, ?, ?)"
        " ON CONFLICT (key) DO NOTHING",
        (canonical(record.label), record.label, record.description, _json(record.applies), record.status, now),
    )


def read_intent(connection: sqlite3.Connection, label: str) -> IntentRecord | None:
    """Read an intent as stored.

    Args:
        connection: The connection to the bank.
        label: Its label, in any spelling.

    Returns:
        The intent, or None if the bank lacks it.
    """
    key = canonical(label)
    row = connection.execute("SELECT label, description, applies, status FROM intents WHERE key = ?", (key,)).fetchone()
    return None if row is None else _intent(key, *row)


def insert_planner(connection: sqlite3.Connection, label: str, planner: Planner, now: str, status: str) -> None:
    """Add a planner to an existing intent, unless the intent has a planner with that text.

    Args:
        connection: The connection to the bank.
        label: The label of the intent.
        planner: The planner.
        now: The time stamp of the row.
        status: ``active`` or ``retired``.

    Raises:
        BankError: The planner's parameters are wrong.
    """
    try:
        _check_parameters(planner)
    except ValueError as error:
        raise BankError(f"The planner cannot be kept: {error}.") from error
    parameters = [list(asdict(parameter).values()) for parameter in planner.parameters]
    connection.execute(
        "INSERT INTO planners (intent, mode, source, parameters, hash, parent, origin, status, created)"
        " SELECT id, ?, ?, ?, ?, ?, ?, ?, ? FROM intents WHERE key = ?"
        " ON CONFLICT (intent, hash) DO NOTHING",
        (
            planner.mode, planner.text, _json(parameters), planner.hash, planner.parent, planner.origin,
            status, now, canonical(label),
        ),
    )  # fmt: skip


def read_planner(connection: sqlite3.Connection, label: str, planner_hash: str) -> tuple[Planner, str] | None:
    """Read a planner of an intent as stored.

    Args:
        connection: The connection to the bank.
        label: The label of the intent.
        planner_hash: The hash of the planner's text.

    Returns:
        The planner and its status, or None if the bank lacks it.
    """
    row = connection.execute(
        f"SELECT planners.status, intents.label, hash, {_PLANNER_COLUMNS} FROM planners"
        " JOIN intents ON intents.id = planners.intent WHERE key = ? AND hash = ?",
        (canonical(label), planner_hash),
    ).fetchone()
    return None if row is None else (_planner(*row[1:]), row[0])


def insert_evidence(connection: sqlite3.Connection, evidence: Evidence, now: str, *, wake: bool = True) -> None:
    """Add evidence about an existing intent and planner.

    Args:
        connection: The connection to the bank.
        evidence: The evidence.
        now: The time stamp of the row.
        wake: Whether a success makes the intent and the planner active again.
    """
    scene = evidence.scene
    values = (
        scene.geometry, scene.relation, _json(scene.relative), scene.controller, _json(evidence.parameters),
        acceleration_at(evidence.acceleration, 0.0),
        _json(evidence.acceleration) if isinstance(evidence.acceleration, tuple) else None,
        evidence.delay, evidence.attempts,
        None if math.isinf(evidence.min_ttc) else evidence.min_ttc,
        *(getattr(evidence, name) for name in EVIDENCE_FLAGS), evidence.version, evidence.network, evidence.seed, now,
    )  # fmt: skip
    key = canonical(evidence.label)
    connection.execute(
        f"INSERT INTO evidence (intent, planner, {', '.join(_EVIDENCE_COLUMNS)})"
        f" SELECT id, ?, {', '.join('?' * len(values))} FROM intents WHERE key = ?",
        (evidence.planner_hash, *values, key),
    )
    if wake and evidence.success:
        set_intent_status(connection, key, "active")
        set_planner_status(connection, key, evidence.planner_hash, "active")


def set_intent_status(connection: sqlite3.Connection, key: str, status: str) -> None:
    """Make an intent active or retired.

    Args:
        connection: The connection to the bank.
        key: The canonical label of the intent.
        status: ``active`` or ``retired``.
    """
    connection.execute("UPDATE intents SET status = ? WHERE key = ? AND status != ?", (status, key, status))


def set_planner_status(connection: sqlite3.Connection, key: str, planner_hash: str, status: str) -> None:
    """Make a planner active or retired.

    Args:
        connection: The connection to the bank.
        key: The canonical label of its intent.
        planner_hash: The hash of the planner's text.
        status: ``active`` or ``retired``.
    """
    connection.execute(
        "UPDATE planners SET status = ? WHERE hash = ? AND status != ?"
        " AND intent = (SELECT id FROM intents WHERE key = ?)",
        (status, planner_hash, status, key),
    )


def resolve(settings: Mapping[str, Any], label: str) -> str:
    """Follow merges to the intent that took over a label.

    Args:
        settings: The settings of the bank.
        label: The label to look up.

    Returns:
        The label at the end of the merges, or ``label`` if the intent was not merged.
    """
    seen: set[str] = set()
    while (key := canonical(label)) not in seen and isinstance(into := settings.get(f"{MERGED_KEY_PREFIX}{key}"), str):
        seen.add(key)
        label = into
    return label


def write_setting(connection: sqlite3.Connection, key: str, value: object) -> None:
    """Set one setting.

    Args:
        connection: The connection to the bank.
        key: The key of the setting.
        value: A JSON value.
    """
    connection.execute(
        "INSERT INTO settings VALUES (?, ?) ON CONFLICT (key) DO UPDATE SET value = excluded.value", (key, _json(value))
    )


def canonical_items(content: Content) -> Iterator[list[Any]]:
    """Yield the content as lists that JSON can hold, without row numbers and time stamps.

    Args:
        content: The content of a bank.
    """
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
    """Return evidence as it reads back: under the intent's own label, with its time stamp and plain dicts.

    Args:
        evidence: The evidence.
        label: The label of the intent as the bank spells it.
        now: The time stamp of the row.
    """
    scene = replace(evidence.scene, relative=dict(evidence.scene.relative))
    return replace(evidence, label=label, scene=scene, parameters=dict(evidence.parameters), created=now)


def _json(value: object) -> str:
    """Return a value as JSON text; raise BankError for a number that is not finite."""
    plain = dict(value) if isinstance(value, Mapping) else value
    try:
        return json.dumps(plain, sort_keys=True, allow_nan=False)
    except ValueError:
        raise BankError("The memory bank keeps finite numbers only; infinity or not-a-number was given.") from None
