"""The analyzer's answers against labels: accuracy, kappa, top-2, confusion and calibration of risk.

A label is a set of behaviours where several are as dangerous; an answer in it is right.  Chance among applicable
intents, the best constant answer and the split-half ceiling stand beside the analyzers, because an accuracy alone says
nothing where an encounter allows only one behaviour.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sumo_adv.benchmark.nouns import Case, Cell
from sumo_adv.benchmark.rows.fixed_intent import LABELS
from sumo_adv.benchmark.rows.oracle import CRITERIA, oracle_labels, split_half, succeeds
from sumo_adv.benchmark.tables.cells import ORACLE, Key, key, names
from sumo_adv.benchmark.tables.compute import paired
from sumo_adv.datatypes import Floats
from sumo_adv.metrics.statistics import Estimate, Paired, bootstrap, wilson

NOVEL, NO_ANSWER = "novel", "no answer"
ANNOTATED, PEOPLE = "annotated", "people"
ANSWERS = (*LABELS, NOVEL, NO_ANSWER)
RISKS = ("low", "medium", "high")
RESAMPLES = 2000
CHANCE, CEILING = "chance among applicable intents", "ceiling: one half of the oracle for the other"

Truth = Mapping[Key, frozenset[str]]


@dataclass(frozen=True, slots=True)
class Score:
    """How one way of answering does. ``several``: accuracy where more than one intent applies."""

    who: str
    accuracy: Estimate
    several: Estimate | None = None
    kappa: Estimate | None = None
    top2: Estimate | None = None
    difference: Paired | None = None  # of accuracy to the reference


@dataclass(frozen=True, slots=True)
class Part:
    """One ego and criterion. ``confusion``: analyzer -> (label, answer) -> encounters, a tie's miss spread over it;
    ``calibration``: analyzer -> risk -> the oracle's share of success by the vehicle and intent ranked first;
    ``by_time``: encounters where no simulation of the oracle succeeded, so that min TTC alone made the label."""

    ego: str
    criterion: str
    scores: tuple[Score, ...]
    confusion: Mapping[str, Mapping[tuple[str, str], float]]
    calibration: Mapping[str, Mapping[str, Estimate]]
    unlabelled: int
    by_time: int = 0


@dataclass(frozen=True, slots=True)
class Analysis:
    """The analyzer table: a part for each ego and criterion."""

    title: str
    reference: str | None
    parts: tuple[Part, ...]
    notes: tuple[str, ...]


def analyze(
    cells: Sequence[Cell],
    cases: Sequence[Case],
    *,
    title: str,
    analyzers: Sequence[str] | None = None,
    reference: str | None = None,
) -> Analysis:
    """The answers of the rows ``analyzers`` (left out: all that rank intents) against the cases' labels.

    Labels are read off the cells of the row ``oracle``, which also tell what applies and how often what an analyzer
    ranked first succeeds; where an encounter has none they are the case's own. People's annotations are a case's own.
    """
    rows = list(analyzers or names((c for c in cells if c.get("intents")), "row"))
    reference = reference or next(iter(rows), None)
    parts, notes = [], []
    for ego in names(cells, "ego"):
        own_cells = [c for c in cells if c["ego"] == ego]
        oracle = {key(c): c for c in own_cells if c["row"] == ORACLE and c.get("attempts")}
        if not oracle:
            notes.append(f"There is no row oracle against {ego}: chance, the ceiling and calibration are not known.")
        for criterion in (*CRITERIA, ANNOTATED):
            truth = _truth(own_cells, cases, ego, criterion, oracle)
            if criterion in CRITERIA:
                notes.append(_agreement(truth, oracle, _given(cases, ego, criterion), ego, criterion))
            if truth:
                parts.append(_part(own_cells, rows, ego, criterion, truth, oracle, reference))
        if ego not in {part.ego for part in parts}:
            notes.append(f"Nothing is labelled for {ego}: add the row oracle.")
    return Analysis(title, reference, tuple(parts), tuple(note for note in notes if note))


def _truth(
    cells: Sequence[Cell], cases: Sequence[Case], ego: str, criterion: str, oracle: Mapping[Key, Cell]
) -> dict[Key, frozenset[str]]:
    """The labels of every encounter that has any."""
    truth: dict[Key, frozenset[str]] = {}
    given = _given(cases, ego, criterion)
    for name in dict.fromkeys(key(c) for c in cells):
        simulated = name in oracle and criterion in CRITERIA
        labels = oracle_labels(oracle[name])[criterion] if simulated else given.get(name[0], ())
        if labels:
            truth[name] = frozenset(labels)
    return truth


def _given(cases: Sequence[Case], ego: str, criterion: str) -> dict[str, tuple[str, ...]]:
    """The cases' own labels; people's for what was annotated."""
    who = PEOPLE if criterion == ANNOTATED else ego
    return {c.name: tuple(c.labels.get(who, {}).get(criterion, ())) for c in cases}


def _agreement(
    truth: Truth, oracle: Mapping[Key, Cell], given: Mapping[str, Sequence[str]], ego: str, criterion: str
) -> str:
    """How many of the suite's own labels have something in common with those that count, in a sentence."""
    both = [(truth[name], given[name[0]]) for name in truth if name in oracle and given.get(name[0])]
    alike = sum(bool(first.intersection(second)) for first, second in both)
    if alike == len(both):
        return ""
    return (
        f"Against {ego}, by {criterion}: the suite's own labels are of the library of their time and share a behaviour "
        f"with the oracle's in {alike} of {len(both)} encounters; the oracle's count."
    )


