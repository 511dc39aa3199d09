"""The index of a batch: its rows, its pages made once, runs in packs; and 5,000 rows in a headless Chromium."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cli_samples import Program, refused
from page_samples import ROOT, Visit, attempt, chromium, make_run, meeting, outcome
from test_coverage import CUT_IN_BESIDE
from test_report_page import HOSTILE, data_of

from sumo_adv.campaigns.results import read_row, write_csv
from sumo_adv.campaigns.store import pack_runs
from sumo_adv.errors import UsageError
from sumo_adv.metrics.severity import Severity
from sumo_adv.report.coverage import make_coverage
from sumo_adv.report.index import (
    MadePages,
    Packs,
    ResultsTable,
    make_index,
    read_rows,
    road_of,
    summarise,
    write_report,
)

MANY = 5000
HITS = ((0, "serious", 4.0), (1, "valid", 2.0), (2, "collision", 1.0))
NETWORK = "straight_3lane.net.xml"


def row(k: int, **other: Any) -> dict[str, Any]:
    """A made-up row: every 10th a collision, every second of these valid; every 100th failed."""
    met = k % 10 == 0
    return {
        "id": f"{k:016x}", "network": f"net{k % 4}", "ego": ("idm", "careful")[k % 2], "seed": k,
        "intent": ("Cut-in", "Brake", "")[k % 3], "ending": "critical",
        "failure": "It failed." if k % 100 == 99 else "",
        "level": ("serious" if k % 20 == 0 else "collision") if met else "none", "severity": "minor" if met else "",
        "relation": "neighbour", "road": "motorway", "preventable_by": "cc_human" if k % 20 == 0 else "",
        "delta_v": 2.5 if met else None, "raw_min_ttc": None,
        "min_ttc": 0.0 if met else None if k % 10 == 1 else (k % 97) / 20, "collided": met,
        "valid": k % 20 == 0 if met else None, "critical": met, "attempts": k % 25, "seconds": 1.5, **other,
    }  # fmt: skip


@pytest.fixture
def batch(tmp_path: Path) -> Path:
    """A batch's folder of three runs, one of which failed before anything was recorded."""
    folder = tmp_path / "campaign"
    make_run(folder / "runs" / "aaaa", vehicles=2, frames=100, pose=meeting)
    make_run(folder / "runs" / "bbbb", vehicles=3, frames=60)
    (folder / "runs" / "cccc").mkdir()
    document = outcome(
        ending="simulation_failed", outcome=None, intent=None, intents=[], attempts=[], best=None, adversaries=[],
        raw=None, encounter=None, trigger_time=None, agents=None, ego={"id": None, "controller": "idm"},
        failure="It broke.",
    )  # fmt: skip
    (folder / "runs" / "cccc" / "outcome.json").write_text(json.dumps(document))
    rows = [read_row(folder / "runs" / name) for name in ("aaaa", "bbbb", "cccc")]
    write_csv(folder / "results.csv", [r for r in rows if r is not None], ())
    return folder


def changes(folder: Path) -> dict[str, int]:
    return {p.name: p.stat().st_mtime_ns for p in sorted(folder.iterdir())}


def test_rows_come_back_with_their_types(batch: Path) -> None:
    first, _, failed = read_rows(batch / "results.csv").rows
    assert (first["id"], first["seed"], first["min_ttc"], first["raw_min_ttc"]) == ("aaaa", 7.0, 0.7213, 9.8765)
    assert (first["collided"], first["valid"], first["critical"]) == (False, None, True)
    assert failed["failure"] == "It broke." and failed["min_ttc"] is None and failed["intent"] == ""
    (batch / "results.csv").write_text("id,network\n1,2\n")
    with pytest.raises(UsageError, match="has no column"):
        read_rows(batch / "results.csv")


