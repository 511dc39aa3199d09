"""What is left to find: Good-Turing and Chao1 of samples that are counted by hand."""

from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path
from typing import Any

import pytest
from cli_samples import ROOT, Program

from sumo_adv.hunting.rounds import kinds_by_encounter, over_time
from sumo_adv.metrics.species import discovery


def benchmark(name: str) -> Any:
    """A program of ``benchmarks/`` as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


def test_chao1_of_six_kinds() -> None:
    """Eight encounters. Three kinds were seen once (a, b, c), two twice (d, e), one three times (f).

    Chance: a, b and c are in three encounters, so 3/8. Least: 6 + 3^2 / (2 x 2) = 8.25. With f1/f2 = 1.5 the variance
    is 2 (1.125 + 3.375 + 1.265625) = 11.53125. ln(1 + 11.53125 / 2.25^2) = 1.1869, K = exp(1.96 x 1.0894) = 8.460.
    """
    left = discovery([{"a", "d"}, {"b"}, {"c"}, {"d", "e"}, {"e", "f"}, {"f"}, {"f"}, set()])
    assert (left.samples, left.kinds, left.once) == (8, 6, 3)
    assert left.chance == pytest.approx(3 / 8) and left.least == pytest.approx(8.25)
    assert left.low == pytest.approx(6 + 2.25 / 8.460, abs=1e-3)
    assert left.high == pytest.approx(6 + 2.25 * 8.460, abs=1e-2)


def test_an_encounter_with_two_new_kinds_is_one_that_would_be_new() -> None:
    """Both kinds are in the first of two encounters: had it come last it would have been new. Least: 2 + 2 x 1 / 2."""
    left = discovery([{"a", "b"}, set()])
    assert (left.chance, left.least) == (0.5, 3.0)
    assert 2.0 < left.low < left.least < left.high


def test_where_all_kinds_were_seen_often_nothing_is_missing() -> None:
    """Two kinds, five times each, in ten encounters: exp(-5) = 0.0067 of the kinds are left out by chance.

    2 / (1 - 0.0067) = 2.0136; variance 2 (0.006738 - 0.0000454) - (2 x 5 x 0.006738)^2 / 10 = 0.012931.
    """
    left = discovery([{"a"}, {"b"}] * 5)
    assert (left.chance, left.least, left.low) == (0.0, 2.0, 2.0)
    assert left.high == pytest.approx(2.01357 + 1.96 * math.sqrt(0.012931) / 0.993262, abs=1e-4)


def test_without_a_kind_there_is_no_bound() -> None:
    none = discovery([set(), set()])
    assert (none.chance, none.least, none.high) == (0.0, 0.0, math.inf)
    assert none.as_data()["high"] is None and discovery([]).as_data()["chance"] is None
    assert discovery([]).words == "no episode yet"
    assert discovery([set()] * 10).words == "the next episode brings a new kind with a probability of 0 %"


def test_below_ten_episodes_nothing_is_said_of_what_is_left() -> None:
    """Of one episode the chance would be 100 %, of five with the same failure 0 %; the numbers stay in JSON."""
    assert {discovery([{"a"}] * n).words for n in (1, 5, 9)} == {"too few episodes to say what is left"}
    assert discovery([{"a"}]).as_data()["chance"] == 1.0
    assert discovery([{"a"}] * 10).words.startswith("the next episode brings a new kind with a probability of 0 %; at ")


def test_a_hunt_says_what_is_left(program: Program) -> None:
    """On the live line, at the end, in JSON and in the figure; and the benchmark reads the folder."""
    options = ("--ego", "idm", "--until", "valid", "--distinct", "1", "--minutes", "2", "--workers", "1", "--no-pages")
    done = program.here("hunt", "signals_red_light", *options, "--out", "hunt")
    assert done.status == 0 and "Estimate of what is left: too few episodes to say what is left." in done.out, done.err
    assert (program.folder / "hunt" / "scenarios.csv").read_text().startswith("list,scenario,encounters,attempts,")
    samples = kinds_by_encounter(Path(program.folder / "hunt"))
    after = over_time(Path(program.folder / "hunt"))[-1].discovery
    assert after is not None and after.kinds == discovery(samples).kinds >= 1


def test_the_estimate_at_a_quarter_is_checked_against_the_whole_hunt() -> None:
    """Sixteen encounters, cut after four: a, b and a again, so 2 kinds and at least 2 + 1 (b once, a twice: 1 / 2).

    At the end there are four. Of the next four encounters one (c) brought a kind that was new.
    """
    done = benchmark("stop_estimate").check(
        "h", [{"a"}, {"b"}, {"a"}, set(), {"c"}, {"a"}, {"b"}, set(), *[{"d"}] * 8], 0.25
    )
    assert (done.at, done.kinds, done.least, done.end, done.held) == (4, 2, 2.5, 4, "within")
    assert (done.chance, done.came) == (0.25, 0.25)
