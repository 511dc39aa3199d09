"""Banks from text: ``<slug>/intent.toml``, ``<mode>.py`` beside it and, in an export, ``evidence.csv``.

``intent.toml`` holds label, description and applies. Its table ``[shared]`` names modes whose text several intents
share: ``weave = { movement = "left" }`` takes ``planners/weave.template`` and writes ``left`` for ``$movement`` and the
intent's label for ``$label``. An export has no shared texts. It may add ``status``, ``merged_into`` and a table
``[planners.<file>]`` with mode (if it is not the file's name), origin, parent and status. ``compositions.toml`` beside
the folders may hold tables ``[[compositions]]``. No function here runs a planner.
"""

from __future__ import annotations

import csv
import io
import json
import math
import sqlite3
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

from sumo_adv.datatypes import Parameter, Planner, acceleration_of, plain_acceleration
from sumo_adv.errors import BankError, SumoAdvError
from sumo_adv.memory import edits, rows
from sumo_adv.memory.bank import EPSILON_KEY, MemoryBank, all_compositions
from sumo_adv.memory.migrations import APPLICATION_ID, Clock, migrate
from sumo_adv.memory.records import (
    EVIDENCE_FLAGS,
    STATUSES,
    Composition,
    Evidence,
    IntentRecord,
    SceneSignature,
    StoredIntent,
    canonical,
    composition_of,
    named_numbers,
    plain_composition,
)
from sumo_adv.memory.similarity import TextAndSlots
from sumo_adv.memory.store import as_bank_errors, make_file
from sumo_adv.parsing import parse_json, parse_toml

Parse = Callable[[str], tuple[Parameter, ...]]
Refuse = Callable[[str, str, BankError], None]
"""Takes the label (or the folder's name), the planner's file (or ``EVERYTHING``) and the error."""

EVERYTHING = "everything"

SEED_TIME = "1970-01-01T00:00:00+00:00"  # time stamp of all rows of a built bank; building twice gives the same bytes
EVIDENCE_FILE = "evidence.csv"
COMPOSITIONS_FILE = "compositions.toml"
MAX_LABEL_CHARACTERS = 400  # in a composition's label, which may combine those of three intents
SHARED_FOLDER = "planners"  # folder of the texts that several intents share
MAX_TEXT_FILE_BYTES = 256 * 1024  # size limit of an intent.toml or a planner
MAX_EVIDENCE_BYTES = 64 * 1024 * 1024
_KEYS = {"label": str, "description": str, "applies": list}
_MORE_KEYS = {"shared": dict, "status": str, "merged_into": str, "planners": dict}
_PLANNER_KEYS = {"mode", "origin", "parent", "status"}
EVIDENCE_FILE_COLUMNS = (
    "planner", "geometry", "relation", "controller", "relative", "parameters", "acceleration", "delay", "attempts",
    "min_ttc", *EVIDENCE_FLAGS, "version", "network", "seed",
)  # fmt: skip
MAX_EVIDENCE_ROWS = 200_000  # in a file; this many take about 150 MB in memory


def read_folder(folder: Path, parse: Parse, refuse: Refuse | None = None) -> list[StoredIntent]:
    """Read the intents of a folder.

    Args:
        folder: The folder of a bank in text.
        parse: Reads a planner's PARAMETERS table without running the planner.
        refuse: Called for each planner and intent that cannot be read. They are left out, and so is their evidence. If
            None, an error is raised instead.

    Returns:
        The intents by slug.

    Raises:
        BankError: A file is missing or wrong, is a link or has an unknown key; an intent has no planners; or a label is
            used twice.
    """
    files = sorted(folder.glob("*/intent.toml"))
    if not files:
        raise BankError(f"{folder} holds no <intent>/intent.toml, so there is no bank to build or import.")
    intents = [stored for file in files if (stored := _taken(file, parse, refuse)) is not None]
    seen: dict[str, str] = {}
    for stored in intents:
        label = stored.intent.label
        if canonical(label) in seen:
            raise BankError(
                f"Two folders of {folder} hold the intent {label!r}; labels must differ by letters or digits."
            )
        seen[canonical(label)] = label
    return intents


