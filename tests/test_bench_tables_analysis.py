"""The analyzer table: answers against sets of labels, chance, ceiling, confusion, calibration of risk."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
from bench_cells import Cell, attempt, cell

from sumo_adv.benchmark.analysis import (
    ANALYZER_ANSWERS,
    CEILING,
    CHANCE,
    AccuracyPart,
    AnalyzerAnalysis,
    AnalyzerScore,
    analyze,
    to_markdown,
    write_analysis,
)
from sumo_adv.benchmark.nouns import SuiteCase
from sumo_adv.benchmark.suites import LABELS_ADAPTER

CUT, BRAKE, SHIFT, TURN = (
    "Aggressive Cut-in", "Emergency Braking", "Straight Lane Shift", "Intersection Rush-through Turn Left",
)  # fmt: skip
ABOUT = {
    "command": "sumo-adv bench analyzer", "suite": "made", "version": "1", "content": "c0ffee",
    "versions": {}, "settings": {}, "seed": 0, "bank_hash": None,
}  # fmt: skip
LABELS = {"a": (CUT,), "b": (CUT, SHIFT), "c": (SHIFT,), "d": (TURN,)}


def cases(
    labels: dict[str, tuple[str, ...]] = LABELS, criterion: str = "collision", ego: str = "idm"
) -> list[SuiteCase]:
    return [
        SuiteCase(n, Path("x"), None, "leader", "straight", {ego: {criterion: label}}) for n, label in labels.items()
    ]


def answered(case: str, row: str, *labels: str, risk: str = "high", won: bool = True) -> Cell:
    """A cell with an analyzer that ranks ``labels``."""
    ranked = [{"bv": "1", "label": label, "risk": risk} for label in labels]
    return cell(case, row, attempt(valid=True) if won else attempt(min_ttc=5.0), intents=ranked)


def expert() -> list[Cell]:
    """Right on a and b (a tie), wrong on c with the second answer right, silent on d."""
    return [
        answered("a", "expert", CUT, SHIFT),
        answered("b", "expert", SHIFT),
        answered("c", "expert", CUT, SHIFT, risk="low", won=False),
        answered("d", "expert"),
    ]


def oracle() -> list[Cell]:
    """Encounters with two applicable intents but d, in which one alone applies."""
    two = [attempt(CUT, valid=True)] * 4 + [attempt(SHIFT, min_ttc=5.0)] * 4
    return [*(cell(name, "oracle", *two) for name in "abc"), cell("d", "oracle", attempt(TURN, valid=True))]


def part(analysis: AnalyzerAnalysis, criterion: str = "collision") -> AccuracyPart:
    return next(p for p in analysis.parts if p.criterion == criterion)


def score(analysis: AnalyzerAnalysis, who: str, criterion: str = "collision") -> AnalyzerScore:
    return next(s for s in part(analysis, criterion).scores if s.who.startswith(who))


def test_an_answer_in_the_tie_is_right_and_none_is_wrong() -> None:
    expert_score = score(analyze(expert(), cases(), title="Made"), "expert")
    assert (expert_score.accuracy.value, expert_score.accuracy.n) == (0.5, 4)
    assert expert_score.top2 is not None and expert_score.top2.value == 0.75
    # answers: CUT 1/2, SHIFT 1/4, none 1/4; allowed: CUT 1/2, SHIFT 1/2, TURN 1/4: chance 3/8, kappa (1/8) / (5/8)
    assert expert_score.kappa is not None and expert_score.kappa.value == pytest.approx(0.2)


def test_kappa_of_single_labels_is_cohens() -> None:
    """Two by two: 20 both yes, 15 both no, 5 and 10 apart: po 0.7, pe 0.5, kappa 0.4 (Cohen's textbook example)."""
    pairs = [(CUT, CUT)] * 20 + [(CUT, SHIFT)] * 5 + [(SHIFT, CUT)] * 10 + [(SHIFT, SHIFT)] * 15
    cells = [answered(f"x{k}", "expert", given) for k, (given, _) in enumerate(pairs)]
    analysis = analyze(cells, cases({f"x{k}": (label,) for k, (_, label) in enumerate(pairs)}), title="Made")
    kappa = score(analysis, "expert").kappa
    assert kappa is not None and kappa.value == pytest.approx(0.4) and kappa.low < 0.4 < kappa.high


def test_chance_ceiling_and_constant_stand_beside() -> None:
    """The oracle labels a, b and c with the cut-in (one of two that apply) and d with the turn (the only one)."""
    analysis = analyze([*expert(), *oracle()], cases({}), title="Made")
    assert score(analysis, CHANCE).accuracy.value == pytest.approx((1 / 2 + 1 / 2 + 1 / 2 + 1) / 4)
    several = score(analysis, CHANCE).several
    assert several is not None and (several.value, several.n) == (pytest.approx(1 / 2), 3)
    assert score(analysis, CEILING).accuracy.value == 1  # the halves are alike
    assert score(analysis, f"always {CUT}").accuracy.value == 0.75
    expert_several = score(analysis, "expert").several
    assert expert_several is not None and (expert_several.value, expert_several.n) == (pytest.approx(2 / 3), 3)


def test_the_oracle_counts_where_a_suite_s_own_labels_say_otherwise_and_a_note_tells_it() -> None:
    """The suite's: a and b share the cut-in with the oracle, d the turn; c is a lane shift there."""
    analysis = analyze([*expert(), *oracle()], cases(), title="Made")
    assert score(analysis, CHANCE).accuracy.value == pytest.approx(0.625)
    assert len(analysis.notes) == 1 and "in 3 of 4 encounters. The oracle's labels count" in analysis.notes[0]


def test_without_labels_the_oracles_cell_says_them() -> None:
    analysis = analyze([*expert(), *oracle()], cases({}), title="Made")
    assert [p.criterion for p in analysis.parts] == ["collision", "valid"]
    assert score(analysis, "expert").accuracy.value == 0.5  # a and c: the cut-in alone collides
    assert analysis.notes == ()


def test_annotations_of_people() -> None:
    analysis = analyze(expert(), cases({"a": (CUT,), "c": (CUT,)}, "annotated", "people"), title="Made")
    assert [p.criterion for p in analysis.parts] == ["annotated"]
    assert score(analysis, "expert", "annotated").accuracy.value == 1 and part(analysis, "annotated").unlabelled == 2
    assert part(analysis, "annotated").calibration == {}


def test_a_suite_may_hold_annotations() -> None:
    given = LABELS_ADAPTER.validate_python({"a": {"people": {"annotated": [CUT]}}})
    assert given == {"a": {"people": {"annotated": (CUT,)}}}


def test_models_are_compared_with_the_expert() -> None:
    model = [answered(name, "llm-a:m", CUT) for name in "abcd"]
    analysis = analyze([*expert(), *model], cases(), title="Made", analyzers=["expert", "llm-a:m"])
    difference = score(analysis, "llm-a:m").difference
    assert difference is not None and (difference.difference, difference.n, difference.p) == (0, 4, 1)
    assert score(analysis, "expert").difference is None


def test_confusion() -> None:
    strange = [*expert()[:3], answered("d", "expert", "Blind-side Merge", won=False)]
    collision_part = part(analyze(strange, cases(), title="Made"))
    assert collision_part.confusion["expert"] == {(CUT, CUT): 1, (SHIFT, SHIFT): 1, (SHIFT, CUT): 1, (TURN, "novel"): 1}
    assert collision_part.calibration == {}  # nothing was simulated


def test_calibration_is_how_often_what_was_ranked_first_succeeds_for_the_oracle() -> None:
    """Ranked first: the cut-in (4 of 4 collide) at high risk on a and at low on c, the shift (0 of 4) at high on b."""
    collision_part = part(analyze([*expert(), *oracle()], cases(), title="Made"))
    rates = {risk: (e.value, e.n) for risk, e in collision_part.calibration["expert"].items()}
    assert rates == {"low": (1, 1), "high": (pytest.approx(1 / 2), 2)}
    # Of a vehicle that the oracle never simulated:
    unsimulated = [{**c, "intents": [{**i, "bv": "2"} for i in c["intents"]]} for c in expert()]
    assert part(analyze([*unsimulated, *oracle()], cases(), title="Made")).calibration == {"expert": {}}


def test_labels_that_min_ttc_alone_made_are_counted() -> None:
    misses = cell("a", "oracle", attempt(CUT, min_ttc=2.0), attempt(SHIFT, min_ttc=5.0))
    analysis = analyze([answered("a", "expert", CUT), misses], cases({}), title="Made")
    assert part(analysis).by_time == 1 and score(analysis, "expert").accuracy.value == 1
    assert "In 1, no simulation succeeds" in to_markdown(analysis)


def test_a_miss_of_a_tie_is_spread_over_it() -> None:
    collision_part = part(analyze([answered("b", "expert", BRAKE)], cases(), title="Made"))
    assert collision_part.confusion["expert"] == {(CUT, BRAKE): 0.5, (SHIFT, BRAKE): 0.5}


def test_nothing_to_judge_is_said() -> None:
    analysis = analyze(expert(), cases({}), title="Made")
    assert analysis.parts == () and any("No encounter has a label for idm" in note for note in analysis.notes)


def test_files(tmp_path: Path) -> None:
    cells = [*expert(), *oracle()]
    analysis = analyze(cells, cases(), title="Made", analyzers=["expert"])
    write_analysis(analysis, cells, tmp_path, ABOUT)
    text = (tmp_path / "analyzer.md").read_text()
    assert "| DeepSeek-R1 | 0.815 |" in text and text == to_markdown(analysis)
    with (tmp_path / "analyzer-confusion.csv").open() as file:
        rows = [r for r in csv.DictReader(file) if r["criterion"] == "collision"]
    assert len(rows) == len(ANALYZER_ANSWERS) - 1 and sum(float(r[a]) for r in rows for a in ANALYZER_ANSWERS) == 4
    document = json.loads((tmp_path / "analyzer.json").read_text())
    assert document["unlabelled"][0] == {"ego": "idm", "criterion": "collision", "encounters": 0}
    assert json.loads((tmp_path / "analyzer.manifest.json").read_text())["cells"] == 8
