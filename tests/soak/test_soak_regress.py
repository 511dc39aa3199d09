"""A case that is run a thousand times gives one answer."""

from __future__ import annotations

import os

import pytest
from cli_samples import Program
from regression_samples import answers_of

REPETITIONS = int(os.environ.get("SOAK_REPETITIONS", "1000"))


@pytest.mark.soak
def test_a_case_repeated_a_thousand_times_gives_one_answer(program: Program) -> None:
    answers = answers_of(program, REPETITIONS)
    assert sum(answers.values()) == REPETITIONS
    assert len(answers) == 1, sorted(answers.values())