def read_compositions(folder: Path) -> list[Composition]:
    """Read the composed intents of a folder.

    Args:
        folder: The folder of a bank in text.

    Returns:
        The compositions; none without their file.

    Raises:
        BankError: The file is wrong.
    """
    file = folder / COMPOSITIONS_FILE
    if not (file.exists() or file.is_symlink()):
        return []
    try:
        table = parse_toml(_read_text(file, MAX_TEXT_FILE_BYTES))
        if table.keys() != {"compositions"} or not isinstance(table["compositions"], list):
            raise ValueError("it must hold tables [[compositions]] and nothing else")
        made = [composition_of(each) for each in table["compositions"]]
    except ValueError as error:
        raise BankError(f"{file} cannot be read: {str(error).rstrip('.')}.") from error
    texts = [text for c in made for text in (c.label, c.description, *(t for p in c.parts for t in (p.intent, p.mode)))]
    if not all(text.isprintable() for text in texts) or any(len(c.label) > MAX_LABEL_CHARACTERS for c in made):
        raise BankError(
            f"{file} must hold texts that can be printed, and labels of at most {MAX_LABEL_CHARACTERS} characters."
        )
    if len({c.key for c in made}) < len(made):
        raise BankError(f"{file} holds a composition twice; labels must differ by letters or digits.")
    return made


def read_intent_file(file: Path) -> IntentRecord:
    """Read the intent of one ``intent.toml``.

    Args:
        file: The path of the file.

    Raises:
        BankError: The file is wrong.
    """
    return _intent(_read_toml(file))


def _read_toml(file: Path) -> dict[str, Any]:
    """Read an ``intent.toml`` and check its keys, types and label."""
    try:
        table = parse_toml(_read_text(file, MAX_TEXT_FILE_BYTES))
    except ValueError as error:
        raise BankError(f"{file} cannot be read as TOML: {error}.") from error
    types = {**_KEYS, **_MORE_KEYS}
    if not set(_KEYS) <= set(table) <= set(types) or any(not isinstance(v, types[k]) for k, v in table.items()):
        raise BankError(
            f"{file} must hold label and description (texts) and applies (a list), may hold {', '.join(_MORE_KEYS)},"
            f" and has {sorted(table)}."
        )
    if not table["label"].isprintable() or len(table["label"]) > 120:
        raise BankError(f"{file} needs a label of at most 120 characters that can be printed.")
    return table


def _read_text(file: Path, limit: int) -> str:
    """Return the text of a regular file; refuse anything else, such as a link out of the folder."""
    try:
        if file.parent.is_symlink():
            raise BankError(f"{file.parent} is a link; a bank in text holds plain folders and files only.")
        if file.is_symlink() or not file.is_file():
            raise BankError(f"{file} is not a plain file; a bank in text holds plain files only.")
        if file.stat().st_size > limit:
            raise BankError(f"{file} is larger than {limit} bytes, the limit for such a file.")
        return file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise BankError(f"{file} is not text in UTF-8.") from error
    except OSError as error:
        raise BankError(f"{file} cannot be read: {error.strerror or error}.") from error


def _intent(table: Mapping[str, Any]) -> IntentRecord:
    """Return the intent that a table describes."""
    description = "".join(c for c in " ".join(table["description"].split()) if c.isprintable())
    return IntentRecord(table["label"], description, tuple(map(str, table["applies"])), table.get("status", "active"))


def _taken(file: Path, parse: Parse, refuse: Refuse | None) -> StoredIntent | None:
    """Read an intent; if it cannot be read, call ``refuse`` and return None."""
    try:
        return _read_stored(file, parse, refuse)
    except BankError as error:
        if refuse is None:
            raise
        refuse(file.parent.name, EVERYTHING, error)
        return None


