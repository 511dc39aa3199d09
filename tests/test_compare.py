"""``compare``: two sides paired by encounter, with figures worked out by hand."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from cli_samples import Program
from regression_samples import attacked

from sumo_adv.campaigns.results import result_row, write_csv
from sumo_adv.comparison.compare import Comparison, compare, read_side
from sumo_adv.comparison.page import html, to_markdown
from sumo_adv.errors import UsageError


def case(name: str, level: str = "none", delta_v: float | None = None, **more: Any) -> dict[str, Any]:
    """A row of ``regress.json``; a collision has a delta-v."""
    hit = delta_v is not None
    result = "fail" if hit else "pass"
    figures = {"level": level, "collided": hit, "delta_v": delta_v, "min_ttc": 0.0 if hit else 2.0}
    return {"case": name, "result": result, **figures, **more}


def regression(folder: Path, ego: str, cases: Sequence[dict[str, Any]]) -> Path:
    folder.mkdir()
    document = {"schema": 1, "suite": "s", "ego": ego, "cases": [{"ego": ego, **each} for each in cases]}
    (folder / "regress.json").write_text(json.dumps(document))
    return folder


def attempt(level: str) -> dict[str, Any]:
    return {"level": level, "valid": level in ("valid", "strict", "serious")}


def campaign(folder: Path, episodes: Sequence[tuple[str, str, Sequence[str]]], attempts: int = 5) -> Path:
    """A campaign's folder: for each episode its input, its ego, and the levels of its attempts, the last of which
    counts."""
    rows = []
    for k, (network, ego, levels) in enumerate(episodes):
        best = levels[-1]
        verdict = {"level": best, "collided": best != "none", "min_ttc": 0.5, "delta_v": 2.0, "severity": "minor"}
        outcome = {
            "ending": "critical", "reason": "", "network": network, "seed": 0, "ego": {"controller": ego},
            "intent": None, "raw": None, "attempts": [attempt(level) for level in levels], "best": len(levels) - 1,
            "outcome": verdict, "timing": {}, "encounter": None, "adversaries": [],
        }  # fmt: skip
        run = folder / "runs" / f"{k:016x}"
        run.mkdir(parents=True)
        (run / "outcome.json").write_text(json.dumps(outcome))
        rows.append(result_row(run.name, outcome, False))
    write_csv(folder / "results.csv", rows, [])
    (folder / "plan.json").write_text(json.dumps({"settings": [{"attempts": attempts}]}))
    return folder


def figures(done: Comparison) -> dict[str, tuple[float, float, float]]:
    """Value of the first side, of the second, difference."""
    return {f.name: (f.first.value, f.second.value, f.change) for f in done.figures}


def test_two_regressions_are_paired_by_case(tmp_path: Path) -> None:
    old = regression(
        tmp_path / "old", "first", [case("a", "serious", 4.0), case("b", "valid", 1.0), case("c"), case("gone")]
    )
    new = regression(tmp_path / "new", "second", [case("c", "collision", 0.5), case("a"), case("b", "valid", 1.0)])
    done = compare(read_side(old), read_side(new))
    assert (done.names, len(done.pairs), done.alone) == (("first", "second"), 3, (1, 0))
    compared = figures(done)
    assert compared["case fails"] == pytest.approx((2 / 3, 2 / 3, 0.0))
    assert compared["collision"] == pytest.approx((2 / 3, 2 / 3, 0.0))
    assert compared["serious"] == pytest.approx((1 / 3, 0.0, -1 / 3))
    assert compared["delta-v, 0 without a collision"] == pytest.approx((5 / 3, 0.5, 0.5 - 5 / 3))
    assert compared["min TTC, at most 10"] == pytest.approx((2 / 3, 2 / 3, 0.0))
    assert "attempts until valid" not in compared  # there is one attempt in each
    assert [(c.key, c.worse) for c in done.changes] == [("c", True), ("a", False)]  # what got worse stands first


def test_two_campaigns_have_attempts_until_the_first_valid_one(tmp_path: Path) -> None:
    first = campaign(tmp_path / "one", [("bend", "idm", ["none", "valid"]), ("merge", "idm", ["serious"])])
    second = campaign(tmp_path / "two", [("bend", "idm", ["none", "collision"]), ("merge", "idm", ["none", "valid"])])
    done = compare(read_side(first), read_side(second))
    assert done.names == ("one", "two")  # the same driver: two revisions
    assert figures(done)["attempts until valid"] == (1.5, 4.0, 2.5)  # 2 and 1; none of 5 counts as 6, and 2
    assert figures(done)["strict"] == (0.5, 0.0, -0.5)
    assert [change.key for change in done.changes] == ["merge seed 0", "bend seed 0"]


def test_a_difference_has_an_interval_from_six_pairs_on(tmp_path: Path) -> None:
    names = "abcdef"
    for many in (5, 6):
        old = regression(tmp_path / f"old{many}", "first", [case(name, "valid", 2.0) for name in names[:many]])
        new = regression(tmp_path / f"new{many}", "second", [case(name) for name in names[:many]])
        valid = next(f for f in compare(read_side(old), read_side(new)).figures if f.name == "valid")
        if many == 5:
            assert (valid.change, valid.difference) == (-1.0, None)
        else:
            assert valid.difference is not None and valid.difference.p == 2 / 2**6  # McNemar: six of six


def test_two_egos_of_one_campaign_are_chosen_by_name(tmp_path: Path) -> None:
    both = campaign(tmp_path / "c", [("bend", "idm", ["valid"]), ("bend", "careful", ["none"])])
    done = compare(read_side(both), read_side(both), ("idm", "careful"))
    assert done.names == ("idm", "careful") and figures(done)["valid"] == (1.0, 0.0, -1.0)
    whole = compare(read_side(both), read_side(both))
    assert [a.key for a, _ in whole.pairs] == ["bend seed 0", "bend seed 0"] and not whole.changes
    with pytest.raises(UsageError, match="no ego 'krauss'; it has idm, careful"):
        compare(read_side(both), read_side(both), ("idm", "krauss"))
    eidm_only = campaign(tmp_path / "d", [("bend", "eidm", ["valid"])])
    with pytest.raises(UsageError, match="choose one of each with --egos"):
        compare(read_side(both), read_side(eidm_only))


def test_what_cannot_be_paired_is_said(tmp_path: Path) -> None:
    first, second = (regression(tmp_path / name, name, [case(name)]) for name in "ab")
    with pytest.raises(UsageError, match="no encounter in common"):
        compare(read_side(first), read_side(second))
    with pytest.raises(UsageError, match="holds no run, campaign, bench or regression"):
        read_side(tmp_path)


def test_a_failure_and_a_missed_encounter_stay_in_the_denominator(tmp_path: Path) -> None:
    missed = case("b", broken="Gone.", missed=True, result="no encounter")
    old = regression(tmp_path / "old", "first", [case("a", "valid", 1.0), case("b", "valid", 1.0)])
    new = regression(tmp_path / "new", "second", [case("a", broken="It raised.", result="error"), missed])
    done = compare(read_side(old), read_side(new))
    assert figures(done)["valid"] == (1.0, 0.0, -1.0)
    with_one = [case(name, "valid", 1.0) for name in "abc"], [case("a", "valid", 1.0), case("c", "valid", 1.0), missed]
    tested = compare(*(read_side(regression(tmp_path / str(k), "x", side)) for k, side in enumerate(with_one)))
    assert figures(tested)["valid"] == (1.0, pytest.approx(2 / 3), pytest.approx(-1 / 3))
    assert figures(tested)["min TTC, at most 10"][2] == 0.0  # an encounter without an attack has no min TTC of one
    text = to_markdown(done, lambda _: None)
    assert "Failed: 0 of first, 1 of second. Without an attack: 0 of first, 1 of second." in " ".join(text.splitlines())
    assert "| no encounter |" in text and "| error |" in text
    assert "A case with an error counts as a failed case, and in the rates of levels as not hit." in text
    assert "In the rates, an encounter without an attack counts as not hit." in text


def test_an_error_fails_a_case(tmp_path: Path) -> None:
    """First: one of four fails. Second: a and b have errors, so two fail; a passed before, and b failed."""
    broken = [case(name, broken="It raised.", result="error") for name in "ab"]
    old = regression(tmp_path / "old", "first", [case("a"), case("b", "valid", 1.0), case("c"), case("d")])
    new = regression(tmp_path / "new", "second", [*broken, case("c"), case("d")])
    done = compare(read_side(old), read_side(new))
    assert figures(done)["case fails"] == (0.25, 0.5, 0.25)
    assert figures(done)["valid"] == (0.25, 0.0, -0.25)
    assert [(change.key, change.worse) for change in done.changes] == [("a", True), ("b", True)]
    assert "| a | pass: none | error |" in to_markdown(done, lambda _: None)


def test_what_an_episode_found_before_it_failed_counts(tmp_path: Path) -> None:
    """Of two episodes, one found a strict collision at its second attempt, and then failed; the other found none."""
    inputs = ("bend", "merge")
    calm = campaign(tmp_path / "one", [(name, "idm", ["none"]) for name in inputs])
    hit = campaign(tmp_path / "two", [("bend", "idm", ["none", "strict"]), ("merge", "idm", ["none"])])
    for run in (hit / "runs").iterdir():
        outcome = json.loads((run / "outcome.json").read_text())
        (run / "outcome.json").write_text(json.dumps({**outcome, "ending": "simulation_failed"}))
    done = compare(read_side(calm), read_side(hit))
    assert figures(done)["strict"] == (0.0, 0.5, 0.5) and figures(done)["serious"] == (0.0, 0.0, 0.0)
    assert [(change.key, change.worse) for change in done.changes] == [("bend seed 0", True)]
    text = to_markdown(done, lambda _: None)
    assert "Failed: 0 of one, 2 of two." in text and "| failed, found before: strict, delta-v 2.0 m/s |" in text
    assert "counts with the level that was found before it failed; if none was found, as not hit." in text


def test_the_page_shows_what_a_run_wrote_as_text(tmp_path: Path) -> None:
    name = "<script>alert(1)</script>"
    plain = name.replace("/", "")  # a case has the name of a folder
    old = regression(tmp_path / "old", "first", [case(plain, "valid", 1.0)])
    new = regression(tmp_path / "new", name, [case(plain)])
    page = html(compare(read_side(old), read_side(new)), lambda episode: None)
    assert "<script" not in page and "&lt;script&gt;alert(1)&lt;/script&gt;" in page


def test_the_command_links_the_replays_of_both(program: Program) -> None:
    for name, level in (("one", "serious"), ("two", "valid")):
        folder = program.folder / name / "runs" / "crossing"
        folder.parent.mkdir(parents=True)
        shutil.copytree(attacked(), folder)
        document = {"schema": 1, "suite": "s", "cases": [case("crossing", level, 2.0, ego=name)]}
        (program.folder / name / "regress.json").write_text(json.dumps(document))
    done = program.here("compare", "one", "two", "--out", "out")
    assert (done.status, done.err) == (0, "")
    assert "[one](one/runs/crossing)" in done.out and "[two](two/runs/crossing)" in done.out
    page = (program.folder / "out" / "compare.html").read_text()
    assert '<a href="pages/1-1.html">fail: serious, delta-v 2.0 m/s</a>' in page
    assert {p.name for p in (program.folder / "out" / "pages").iterdir()} == {"1-1.html", "1-2.html"}
    data = json.loads(program.here("compare", "one", "two", "--json").out)
    assert data["encounters"] == 1 and data["changes"][0]["second"]["run"] == "two/runs/crossing"
    assert program.here("compare", "one", "two", "--egos", "one").status == 2


def test_a_run_is_compared_with_itself(program: Program) -> None:
    done = json.loads(program.here("compare", attacked(), attacked(), "--json").out)
    assert done["encounters"] == 1 and done["changes"] == []
