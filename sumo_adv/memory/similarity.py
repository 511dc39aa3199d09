"""d(phi, phi_j): how far apart two intents are, from the words of their labels and descriptions.

The default metric ``TextAndSlots`` is d = 1 - f^c cos(u, v).  u and v are unit vectors of TF-IDF over stems and
concepts (``words.features``): term frequency 1 + ln(count), smoothed inverse document frequency
ln((1 + n) / (1 + df)) + 1 over the bank (Salton and Buckley, 1988).  c is the number of slots (``slots.py``) in which
the intents contradict each other, and f is ``TextAndSlots.FACTOR``.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.memory.slots import OPTIONAL, SLOTS, Slots, slots_of
from sumo_adv.memory.words import features


class Similarity(Protocol):
    """A metric over intents. ``name`` identifies it and its version, and is the key of its epsilon in the bank;
    ``epsilon`` (None = there is none) and ``calibrated_on`` hold where the bank has no setting of its own."""

    @property
    def name(self) -> str:
        """What its epsilon is stored under."""
        ...

    @property
    def epsilon(self) -> float | None:
        """The distance up to which two intents are one."""
        ...

    @property
    def calibrated_on(self) -> str:
        """Where epsilon comes from."""
        ...

    def fit(self, entries: Sequence[tuple[str, str]]) -> None:
        """Take the (label, description) pairs of the bank, in its order."""
        ...

    def distances(self, label: str, description: str) -> Floats:
        """Distances in [0, 1] to the fitted entries, in their order, shape (n,)."""
        ...


class TextAndSlots:
    """The metric that needs no download. See the module's docstring.

    Two intents contradict each other in a slot if they have no value of it in common and at least one has a value.  A
    place that only the fitted entry has is no contradiction, since descriptions often leave the place out.
    """

    name = "slots-1"
    epsilon = 0.78
    calibrated_on = (
        "intents_paraphrases.toml and intents_independent.toml in tests/data, tuning halves: 147 paraphrases of the "
        "seven, 70 novel behaviours"
    )

    FACTOR = 0.4  # of the cosine, for each contradiction; 0.3 to 0.5 are equally good on the tuning halves

    def __init__(self) -> None:
        self._text = TfIdf()
        self._slots: dict[tuple[str, str], Slots] = {}
        self._size = 0
        self._holders: dict[str, dict[str, Bools]] = {}  # by slot and value: which entries have it, (n,)

    def fit(self, entries: Sequence[tuple[str, str]]) -> None:
        """Take (label, description) pairs; slots of entries seen before are reused."""
        self._text.fit(entries)
        self._slots = {entry: self._slots.get(entry) or slots_of(*entry) for entry in entries}
        self._size = len(entries)
        self._holders = {slot: {} for slot in SLOTS}
        for row, entry in enumerate(entries):
            for slot, values in self._slots[entry].items():
                for value in values:
                    none = np.zeros(self._size, dtype=np.bool_)
                    self._holders[slot].setdefault(value, none)[row] = True

    def distances(self, label: str, description: str) -> Floats:
        """Distances in [0, 1] to the fitted entries, shape (n,)."""
        contradictions = np.zeros(self._size)
        for slot, values in slots_of(label, description).items():
            contradictions += self._contradict(slot, values)
        return 1.0 - self.FACTOR**contradictions * (1.0 - self._text.distances(label, description))

    def _contradict(self, slot: str, values: frozenset[str]) -> Bools:
        """Which entries contradict ``values``, shape (n,)."""
        holders = self._holders[slot]
        none = np.zeros(self._size, dtype=np.bool_)
        if values:
            return ~np.logical_or.reduce([none, *(holders[value] for value in values if value in holders)])
        return none if slot in OPTIONAL else np.logical_or.reduce([none, *holders.values()])


class TfIdf:
    """1 - cosine between texts, as in the module's docstring. An inverted index keeps it fast for thousands of entries.

    Heavier label words, lighter bare stems and lighter unknown words were tried on a tuning half and did not help.
    """

    def __init__(self) -> None:
        self._counts: dict[tuple[str, str], dict[str, float]] = {}
        self._size = 0
        self._idf: dict[str, float] = {}
        self._postings: dict[str, tuple[NDArray[np.intp], Floats]] = {}
        self._unseen_idf = 1.0

    def fit(self, entries: Sequence[tuple[str, str]]) -> None:
        """Build the index over (label, description) pairs; counts of entries seen before are reused."""
        self._counts = {entry: self._counts.get(entry) or term_counts(*entry) for entry in entries}
        self._size = len(entries)
        self._unseen_idf = float(np.log(1.0 + self._size)) + 1.0
        self._postings, self._idf = {}, {}
        if not entries:
            return
        terms: dict[str, int] = {}
        columns: list[int] = []
        rows: list[int] = []
        values: list[float] = []
        for row, entry in enumerate(entries):
            for term, count in self._counts[entry].items():
                columns.append(terms.setdefault(term, len(terms)))
                rows.append(row)
                values.append(count)
        self._index(terms, np.asarray(rows, dtype=np.intp), np.asarray(columns, dtype=np.intp), np.asarray(values))

    def _index(
        self, terms: Mapping[str, int], rows: NDArray[np.intp], columns: NDArray[np.intp], counts: Floats
    ) -> None:
        """Unit weights per entry, grouped by term."""
        frequency = np.bincount(columns, minlength=len(terms))
        idf = np.log((1.0 + self._size) / (1.0 + frequency)) + 1.0
        weights = counts * idf[columns]
        norms = np.sqrt(np.bincount(rows, weights=weights**2, minlength=self._size))
        weights = weights / np.where(norms > 0.0, norms, 1.0)[rows]
        order = np.argsort(columns, kind="stable")
        starts = np.concatenate(([0], np.cumsum(frequency)))
        rows, weights = rows[order], weights[order]
        for term, column in terms.items():
            part = slice(starts[column], starts[column + 1])
            self._postings[term] = (rows[part], weights[part])
            self._idf[term] = float(idf[column])

    def distances(self, label: str, description: str) -> Floats:
        """1 - cosine to each fitted entry, shape (n,); 1 where no word is shared."""
        scores = np.zeros(self._size)
        square = 0.0
        for term, count in term_counts(label, description).items():
            if term in self._postings:
                weight = count * self._idf[term]
                rows, weights = self._postings[term]
                scores[rows] += weight * weights
            else:
                weight = count * self._unseen_idf
            square += weight**2
        if square > 0.0:
            scores /= np.sqrt(square)
        return np.clip(1.0 - scores, 0.0, 1.0)


def term_counts(label: str, description: str) -> dict[str, float]:
    """Damped counts, 1 + ln(count), of the features of an intent."""
    raw = Counter(features(label))
    raw.update(features(description))
    return {term: 1.0 + math.log(count) for term, count in raw.items()}