def _part(
    cells: Sequence[Cell], rows: Sequence[str], ego: str, criterion: str, truth: Truth, oracle: Mapping[Key, Cell],
    reference: str | None,
) -> Part:  # fmt: skip
    simulated = oracle if criterion in CRITERIA else {}
    applies = {name: sorted({a["intent"] for a in cell["attempts"]}) for name, cell in oracle.items() if name in truth}
    every = {key(c) for c in cells}
    by_row = {row: {key(c): c for c in cells if c["row"] == row and key(c) in truth} for row in rows}
    scores = [_score(row, own, truth, applies) for row, own in by_row.items() if own]
    scores = [_compared(s, by_row, truth, reference) for s in scores]
    scores.append(_constant(truth, applies))
    if applies:
        scores += _references(criterion, truth, applies, oracle)
    return Part(
        ego, criterion, tuple(scores), {row: _confusion(own, truth) for row, own in by_row.items() if own},
        {row: _calibration(own, simulated, criterion) for row, own in by_row.items() if simulated and own},
        len(every - truth.keys()),
        sum(not any(succeeds(a, criterion) for a in simulated[n]["attempts"]) for n in truth if n in simulated),
    )  # fmt: skip


def answers(cell: Cell) -> list[str]:
    """The behaviours that the analyzer ranked, the most dangerous first, each once."""
    return list(dict.fromkeys(str(i["label"]) for i in cell.get("intents") or ()))


def _right(cell: Cell, truth: Truth, within: int = 1) -> bool:
    return bool(truth[key(cell)].intersection(answers(cell)[:within]))


def _score(who: str, cells: Mapping[Key, Cell], truth: Truth, applies: Mapping[Key, Sequence[str]]) -> Score:
    right = {name: _right(cell, truth) for name, cell in cells.items()}
    several = [right[name] for name in right if len(applies.get(name, ())) > 1]
    twice = [_right(cell, truth, 2) for cell in cells.values()]
    return Score(
        who, wilson(sum(right.values()), len(right)), wilson(sum(several), len(several)) if several else None,
        _kappa([next(iter(answers(c)), NO_ANSWER) for c in cells.values()], [truth[name] for name in cells]),
        wilson(sum(twice), len(twice)),
    )  # fmt: skip


def _compared(score: Score, by_row: Mapping[str, Mapping[Key, Cell]], truth: Truth, reference: str | None) -> Score:
    own, baseline = by_row[score.who], by_row.get(reference or "", {})
    common = [name for name in own if name in baseline]
    if score.who == reference or not common:
        return score
    left, right = ([float(_right(cells[name], truth)) for name in common] for cells in (own, baseline))
    return replace(score, difference=paired(left, right, rate=True))


