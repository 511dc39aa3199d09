"""Banks from text: ``<slug>/intent.toml``, ``<mode>.py`` beside it and, in an export, ``evidence.csv``.

``intent.toml`` holds label, description and applies. Its table ``[shared]`` names modes whose text several intents
share: ``weave = { movement = "left" }`` takes ``planners/weave.template`` and writes ``left`` for ``$movement`` and the
intent's label for ``$label``. An export has no shared texts. It may add ``status``, ``merged_into`` and a table
``[planners.<file>]`` with mode (if it is not the file's name), origin, parent and status. ``compositions.toml`` beside
the folders may hold tables ``[[compositions]]``. Nothing here runs a planner.
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
"""Takes the label (or the folder's name), the planner's file (or ``EVERYTHING``) and what is wrong with it."""

EVERYTHING = "everything"

SEED_TIME = "1970-01-01T00:00:00+00:00"  # of all rows of a built bank, so that building twice gives the same bytes
EVIDENCE_FILE = "evidence.csv"
COMPOSITIONS_FILE = "compositions.toml"
MAX_LABEL_CHARACTERS = 400  # of a composition's label, which may be put together from those of three intents
SHARED_FOLDER = "planners"  # of the texts that several intents share
MAX_TEXT_FILE_BYTES = 256 * 1024  # of an intent.toml or a planner
MAX_EVIDENCE_BYTES = 64 * 1024 * 1024
_KEYS = {"label": str, "description": str, "applies": list}
_MORE_KEYS = {"shared": dict, "status": str, "merged_into": str, "planners": dict}
_PLANNER_KEYS = {"mode", "origin", "parent", "status"}
EVIDENCE_FILE_COLUMNS = (
    "planner", "geometry", "relation", "controller", "relative", "parameters", "acceleration", "delay", "attempts",
    "min_ttc", *EVIDENCE_FLAGS, "version", "network", "seed",
)  # fmt: skip
MAX_EVIDENCE_ROWS = 200_000  # of a file: about 150 MB in memory


def read_folder(folder: Path, parse: Parse, refuse: Refuse | None = None) -> list[StoredIntent]:
    """The intents of ``folder`` by slug. ``parse`` reads a planner's PARAMETERS table without running it.

    Raises BankError for a missing or wrong file, a link, an unknown key, an intent without planners, a label used
    twice. With ``refuse``, planners that cannot be read (and their evidence) and intents that cannot are told to it
    and left out.
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
    """The composed intents of ``folder``; empty without their file. Raises BankError for a wrong one."""
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
    """The intent of one ``intent.toml``. Raises BankError."""
    return _intent(_read_toml(file))


def _read_toml(file: Path) -> dict[str, Any]:
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
    """The text of a regular file; anything else, such as a link out of the folder, is refused."""
    try:
        if file.parent.is_symlink():
            raise BankError(f"{file.parent} is a link; a bank in text holds plain folders and files only.")
        if file.is_symlink() or not file.is_file():
            raise BankError(f"{file} is not a plain file; a bank in text holds plain files only.")
        if file.stat().st_size > limit:
            raise BankError(f"{file} is larger than {limit} bytes, which no such file needs to be.")
        return file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise BankError(f"{file} is not text in UTF-8.") from error
    except OSError as error:
        raise BankError(f"{file} cannot be read: {error.strerror or error}.") from error


def _intent(table: Mapping[str, Any]) -> IntentRecord:
    description = "".join(c for c in " ".join(table["description"].split()) if c.isprintable())
    return IntentRecord(table["label"], description, tuple(map(str, table["applies"])), table.get("status", "active"))


def _taken(file: Path, parse: Parse, refuse: Refuse | None) -> StoredIntent | None:
    try:
        return _read_stored(file, parse, refuse)
    except BankError as error:
        if refuse is None:
            raise
        refuse(file.parent.name, EVERYTHING, error)
        return None


def _read_stored(file: Path, parse: Parse, refuse: Refuse | None) -> StoredIntent:
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
    """The words of each shared mode, from the table ``[shared]`` of ``file``."""
    for mode, words in table.items():
        if not mode.isidentifier() or not isinstance(words, dict):
            raise BankError(f"{file} must give each mode of [shared] as a name and a table of words, not {mode!r}.")
        if any(not isinstance(w, str) or not w.isprintable() or len(w) > 120 for w in words.values()):
            raise BankError(f"{file} must give the words of the shared mode {mode!r} as short texts.")
    return table


def _filled(path: Path, text: str, label: str, words: Mapping[str, str]) -> str:
    """The shared text with ``$label`` and its other ``$`` words replaced; ``words`` must give exactly those others."""
    template = Template(text)
    needed = set(template.get_identifiers()) - {"label"}
    if not template.is_valid() or needed != words.keys():
        raise BankError(f"{path} needs the words {sorted(needed)} in [shared], and is given {sorted(words)}.")
    return template.substitute(words, label=label)


def _planner(path: Path, text: str, label: str, details: Mapping[str, str], parse: Parse) -> Planner:
    try:
        parameters = parse(text)
    except SumoAdvError as error:
        raise BankError(f"{path} is no planner: {error}") from error
    mode = details.get("mode", path.stem)
    return Planner(label, mode, text, parameters, details.get("origin", "seed"), details.get("parent"))


def build(folder: Path, target: Path, parse: Parse) -> None:
    """Write the bank of the intents in ``folder`` to ``target``, replacing what is there, whole or not at all.

    The file is in rollback-journal mode, so that reading it makes no files beside it. Raises BankError.
    """
    settings: dict[str, object] = {
        EPSILON_KEY: {"epsilon": TextAndSlots.epsilon, "calibrated_on": TextAndSlots.calibrated_on},
        **{c.key: plain_composition(c) for c in read_compositions(folder)},
    }
    _write(target, read_folder(folder, parse), settings, lambda: SEED_TIME, replace=True)


def write_part(bank: MemoryBank, target: Path, labels: Iterable[str], clock: Clock) -> list[str]:
    """A new bank at ``target`` with only these intents of ``bank``: with their planners and evidence, the epsilon, and
    the compositions that have no other intent of the bank. Returns their labels.

    Raises BankError, also for a label that the bank lacks or a target that exists.
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
    """A bank at ``target``, whole or not at all; one that exists is kept unless ``replace``."""

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
# those of Evidence; ``relative`` and ``parameters`` are JSON objects of numbers, ``acceleration`` is a number or a JSON
# list of [time, m/s2], yes or no is 1 or 0, and what does not arise (or a TTC that is never) is empty. Time stamps are
# left out: they are no part of a bank's content.


def write_evidence(evidence: Sequence[Evidence], names: Mapping[str, str]) -> str:
    """The text of the file; ``names``: planner hash -> name of its file."""
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(EVIDENCE_FILE_COLUMNS)
    writer.writerows(sorted(_row(each, names[each.planner_hash]) for each in evidence))
    return lines.getvalue()


def _row(e: Evidence, name: str) -> list[str]:
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
    """Evidence about ``label`` from the text of a file; ``hashes``: name of a planner's file -> its hash; rows about
    the planners in ``left_out`` are passed over.

    Raises BankError with the line, ``where`` being the file's name for the sentence.
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
                raise BankError(f"{where}, line {lines.line_num}, is no evidence: {fault}.") from error
    except csv.Error as error:
        raise BankError(f"{where} cannot be read as CSV: {error}.") from error
    return tuple(evidence)


def _evidence(row: Mapping[str, str], label: str, hashes: Mapping[str, str]) -> Evidence:
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
    if text not in ("0", "1"):
        raise ValueError(f"yes or no is 1 or 0, not {text[:20]!r}")
    return text == "1"


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:20]!r} is not a finite number")
    return value
