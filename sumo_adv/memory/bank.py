"""The memory bank: M = {(phi_j, f_j)} of the paper (Online Scenario Generation by Dynamic Memorization and Retrieval).

One SQLite file.  Opening reads it whole into RAM, and every question is answered from there, so a run sees one fixed
content (whose hash goes into its manifest) whatever other processes write meanwhile; ``refresh`` takes in their rows.
``record`` is one short transaction.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType

import numpy as np

from sumo_adv.datatypes import Floats, Planner
from sumo_adv.errors import BankError
from sumo_adv.memory import edits, rows
from sumo_adv.memory.migrations import Clock, utc_now
from sumo_adv.memory.recall import SceneIndex
from sumo_adv.memory.records import (
    BankStatistics,
    Evidence,
    IntentRecord,
    LabelStatistics,
    Retrieval,
    Source,
    canonical,
)
from sumo_adv.memory.similarity import Similarity, TfIdf
from sumo_adv.memory.store import open_file, sentences

NEAREST = 5  # labels named in a retrieval
BAND = 0.1  # of epsilon, to both sides: how near to it a retrieval is uncertain


class MemoryBank:
    """An open bank; use it in a ``with`` statement. All methods that touch the file raise BankError."""

    def __init__(
        self, connection: sqlite3.Connection, path: Path, writable: bool, similarity: Similarity, clock: Clock
    ) -> None:
        """Use ``MemoryBank.open``."""
        self.path = path
        self.writable = writable
        self._connection = connection
        self._similarity = similarity
        self._clock = clock
        self._content = rows.load(connection)
        self._fitted: dict[str, int] | None = None  # label -> place, as the similarity has seen them
        self._scenes: SceneIndex | None = None

    @classmethod
    def open(
        cls,
        path: Path,
        *,
        seed_from: Path | None = None,
        read_only: bool = False,
        similarity: Similarity | None = None,
        clock: Clock = utc_now,
    ) -> MemoryBank:
        """The bank at ``path``; where nothing is there, a copy of ``seed_from`` (never written to) or a blank one.

        ``read_only`` makes no file and changes none. A bank that cannot be written opens for reading, and ``record``
        says so. Raises BankError: not SQLite, another program's, newer, damaged, folder not writable, disk full.
        """
        path = Path(path)
        connection, writable = open_file(path, seed_from=seed_from, read_only=read_only, clock=clock)
        try:
            with sentences(path):
                return cls(connection, path, writable, similarity or TfIdf(), clock)
        except BaseException:
            connection.close()
            raise

    def __enter__(self) -> MemoryBank:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._connection.close()

    # reading

    def refresh(self) -> None:
        """Take in what other processes wrote since the bank was opened."""
        with sentences(self.path):
            self._content = rows.load(self._connection)
        self._fitted = self._scenes = None

    def intents(self) -> list[IntentRecord]:
        """All intents, oldest first, retired ones too."""
        return list(self._content.intents.values())

    def intent(self, label: str) -> IntentRecord | None:
        """The intent of that label, in any case and spacing; None if there is none."""
        return self._content.intents.get(canonical(label))

    def planners(self, label: str) -> list[Planner]:
        """The active planners of an intent, by mode, then age; empty for an unknown label."""
        key = canonical(label)
        found = [p for p in self._content.planners.get(key, ()) if (key, p.hash) not in self._content.retired]
        return sorted(found, key=lambda planner: planner.mode)

    def evidence(self, label: str | None = None) -> list[Evidence]:
        """All evidence, oldest first, or that of one intent."""
        if label is None:
            return list(self._content.evidence)
        key = canonical(label)
        return [e for e in self._content.evidence if canonical(e.label) == key]

    def sources(self) -> list[Source]:
        """Everything about every intent, retired planners too, by mode, then text."""
        held: dict[str, list[Evidence]] = {}
        for evidence in self._content.evidence:
            held.setdefault(canonical(evidence.label), []).append(evidence)
        content = self._content
        return [
            Source(
                record,
                tuple(sorted(content.planners[key], key=lambda planner: (planner.mode, planner.source))),
                frozenset(planner.hash for planner in content.planners[key] if (key, planner.hash) in content.retired),
                tuple(held.get(key, ())),
                content.settings.get(f"{rows.MERGED}{key}"),
            )
            for key, record in content.intents.items()
        ]

    def scenes(self) -> SceneIndex:
        """The scenes in which active planners of active intents succeeded, for ``recall.recall_scene``."""
        if self._scenes is None:
            active = {
                (record.label, planner.hash) for record in self._active() for planner in self.planners(record.label)
            }
            self._scenes = SceneIndex(
                [e for e in self._content.evidence if e.success and (e.label, e.planner_hash) in active]
            )
        return self._scenes

    def settings(self, prefix: str) -> dict[str, object]:
        """The settings whose keys begin so."""
        return {key: value for key, value in self._content.settings.items() if key.startswith(prefix)}

    def epsilon(self) -> tuple[float, str]:
        """The distance up to which an intent is known, for the metric in use, and what it was calibrated on.

        Raises BankError for a metric that was never calibrated for this bank.
        """
        value = self._content.settings.get(f"epsilon.{self._similarity.name}")
        if isinstance(value, dict):
            return float(value["epsilon"]), str(value["calibrated_on"])
        if self._similarity.epsilon is None:
            raise BankError(
                f"The memory bank {self.path} has no epsilon for the metric {self._similarity.name}; "
                "measure one: memory calibrate PARAPHRASES.toml --metric .. --store."
            )
        return self._similarity.epsilon, self._similarity.calibrated_on

    def retrieve(self, label: str, description: str = "") -> Retrieval:
        """The paper's j* = argmin d(phi', phi_j) among active intents, a hit if d <= epsilon.

        The same label (in any case, spacing or hyphenation) is distance 0, as is that of an intent merged into another
        for that one; else the metric on label + description.
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
        nearest = _nearest(list(self._fitted), distances)
        first, distance = nearest[0]
        band = abs(distance - epsilon) <= BAND * epsilon
        return Retrieval(first if distance <= epsilon else None, distance, epsilon, nearest, band)

    def _active(self) -> list[IntentRecord]:
        return [record for record in self._content.intents.values() if record.status == "active"]

    def content_hash(self) -> str:
        """SHA-256 over intents, planners, evidence and settings as read; row order and time stamps do not count."""
        digest = hashlib.sha256()
        for line in sorted(json.dumps(item, sort_keys=True) for item in rows.canonical_items(self._content)):
            digest.update(line.encode() + b"\n")
        return digest.hexdigest()

    def statistics(self) -> BankStatistics:
        """Counts over the bank and per intent."""
        by_label = {
            record.label: _label_statistics(self._content.planners.get(key, ()), self.evidence(record.label))
            for key, record in self._content.intents.items()
        }
        return BankStatistics(
            intents=len(self._content.intents),
            active=sum(record.status == "active" for record in self._content.intents.values()),
            planners=sum(len(found) for found in self._content.planners.values()),
            evidence=len(self._content.evidence),
            by_label=by_label,
        )

    # writing

    def record(self, evidence: Evidence, *, intent: IntentRecord | None = None, planner: Planner | None = None) -> None:
        """Add evidence, and the intent and the planner it is about where the bank lacks them, in one transaction.

        What is there already stays as it is (two writers may find the same intent), but evidence of success makes a
        retired intent or planner active again, and what comes with evidence of failure begins as retired. What is about
        an intent merged into another is kept under that one. Raises BankError, also if intent or planner is neither
        given nor known, or is not the one that the evidence names; nothing is written then.
        """
        if intent is not None and canonical(intent.label) != canonical(evidence.label):
            raise BankError(f"The evidence is about {evidence.label!r} but the intent given is {intent.label!r}.")
        if planner is not None and planner.hash != evidence.planner_hash:
            raise BankError(f"The evidence for {evidence.label!r} names another planner than the one given.")
        status = "active" if evidence.success else "retired"
        with self._writing() as now:
            label = rows.resolve(rows.read_settings(self._connection), evidence.label)
            if intent is not None and label == evidence.label:
                rows.insert_intent(
                    self._connection, intent if evidence.success else replace(intent, status=status), now
                )
            if planner is not None:
                rows.insert_planner(self._connection, label, planner, now, status)
            evidence = replace(evidence, label=label)
            known_intent = rows.read_intent(self._connection, label)
            known_planner = rows.read_planner(self._connection, label, evidence.planner_hash)
            if known_intent is None or known_planner is None:
                lacking = "intent" if known_intent is None else "planner"
                raise BankError(f"The memory bank has no such {lacking} as the evidence for {evidence.label!r} names.")
            rows.insert_evidence(self._connection, evidence, now)
            known_intent = rows.read_intent(self._connection, label) or known_intent
        self._take_in(rows.stored(evidence, known_intent.label, now), known_intent, *known_planner)

    def add(self, intent: IntentRecord, planners: Iterable[Planner] = ()) -> None:
        """Add an intent and planners without evidence (a person's work), in one transaction.

        What is there already stays as it is. Raises BankError.
        """
        self.absorb([Source(intent, tuple(planners))], unique_modes=False)

    def absorb(self, sources: Iterable[Source], *, unique_modes: bool = True) -> edits.Absorbed:
        """Add what the bank lacks of ``sources`` (an import), in one transaction; what was added. Raises BankError.

        What is there already stays as it is. With ``unique_modes`` a planner whose mode another one of its intent has
        gets a mode with a number.
        """
        with self._writing() as now:
            added = edits.absorb(self._connection, sources, now, unique_modes=unique_modes)
        self.refresh()
        return added

    def merge(self, label: str, into: str) -> None:
        """Move planners and evidence of one intent into another active one; the first is retired, and its label finds
        the other from now on. In one transaction. Raises BankError, also if either is unknown or both are one."""
        with self._writing() as now:
            edits.merge(self._connection, label, into, now)
        self.refresh()

    def retire(self, label: str, mode: str | None = None, *, back: bool = False) -> None:
        """Retire an intent, or its planners of one mode (with the last active one the intent too); nothing is deleted.

        ``back`` makes active again what was retired. Raises BankError, also if there is no such intent or mode.
        """
        with self._writing():
            edits.retire(self._connection, label, mode, back=back)
        self.refresh()

    def set_epsilon(self, epsilon: float, calibrated_on: str) -> None:
        """Store the epsilon of the metric in use, and what it was calibrated on. Raises BankError."""
        with self._writing():
            value = {"epsilon": epsilon, "calibrated_on": calibrated_on}
            rows.write_setting(self._connection, f"epsilon.{self._similarity.name}", value)
        self.refresh()

    @contextlib.contextmanager
    def _writing(self) -> Iterator[str]:
        """One IMMEDIATE transaction, undone on any error; gives the time stamp of its rows."""
        if not self.writable:
            raise BankError(f"The memory bank {self.path} is read-only; give another path, or make it writable.")
        with sentences(self.path):
            self._connection.execute("BEGIN IMMEDIATE")
            try:
                yield self._clock()
                self._connection.execute("COMMIT")
            except BaseException:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                raise

    def _take_in(self, evidence: Evidence, intent: IntentRecord, planner: Planner, status: str) -> None:
        """Add what was written to what is in RAM."""
        key = canonical(intent.label)
        if self._content.intents.get(key) != intent:
            self._content.intents[key] = intent
            self._fitted = None
        planners = self._content.planners.setdefault(key, [])
        if all(known.hash != planner.hash for known in planners):
            planners.append(planner)
            if status == "retired":
                self._content.retired.add((key, planner.hash))
        if evidence.success:
            self._content.retired.discard((key, planner.hash))
        self._content.evidence.append(evidence)
        self._scenes = None


def _label_statistics(planners: Sequence[Planner], evidence: Sequence[Evidence]) -> LabelStatistics:
    return LabelStatistics(
        planners=len(planners),
        evidence=len(evidence),
        successes=sum(e.success for e in evidence),
        collisions=sum(e.collided for e in evidence),
        valid=sum(e.valid is True for e in evidence),
        attempts=sum(e.attempts for e in evidence),
    )


def _nearest(labels: Sequence[str], distances: Floats) -> list[tuple[str, float]]:
    """The nearest few labels and their distances, nearest first, in the labels' order where they tie."""
    count = min(NEAREST, len(distances))
    worst = np.partition(distances, count - 1)[count - 1]
    candidates = np.flatnonzero(distances <= worst)
    order = candidates[np.argsort(distances[candidates], kind="stable")][:count]
    return [(labels[i], float(distances[i])) for i in order]