def _kappa(given: Sequence[str], truth: Sequence[frozenset[str]]) -> Estimate | None:
    """Cohen's kappa with sets of labels: chance agreement is that of answers dealt out at random to the encounters.

    None where chance alone is always right.
    """
    every = sorted({*given, *(label for labels in truth for label in labels)})
    answer = np.array([[a == label for label in every] for a in given], dtype=float)
    allowed = np.array([[label in labels for label in every] for labels in truth], dtype=float)
    right = (answer * allowed).sum(axis=1)
    n = len(given)
    drawn = np.random.default_rng(0).integers(0, n, (RESAMPLES, n))
    weights = np.array([np.bincount(row, minlength=n) for row in drawn], dtype=float) / n
    kappas = _kappas(np.vstack([np.full((1, n), 1 / n), weights]), right, answer, allowed)
    finite = kappas[1:][np.isfinite(kappas[1:])]
    if not np.isfinite(kappas[0]) or not finite.size:
        return None
    low, high = np.quantile(finite, [0.025, 0.975])
    return Estimate(float(kappas[0]), float(low), float(high), n)


def _kappas(weights: Floats, right: Floats, answer: Floats, allowed: Floats) -> Floats:
    chance = ((weights @ answer) * (weights @ allowed)).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(chance < 1 - 1e-9, (weights @ right - chance) / (1 - chance), np.nan)


def _constant(truth: Truth, applies: Mapping[Key, Sequence[str]]) -> Score:
    """The one label that is right most often, chosen in hindsight."""
    best = max(LABELS, key=lambda label: sum(label in labels for labels in truth.values()))
    right = {name: best in labels for name, labels in truth.items()}
    several = [right[name] for name in right if len(applies.get(name, ())) > 1]
    return Score(
        f"always {best} (best constant, in hindsight)", wilson(sum(right.values()), len(right)),
        wilson(sum(several), len(several)) if several else None,
    )  # fmt: skip


def _references(
    criterion: str, truth: Truth, applies: Mapping[Key, Sequence[str]], oracle: Mapping[Key, Cell]
) -> list[Score]:
    """Chance among what applies, and how well one half of the oracle's simulations answers for the other."""
    chance = {name: len(truth[name].intersection(applicable)) / len(applicable) for name, applicable in applies.items()}
    several = [value for name, value in chance.items() if len(applies[name]) > 1]
    scores = [Score(CHANCE, bootstrap(list(chance.values())), bootstrap(several) if several else None)]
    if criterion in CRITERIA:
        halves = {name: split_half(oracle[name])[criterion] for name in applies}
        agreed = [value for value in halves.values() if value is not None]
        whole = [1.0 if value is None else value for value in halves.values()]  # one label: it agrees with itself
        scores.append(Score(CEILING, bootstrap(whole), bootstrap(agreed) if agreed else None))
    return scores


def _confusion(cells: Mapping[Key, Cell], truth: Truth) -> dict[tuple[str, str], float]:
    counts: dict[tuple[str, str], float] = defaultdict(float)
    for name, cell in cells.items():
        first = next(iter(answers(cell)), NO_ANSWER)
        if first in truth[name]:
            counts[_known(first), _known(first)] += 1.0
            continue
        for label in truth[name]:
            counts[_known(label), _known(first)] += 1.0 / len(truth[name])
    return dict(counts)


def _known(label: str) -> str:
    return label if label in ANSWERS else NOVEL


def _calibration(cells: Mapping[Key, Cell], oracle: Mapping[Key, Cell], criterion: str) -> dict[str, Estimate]:
    """By the risk that the analyzer gave what it ranked first: the share of the oracle's simulations with that vehicle
    and intent that succeed, over encounters that have any."""
    rates: dict[str, list[float]] = defaultdict(list)
    for name, cell in cells.items():
        first = next(iter(cell.get("intents") or ()), None)
        tried = (oracle.get(name) or {}).get("attempts") or ()
        same = [a for a in tried if first and a["intent"] == first["label"] and first["bv"] in a["adversaries"]]
        if first and same:
            rates[str(first["risk"])].append(sum(succeeds(a, criterion) for a in same) / len(same))
    return {risk: bootstrap(rates[risk]) for risk in dict.fromkeys((*RISKS, *rates)) if risk in rates}
