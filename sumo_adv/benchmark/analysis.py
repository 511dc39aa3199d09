"""Compare the analyzer's answers with labels: accuracy, kappa, top-2, confusion and calibration of risk.

A label is a set of behaviours if several are equally dangerous, and any answer in the set is right. Chance among
applicable intents, the best constant answer and the split-half ceiling are reported with the analyzers. An accuracy
alone is meaningless if an encounter allows only one behaviour.
"""

from __future__ import annotations

import hashlib
import json
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.benchmark.cells import ORACLE, CellKey, interval, key, names, resamples
from sumo_adv.benchmark.nouns import Cell, Suite, SuiteCase
from sumo_adv.benchmark.rows import BEHAVIOUR_LABELS, CRITERIA, oracle_labels, split_half, succeeds
from sumo_adv.benchmark.table import ACCURACY, ANALYZER_NOTE, grid, number, paired, signed
from sumo_adv.benchmark.write import TABLE_SCHEMA, aligned, as_csv, as_json, on_screen, rate, write_files
from sumo_adv.datatypes import Floats
from sumo_adv.metrics.statistics import Estimate, Paired, bootstrap, wilson

NOVEL, NO_ANSWER = "novel", "no answer"
ANNOTATED, PEOPLE = "annotated", "people"
ANALYZER_ANSWERS = (*BEHAVIOUR_LABELS, NOVEL, NO_ANSWER)
RISK_WORDS = ("low", "medium", "high")
ACCURACY_RESAMPLES = 2000
CHANCE, CEILING = "chance among applicable intents", "ceiling: one half of the oracle for the other"

Truth = Mapping[CellKey, frozenset[str]]


@dataclass(frozen=True, slots=True)
class AnalyzerScore:
    """How well one way of answering does.

    Attributes:
        who: The analyzer or reference.
        accuracy: The share of right answers.
        several: The accuracy over encounters to which more than one intent applies.
        kappa: Cohen's kappa.
        top2: The share of encounters in which one of the first two answers is right.
        difference: The paired difference of accuracy to the reference.
    """

    who: str
    accuracy: Estimate
    several: Estimate | None = None
    kappa: Estimate | None = None
    top2: Estimate | None = None
    difference: Paired | None = None  # to the reference's accuracy


@dataclass(frozen=True, slots=True)
class AccuracyPart:
    """The scores against one ego, by one criterion.

    Attributes:
        ego: The ego's driver.
        criterion: The criterion of the labels.
        scores: The scores.
        confusion: By analyzer, the number of encounters of each label and answer. A wrong answer to a tie is spread
            over the tie's labels.
        calibration: By analyzer and risk, the oracle's share of success with the vehicle and intent ranked first.
        unlabelled: The number of encounters without a label.
        by_time: The number of encounters in which no simulation of the oracle succeeded, so that only the minimum TTC
            made the label.
    """

    ego: str
    criterion: str
    scores: tuple[AnalyzerScore, ...]
    confusion: Mapping[str, Mapping[tuple[str, str], float]]
    calibration: Mapping[str, Mapping[str, Estimate]]
    unlabelled: int
    by_time: int = 0


@dataclass(frozen=True, slots=True)
class AnalyzerAnalysis:
    """The analysis of all egos and criteria.

    Attributes:
        title: The title.
        reference: The row that the others are compared with; None if there is none.
        parts: The parts.
        notes: Sentences for the reader.
    """

    title: str
    reference: str | None
    parts: tuple[AccuracyPart, ...]
    notes: tuple[str, ...]


