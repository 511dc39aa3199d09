"""Changes to a bank's content other than new evidence: importing another bank's content, merging, retiring.

Call every function within a transaction. A BankError is raised before a change that cannot be finished.
"""

from __future__ import annotations

import json
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import asdict, dataclass, replace

from sumo_adv.errors import BankError
from sumo_adv.memory import rows
from sumo_adv.memory.records import (
    COMPOSITION_KEY_PREFIX,
    Composition,
    Evidence,
    IntentRecord,
    StoredIntent,
    canonical,
    composition_of,
    plain_composition,
    renamed,
)


@dataclass(slots=True)
class Absorbed:
    """How much of an import was new.

    Attributes:
        intents: The number of intents added.
        planners: The number of planners added.
        evidence: The number of pieces of evidence added.
        compositions: The number of compositions added.
    """

    intents: int = 0
    planners: int = 0
    evidence: int = 0
    compositions: int = 0


def absorb(
    connection: sqlite3.Connection, intents: Iterable[StoredIntent], now: str, *, unique_modes: bool,
    compositions: Iterable[Composition] = (),
) -> Absorbed:  # fmt: skip
    """Add what the bank lacks.

    A piece of evidence that the bank holds as often as ``intents`` do is not added again.

    Args:
        connection: The connection to the bank.
        intents: The intents with their planners and evidence.
        now: The time stamp of the new rows.
        unique_modes: Whether to number the mode of a new planner if another planner of its intent has that mode.
        compositions: The compositions.

    Returns:
        The numbers of additions.

    Raises:
        BankError: An intent is merged into one that the bank lacks.
    """
    intents = list(intents)
    added = Absorbed()
    content = rows.read(connection)
    held = Counter(_evidence_key(evidence) for evidence in content.evidence)
    for stored in intents:
        _absorb_one(connection, stored, content, held, now, added, unique_modes)
    for stored in intents:
        key = canonical(stored.intent.label)
        if stored.merged_into is not None and key not in content.intents:
            if rows.read_intent(connection, stored.merged_into) is None:
                raise BankError(
                    f"The intent {stored.intent.label!r} is merged into {stored.merged_into!r}, which does not exist."
                )
            rows.write_setting(connection, f"{rows.MERGED_KEY_PREFIX}{key}", stored.merged_into)
    for composition in compositions:
        if composition.key not in content.settings:
            rows.write_setting(connection, composition.key, plain_composition(composition))
            added.compositions += 1
    return added


def _absorb_one(
    connection: sqlite3.Connection, stored: StoredIntent, content: rows.Content, held: Counter[str], now: str,
    added: Absorbed, unique_modes: bool,
) -> None:  # fmt: skip
    """Add an intent, its planners and its evidence, and count them in ``added``."""
    label = rows.resolve(content.settings, stored.intent.label)
    key = canonical(label)
    if key not in content.intents:
        rows.insert_intent(connection, stored.intent, now)
        added.intents += 1
    else:
        label = content.intents[key].label
    held_planners = content.planners.get(key, [])
    hashes, modes = {planner.hash for planner in held_planners}, {planner.mode for planner in held_planners}
    for planner in stored.planners:
        if planner.hash in hashes:
            continue
        named = replace(planner, mode=free_mode(planner.mode, modes)) if unique_modes else planner
        modes.add(named.mode)
        status = "retired" if planner.hash in stored.retired else "active"
        rows.insert_planner(connection, label, named, now, status)
        added.planners += 1
    for evidence in stored.evidence:
        relabelled = replace(evidence, label=label)
        if held[_evidence_key(relabelled)] > 0:
            held[_evidence_key(relabelled)] -= 1
        else:
            rows.insert_evidence(connection, relabelled, now, wake=False)
            added.evidence += 1


def free_mode(mode: str, taken: Collection[str]) -> str:
    """Return a mode that is not taken.

    Args:
        mode: The wanted mode.
        taken: The modes in use.

    Returns:
        The mode, with the first free number from 2 on appended if it is taken.
    """
    number, name = 1, mode
    while name in taken:
        number += 1
        name = f"{mode}-{number}"
    return name


