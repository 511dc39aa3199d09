"""The memory bank: M = {(phi_j, f_j)} of the paper (Online Scenario Generation by Dynamic Memorization and Retrieval).

A bank is one SQLite file. ``open`` reads the whole file into memory, and all lookups use that copy. So a run sees one
fixed content, and its manifest holds the hash of it. ``refresh`` reads what other processes have written since.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from sumo_adv.datatypes import Planner
from sumo_adv.errors import BankError
from sumo_adv.memory import edits, rows
from sumo_adv.memory.migrations import Clock, utc_now
from sumo_adv.memory.recall import MAX_SIMILAR_DISTANCE, SceneIndex, allows
from sumo_adv.memory.records import (
    COMPOSITION_KEY_PREFIX,
    Composition,
    Evidence,
    IntentRecord,
    Retrieval,
    SceneSignature,
    StoredIntent,
    canonical,
    composition_of,
    counted,
    plain_composition,
)
from sumo_adv.memory.similarity import TextAndSlots
from sumo_adv.memory.store import as_bank_errors, open_file

MAX_RETRIEVED_LABELS = 5  # labels in a retrieval
EPSILON_KEY = f"{rows.EPSILON_KEY_PREFIX}{TextAndSlots.name}"  # of the bank's setting
UNCERTAIN_EPSILON_SHARE = 0.1  # share of epsilon; nearer to epsilon than this a retrieval is uncertain


class MemoryBank:
    """An open bank. Use it in a ``with`` statement. All methods that touch the file raise BankError."""

    def __init__(self, connection: sqlite3.Connection, path: Path, writable: bool, clock: Clock) -> None:
        """Use ``MemoryBank.open``."""
        self.path = path
        self.writable = writable
        self._connection = connection
        self._similarity = TextAndSlots()
        self._clock = clock
        self._content = rows.read_snapshot(connection)
        self._fitted: dict[str, int] | None = None  # label -> index in the fitted similarity
        self._scenes: SceneIndex | None = None

    @classmethod
    def open(
        cls, path: Path, *, seed_from: Path | None = None, read_only: bool = False, clock: Clock = utc_now
    ) -> MemoryBank:
        """The bank at ``path``. A missing file is created as a copy of ``seed_from``, or blank. read_only: creates and
        changes no file.

        A file without write permission opens for reading, and ``record`` raises. Raises BankError for a file that is
        not SQLite, of another program, of a newer version or damaged, for a read-only folder and for a full disk.
        """
        path = Path(path)
        connection, writable = open_file(path, seed_from=seed_from, read_only=read_only, clock=clock)
        try:
            with as_bank_errors(path):
                return cls(connection, path, writable, clock)
        except BaseException:
            connection.close()
            raise

    def __enter__(self) -> MemoryBank:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file. A second call does nothing."""
        self._connection.close()

    # reading

    def refresh(self) -> None:
        """Read the file again, with the rows that other processes have written."""
        with as_bank_errors(self.path):
            self._content = rows.read_snapshot(self._connection)
        self._fitted = self._scenes = None

    def intents(self) -> list[IntentRecord]:
        """All intents, retired ones included, oldest first."""
        return list(self._content.intents.values())

    def intent(self, label: str) -> IntentRecord | None:
        """The intent with that label, in any case and spacing, or None."""
        return self._content.intents.get(canonical(label))

    def planners(self, label: str) -> list[Planner]:
        """The active planners of an intent, by mode, then age; empty for an unknown label."""
        key = canonical(label)
        active = [p for p in self._content.planners.get(key, ()) if (key, p.hash) not in self._content.retired]
        return sorted(active, key=lambda planner: planner.mode)

    def evidence(self, label: str | None = None) -> list[Evidence]:
        """All evidence, or the evidence of one intent, oldest first."""
        if label is None:
            return list(self._content.evidence)
        key = canonical(label)
        return [e for e in self._content.evidence if canonical(e.label) == key]

    def stored_intents(self) -> list[StoredIntent]:
        """The whole content by intent. Retired planners are included. Planners are sorted by mode, then text."""
        by_intent: dict[str, list[Evidence]] = {}
        for evidence in self._content.evidence:
            by_intent.setdefault(canonical(evidence.label), []).append(evidence)
        content = self._content
        return [
            StoredIntent(
                record,
                tuple(sorted(content.planners[key], key=lambda planner: (planner.mode, planner.text))),
                frozenset(planner.hash for planner in content.planners[key] if (key, planner.hash) in content.retired),
                tuple(by_intent.get(key, ())),
                content.settings.get(f"{rows.MERGED_KEY_PREFIX}{key}"),
            )
            for key, record in content.intents.items()
        ]

    def recall_scene(self, signature: SceneSignature, limit: float = MAX_SIMILAR_DISTANCE) -> Evidence | None:
        """The evidence of a success in a similar scene, at most ``limit`` away by ``recall.signature_distance``.

        Valid collisions have precedence over other successes, then the nearest scene. Retired intents and planners are
        left out, and so is evidence with parameters that the planner does not have or does not allow.
        """
        if self._scenes is None:
            active = {
                (record.label, planner.hash): planner
                for record in self._active()
                for planner in self.planners(record.label)
            }
            successes = [(e, active.get((e.label, e.planner_hash))) for e in self._content.evidence if e.success]
            self._scenes = SceneIndex([e for e, planner in successes if planner is not None and allows(planner, e)])
        return self._scenes.nearest(signature, limit)

    def settings(self, prefix: str) -> dict[str, object]:
        """The settings with keys that begin with ``prefix``."""
        return {key: value for key, value in self._content.settings.items() if key.startswith(prefix)}

    def epsilon(self) -> tuple[float, str]:
        """The distance up to which an intent counts as known, and its calibration data."""
        value = self._content.settings.get(EPSILON_KEY)
        if isinstance(value, dict):
            return float(value["epsilon"]), str(value["calibrated_on"])
        return TextAndSlots.epsilon, TextAndSlots.calibrated_on

    def retrieve(self, label: str, description: str = "") -> Retrieval:
        """The paper's j* = argmin d(phi', phi_j) among active intents; a hit if d <= epsilon.

        The distance is 0 for the same label in any case, spacing or hyphenation. The label of a merged intent stands
        for the intent that took it over. Otherwise the metric compares label and description.
        """
        epsilon = self.epsilon()[0]
        if self._fitted is None:
            self._fitted = {r.label: i for i, r in enumerate(self._active())}
            self._similarity.fit([(record.label, record.description) for record in self._active()])
        if not self._fitted:
            return Retrieval(None, 1.0, epsilon, ())
        distances = self._similarity.distances(label, description)
        same = self.intent(rows.resolve(self._content.settings, label))
        if same is not None and same.status == "active":
            distances[self._fitted[same.label]] = 0.0
        labels = list(self._fitted)
        order = np.argsort(distances, kind="stable")[:MAX_RETRIEVED_LABELS]
        nearest = [(labels[i], float(distances[i])) for i in order]
        first, distance = nearest[0]
        band = abs(distance - epsilon) <= UNCERTAIN_EPSILON_SHARE * epsilon
        return Retrieval(first if distance <= epsilon else None, distance, epsilon, nearest, band)

    def _active(self) -> list[IntentRecord]:
        return [record for record in self._content.intents.values() if record.status == "active"]

    def content_hash(self) -> str:
        """SHA-256 over intents, planners, evidence and settings. Row order and time stamps do not count."""
        digest = hashlib.sha256()
        for line in sorted(json.dumps(item, sort_keys=True) for item in rows.canonical_items(self._content)):
            digest.update(line.encode() + b"\n")
        return digest.hexdigest()

    # writing

    def record(self, evidence: Evidence, *, intent: IntentRecord | None = None, planner: Planner | None = None) -> None:
        """Add evidence, and its intent and planner if the bank lacks them, in one transaction.

        - An existing intent or planner is not changed, since two processes may write the same intent.
        - Evidence of success makes a retired intent or planner active. A new one with evidence of failure is retired.
        - Evidence of a merged intent is stored under the intent that took it over.

        Raises BankError and writes nothing if intent or planner is neither given nor known, or does not match the
        evidence.
        """
        if intent is not None and canonical(intent.label) != canonical(evidence.label):
            raise BankError(f"The evidence is about {evidence.label!r} but the intent given is {intent.label!r}.")
        if planner is not None and planner.hash != evidence.planner_hash:
            raise BankError(f"The evidence for {evidence.label!r} names another planner than the one given.")
        status = "active" if evidence.success else "retired"
        with self._writing(refresh=False) as stamp:
            label = rows.resolve(rows.read_settings(self._connection), evidence.label)
            if intent is not None and label == evidence.label:
                rows.insert_intent(
                    self._connection, intent if evidence.success else replace(intent, status=status), stamp
                )
            if planner is not None:
                rows.insert_planner(self._connection, label, planner, stamp, status)
            evidence = replace(evidence, label=label)
            known_intent = rows.read_intent(self._connection, label)
            known_planner = rows.read_planner(self._connection, label, evidence.planner_hash)
            if known_intent is None or known_planner is None:
                missing = "intent" if known_intent is None else "planner"
                raise BankError(f"The memory bank has no such {missing} as the evidence for {evidence.label!r} names.")
            rows.insert_evidence(self._connection, evidence, stamp)
            known_intent = rows.read_intent(self._connection, label) or known_intent
        self._remember(rows.stored(evidence, known_intent.label, stamp), known_intent, *known_planner)

    def record_composition(self, composition: Composition, attempts: Sequence[bool]) -> bool:
        """Count attempts with a composition, True for each success, in one transaction. An unknown composition is added
        by a success only, as an intent is; the result tells whether the bank knows it now."""
        with self._writing():
            before = rows.read_settings(self._connection).get(composition.key)
            after = counted(None if before is None else composition_of(before), composition, attempts)
            if after is not None:
                rows.write_setting(self._connection, composition.key, plain_composition(after))
        return after is not None

    def add(self, intent: IntentRecord, planners: Iterable[Planner] = ()) -> None:
        """Add an intent and planners without evidence, in one transaction. Existing ones are not changed."""
        self.absorb([StoredIntent(intent, tuple(planners))], unique_modes=False)

    def absorb(
        self, intents: Iterable[StoredIntent], *, unique_modes: bool = True, compositions: Iterable[Composition] = ()
    ) -> edits.Absorbed:
        """Import ``intents`` and ``compositions`` in one transaction; returns the additions. Nothing that is there is
        changed. unique_modes: number the mode of a new planner if another planner of its intent has that mode."""
        with self._writing() as stamp:
            return edits.absorb(self._connection, intents, stamp, unique_modes=unique_modes, compositions=compositions)

    def merge(self, label: str, into: str) -> None:
        """Move planners and evidence of intent ``label`` to the active intent ``into``, in one transaction.

        The first intent is retired, and its label then stands for ``into``. Raises BankError, also if either intent is
        unknown or both are the same.
        """
        with self._writing() as stamp:
            edits.merge(self._connection, label, into, stamp)

    def retire(self, label: str, mode: str | None = None, *, back: bool = False) -> None:
        """Retire an intent, or its planners of one ``mode``. An intent without active planners is retired too.

        Nothing is deleted: ``back`` makes retired ones active again. Raises BankError, also for an unknown intent or
        mode.
        """
        with self._writing():
            edits.retire(self._connection, label, mode, back=back)

    def set_epsilon(self, epsilon: float, calibrated_on: str) -> None:
        """Store the epsilon and its calibration data."""
        with self._writing():
            setting = {"epsilon": epsilon, "calibrated_on": calibrated_on}
            rows.write_setting(self._connection, EPSILON_KEY, setting)

    @contextlib.contextmanager
    def _writing(self, *, refresh: bool = True) -> Iterator[str]:
        """One IMMEDIATE transaction, rolled back on any error. Yields the time stamp of its rows. refresh: read the
        file again afterwards."""
        if not self.writable:
            raise BankError(f"The memory bank {self.path} is read-only; give another path, or make it writable.")
        with as_bank_errors(self.path), self._connection:
            self._connection.execute("BEGIN IMMEDIATE")
            yield self._clock()
        if refresh:
            self.refresh()

    def _remember(self, evidence: Evidence, intent: IntentRecord, planner: Planner, status: str) -> None:
        """Add written rows to the content in memory."""
        key = canonical(intent.label)
        if self._content.intents.get(key) != intent:
            self._content.intents[key] = intent
            self._fitted = None
        planners = self._content.planners.setdefault(key, [])
        if all(each.hash != planner.hash for each in planners):
            planners.append(planner)
            if status == "retired":
                self._content.retired.add((key, planner.hash))
        if evidence.success:
            self._content.retired.discard((key, planner.hash))
        self._content.evidence.append(evidence)
        self._scenes = None