def _read_stored(file: Path, parse: Parse, refuse: Refuse | None) -> StoredIntent:
    """Read an intent with its planners and evidence."""
    folder, table = file.parent, _read_toml(file)
    intent, merged_into = _intent(table), table.get("merged_into")
    details: dict[str, dict[str, str]] = table.get("planners", {})
    shared = _shared(file, table.get("shared", {}))
    files = {path.stem: path for path in folder.glob("*.py")}
    if both := shared.keys() & files.keys():
        raise BankError(f"{file} shares the modes {sorted(both)}, which have files of their own beside it; keep one.")
    names = sorted([*files, *shared])
    if any(not name.isprintable() or len(name) > 120 for name in names):
        raise BankError(f"{folder} has a planner whose file name is too long or cannot be printed.")
    for name, each in details.items():
        if name not in names or not isinstance(each, dict) or not set(each) <= _PLANNER_KEYS:
            raise BankError(f"{file} has a wrong table for the planner {name!r}; it may hold {sorted(_PLANNER_KEYS)}.")
        if any(not isinstance(v, str) or not v.isprintable() or len(v) > 120 for v in each.values()):
            raise BankError(f"{file} must describe the planner {name!r} in short texts.")
        if each.get("status", "active") not in STATUSES:
            raise BankError(f"{file} gives the planner {name!r} a status that is neither active nor retired.")
    planners: dict[str, Planner] = {}
    for name in names:
        try:
            path = files.get(name, folder.parent / SHARED_FOLDER / f"{name}.template")
            text = _read_text(path, MAX_TEXT_FILE_BYTES)
            if name in shared:
                text = _filled(path, text, intent.label, shared[name])
            planners[name] = _planner(path, text, intent.label, details.get(name, {}), parse)
        except BankError as error:
            if refuse is None:
                raise
            refuse(intent.label, details.get(name, {}).get("mode", name), error)
    if not planners and merged_into is None:
        raise BankError(f"{folder} has no planner; an intent needs at least one <mode>.py or shared mode.")
    hashes = {name: planner.hash for name, planner in planners.items()}
    if len(set(hashes.values())) < len(planners):
        raise BankError(f"{folder} has two planners with the same text; each mode needs its own.")
    retired = frozenset(hashes[n] for n, each in details.items() if n in hashes and each.get("status") == "retired")
    file = folder / EVIDENCE_FILE
    evidence: tuple[Evidence, ...] = ()
    if file.exists() or file.is_symlink():
        left_out = set(names) - set(hashes)
        evidence = read_evidence(_read_text(file, MAX_EVIDENCE_BYTES), intent.label, hashes, str(file), left_out)
    return StoredIntent(intent, tuple(planners.values()), retired, evidence, merged_into)


def _shared(file: Path, table: Mapping[str, Any]) -> Mapping[str, Mapping[str, str]]:
    """Return the words of each shared mode, from the table ``[shared]`` of ``file``."""
    for mode, words in table.items():
        if not mode.isidentifier() or not isinstance(words, dict):
            raise BankError(f"{file} must give each mode of [shared] as a name and a table of words, not {mode!r}.")
        if any(not isinstance(w, str) or not w.isprintable() or len(w) > 120 for w in words.values()):
            raise BankError(f"{file} must give the words of the shared mode {mode!r} as short texts.")
    return table


def _filled(path: Path, text: str, label: str, words: Mapping[str, str]) -> str:
    """Replace ``$label`` and the other ``$`` words of a shared text; ``words`` must give exactly those others."""
    template = Template(text)
    needed = set(template.get_identifiers()) - {"label"}
    if not template.is_valid() or needed != words.keys():
        raise BankError(f"{path} needs the words {sorted(needed)} in [shared], and is given {sorted(words)}.")
    return template.substitute(words, label=label)