def test_a_page_an_episode_and_the_second_time_none(batch: Path, program: Program) -> None:
    done = program.here("report", batch, "--json")
    assert done.status == 0, done.err
    summary = json.loads(done.out)
    assert (summary["episodes"], summary["pages"], summary["made"], summary["damaged"]) == (3, 3, 3, [])
    data = data_of((batch / "report" / "index.html").read_text())
    assert data["columns"]["id"] == ["aaaa", "bbbb", "cccc"] and data["page"] == [1, 1, 1]
    # the two that meet are closest at 4.8 s, when the ego, 1 m a step from x = 1 at 0.1 s, is at x = 48
    assert (data["x"][0], data["y"][0], data["map"]) == (48.0, -1.6, [0, 0, -1])
    before = changes(batch / "report" / "pages")
    outcome_file = batch / "runs" / "bbbb" / "outcome.json"
    outcome_file.write_text(outcome_file.read_text().replace('"seed": 7', '"seed": 8'))
    again = json.loads(program.here("report", batch, "--json").out)
    assert (again["pages"], again["made"]) == (3, 1)
    after = changes(batch / "report" / "pages")
    assert [n for n in after if after[n] != before[n]] == ["bbbb.html"]


def test_some_pages_now_the_most_critical_first(batch: Path, tmp_path: Path) -> None:
    table = read_rows(batch / "results.csv")
    made = write_report(batch / "runs", tmp_path / "out", "b", table, Packs(), most=1)
    assert (made.pages, made.made) == (1, 1) and not (tmp_path / "out" / "pages" / "cccc.html").exists()
    made = write_report(batch / "runs", tmp_path / "out", "b", table, Packs())
    assert (made.pages, made.made) == (3, 2)


def test_pages_below_a_file_are_a_sentence(batch: Path, program: Program) -> None:
    refused(program.here("report", batch, "--out", batch / "results.csv" / "pages"), 2, "give another --out")


def test_egos_against_outcomes_with_intervals() -> None:
    hits = [row(k, ego="idm", level=level, severity="minor", delta_v=v, failure="") for k, level, v in HITS]
    failed = row(7, ego="idm", level="", severity="", delta_v=None, failure="It broke.", ending="simulation_failed")
    critical = row(8, ego="careful", level="critical", severity="", delta_v=None, failure="")
    careful, idm = summarise([*hits, failed, critical])
    assert [(each["ego"], each["episodes"]) for each in (careful, idm)] == [("careful", 1), ("idm", 4)]
    # critical, collision, valid, strict, serious; the failed episode is in every denominator
    assert [value for value, _, _ in idm["reached"]] == [0.75, 0.75, 0.5, 0.25, 0.25]
    assert idm["failed"][0] == 0.25
    minor = idm["severity"][list(Severity).index(Severity.MINOR)]
    assert (minor, idm["delta_v"]) == (2, 3.0)  # of the two that are valid: 2 and 4 m/s
    # Wilson's interval of two of four: (0.5 + 1.92/4) / (1 + 3.84/4) -+ 0.35
    assert idm["reached"][2][1:] == pytest.approx([0.150, 0.850], abs=1e-3)
    assert careful["delta_v"] is None and careful["reached"][0][0] == 1.0


def test_the_report_of_a_campaign_has_its_coverage(batch: Path, program: Program) -> None:
    file = batch / "runs" / "aaaa" / "outcome.json"
    document = json.loads(file.read_text())
    document["encounter"] |= {"road": "urban", "ego_speed": 10.0}
    document["attempts"][0] |= {"intent": "Straight Lane Shift", "level": "valid"}
    file.write_text(json.dumps(document))
    odd = {"roads": ["urban"], "relations": ["neighbour", "leader"], "speed": [8.0, 13.0]}
    (batch / "plan.json").write_text(json.dumps({"settings": [{"odd": odd}]}))
    done = program.here("report", batch)
    assert done.status == 0, done.err
    # the shipped intents that a leader or a neighbour can try, on one road class, in one speed band
    assert "Coverage: 1 of 5 cells have an encounter. Table: " in done.out
    data = data_of((batch / "report" / "index.html").read_text())
    assert sorted(count[0] for count in data["coverage"]["egos"]["all"]) == [0, 0, 0, 0, 1]
    assert data["coverage"]["unplaced"] == 2  # a run without a place, and the failed run
    with (batch / "report" / "coverage.csv").open(newline="") as file_of_cells:
        rows = [each for each in csv.DictReader(file_of_cells) if each["ego"] == "all"]
    assert [each["encounters"] for each in rows] == ["0", "0", "0", "0", "1"]
    assert (rows[-1]["intent"], rows[-1]["failures"]) == ("Straight Lane Shift", "1")


