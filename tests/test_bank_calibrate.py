"""Calibration of epsilon: statistics by hand, and what the shipped metric reaches on the halves without tuning."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sumo_adv.errors import BankError
from sumo_adv.memory.build import read_intent_file
from sumo_adv.memory.similarity import (
    Measured,
    TextAndSlots,
    auc,
    balanced_accuracy,
    best_epsilon,
    calibrate,
    read_paraphrases,
    recognised,
    refused,
    top1,
)

HERE = Path(__file__).parent
PARAPHRASES = HERE / "data" / "intents_paraphrases.toml"
INDEPENDENT = HERE / "data" / "intents_independent.toml"


def by_hand() -> Measured:
    """Known at .1 (right), .2 (right), .5 (wrong), .7 (right); novel at .5, .9."""
    return Measured(
        np.array([0.1, 0.2, 0.5, 0.7, 0.5, 0.9]),
        np.array([True, True, False, True, False, False]),
        np.array([True, True, True, True, False, False]),
    )


def test_statistics_by_hand() -> None:
    measured = by_hand()
    assert top1(measured) == 0.75
    # of 4 x 2 pairs: .1 and .2 win twice each, .5 ties once and wins once, .7 wins once: 6.5
    assert auc(measured) == pytest.approx(6.5 / 8)
    assert (recognised(measured, 0.3), refused(measured, 0.3)) == (2 / 4, 2 / 2)
    assert balanced_accuracy(measured, 0.3) == pytest.approx((2 / 4 + 2 / 2) / 2)
    assert balanced_accuracy(measured, 0.7) == pytest.approx((4 / 4 + 1 / 2) / 2)
    # .2 | .5 and .7 | .9 are equally good at 0.75; the candidates are .35 and .8, one point each: the first is taken
    assert best_epsilon(measured) == pytest.approx(0.35)


def test_the_set_is_as_large_as_it_says() -> None:
    tuning, reporting = read_paraphrases(PARAPHRASES)
    everything = tuning + reporting
    assert len({(p.label, p.description) for p in everything}) == len(everything)
    assert sum(p.intent is not None for p in everything) >= 150
    assert sum(p.intent is None for p in everything) >= 60
    assert abs(len(tuning) - len(reporting)) <= 1


def test_the_shipped_metric_on_the_reporting_halves() -> None:
    intents = [read_intent_file(file) for file in sorted((HERE.parent / "memory_bank").glob("*/intent.toml"))]
    result = calibrate(intents, [read_paraphrases(PARAPHRASES), read_paraphrases(INDEPENDENT)])
    assert result.epsilon == pytest.approx(TextAndSlots.epsilon, abs=0.005)
    ours, independent = result.sets
    assert (independent.known, independent.novel) == (70, 40)
    # measured: AUC 0.992 [0.978, 1.000], balanced accuracy 0.964 [0.918, 0.994] on words of our own,
    # AUC 0.944 [0.900, 0.978], recognised 0.757 [0.657, 0.857], refused 0.900 [0.800, 0.975] on another author's
    for figure, least in (
        (ours.auc, 0.98), (ours.balanced_accuracy, 0.95), (independent.auc, 0.93), (independent.refused, 0.89),
        (independent.recognised, 0.74),
    ):  # fmt: skip
        assert figure.value >= least
        assert figure.low <= figure.value <= figure.high <= 1.0


def test_a_wrong_set_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "set.toml"
    file.write_text("[known]\nA = [['one']]\n")
    with pytest.raises(BankError, match="need"):
        read_paraphrases(file)
    with pytest.raises(BankError, match="cannot be read"):
        read_paraphrases(tmp_path / "lacking.toml")
    tuning, _ = read_paraphrases(PARAPHRASES)
    with pytest.raises(BankError, match="Calibration needs"):
        calibrate([], [(tuning, tuning)])
