"""The distance d(phi, phi_j) of two intents, from the words of their labels and descriptions.

The metric ``TextAndSlots`` is d = 1 - f^c cos(u, v). u and v are unit vectors of TF-IDF over stems and concepts
(``words.text_features``): term frequency 1 + ln(count), smoothed inverse document frequency ln((1 + n) / (1 + df)) + 1
over the bank (Salton and Buckley, 1988). c is the number of slots (``slots.py``) in which the intents contradict each
other, and f is ``TextAndSlots.FACTOR``.

The second half of this module chooses epsilon, the distance up to which an intent counts as known, and measures how
well the bank tells known intents from novel ones. The data are sets of paraphrases of known intents and of novel
behaviours. The figures, each with a 95 % bootstrap interval, are:

- top-1: the share of known ones whose nearest label is the right one
- the area under the ROC curve of known against novel by the distance to the nearest intent (Mann-Whitney, ties count
  half)
- for "known if distance <= epsilon", the shares of known ones recognised and of novel ones refused, and their mean, the
  balanced accuracy

Epsilon is chosen on the tuning halves of all sets (even places of each list). The figures come from the other half of
each set, which did not influence any choice.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.errors import BankError
from sumo_adv.memory.records import IntentRecord, canonical
from sumo_adv.memory.slots import OPTIONAL, SLOTS, Slots, slots_of
from sumo_adv.memory.words import text_features
from sumo_adv.parsing import parse_toml

CALIBRATION_RESAMPLES = 2000
CALIBRATION_CONFIDENCE = 0.95


class TextAndSlots:
    """The metric of the module's docstring.

    Two intents contradict each other in a slot if they have no value of it in common and at least one has a value. A
    place that only the fitted entry has is no contradiction, since descriptions often leave the place out.

    Attributes:
        name: The metric and its version, which is the key of its epsilon in the bank.
        epsilon: The distance up to which an intent counts as known, if the bank has no setting of its own.
        calibrated_on: The calibration data of ``epsilon``.
        FACTOR: The factor of the cosine for each contradiction.
    """

    name = "slots-1"
    epsilon = 0.78
    calibrated_on = (
        "intents_paraphrases.toml and intents_independent.toml in tests/data, tuning halves: 147 paraphrases of the "
        "seven, 70 novel behaviours"
    )

    FACTOR = 0.4  # 0.3 to 0.5 are equally good on the tuning halves

    def __init__(self) -> None:
        self._text = TfIdf()
        self._slots: dict[tuple[str, str], Slots] = {}
        self._size = 0
        self._holders: dict[str, dict[str, Bools]] = {}  # slot -> value -> which entries have it, (n,)

    def fit(self, entries: Sequence[tuple[str, str]]) -> None:
        """Fit the metric to entries; slots of entries seen before are reused.

        Args:
            entries: Pairs of label and description.
        """
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
        """Return the distances to the fitted entries.

        Args:
            label: The label to compare.
            description: Its description.

        Returns:
            Distances in [0, 1], shape (n,).
        """
        contradictions = np.zeros(self._size)
        for slot, values in slots_of(label, description).items():
            contradictions += self._contradict(slot, values)
        return 1.0 - self.FACTOR**contradictions * (1.0 - self._text.distances(label, description))

    def _contradict(self, slot: str, values: frozenset[str]) -> Bools:
        """Return which entries contradict ``values``, shape (n,)."""
        holders = self._holders[slot]
        none = np.zeros(self._size, dtype=np.bool_)
        if values:
            return ~np.logical_or.reduce([none, *(holders[value] for value in values if value in holders)])
        return none if slot in OPTIONAL else np.logical_or.reduce([none, *holders.values()])


class TfIdf:
    """The distance 1 - cosine between texts, as in the module's docstring.

    An inverted index keeps it fast for thousands of entries. Heavier label words, lighter bare stems and lighter
    unknown words were tried on a tuning half and did not help.
    """

    def __init__(self) -> None:
        self._counts: dict[tuple[str, str], dict[str, float]] = {}
        self._size = 0
        self._idf: dict[str, float] = {}
        self._postings: dict[str, tuple[NDArray[np.intp], Floats]] = {}
        self._unseen_idf = 1.0

    def fit(self, entries: Sequence[tuple[str, str]]) -> None:
        """Build the index over entries; counts of entries seen before are reused.

        Args:
            entries: Pairs of label and description.
        """
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
        """Compute the unit weights of each entry, grouped by term."""
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
        """Return 1 - cosine to each fitted entry.

        Args:
            label: The label to compare.
            description: Its description.

        Returns:
            Distances in [0, 1], shape (n,); 1 if no word is shared.
        """
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
    """Return the damped counts, 1 + ln(count), of the features of an intent.

    Args:
        label: The label of the intent.
        description: Its description.
    """
    raw = Counter(text_features(label))
    raw.update(text_features(description))
    return {term: 1.0 + math.log(count) for term, count in raw.items()}


@dataclass(frozen=True, slots=True)
class Paraphrase:
    """A behaviour as a language model might name it.

    Attributes:
        intent: The label of the intent that it should match; None for a novel behaviour.
        label: The name.
        description: The description.
    """

    intent: str | None
    label: str
    description: str


@dataclass(frozen=True, slots=True)
class Figure:
    """A value with its bootstrap interval.

    Attributes:
        value: The value.
        low: The 2.5th percentile.
        high: The 97.5th percentile.
    """

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class SetFigures:
    """The performance of the metric on the reporting half of a set.

    Attributes:
        known: The number of known behaviours.
        novel: The number of novel behaviours.
        top1: The share of known ones whose nearest intent is the right one.
        auc: The area under the ROC curve.
        recognised: The share of known ones within epsilon.
        refused: The share of novel ones beyond epsilon.
        balanced_accuracy: The mean of ``recognised`` and ``refused``.
    """

    known: int
    novel: int
    top1: Figure
    auc: Figure
    recognised: Figure
    refused: Figure
    balanced_accuracy: Figure


@dataclass(frozen=True, slots=True)
class Calibration:
    """The result of a calibration.

    Attributes:
        metric: The name of the metric.
        epsilon: The epsilon from the tuning halves of all sets.
        sets: The figures of each set, in the order given.
    """

    metric: str
    epsilon: float
    sets: tuple[SetFigures, ...]


@dataclass(frozen=True, slots=True)
class Measured:
    """Distances of paraphrases, one row for each, (n,).

    Attributes:
        distance: The distance to the nearest intent.
        right: Whether the nearest intent is the right one.
        known: Whether the paraphrase is one of a known intent.
    """

    distance: Floats
    right: Bools
    known: Bools


def read_paraphrases(file: Path) -> tuple[list[Paraphrase], list[Paraphrase]]:
    """Read paraphrases from a TOML file.

    The file has ``[known]`` LABEL = [[name, description], ..] and ``[novel]`` behaviours = [..].

    Args:
        file: The path of the file.

    Returns:
        The tuning and the reporting half: the even and the odd places of each list.

    Raises:
        BankError: The file cannot be read.
    """
    try:
        table = parse_toml(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise BankError(f"The paraphrases {file} cannot be read: {error}.") from error
    try:
        lists = [(label, pairs) for label, pairs in table["known"].items()] + [(None, table["novel"]["behaviours"])]
        halves: tuple[list[Paraphrase], list[Paraphrase]] = ([], [])
        for intent, pairs in lists:
            for place, (name, description) in enumerate(pairs):
                halves[place % 2].append(Paraphrase(intent, str(name), str(description)))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BankError(f"The paraphrases {file} need [known] with lists of [name, text], and [novel].") from error
    return halves


def measure_distances(intents: Sequence[IntentRecord], paraphrases: Sequence[Paraphrase]) -> Measured:
    """Measure the distances of paraphrases to the nearest intent. An exact label gets no privilege here.

    Args:
        intents: The intents of a bank.
        paraphrases: The paraphrases.
    """
    similarity = TextAndSlots()
    similarity.fit([(record.label, record.description) for record in intents])
    keys = [canonical(record.label) for record in intents]
    distance, right = np.ones(len(paraphrases)), np.zeros(len(paraphrases), dtype=np.bool_)
    for i, paraphrase in enumerate(paraphrases):
        distances = similarity.distances(paraphrase.label, paraphrase.description)
        nearest = int(np.argmin(distances))
        distance[i] = distances[nearest]
        right[i] = paraphrase.intent is not None and keys[nearest] == canonical(paraphrase.intent)
    return Measured(distance, right, np.asarray([p.intent is not None for p in paraphrases], dtype=np.bool_))


def best_epsilon(measured: Measured) -> float:
    """Return the epsilon with the best balanced accuracy; of equally good ones, the middle of the widest range.

    Args:
        measured: The distances of paraphrases.
    """
    values = np.unique(measured.distance)
    edges = np.concatenate((values[:1] - 1e-6, (values[:-1] + values[1:]) / 2.0, values[-1:] + 1e-6))
    scores = np.asarray([balanced_accuracy(measured, float(edge)) for edge in edges])
    best = np.flatnonzero(scores >= scores.max() - 1e-12)
    runs = np.split(best, np.flatnonzero(np.diff(best) > 1) + 1)
    widest = max(runs, key=lambda run: edges[run[-1]] - edges[run[0]])
    return float((edges[widest[0]] + edges[widest[-1]]) / 2.0)


def top1(measured: Measured) -> float:
    """Return the share of the known behaviours whose nearest intent is the right one.

    Args:
        measured: The distances of paraphrases.
    """
    return float(np.mean(measured.right[measured.known]))


def auc(measured: Measured) -> float:
    """Return the chance that a known behaviour is nearer to the bank than a novel one; ties count half.

    Args:
        measured: The distances of paraphrases.
    """
    of_known, of_novel = measured.distance[measured.known][:, None], measured.distance[~measured.known]
    return float(np.mean((of_known < of_novel) + 0.5 * (of_known == of_novel)))


def recognised(measured: Measured, epsilon: float) -> float:
    """Return the share of the known behaviours within epsilon.

    Args:
        measured: The distances of paraphrases.
        epsilon: The distance up to which an intent counts as known.
    """
    return float(np.mean(measured.distance[measured.known] <= epsilon))


def refused(measured: Measured, epsilon: float) -> float:
    """Return the share of the novel behaviours beyond epsilon.

    Args:
        measured: The distances of paraphrases.
        epsilon: The distance up to which an intent counts as known.
    """
    return float(np.mean(measured.distance[~measured.known] > epsilon))


def balanced_accuracy(measured: Measured, epsilon: float) -> float:
    """Return the mean of ``recognised`` and ``refused``.

    Args:
        measured: The distances of paraphrases.
        epsilon: The distance up to which an intent counts as known.
    """
    return (recognised(measured, epsilon) + refused(measured, epsilon)) / 2.0


def calibrate(
    intents: Sequence[IntentRecord], sets: Sequence[tuple[Sequence[Paraphrase], Sequence[Paraphrase]]]
) -> Calibration:
    """Choose epsilon on the tuning halves of all sets, and measure on each reporting half.

    Args:
        intents: The intents of a bank.
        sets: Sets of paraphrases, each as a tuning and a reporting half.

    Raises:
        BankError: There are no intents or sets, or a half lacks known or novel behaviours.
    """
    if not intents or not sets or any({p.intent is None for p in half} != {True, False} for s in sets for half in s):
        raise BankError("Calibration needs intents, and known and novel behaviours in both halves of its sets.")
    epsilon = best_epsilon(measure_distances(intents, [p for tuning, _ in sets for p in tuning]))
    figures = tuple(_figures(measure_distances(intents, reporting), epsilon) for _, reporting in sets)
    return Calibration(TextAndSlots.name, epsilon, figures)


def _figures(measured: Measured, epsilon: float) -> SetFigures:
    """Compute the figures of a set, each with its percentile bootstrap."""

    def figure(statistic: Callable[[Measured], float]) -> Figure:
        rng = np.random.default_rng(0)
        values = [statistic(_resampled(measured, rng)) for _ in range(CALIBRATION_RESAMPLES)]
        tail = 50.0 * (1.0 - CALIBRATION_CONFIDENCE)
        low, high = np.percentile(values, [tail, 100.0 - tail])
        return Figure(statistic(measured), float(low), float(high))

    shares = [figure(partial(share, epsilon=epsilon)) for share in (recognised, refused, balanced_accuracy)]
    return SetFigures(int(measured.known.sum()), int((~measured.known).sum()), figure(top1), figure(auc), *shares)


def _resampled(measured: Measured, rng: np.random.Generator) -> Measured:
    """Resample known and novel behaviours, each among themselves."""
    known, novel = np.flatnonzero(measured.known), np.flatnonzero(~measured.known)
    places = np.concatenate((rng.choice(known, known.size), rng.choice(novel, novel.size)))
    return Measured(measured.distance[places], measured.right[places], measured.known[places])