# Composed intents: a composition is kept under the settings of the bank (``COMPOSITION_KEY_PREFIX``), is found by its
# own label or description, and is forgotten once ``MAX_FAILURES_IN_A_ROW`` attempts in a row have failed. Planners stay
# with their intents.


def compositions(bank: MemoryBank) -> list[Composition]:
    """The compositions of a bank by label; those that are forgotten are left out."""
    return [composition for composition in all_compositions(bank) if not composition.hopeless]


def all_compositions(bank: MemoryBank) -> list[Composition]:
    """The compositions of a bank by label, also those that are forgotten."""
    return [composition_of(value) for _, value in sorted(bank.settings(COMPOSITION_KEY_PREFIX).items())]


def retrieve_composition(bank: MemoryBank, label: str, description: str) -> Composition | None:
    """The composition of a bank that means the same by its own label or description; None if none is near enough."""
    candidates = compositions(bank)
    same = next((c for c in candidates if canonical(c.label) == canonical(label)), None)
    if same is not None or not candidates:
        return same
    similarity = TextAndSlots()
    similarity.fit([(c.label, c.description) for c in candidates])
    distances = similarity.distances(label, description)
    nearest = int(distances.argmin())
    return candidates[nearest] if distances[nearest] <= bank.epsilon()[0] else None
