"""The memory bank: M = {(phi_j, f_j)} of the paper (Online Scenario Generation by Dynamic Memorization and Retrieval).

A bank is one SQLite file. ``open`` reads the whole file into memory, and all lookups use that copy. Thus a run sees one
fixed content, and its manifest holds the hash of that content. ``refresh`` reads what other processes have written
since.
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

MAX_RETRIEVED_LABELS = 5  # maximum number of labels in a retrieval
EPSILON_KEY = f"{rows.EPSILON_KEY_PREFIX}{TextAndSlots.name}"  # key of the bank's setting
UNCERTAIN_EPSILON_SHARE = 0.1  # share of epsilon; a retrieval whose distance is nearer to epsilon is uncertain


class MemoryBank:
    """An open bank.

    Use it in a ``with`` statement. All methods that touch the file raise BankError.

    Attributes:
        path: The path of the file.
        writable: Whether the bank can be written.
    """

    def __init__(self, connection: sqlite3.Connection, path: Path, writable: bool, clock: Clock) -> None:
        """Use ``MemoryBank.open`` instead.

        Args:
            connection: The connection to the file.
            path: The path of the file.
            writable: Whether the bank can be written.
            clock: Returns the time stamp of new rows.
        """
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
        """Open the bank at ``path``.

        A missing file is created as a copy of ``seed_from``, or blank. A file without write permission opens for
        reading, and ``record`` raises.

        Args:
            path: The path of the file.
            seed_from: The bank that a missing file is copied from; None creates a blank one.
            read_only: Whether to create and change no file.
            clock: Returns the time stamp of new rows.

        Returns:
            The open bank.

        Raises:
            BankError: The file is not SQLite, belongs to another program, has a newer version or is damaged; the folder
                is read-only; or the disk is full.
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
        """Return all intents, including retired ones, oldest first."""
        return list(self._content.intents.values())

    def intent(self, label: str) -> IntentRecord | None:
        """Return an intent.

        Args:
            label: Its label, in any case and spacing.

        Returns:
            The intent, or None if the bank lacks it.
        """
        return self._content.intents.get(canonical(label))

    def planners(self, label: str) -> list[Planner]:
        """Return the active planners of an intent, by mode, then by age.

        Args:
            label: The label of the intent.

        Returns:
            The planners; none for an unknown label.
        """
        key = canonical(label)
        active = [p for p in self._content.planners.get(key, ()) if (key, p.hash) not in self._content.retired]
        return sorted(active, key=lambda planner: planner.mode)

    def evidence(self, label: str | None = None) -> list[Evidence]:
        """Return evidence, oldest first.

        Args:
            label: The label of an intent; None returns all evidence.
        """
        if label is None:
            return list(self._content.evidence)
        key = canonical(label)
        return [e for e in self._content.evidence if canonical(e.label) == key]

    def stored_intents(self) -> list[StoredIntent]:
        """Return the whole content by intent.

        Retired planners are included. Planners are sorted by mode, then by text.
        """
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
        """Return the evidence of a success in a similar scene.

        Valid collisions take precedence over other successes; then the nearest scene wins. Retired intents and planners
        are left out. So is evidence with parameters that the planner does not have or does not allow.

        Args:
            signature: The scene to compare with.
            limit: The maximum distance by ``recall.signature_distance`` [-].

        Returns:
            The evidence, or None if no scene is near enough.
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
        """Return the settings whose keys begin with ``prefix``.

        Args:
            prefix: The beginning of the keys.
        """
        return {key: value for key, value in self._content.settings.items() if key.startswith(prefix)}

    def epsilon(self) -> tuple[float, str]:
        """Return the distance up to which an intent counts as known, and its calibration data."""
        value = self._content.settings.get(EPSILON_KEY)
        if isinstance(value, dict):
            return float(value["epsilon"]), str(value["calibrated_on"])
        return TextAndSlots.epsilon, TextAndSlots.calibrated_on

    def retrieve(self, label: str, description: str = "") -> Retrieval:
        """Find the nearest active intent: the paper's j* = argmin d(phi', phi_j), a hit if d <= epsilon.

        The distance is 0 for the same label in any case, spacing or hyphenation. The label of a merged intent means the
        intent that took it over. Otherwise the metric compares label and description.

        Args:
            label: The label to look up.
            description: Its description.

        Returns:
            The hit and the nearest intents.
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
        """Return the active intents."""
        return [record for record in self._content.intents.values() if record.status == "active"]

    def content_hash(self) -> str:
        """Return the SHA-256 of intents, planners, evidence and settings, regardless of row order and time stamps."""
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

        Args:
            evidence: The evidence to add.
            intent: Its intent; None if the bank has it.
            planner: Its planner; None if the bank has it.

        Raises:
            BankError: Intent or planner is neither given nor known, or does not match the evidence. Nothing is written.
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
                raise BankError(f"The memory bank lacks the {missing} that the evidence for {evidence.label!r} names.")
            rows.insert_evidence(self._connection, evidence, stamp)
            known_intent = rows.read_intent(self._connection, label) or known_intent
        self._remember(rows.stored(evidence, known_intent.label, stamp), known_intent, *known_planner)

    def record_composition(self, composition: Composition, attempts: Sequence[bool]) -> bool:
        """Count attempts with a composition, in one transaction.

        Only a success adds an unknown composition.

        Args:
            composition: The composition.
            attempts: True for each success, False for each failure, in order.

        Returns:
            Whether the bank knows the composition now.
        """
        with self._writing():
            before = rows.read_settings(self._connection).get(composition.key)
            after = counted(None if before is None else composition_of(before), composition, attempts)
            if after is not None:
                rows.write_setting(self._connection, composition.key, plain_composition(after))
        return after is not None

    def add(self, intent: IntentRecord, planners: Iterable[Planner] = ()) -> None:
        """Add an intent and planners without evidence, in one transaction. Existing ones are not changed.

        Args:
            intent: The intent.
            planners: Its planners.
        """
        self.absorb([StoredIntent(intent, tuple(planners))], unique_modes=False)

    def absorb(
        self, intents: Iterable[StoredIntent], *, unique_modes: bool = True, compositions: Iterable[Composition] = ()
    ) -> edits.Absorbed:
        """Import intents and compositions in one transaction. Nothing in the bank is changed.

        Args:
            intents: The intents with their planners and evidence.
            unique_modes: Whether to number the mode of a new planner if another planner of its intent has that mode.
            compositions: The compositions.

        Returns:
            The numbers of additions.
        """
        with self._writing() as stamp:
            return edits.absorb(self._connection, intents, stamp, unique_modes=unique_modes, compositions=compositions)

    def merge(self, label: str, into: str) -> None:
        """Move planners and evidence of one intent to another, in one transaction.

        The first intent is retired. From then on its label means the second intent.

        Args:
            label: The label of the intent to merge.
            into: The label of the active intent that takes it over.

        Raises:
            BankError: Either intent is unknown, both are the same, or ``into`` is retired.
        """
        with self._writing() as stamp:
            edits.merge(self._connection, label, into, stamp)

    def retire(self, label: str, mode: str | None = None, *, back: bool = False) -> None:
        """Retire an intent, or its planners of one mode.

        An intent without active planners is retired too. Nothing is deleted.

        Args:
            label: The label of the intent.
            mode: The mode of the planners; None means the intent itself.
            back: Whether to make retired ones active again instead.

        Raises:
            BankError: The intent or the mode is unknown.
        """
        with self._writing():
            edits.retire(self._connection, label, mode, back=back)

    def set_epsilon(self, epsilon: float, calibrated_on: str) -> None:
        """Store the epsilon and its calibration data.

        Args:
            epsilon: The distance up to which an intent counts as known [-].
            calibrated_on: What it was calibrated on.
        """
        with self._writing():
            setting = {"epsilon": epsilon, "calibrated_on": calibrated_on}
            rows.write_setting(self._connection, EPSILON_KEY, setting)

    @contextlib.contextmanager
    def _writing(self, *, refresh: bool = True) -> Iterator[str]:
        """Run one IMMEDIATE transaction, rolled back on any error, and yield the time stamp of its rows.

        Args:
            refresh: Whether to read the file again afterwards.
        """
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