def _planner(path: Path, text: str, label: str, details: Mapping[str, str], parse: Parse) -> Planner:
    """Return the planner in a file."""
    try:
        parameters = parse(text)
    except SumoAdvError as error:
        raise BankError(f"{path} is not a planner: {error}") from error
    mode = details.get("mode", path.stem)
    return Planner(label, mode, text, parameters, details.get("origin", "seed"), details.get("parent"))


def build(folder: Path, target: Path, parse: Parse) -> None:
    """Write the bank of the intents in a folder, whole or not at all.

    The file is in rollback-journal mode, so that reading it makes no files beside it.

    Args:
        folder: The folder of a bank in text.
        target: The path of the bank; an existing file is replaced.
        parse: Reads a planner's PARAMETERS table without running the planner.

    Raises:
        BankError: The folder cannot be read, or the file cannot be written.
    """
    settings: dict[str, object] = {
        EPSILON_KEY: {"epsilon": TextAndSlots.epsilon, "calibrated_on": TextAndSlots.calibrated_on},
        **{c.key: plain_composition(c) for c in read_compositions(folder)},
    }
    _write(target, read_folder(folder, parse), settings, lambda: SEED_TIME, replace=True)


def write_part(bank: MemoryBank, target: Path, labels: Iterable[str], clock: Clock) -> list[str]:
    """Write a new bank with some intents of another one.

    The new bank has their planners and evidence, the epsilon, and the compositions whose intents are all among them.

    Args:
        bank: The bank to copy from.
        target: The path of the new bank.
        labels: The labels of the intents.
        clock: Returns the time stamp of the rows.

    Returns:
        The labels of the intents, as the bank spells them.

    Raises:
        BankError: The bank lacks a label, or the target exists.
    """
    chosen = {canonical(label): label for label in labels}
    intents = [stored for stored in bank.stored_intents() if canonical(stored.intent.label) in chosen]
    lacking = chosen.keys() - {canonical(stored.intent.label) for stored in intents}
    if lacking or not intents:
        named = ", ".join(repr(chosen[key]) for key in sorted(lacking)) or "nothing"
        there = ", ".join(record.label for record in bank.intents())
        raise BankError(f"The bank has no intent {named}; it has: {there}.")
    if target.exists():
        raise BankError(f"{target} exists; give the path of a new bank.")
    left_out = {canonical(record.label) for record in bank.intents()} - chosen.keys()
    composed = {
        c.key: plain_composition(c)
        for c in all_compositions(bank)
        if left_out.isdisjoint(canonical(part.intent) for part in c.parts)
    }
    _write(target, intents, {**bank.settings(rows.EPSILON_KEY_PREFIX), **composed}, clock, replace=False)
    return [stored.intent.label for stored in intents]


def _write(
    target: Path, intents: list[StoredIntent], settings: Mapping[str, object], clock: Clock, *, replace: bool
) -> None:
    """Write a bank, whole or not at all; an existing file is kept unless ``replace``."""

    def fill(connection: sqlite3.Connection) -> None:
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        migrate(connection, str(target), clock)
        with connection:
            connection.execute("BEGIN IMMEDIATE")
            edits.absorb(connection, intents, clock(), unique_modes=False)
            for key, value in settings.items():
                rows.write_setting(connection, key, value)

    with as_bank_errors(target):
        make_file(target, fill, replace=replace)


# Evidence as a CSV file, one row a piece, sorted. Columns: ``planner`` (the name of its file without ``.py``), then
# the fields of Evidence. ``relative`` and ``parameters`` are JSON objects of numbers. ``acceleration`` is a number or a
# JSON list of [time, m/s2]. Flags are 1 or 0. What does not apply is empty, as is an infinite TTC. Time stamps are
# left out, because they are no part of a bank's content.


def write_evidence(evidence: Sequence[Evidence], names: Mapping[str, str]) -> str:
    """Return the text of an evidence file.

    Args:
        evidence: The evidence of one intent.
        names: The name of each planner's file, by the planner's hash.
    """
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(EVIDENCE_FILE_COLUMNS)
    writer.writerows(sorted(_row(each, names[each.planner_hash]) for each in evidence))
    return lines.getvalue()