def test_what_was_done_before_an_interrupt_is_kept(batch: Path, tmp_path: Path) -> None:
    def stop(done: int, of: int) -> None:
        assert of == 3
        if done == 2:
            raise KeyboardInterrupt

    table = read_rows(batch / "results.csv")
    with pytest.raises(KeyboardInterrupt):
        write_report(batch / "runs", tmp_path / "out", "b", table, Packs(), tell=stop)
    assert sum(data_of((tmp_path / "out" / "index.html").read_text())["page"]) == 2
    assert write_report(batch / "runs", tmp_path / "out", "b", table, Packs()).made == 1


def test_a_damaged_run_is_told_and_the_others_are_shown(batch: Path, tmp_path: Path) -> None:
    (batch / "runs" / "bbbb" / "states.csv.gz").write_bytes(b"no")
    made = write_report(batch / "runs", tmp_path / "out", "b", read_rows(batch / "results.csv"), Packs())
    assert made.pages == 2 and len(made.damaged) == 1 and "states.csv.gz is damaged" in made.damaged[0]
    assert data_of(made.index.read_text())["page"] == [1, 0, 1]


def test_names_that_are_paths_open_nothing(batch: Path, tmp_path: Path) -> None:
    make_run(batch / "secret", vehicles=2, frames=30)
    table = ResultsTable([row(0, id="../secret"), row(1, id=".."), row(2, id="aaaa")])
    made = write_report(batch / "runs", tmp_path / "out", "b", table, Packs())
    assert made.pages == 1 and list(changes(tmp_path / "out" / "pages")) == ["aaaa.html"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["campaign", "out"]


def test_packed_runs_have_pages(batch: Path, program: Program) -> None:
    pack_runs(batch)
    assert not (batch / "runs" / "aaaa").exists()
    summary = json.loads(program.here("report", batch, "--json").out)
    assert (summary["pages"], summary["made"]) == (3, 3) and not (batch / "runs" / "aaaa").exists()
    assert data_of((batch / "report" / "index.html").read_text())["map"] == [0, 0, -1]


def test_runs_side_by_side_without_a_table(batch: Path, program: Program) -> None:
    summary = json.loads(program.here("report", batch / "runs", "--json").out)
    assert (summary["episodes"], summary["pages"]) == (3, 3)


# -- in a browser ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An index of 5,000 rows."""
    table = ResultsTable([row(k) for k in range(MANY)])
    made = {f"{k:016x}": MadePages(0, (k % 400 - 200.0, -1.6), NETWORK) for k in range(MANY)}
    file = tmp_path_factory.mktemp("large") / "index.html"
    file.write_text(make_index("many", table, made, {NETWORK: road_of(ROOT / "networks" / NETWORK)}), encoding="utf-8")
    return file


def ids(page: Any) -> list[str]:
    """The ids of the rows that stand in the document."""
    return [str(t) for t in page.locator("#rows tr td:last-child").all_text_contents()]


def test_five_thousand_rows_sort_filter_and_scroll(browser: Any, large: Path) -> None:
    rows = [row(k) for k in range(MANY)]
    with Visit(browser, large) as visit:
        page = visit.page
        assert page.locator("#rows tr").count() < 80
        assert page.get_attribute("#table", "aria-rowcount") == str(MANY + 1)
        page.click("#heads button:has-text('min TTC')")
        least = sorted(rows, key=lambda r: (r["min_ttc"] is None, r["min_ttc"] or 0.0, r["seed"]))
        assert ids(page)[:20] == [r["id"] for r in least[:20]]
        assert page.locator("#heads th").nth(5).get_attribute("aria-sort") == "ascending"
        page.evaluate("document.getElementById('list').scrollTop = 1e9")
        visit.until("document.querySelector('#rows tr:last-child').getAttribute('aria-rowindex') === '5001'")
        assert ids(page)[-1] == least[-1]["id"] and page.locator("#rows tr").count() < 80
        page.select_option("#intent", "Brake")
        page.select_option("#ego", "careful")
        page.fill("#most", "1")
        expected = [r for r in rows if r["intent"] == "Brake" and r["ego"] == "careful"]
        expected = [r for r in expected if r["min_ttc"] is not None and r["min_ttc"] <= 1]
        assert page.inner_text("#count").startswith(f"{len(expected)} of {MANY} episodes shown.")
        assert set(ids(page)) <= {r["id"] for r in expected}
        page.click("#reset")
        page.select_option("#valid", "yes")
        assert page.inner_text("#count").startswith(f"{MANY // 20} of {MANY}")
        page.click("#reset")
        page.fill("#search", "It failed")
        assert "50 (100.0 %) failed" in page.inner_text("#count")
        visit.clean()


def test_histograms_filter_and_the_map_shows_where(browser: Any, large: Path) -> None:
    with Visit(browser, large) as visit:
        page = visit.page
        page.click(".chart button:has-text('serious collision')")
        assert page.input_value("#outcome") == "serious"
        assert page.inner_text("#count").startswith(f"{MANY // 20} of {MANY}")
        box = page.locator("#spots").evaluate(
            """(c) => { const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
                return new Set(new Uint32Array(d.buffer)).size; }"""
        )
        assert box > 5 and page.locator("#maps option").all_text_contents() == [f"straight_3lane ({MANY})"]
        visit.clean()


def test_coverage_and_egos_are_shown(browser: Any, tmp_path: Path) -> None:
    document = outcome(attempts=[attempt(0, "a", intent="Cut-in", level="valid")])
    document["encounter"] |= {"road": "motorway", "ego_speed": 25.0}
    covered = make_coverage([document, {**document, "ego": {"controller": HOSTILE}}], [CUT_IN_BESIDE])
    failed = row(1, ego=HOSTILE, failure="It broke.", level="", severity="")
    file = tmp_path / "index.html"
    file.write_text(make_index("c", ResultsTable([row(0), failed]), {}, {}, covered), encoding="utf-8")
    with Visit(browser, file) as visit:
        page = visit.page
        assert page.inner_text("#covered").startswith("1 of 16 cells have an encounter, 15 are empty; in 1 the ego")
        assert page.locator("#matrix td.empty").count() == 15
        assert page.locator("#matrix td.met").all_text_contents() == ["2/2"]
        assert page.locator("#cells tbody tr").first.inner_text().split("\t")[-3:] == ["0", "–", "–"]
        assert "100 % 34–100" in page.locator("#cells tbody tr").last.inner_text()  # two of two
        page.select_option("#of", "idm")
        assert page.locator("#matrix td.met").all_text_contents() == ["1/1"]
        assert "1 minor" in page.inner_text("#egos") and "100 % 21–100" in page.inner_text("#egos")
        assert "✕ failed: It broke." in page.inner_text("#rows")
        assert page.locator("#rows tr").nth(1).locator("td").nth(4).inner_text() == "–"  # no min TTC was measured
        assert page.locator("img").count() == 0
        visit.clean()


@pytest.mark.parametrize("how", ["click", "keyboard"])
def test_a_row_opens_its_replay_and_leads_back(browser: Any, batch: Path, tmp_path: Path, how: str) -> None:
    made = write_report(batch / "runs", tmp_path / "out", "b", read_rows(batch / "results.csv"), Packs())
    with Visit(browser, made.index) as visit:
        if how == "click":
            visit.page.click("#rows tr:nth-child(2) td:nth-child(5)")
        else:
            visit.page.focus("#rows tr:nth-child(2) a")
            visit.page.keyboard.press("Enter")
        visit.page.wait_for_url("**/pages/bbbb.html")
        assert visit.page.inner_text("#title").startswith("sample")
        visit.page.click("#back a")
        visit.page.wait_for_url("**/index.html")
        assert visit.wrong == [] and all(r.startswith("file:") for r in visit.requests)


def test_hostile_rows_do_nothing_on_a_phone(browser: Any, tmp_path: Path) -> None:
    table = ResultsTable([row(k, network=HOSTILE, ego=HOSTILE, intent=HOSTILE, failure=HOSTILE) for k in range(3)])
    html = make_index(HOSTILE, table, {}, {})
    assert "<img" not in html and html.count("</script>") == 2
    file = tmp_path / "index.html"
    file.write_text(html, encoding="utf-8")
    with Visit(browser, file, viewport={"width": 375, "height": 720}, is_mobile=True, has_touch=True) as visit:
        assert "onerror=alert(1)" in visit.page.inner_text("#rows")
        assert visit.page.locator("img").count() == 0
        assert visit.page.evaluate("document.documentElement.scrollWidth") <= 375
        visit.clean()