# Composed intents. A composition is stored in the settings of the bank (``COMPOSITION_KEY_PREFIX``). It is found by its
# own label or description, and ignored once ``MAX_FAILURES_IN_A_ROW`` attempts in a row have failed. Its planners stay
# with their intents.


def compositions(bank: MemoryBank) -> list[Composition]:
    """Return the compositions of a bank by label, without those that ``MAX_FAILURES_IN_A_ROW`` failures rule out.

    Args:
        bank: The bank to read.
    """
    return [composition for composition in all_compositions(bank) if not composition.hopeless]


def all_compositions(bank: MemoryBank) -> list[Composition]:
    """Return all compositions of a bank by label.

    Args:
        bank: The bank to read.
    """
    return [composition_of(value) for _, value in sorted(bank.settings(COMPOSITION_KEY_PREFIX).items())]


def retrieve_composition(bank: MemoryBank, label: str, description: str) -> Composition | None:
    """Find the composition with the same meaning, by its own label or description.

    Args:
        bank: The bank to search.
        label: The label to look up.
        description: Its description.

    Returns:
        The composition, or None if none is near enough.
    """
    candidates = compositions(bank)
    same = next((c for c in candidates if canonical(c.label) == canonical(label)), None)
    if same is not None or not candidates:
        return same
    similarity = TextAndSlots()
    similarity.fit([(c.label, c.description) for c in candidates])
    distances = similarity.distances(label, description)
    nearest = int(distances.argmin())
    return candidates[nearest] if distances[nearest] <= bank.epsilon()[0] else None
