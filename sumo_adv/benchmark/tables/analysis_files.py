"""The analyzer table as files: Markdown, CSV of the scores, CSV of the confusion matrices, JSON, manifest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from sumo_adv.benchmark.nouns import Cell, Suite
from sumo_adv.benchmark.tables import paper
from sumo_adv.benchmark.tables.analysis import ANSWERS, NO_ANSWER, Analysis, Part
from sumo_adv.benchmark.tables.markdown import grid, number, signed
from sumo_adv.benchmark.tables.write import SCHEMA, About, as_csv, as_json, manifest, write_texts
from sumo_adv.metrics.statistics import Estimate, Paired

FIGURES = ("accuracy", "several", "kappa", "top2")
SCORES = ("ego", "criterion", "who", "figure", "value", "low", "high", "n", "difference", "p")
CONFUSION = ("ego", "criterion", "who", "label", *ANSWERS)
HOW = (
    "Label: the intent that is most dangerous against this ego in simulation, by the share of its candidates that "
    "collide (criterion collision: feasible, not rear-end; valid: valid ones), then by mean capped min TTC; a tie is a "
    "set, and any answer in it is right. Answer: the first intent that the analyzer ranks. No answer is wrong. Kappa: "
    "Cohen's, with chance agreement taken over the sets. Several: the encounters in which more than one intent applies."
)


def write_analysis(
    analysis: Analysis, cells: Sequence[Cell], folder: Path, about: About, name: str = "analyzer"
) -> list[Path]:
    """``NAME.md``, ``.csv``, ``.json``, ``NAME-confusion.csv``, ``NAME.manifest.json``. Raises UsageError."""
    texts = {
        f"{name}.md": to_markdown(analysis),
        f"{name}.csv": as_csv(SCORES, [*_score_rows(analysis), *_calibration_rows(analysis)]),
        f"{name}-confusion.csv": as_csv(CONFUSION, _confusion_rows(analysis)),
        f"{name}.json": as_json(_document(analysis)),
    }
    texts[f"{name}.manifest.json"] = as_json(manifest(about, cells, list(texts)))
    return write_texts(folder, texts)


def labels_hash(suite: Suite) -> str:
    """SHA-256 over the labels that a suite brings along."""
    given = {case.name: case.labels for case in suite.cases if case.labels}
    return hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()


def to_markdown(analysis: Analysis) -> str:
    """The analyzer table as text."""
    lines = [f"# {analysis.title}", "", HOW, ""]
    lines += [*(f"- {note}" for note in analysis.notes), ""] if analysis.notes else []
    for part in analysis.parts:
        lines += _part(part, analysis.reference)
    reported = [[who, f"{value:.3f}"] for who, value in paper.ACCURACY.items()]
    lines += ["## What the paper reports (Fig. 3)", "", *grid(["analyzer", "accuracy"], reported)]
    return "\n".join([*lines, paper.ANALYZER_NOTE]) + "\n"


def _part(part: Part, reference: str | None) -> list[str]:
    lines = [f"## Ego {part.ego}, by {part.criterion}", ""]
    if part.unlabelled:
        lines += [f"{part.unlabelled} encounters have no label and are left out.", ""]
    if part.by_time:
        lines += [f"In {part.by_time} no simulation succeeds: there the label is by min TTC alone.", ""]
    rows = [
        [s.who, str(s.accuracy.n), *(_shown(getattr(s, f)) for f in FIGURES), signed(s.difference)] for s in part.scores
    ]
    head = ["who", "n", "accuracy", "several", "kappa", "top-2", f"accuracy, difference to {reference}"]
    lines += grid(head, rows)
    if part.calibration:
        risks = list(dict.fromkeys(risk for estimates in part.calibration.values() for risk in estimates))
        rows = [[who, *(_shown(estimates.get(r)) for r in risks)] for who, estimates in part.calibration.items()]
        lines += ["Success in the oracle's simulations of what the analyzer ranked first, by the risk it gave:", ""]
        lines += grid(["who", *risks], rows)
    for who, matrix in part.confusion.items():
        shown = [a for a in ANSWERS if any(a in pair for pair in matrix)]
        rows = [[label, *(f"{matrix.get((label, a), 0):g}" for a in shown)] for label in shown if label != NO_ANSWER]
        lines += [f"Confusion of {who} (rows: label, columns: answer; a tie's miss is spread over it):", ""]
        lines += grid(["label", *shown], rows)
    return lines


def _shown(estimate: Estimate | None) -> str:
    return number(estimate) + (f", n {estimate.n}" if estimate is not None else "")


def _score_rows(analysis: Analysis) -> Iterator[dict[str, Any]]:
    for part in analysis.parts:
        for score in part.scores:
            for figure in FIGURES:
                e: Estimate | None = getattr(score, figure)
                if e is not None:
                    yield _figure_row(part, score.who, figure, e, score.difference if figure == "accuracy" else None)


def _calibration_rows(analysis: Analysis) -> Iterator[dict[str, Any]]:
    for part in analysis.parts:
        for who, estimates in part.calibration.items():
            for risk, e in estimates.items():
                yield _figure_row(part, who, f"success at risk {risk}", e, None)


def _figure_row(part: Part, who: str, figure: str, e: Estimate, d: Paired | None) -> dict[str, Any]:
    return {
        "ego": part.ego, "criterion": part.criterion, "who": who, "figure": figure, "value": e.value,
        "low": e.low, "high": e.high, "n": e.n, "difference": d.difference if d else None, "p": d.p if d else None,
    }  # fmt: skip


def _confusion_rows(analysis: Analysis) -> Iterator[dict[str, Any]]:
    for part in analysis.parts:
        for who, matrix in part.confusion.items():
            for label in ANSWERS[:-1]:
                counts = {answer: matrix.get((label, answer), 0.0) for answer in ANSWERS}
                yield {"ego": part.ego, "criterion": part.criterion, "who": who, "label": label, **counts}


def _document(analysis: Analysis) -> dict[str, Any]:
    return {
        "schema": SCHEMA, "title": analysis.title, "reference": analysis.reference, "notes": analysis.notes,
        "scores": list(_score_rows(analysis)), "confusion": list(_confusion_rows(analysis)),
        "calibration": list(_calibration_rows(analysis)),
        "unlabelled": [{"ego": p.ego, "criterion": p.criterion, "encounters": p.unlabelled} for p in analysis.parts],
        "by_time": [{"ego": p.ego, "criterion": p.criterion, "encounters": p.by_time} for p in analysis.parts],
    }  # fmt: skip