def _row(e: Evidence, name: str) -> list[str]:
    """Return the row of a piece of evidence; ``name`` is the planner's file."""
    return [
        name, e.scene.geometry, e.scene.relation, e.scene.controller,
        json.dumps(dict(e.scene.relative), sort_keys=True), json.dumps(dict(e.parameters), sort_keys=True),
        json.dumps(plain_acceleration(e.acceleration)), repr(float(e.delay)), str(e.attempts),
        "" if math.isinf(e.min_ttc) else repr(float(e.min_ttc)),
        *("" if (flag := getattr(e, name)) is None else str(int(flag)) for name in EVIDENCE_FLAGS),
        e.version, e.network, str(e.seed),
    ]  # fmt: skip


def read_evidence(
    text: str, label: str, hashes: Mapping[str, str], where: str, left_out: Collection[str] = ()
) -> tuple[Evidence, ...]:
    """Read evidence about an intent from the text of a file.

    Args:
        text: The text of the file.
        label: The label of the intent.
        hashes: The hash of each planner, by the name of its file.
        where: The file's name, for error messages.
        left_out: Names of planners whose rows are skipped.

    Raises:
        BankError: A row is wrong. The message names the line.
    """
    try:
        lines = csv.reader(io.StringIO(text), strict=True)
        head = tuple(next(lines, ()))
        if head != EVIDENCE_FILE_COLUMNS:
            raise BankError(f"{where} must have the columns {', '.join(EVIDENCE_FILE_COLUMNS)}.")
        evidence: list[Evidence] = []
        for row in lines:
            if len(evidence) >= MAX_EVIDENCE_ROWS:
                raise BankError(f"{where} has more than {MAX_EVIDENCE_ROWS} rows; leave old ones out.")
            if row and row[0] in left_out:
                continue
            try:
                evidence.append(_evidence(dict(zip(EVIDENCE_FILE_COLUMNS, row, strict=True)), label, hashes))
            except (ValueError, KeyError, TypeError, RecursionError, BankError) as error:
                fault = str(error).rstrip(".")
                raise BankError(f"{where}, line {lines.line_num}, is not evidence: {fault}.") from error
    except csv.Error as error:
        raise BankError(f"{where} cannot be read as CSV: {error}.") from error
    return tuple(evidence)


def _evidence(row: Mapping[str, str], label: str, hashes: Mapping[str, str]) -> Evidence:
    """Return the evidence of a row; raise ValueError or another error if a value is wrong."""
    if row["planner"] not in hashes:
        raise ValueError(f"there is no planner {row['planner'][:80]!r}")
    for name in ("geometry", "relation", "controller", "version", "network"):
        if len(row[name]) > 200 or not row[name].isprintable():
            raise ValueError(f"{name} must be short text")
    flags: dict[str, Any] = {
        name: None if not row[name] and name in ("valid", "strict") else _flag(row[name]) for name in EVIDENCE_FLAGS
    }
    return Evidence(
        label=label,
        planner_hash=hashes[row["planner"]],
        scene=SceneSignature(
            row["geometry"], row["relation"], named_numbers(parse_json(row["relative"])), row["controller"]
        ),
        attempts=int(row["attempts"]),
        min_ttc=_number(row["min_ttc"]) if row["min_ttc"] else math.inf,
        **flags,
        version=row["version"],
        network=row["network"],
        seed=int(row["seed"]),
        parameters=named_numbers(parse_json(row["parameters"])),
        acceleration=acceleration_of(parse_json(row["acceleration"])),
        delay=_number(row["delay"]),
    )


def _flag(text: str) -> bool:
    """Parse a flag: 1 or 0."""
    if text not in ("0", "1"):
        raise ValueError(f"yes or no must be 1 or 0, not {text[:20]!r}")
    return text == "1"


def _number(text: str) -> float:
    """Parse a finite number."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:20]!r} is not a finite number")
    return value
