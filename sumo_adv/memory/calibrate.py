"""Epsilon for a metric: how well the bank tells known intents from novel ones, and where to draw the line.

From sets of paraphrases of known intents and of novel behaviours: top-1 (the nearest label is the right one), the area
under the ROC curve of known against novel by the distance to the nearest (Mann-Whitney, ties half), and for "known if
distance <= epsilon" the shares of known ones recognised and of novel ones refused, and their mean, the balanced
accuracy; with 95 % bootstrap intervals.  Epsilon is chosen on the tuning halves of all sets (even places of each list);
figures are of the other half of each set, which nothing was chosen on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Bools, Floats
from sumo_adv.errors import BankError
from sumo_adv.memory.records import IntentRecord, canonical
from sumo_adv.memory.similarity import Similarity
from sumo_adv.parsing import parse_toml

RESAMPLES = 2000
CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Paraphrase:
    """A behaviour as a model might name it. ``intent`` is the label it should find, None for a novel one."""

    intent: str | None
    label: str
    description: str


@dataclass(frozen=True, slots=True)
class Figure:
    """A value with its bootstrap interval (percentiles 2.5 and 97.5)."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class SetFigures:
    """What a metric can do on the reporting half of a set. ``known`` and ``novel`` are counts."""

    known: int
    novel: int
    top1: Figure
    auc: Figure
    recognised: Figure
    refused: Figure
    balanced_accuracy: Figure


@dataclass(frozen=True, slots=True)
class Calibration:
    """``epsilon`` from the tuning halves of all sets, and the figures of each set, in the order given."""

    metric: str
    epsilon: float
    sets: tuple[SetFigures, ...]


@dataclass(frozen=True, slots=True)
class Measured:
    """Per paraphrase, (n,): distance to the nearest intent, whether that is the right one, whether it is known."""

    distance: Floats
    right: Bools
    known: Bools

    def take(self, places: NDArray[np.intp]) -> Measured:
        """The paraphrases at these places."""
        return Measured(self.distance[places], self.right[places], self.known[places])


def read_paraphrases(file: Path) -> tuple[list[Paraphrase], list[Paraphrase]]:
    """The (tuning, reporting) halves of a TOML file with ``[known]`` LABEL = [[name, description], ..] and ``[novel]``
    behaviours = [..]: even and odd places of each list. Raises BankError."""
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


def measure(similarity: Similarity, intents: Sequence[IntentRecord], paraphrases: Sequence[Paraphrase]) -> Measured:
    """Distances of the paraphrases to the nearest of ``intents``; an exact label gets no privilege here."""
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
    """The epsilon of the best balanced accuracy; of equally good ones the middle of the widest range."""
    values = np.unique(measured.distance)
    edges = np.concatenate((values[:1] - 1e-6, (values[:-1] + values[1:]) / 2.0, values[-1:] + 1e-6))
    scores = np.asarray([balanced_accuracy(measured, float(edge)) for edge in edges])
    best = np.flatnonzero(scores >= scores.max() - 1e-12)
    runs = np.split(best, np.flatnonzero(np.diff(best) > 1) + 1)
    widest = max(runs, key=lambda run: edges[run[-1]] - edges[run[0]])
    return float((edges[widest[0]] + edges[widest[-1]]) / 2.0)


def top1(measured: Measured) -> float:
    """Share of the known ones with the right nearest intent."""
    return float(np.mean(measured.right[measured.known]))


def auc(measured: Measured) -> float:
    """Chance that a known one is nearer to the bank than a novel one, ties counting half."""
    of_known, of_novel = measured.distance[measured.known], measured.distance[~measured.known]
    ordered = np.sort(of_novel)
    above = of_novel.size - np.searchsorted(ordered, of_known, side="right")
    ties = of_novel.size - above - np.searchsorted(ordered, of_known, side="left")
    return float(np.sum(above + 0.5 * ties) / (of_known.size * of_novel.size))


def recognised(measured: Measured, epsilon: float) -> float:
    """Share of the known ones within epsilon."""
    return float(np.mean(measured.distance[measured.known] <= epsilon))


def refused(measured: Measured, epsilon: float) -> float:
    """Share of the novel ones beyond epsilon."""
    return float(np.mean(measured.distance[~measured.known] > epsilon))


def balanced_accuracy(measured: Measured, epsilon: float) -> float:
    """Mean of ``recognised`` and ``refused``."""
    return (recognised(measured, epsilon) + refused(measured, epsilon)) / 2.0


def calibrate(
    similarity: Similarity,
    intents: Sequence[IntentRecord],
    sets: Sequence[tuple[Sequence[Paraphrase], Sequence[Paraphrase]]],
    seed: int = 0,
) -> Calibration:
    """Choose epsilon on the tuning halves of (tuning, reporting) ``sets``, measure on each reporting half.

    Raises BankError without intents or sets, and if a half lacks known or novel ones.
    """
    if not intents or not sets or any({p.intent is None for p in half} != {True, False} for s in sets for half in s):
        raise BankError("Calibration needs intents, and known and novel behaviours in both halves of its sets.")
    epsilon = best_epsilon(measure(similarity, intents, [p for tuning, _ in sets for p in tuning]))
    figures = tuple(_figures(measure(similarity, intents, reporting), epsilon, seed) for _, reporting in sets)
    return Calibration(similarity.name, epsilon, figures)


def _figures(measured: Measured, epsilon: float, seed: int) -> SetFigures:
    def figure(statistic: Callable[[Measured], float]) -> Figure:
        return Figure(statistic(measured), *_interval(measured, statistic, seed))

    return SetFigures(
        known=int(measured.known.sum()),
        novel=int((~measured.known).sum()),
        top1=figure(top1),
        auc=figure(auc),
        recognised=figure(lambda resampled: recognised(resampled, epsilon)),
        refused=figure(lambda resampled: refused(resampled, epsilon)),
        balanced_accuracy=figure(lambda resampled: balanced_accuracy(resampled, epsilon)),
    )


def _interval(measured: Measured, statistic: Callable[[Measured], float], seed: int) -> tuple[float, float]:
    """Percentile bootstrap, resampling known and novel ones each among themselves."""
    rng = np.random.default_rng(seed)
    known_rows, novel_rows = np.flatnonzero(measured.known), np.flatnonzero(~measured.known)
    values = [
        statistic(
            measured.take(
                np.concatenate((rng.choice(known_rows, known_rows.size), rng.choice(novel_rows, novel_rows.size)))
            )
        )
        for _ in range(RESAMPLES)
    ]
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(values, [tail, 100.0 - tail])
    return float(low), float(high)