def analyze(
    cells: Sequence[Cell],
    cases: Sequence[SuiteCase],
    *,
    title: str,
    analyzers: Sequence[str] | None = None,
    reference: str | None = None,
) -> AnalyzerAnalysis:
    """Compare the answers of analyzers with the labels of encounters.

    Labels come from the cells of the row ``oracle``, which also say which intents apply, and how often an analyzer's
    first answer succeeds. If an encounter has no such cell, its case's own labels count. People's annotations are
    always the case's own.

    Args:
        cells: The cells.
        cases: The encounters.
        title: The title.
        analyzers: The rows to compare; None takes all that rank intents.
        reference: The row that the others are compared with; None takes the first.

    Returns:
        The analysis.
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
            notes.append(f"No encounter has a label for {ego}: add the row oracle.")
    return AnalyzerAnalysis(title, reference, tuple(parts), tuple(note for note in notes if note))


def _truth(
    cells: Sequence[Cell], cases: Sequence[SuiteCase], ego: str, criterion: str, oracle: Mapping[CellKey, Cell]
) -> dict[CellKey, frozenset[str]]:
    """Return the labels that count, by encounter."""
    truth: dict[CellKey, frozenset[str]] = {}
    given = _given(cases, ego, criterion)
    for name in dict.fromkeys(key(c) for c in cells):
        simulated = name in oracle and criterion in CRITERIA
        labels = oracle_labels(oracle[name])[criterion] if simulated else given.get(name[0], ())
        if labels:
            truth[name] = frozenset(labels)
    return truth


def _given(cases: Sequence[SuiteCase], ego: str, criterion: str) -> dict[str, tuple[str, ...]]:
    """Return the cases' own labels; for the criterion of annotations, those of people."""
    who = PEOPLE if criterion == ANNOTATED else ego
    return {c.name: tuple(c.labels.get(who, {}).get(criterion, ())) for c in cases}


def _agreement(
    truth: Truth, oracle: Mapping[CellKey, Cell], given: Mapping[str, Sequence[str]], ego: str, criterion: str
) -> str:
    """Say how many of the suite's own labels share a behaviour with those that count; '' if all do."""
    both = [(truth[name], given[name[0]]) for name in truth if name in oracle and given.get(name[0])]
    alike = sum(bool(first.intersection(second)) for first, second in both)
    if alike == len(both):
        return ""
    return (
        f"Against {ego}, by {criterion}: the suite's own labels were made with an earlier library. They share a "
        f"behaviour with the oracle's labels in {alike} of {len(both)} encounters. The oracle's labels count."
    )


def _part(
    cells: Sequence[Cell], rows: Sequence[str], ego: str, criterion: str, truth: Truth, oracle: Mapping[CellKey, Cell],
    reference: str | None,
) -> AccuracyPart:  # fmt: skip
    """Compute the scores against one ego, by one criterion."""
    simulated = oracle if criterion in CRITERIA else {}
    applies = {name: sorted({a["intent"] for a in cell["attempts"]}) for name, cell in oracle.items() if name in truth}
    every = {key(c) for c in cells}
    by_row = {row: {key(c): c for c in cells if c["row"] == row and key(c) in truth} for row in rows}
    scores = [_score(row, own, truth, applies) for row, own in by_row.items() if own]
    scores = [_compared(s, by_row, truth, reference) for s in scores]
    scores.append(_constant(truth, applies))
    if applies:
        scores += _references(criterion, truth, applies, oracle)
    return AccuracyPart(
        ego, criterion, tuple(scores), {row: _confusion(own, truth) for row, own in by_row.items() if own},
        {row: _calibration(own, simulated, criterion) for row, own in by_row.items() if simulated and own},
        len(every - truth.keys()),
        sum(not any(succeeds(a, criterion) for a in simulated[n]["attempts"]) for n in truth if n in simulated),
    )  # fmt: skip


def answers(cell: Cell) -> list[str]:
    """Return the behaviours that the analyzer ranked, the most dangerous first, each once."""
    return list(dict.fromkeys(str(i["label"]) for i in cell.get("intents") or ()))


def _right(cell: Cell, truth: Truth, within: int = 1) -> bool:
    """Return whether one of the first ``within`` answers is right."""
    return bool(truth[key(cell)].intersection(answers(cell)[:within]))


