"""The shipped bank from its text sources: ``memory_bank/<slug>/intent.toml`` and ``<mode>.py`` beside it."""

from __future__ import annotations

import os
import tempfile
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sumo_adv.datatypes import Parameter, Planner
from sumo_adv.errors import BankError, SumoAdvError
from sumo_adv.memory import rows
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.migrations import APPLICATION_ID, migrate
from sumo_adv.memory.records import IntentRecord, canonical
from sumo_adv.memory.similarity import TfIdf
from sumo_adv.memory.store import connect, sentences

Parse = Callable[[str], tuple[Parameter, ...]]

SEED_TIME = "1970-01-01T00:00:00+00:00"  # of all rows of a built bank, so that building twice gives the same bytes
_KEYS = {"label": str, "description": str, "applies": list}


@dataclass(frozen=True, slots=True)
class Source:
    """One intent of the sources and its planners, by mode."""

    intent: IntentRecord
    planners: tuple[Planner, ...]


def read_sources(folder: Path, parse: Parse) -> list[Source]:
    """The intents of ``folder`` by slug. ``parse`` reads a planner's PARAMETERS table without running it.

    Raises BankError for a missing or wrong file, an unknown key, an intent without planners, a label used twice.
    """
    files = sorted(folder.glob("*/intent.toml"))
    if not files:
        raise BankError(f"{folder} holds no <intent>/intent.toml, so there is no bank to build.")
    sources = [Source(intent := read_intent(file), _read_planners(file.parent, intent.label, parse)) for file in files]
    seen: dict[str, str] = {}
    for source in sources:
        label = source.intent.label
        if canonical(label) in seen:
            raise BankError(
                f"Two folders of {folder} hold the intent {label!r}; labels must differ by letters or digits."
            )
        seen[canonical(label)] = label
    return sources


def read_intent(file: Path) -> IntentRecord:
    """One ``intent.toml``. Raises BankError."""
    try:
        table = tomllib.loads(file.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, OSError) as error:
        raise BankError(f"{file} cannot be read as TOML: {error}.") from error
    if set(table) != set(_KEYS) or any(not isinstance(table[key], kind) for key, kind in _KEYS.items()):
        raise BankError(
            f"{file} must hold label and description (texts) and applies (a list), and has {sorted(table)}."
        )
    return IntentRecord(table["label"], " ".join(table["description"].split()), tuple(map(str, table["applies"])))


def _read_planners(folder: Path, label: str, parse: Parse) -> tuple[Planner, ...]:
    planners = []
    for file in sorted(folder.glob("*.py")):
        try:
            source = file.read_text(encoding="utf-8")
            parameters = parse(source)
        except (SumoAdvError, UnicodeDecodeError, OSError) as error:
            raise BankError(f"{file} is no planner: {error}") from error
        planners.append(Planner(label, file.stem, source, parameters, "seed"))
    if not planners:
        raise BankError(f"{folder} has no planner; an intent needs at least one <mode>.py.")
    if len({planner.hash for planner in planners}) < len(planners):
        raise BankError(f"{folder} has two planners with the same text; each mode needs its own.")
    return tuple(planners)


def build(folder: Path, target: Path, parse: Parse) -> None:
    """Write the bank of the sources in ``folder`` to ``target``, replacing what is there, whole or not at all.

    The file is in rollback-journal mode, so that reading it makes no files beside it. Raises BankError.
    """
    sources = read_sources(folder, parse)
    with sentences(target):
        handle, name = tempfile.mkstemp(prefix=f".{target.name}-", suffix=".new", dir=target.parent)
        os.close(handle)
        fresh = Path(name)
        try:
            _write(fresh, sources)
            fresh.chmod(0o644)
            fresh.replace(target)
        finally:
            for leftover in (fresh, fresh.with_name(fresh.name + "-journal")):
                leftover.unlink(missing_ok=True)


def _write(fresh: Path, sources: list[Source]) -> None:
    connection = connect(fresh, "mode=rw")
    try:
        connection.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        migrate(connection, str(fresh), lambda: SEED_TIME)
        connection.execute("BEGIN IMMEDIATE")
        for source in sources:
            rows.insert_intent(connection, source.intent, SEED_TIME)
            for planner in source.planners:
                rows.insert_planner(connection, source.intent.label, planner, SEED_TIME)
        rows.write_setting(connection, *epsilon_setting())
        connection.execute("COMMIT")
    finally:
        connection.close()


def epsilon_setting() -> tuple[str, dict[str, object]]:
    """Key and value of the setting that a built bank carries: the default metric's epsilon."""
    return f"epsilon.{TfIdf.name}", {"epsilon": TfIdf.epsilon, "calibrated_on": TfIdf.calibrated_on}


def verify_same(folder: Path, bank_path: Path, parse: Parse) -> list[str]:
    """How the bank at ``bank_path``, which is only read, differs from the sources; empty if it does not.

    Each difference is one sentence. Raises BankError if either cannot be read.
    """
    sources = read_sources(folder, parse)
    with MemoryBank.open(bank_path, read_only=True) as bank:
        found = {record.label: record for record in bank.intents()}
        wanted = {source.intent.label: source for source in sources}
        differences = [f"The bank lacks the intent {label!r}." for label in wanted if label not in found]
        differences += [f"The sources lack the intent {label!r}." for label in found if label not in wanted]
        for label, source in wanted.items():
            if label in found:
                differences += _compare(source, found[label], bank.planners(label))
        if bank.evidence():
            differences.append("The bank holds evidence, and the sources have none.")
        value = epsilon_setting()[1]
        if bank.epsilon() != (value["epsilon"], value["calibrated_on"]):
            differences.append("The bank has another epsilon than the program.")
    return differences


def _compare(source: Source, found: IntentRecord, planners: list[Planner]) -> list[str]:
    label = found.label
    differences = (
        [] if found == source.intent else [f"The intent {label!r} differs in description, relations or status."]
    )
    wanted = {planner.hash: planner for planner in source.planners}
    stored = {planner.hash: planner for planner in planners}
    for planner in source.planners:
        if planner.hash not in stored:
            differences.append(f"The bank lacks the planner {planner.mode!r} of {label!r} as the sources have it.")
        elif stored[planner.hash] != planner:
            differences.append(f"The planner {planner.mode!r} of {label!r} differs in mode, parameters or origin.")
    for planner in planners:
        if planner.hash not in wanted:
            differences.append(f"The sources lack the planner {planner.mode!r} of {label!r} as the bank has it.")
    return differences
