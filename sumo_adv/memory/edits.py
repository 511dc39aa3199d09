"""Changes to what a bank holds, beside new evidence: taking in another's content, merging, retiring.

Call every function within a transaction; it raises BankError before it changes anything it cannot finish.
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
    """How much of an offer was new."""

    intents: int = 0
    planners: int = 0
    evidence: int = 0
    compositions: int = 0


def absorb(
    connection: sqlite3.Connection, intents: Iterable[StoredIntent], now: str, *, unique_modes: bool,
    compositions: Iterable[Composition] = (),
) -> Absorbed:  # fmt: skip
    """Add what the bank lacks; a piece of evidence that it holds as often as ``intents`` do is not added again."""
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
                    f"The intent {stored.intent.label!r} is merged into {stored.merged_into!r}, which is not there."
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
    """``mode``, or with the first number from 2 on that makes it none of ``taken``."""
    number, name = 1, mode
    while name in taken:
        number += 1
        name = f"{mode}-{number}"
    return name


def _evidence_key(evidence: Evidence) -> str:
    """The content of a piece of evidence as text, without its time stamp; equal for equal pieces."""
    plain = asdict(evidence)
    del plain["created"]
    plain["label"] = canonical(evidence.label)
    return json.dumps(plain, sort_keys=True)


def merge(connection: sqlite3.Connection, label: str, into: str, now: str) -> None:
    """See ``MemoryBank.merge``."""
    content = rows.read(connection)
    merged, kept = _known(content, label), _known(content, into)
    old, target = canonical(merged.label), canonical(kept.label)
    if old == target:
        raise BankError(f"{label!r} and {into!r} are the same intent; name two.")
    if kept.status != "active":
        raise BankError(f"The intent {kept.label!r} is retired; merge into an active one.")
    modes = {planner.mode for planner in content.planners[target]}
    hashes = {planner.hash: planner.mode for planner in content.planners[target]}
    became = dict[str, str]()  # mode -> mode of the same planner afterwards
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
    """See ``MemoryBank.retire``."""
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
        raise BankError(f"The intent {record.label!r} has no active planner; say --mode to bring one back too.")
    if mode is None or back or not left:
        rows.set_intent_status(connection, key, status)


def _known(content: rows.Content, label: str) -> IntentRecord:
    record = content.intents.get(canonical(label))
    if record is None:
        there = ", ".join(each.label for each in content.intents.values()) or "none"
        raise BankError(f"The bank has no intent {label!r}; it has: {there}.")
    return record