def _score(
    who: str, cells: Mapping[CellKey, Cell], truth: Truth, applies: Mapping[CellKey, Sequence[str]]
) -> AnalyzerScore:
    right = {name: _right(cell, truth) for name, cell in cells.items()}
    several = [right[name] for name in right if len(applies.get(name, ())) > 1]
    twice = [_right(cell, truth, 2) for cell in cells.values()]
    return AnalyzerScore(
        who, wilson(sum(right.values()), len(right)), wilson(sum(several), len(several)) if several else None,
        _kappa([next(iter(answers(c)), NO_ANSWER) for c in cells.values()], [truth[name] for name in cells]),
        wilson(sum(twice), len(twice)),
    )  # fmt: skip


def _compared(
    score: AnalyzerScore, by_row: Mapping[str, Mapping[CellKey, Cell]], truth: Truth, reference: str | None
) -> AnalyzerScore:
    """Add the difference to the reference, over the encounters that both have."""
    own, baseline = by_row[score.who], by_row.get(reference or "", {})
    common = [name for name in own if name in baseline]
    if score.who == reference or not common:
        return score
    left, right = ([float(_right(cells[name], truth)) for name in common] for cells in (own, baseline))
    return replace(score, difference=paired(left, right, rate=True))


def _kappa(given: Sequence[str], truth: Sequence[frozenset[str]]) -> Estimate | None:
    """Compute Cohen's kappa with sets of labels; chance agreement is that of the answers dealt out at random.

    Return None if chance alone is always right.
    """
    every = sorted({*given, *(label for labels in truth for label in labels)})
    answer = np.array([[a == label for label in every] for a in given], dtype=float)
    allowed = np.array([[label in labels for label in every] for labels in truth], dtype=float)
    right = (answer * allowed).sum(axis=1)
    n = len(given)
    weights = np.vstack([np.full((1, n), 1 / n), resamples(n, ACCURACY_RESAMPLES) / n])
    kappas = _kappas(weights, right, answer, allowed)
    finite = kappas[1:][np.isfinite(kappas[1:])]
    if not np.isfinite(kappas[0]) or not finite.size:
        return None
    return interval(float(kappas[0]), finite, n)


def _kappas(weights: Floats, right: Floats, answer: Floats, allowed: Floats) -> Floats:
    """Compute kappa for each row of weights, NaN if chance alone is always right."""
    chance = ((weights @ answer) * (weights @ allowed)).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(chance < 1 - 1e-9, (weights @ right - chance) / (1 - chance), np.nan)


def _constant(truth: Truth, applies: Mapping[CellKey, Sequence[str]]) -> AnalyzerScore:
    """Score the one label that is right most often, chosen in hindsight."""
    best = max(BEHAVIOUR_LABELS, key=lambda label: sum(label in labels for labels in truth.values()))
    right = {name: best in labels for name, labels in truth.items()}
    several = [right[name] for name in right if len(applies.get(name, ())) > 1]
    return AnalyzerScore(
        f"always {best} (best constant, in hindsight)", wilson(sum(right.values()), len(right)),
        wilson(sum(several), len(several)) if several else None,
    )  # fmt: skip


def _references(
    criterion: str, truth: Truth, applies: Mapping[CellKey, Sequence[str]], oracle: Mapping[CellKey, Cell]
) -> list[AnalyzerScore]:
    """Score chance among applicable intents, and how well one half of the oracle's simulations predicts the other."""
    chance = {name: len(truth[name].intersection(applicable)) / len(applicable) for name, applicable in applies.items()}
    several = [value for name, value in chance.items() if len(applies[name]) > 1]
    scores = [AnalyzerScore(CHANCE, bootstrap(list(chance.values())), bootstrap(several) if several else None)]
    if criterion in CRITERIA:
        halves = {name: split_half(oracle[name])[criterion] for name in applies}
        agreed = [value for value in halves.values() if value is not None]
        whole = [1.0 if value is None else value for value in halves.values()]  # a single label agrees with itself
        scores.append(AnalyzerScore(CEILING, bootstrap(whole), bootstrap(agreed) if agreed else None))
    return scores