def _evidence_key(evidence: Evidence) -> str:
    """Return the content of a piece of evidence as text, without its time stamp; equal for equal pieces."""
    plain = asdict(evidence)
    del plain["created"]
    plain["label"] = canonical(evidence.label)
    return json.dumps(plain, sort_keys=True)


def merge(connection: sqlite3.Connection, label: str, into: str, now: str) -> None:
    """Merge intents; see ``MemoryBank.merge``.

    Args:
        connection: The connection to the bank.
        label: The label of the intent to merge.
        into: The label of the active intent that takes it over.
        now: The time stamp of the new rows.
    """
    content = rows.read(connection)
    merged, kept = _known(content, label), _known(content, into)
    old, target = canonical(merged.label), canonical(kept.label)
    if old == target:
        raise BankError(f"{label!r} and {into!r} are the same intent; name two.")
    if kept.status != "active":
        raise BankError(f"The intent {kept.label!r} is retired; merge into an active one.")
    modes = {planner.mode for planner in content.planners[target]}
    hashes = {planner.hash: planner.mode for planner in content.planners[target]}
    became = dict[str, str]()  # mode -> mode of the same planner after the merge
    for planner in content.planners[old]:
        retired = (old, planner.hash) in content.retired
        if planner.hash not in hashes:
            named = replace(planner, label=kept.label, mode=free_mode(planner.mode, modes))
            modes.add(named.mode)
            hashes[planner.hash] = named.mode
            rows.insert_planner(connection, kept.label, named, now, "retired" if retired else "active")
        elif not retired:
            rows.set_planner_status(connection, target, planner.hash, "active")
        became[planner.mode] = hashes[planner.hash]
    connection.execute(
        "UPDATE evidence SET intent = (SELECT id FROM intents WHERE key = ?)"
        " WHERE intent = (SELECT id FROM intents WHERE key = ?)",
        (target, old),
    )
    connection.execute("DELETE FROM planners WHERE intent = (SELECT id FROM intents WHERE key = ?)", (old,))
    rows.set_intent_status(connection, old, "retired")
    rows.write_setting(connection, f"{rows.MERGED_KEY_PREFIX}{old}", kept.label)
    for key, value in content.settings.items():
        if key.startswith(COMPOSITION_KEY_PREFIX):
            after = renamed(composition_of(value), merged.label, kept.label, became)
            rows.write_setting(connection, key, plain_composition(after))


def retire(connection: sqlite3.Connection, label: str, mode: str | None, *, back: bool) -> None:
    """Retire an intent or planners; see ``MemoryBank.retire``.

    Args:
        connection: The connection to the bank.
        label: The label of the intent.
        mode: The mode of the planners; None means the intent itself.
        back: Whether to make retired ones active again instead.
    """
    content = rows.read(connection)
    record = _known(content, label)
    key = canonical(record.label)
    planners = content.planners[key]
    if back and (into := content.settings.get(f"{rows.MERGED_KEY_PREFIX}{key}")) is not None:
        raise BankError(f"The intent {record.label!r} is merged into {into!r}, which has its planners; name that one.")
    chosen = [planner for planner in planners if mode is not None and planner.mode == mode]
    if mode is not None and not chosen:
        there = ", ".join(sorted({planner.mode for planner in planners})) or "none"
        raise BankError(f"The intent {record.label!r} has no planner of the mode {mode!r}; its modes: {there}.")
    status = "active" if back else "retired"
    for planner in chosen:
        rows.set_planner_status(connection, key, planner.hash, status)
    gone = {planner.hash for planner in planners if (key, planner.hash) in content.retired}
    touched = {planner.hash for planner in chosen}
    gone = gone - touched if back else gone | touched
    left = [planner for planner in planners if planner.hash not in gone]
    if back and not left:
        raise BankError(f"The intent {record.label!r} has no active planner; give --mode to bring one back, too.")
    if mode is None or back or not left:
        rows.set_intent_status(connection, key, status)


def _known(content: rows.Content, label: str) -> IntentRecord:
    """Return the intent; raise BankError with the known labels if there is none."""
    record = content.intents.get(canonical(label))
    if record is None:
        there = ", ".join(each.label for each in content.intents.values()) or "none"
        raise BankError(f"The bank has no intent {label!r}; it has: {there}.")
    return record