def _confusion(cells: Mapping[CellKey, Cell], truth: Truth) -> dict[tuple[str, str], float]:
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
    return label if label in ANALYZER_ANSWERS else NOVEL


def _calibration(cells: Mapping[CellKey, Cell], oracle: Mapping[CellKey, Cell], criterion: str) -> dict[str, Estimate]:
    """Return the oracle's success rate with the analyzer's first choice, by the risk that the analyzer gave.

    Simulations of the same vehicle and intent count. Encounters without such simulations are left out.
    """
    rates: dict[str, list[float]] = defaultdict(list)
    for name, cell in cells.items():
        first = next(iter(cell.get("intents") or ()), None)
        tried = (oracle.get(name) or {}).get("attempts") or ()
        same = [a for a in tried if first and a["intent"] == first["label"] and first["bv"] in a["adversaries"]]
        if first and same:
            rates[str(first["risk"])].append(sum(succeeds(a, criterion) for a in same) / len(same))
    return {risk: bootstrap(rates[risk]) for risk in dict.fromkeys((*RISK_WORDS, *rates)) if risk in rates}


# -- files


FIGURES = ("accuracy", "several", "kappa", "top2")
SCORES = ("ego", "criterion", "who", "figure", "value", "low", "high", "n", "difference", "p")
CONFUSION = ("ego", "criterion", "who", "label", *ANALYZER_ANSWERS)
ANALYSIS_NOTE = (
    "Label: the intent that is most dangerous against this ego in simulation, by the share of its candidates that "
    "collide (criterion collision: feasible, not rear-end; valid: valid ones), then by mean capped min TTC. A tie is a "
    "set, and any answer in it is right. Answer: the first intent that the analyzer ranks. A missing answer counts as "
    "wrong. Kappa: Cohen's, with chance agreement taken over the sets. Several: the encounters in which more than one "
    "intent applies."
)


def write_analysis(
    analysis: AnalyzerAnalysis, cells: Sequence[Cell], folder: Path, about: Mapping[str, Any]
) -> list[Path]:
    """Write ``analyzer.md``, ``.csv``, ``.json``, ``-confusion.csv`` and ``.manifest.json``.

    Args:
        analysis: The analysis.
        cells: The cells that it was made of.
        folder: The folder.
        about: What the manifest says about the analysis.

    Returns:
        The files.

    Raises:
        UsageError: A file cannot be written.
    """
    texts = {
        ".md": to_markdown(analysis), ".csv": as_csv(SCORES, [*_score_rows(analysis), *_calibration_rows(analysis)]),
        "-confusion.csv": as_csv(CONFUSION, _confusion_rows(analysis)), ".json": as_json(_document(analysis)),
    }  # fmt: skip
    return write_files(folder, "analyzer", texts, cells, about)


def labels_hash(suite: Suite) -> str:
    """Return the SHA-256 of the labels that a suite has."""
    given = {case.name: case.labels for case in suite.cases if case.labels}
    return hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()


def to_markdown(analysis: AnalyzerAnalysis) -> str:
    """Format the analysis as Markdown."""
    lines = [f"# {analysis.title}", "", ANALYSIS_NOTE, ""]
    lines += [*(f"- {note}" for note in analysis.notes), ""] if analysis.notes else []
    for part in analysis.parts:
        lines += _part_lines(part, analysis.reference)
    reported = [[who, f"{value:.3f}"] for who, value in ACCURACY.items()]
    lines += ["## What the paper reports (Fig. 3)", "", *grid(["analyzer", "accuracy"], reported)]
    return "\n".join([*lines, ANALYZER_NOTE]) + "\n"


def _part_lines(part: AccuracyPart, reference: str | None) -> list[str]:
    lines = [f"## Ego {part.ego}, by {part.criterion}", ""]
    if part.unlabelled:
        lines += [f"{part.unlabelled} encounters have no label and are left out.", ""]
    if part.by_time:
        lines += [f"In {part.by_time}, no simulation succeeds, so their label is by min TTC alone.", ""]
    rows = [
        [s.who, str(s.accuracy.n), *(_shown(getattr(s, f)) for f in FIGURES), signed(s.difference)] for s in part.scores
    ]
    head = ["who", "n", "accuracy", "several", "kappa", "top-2", f"accuracy, difference to {reference}"]
    lines += grid(head, rows)
    if part.calibration:
        risks = list(dict.fromkeys(risk for estimates in part.calibration.values() for risk in estimates))
        rows = [[who, *(_shown(estimates.get(r)) for r in risks)] for who, estimates in part.calibration.items()]
        lines += ["Success, in the oracle's simulations, of the intent that the analyzer ranks first, by its risk:", ""]
        lines += grid(["who", *risks], rows)
    for who, matrix in part.confusion.items():
        shown = [a for a in ANALYZER_ANSWERS if any(a in pair for pair in matrix)]
        rows = [[label, *(f"{matrix.get((label, a), 0):g}" for a in shown)] for label in shown if label != NO_ANSWER]
        lines += [f"Confusion of {who} (rows: label, columns: answer; a tie's miss is spread over it):", ""]
        lines += grid(["label", *shown], rows)
    return lines


def _shown(estimate: Estimate | None) -> str:
    return number(estimate) + (f", n {estimate.n}" if estimate is not None else "")


def _score_rows(analysis: AnalyzerAnalysis) -> Iterator[dict[str, Any]]:
    for part in analysis.parts:
        for score in part.scores:
            for figure in FIGURES:
                e: Estimate | None = getattr(score, figure)
                if e is not None:
                    yield _figure_row(part, score.who, figure, e, score.difference if figure == "accuracy" else None)


def _calibration_rows(analysis: AnalyzerAnalysis) -> Iterator[dict[str, Any]]:
    for part in analysis.parts:
        for who, estimates in part.calibration.items():
            for risk, e in estimates.items():
                yield _figure_row(part, who, f"success at risk {risk}", e, None)


def _figure_row(part: AccuracyPart, who: str, figure: str, e: Estimate, d: Paired | None) -> dict[str, Any]:
    return {
        "ego": part.ego, "criterion": part.criterion, "who": who, "figure": figure, "value": e.value,
        "low": e.low, "high": e.high, "n": e.n, "difference": d.difference if d else None, "p": d.p if d else None,
    }  # fmt: skip


def _confusion_rows(analysis: AnalyzerAnalysis) -> Iterator[dict[str, Any]]:
    for part in analysis.parts:
        for who, matrix in part.confusion.items():
            for label in ANALYZER_ANSWERS[:-1]:
                counts = {answer: matrix.get((label, answer), 0.0) for answer in ANALYZER_ANSWERS}
                yield {"ego": part.ego, "criterion": part.criterion, "who": who, "label": label, **counts}


def _document(analysis: AnalyzerAnalysis) -> dict[str, Any]:
    return {
        "schema": TABLE_SCHEMA, "title": analysis.title, "reference": analysis.reference, "notes": analysis.notes,
        "scores": list(_score_rows(analysis)), "confusion": list(_confusion_rows(analysis)),
        "calibration": list(_calibration_rows(analysis)),
        "unlabelled": [{"ego": p.ego, "criterion": p.criterion, "encounters": p.unlabelled} for p in analysis.parts],
        "by_time": [{"ego": p.ego, "criterion": p.criterion, "encounters": p.by_time} for p in analysis.parts],
    }  # fmt: skip


def analysis_text(analysis: AnalyzerAnalysis, file: Path) -> str:
    """Format the analysis for the terminal: how often each analyzer names the most dangerous intent."""
    sections = []
    for part in analysis.parts:
        rows = [[s.who, str(s.accuracy.n), *(rate(x) for x in (s.accuracy, s.several, s.top2))] for s in part.scores]
        lines = aligned(["who", "n", "accuracy", "several", "top-2"], rows)
        sections.append((f"Against {part.ego}, by {part.criterion}", lines))
    notes = ["Several: the encounters in which more than one intent applies.", *analysis.notes]
    return on_screen(analysis.title, sections, notes, file)
