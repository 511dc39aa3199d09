"""The replay page as text: its contents, its size, and refusals."""

from __future__ import annotations

import base64
import csv
import gzip
import hashlib
import json
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_samples import Program, read_states
from hypothesis import given
from hypothesis import strategies as st
from page_samples import HEADER, attempt, make_run, manifest, meeting, outcome

from sumo_adv.errors import UsageError
from sumo_adv.report.document import ABSENT, differences, packed, varints, whole
from sumo_adv.report.page import make_page

HOSTILE = "</script><img src=x onerror=alert(1)>\"'<!--\u202e\u2066"


def data_of(html: str) -> Any:
    """The data that a page carries."""
    return json.loads(re.findall(r'<script type="application/json" id="data">(.*?)</script>', html, re.S)[0])


def read_back(text: str, counts: list[tuple[int, int]]) -> list[list[int]]:
    """Columns of (length, order), as the page's script reads them."""
    numbers = iter(zlib.decompress(base64.b64decode(text)))

    def one() -> int:
        value, shift = 0, 0
        while True:
            byte = next(numbers)
            value |= (byte & 127) << shift
            if byte < 128:
                return value // 2 if value % 2 == 0 else -(value + 1) // 2
            shift += 7

    columns = []
    for length, order in counts:
        column = np.array([one() for _ in range(length)], dtype=np.int64)
        for _ in range(order):
            column = np.cumsum(column)
        columns.append(column.tolist())
    return columns


@given(st.lists(st.lists(st.integers(-(2**40), 2**40), max_size=30), max_size=5), st.sampled_from([1, 2]))
def test_numbers_are_packed_without_loss(columns: list[list[int]], order: int) -> None:
    text = packed([(order, np.array(c, dtype=np.int64)) for c in columns])
    assert read_back(text, [(len(c), order) for c in columns]) == columns


def test_packing_by_hand() -> None:
    assert varints(np.array([0, -1, 1, 63, 64, -65])).tolist() == [0, 1, 2, 126, 128, 1, 129, 1]
    assert differences(np.array([5, 7, 10]), 1).tolist() == [5, 2, 3]
    assert differences(np.array([5, 7, 10]), 2).tolist() == [5, -3, 1]
    assert whole(np.array([1.234, np.nan, np.inf, -0.006]), 0.01).tolist() == [123, ABSENT, ABSENT, -1]


def test_positions_are_within_half_a_centimetre(tmp_path: Path) -> None:
    scene = data_of(make_page(make_run(tmp_path / "run", vehicles=5, frames=50, with_raw=False)))["scene"]
    (shown,) = scene["attempts"]
    segments = [(vehicle[0], *segment) for vehicle in shown["vehicles"] for segment in vehicle[4]]
    columns = read_back(scene["blob"], [(count, 2) for _ in "xyh" for _, _, count in segments])
    rows = read_states(tmp_path / "run" / "states.csv.gz")
    compared = 0
    for k, (name, first, count) in enumerate(segments):
        for i in range(count):
            row = rows[name][round(scene["start"] + (first + i) * scene["step"], 2)]
            for axis, n in (("x", 0), ("y", 1)):
                there = scene["origin"][n] + columns[n * len(segments) + k][i] / 100
                assert abs(there - float(row[axis])) <= 0.005 + 1e-9
            assert abs(columns[2 * len(segments) + k][i] / 1000 - float(row["heading"])) <= 0.0005 + 1e-9
            compared += 1
    assert compared == 5 * 50


def test_forty_vehicles_over_six_hundred_frames_stay_below_300_kb(tmp_path: Path) -> None:
    html = make_page(
        make_run(tmp_path / "run", vehicles=40, frames=600, told=outcome(trigger_time=50.0, encounter=None))
    )
    scene = data_of(html)["scene"]
    assert sum(s[1] for v in scene["attempts"][0]["vehicles"] for s in v[4]) == 40 * 600
    assert len(html.encode()) < 300_000


def test_nothing_may_be_loaded_and_only_our_script_may_run(tmp_path: Path) -> None:
    html = make_page(make_run(tmp_path / "run"))
    policy = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', html)[0]
    script = re.findall(r"<script>(.*?)</script>", html, re.S)
    style = re.findall(r"<style>(.*?)</style>", html, re.S)
    assert len(script) == len(style) == 1
    for kind, text in (("script-src", script[0]), ("style-src", style[0])):
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{kind} 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none'") and "unsafe" not in policy and "http" not in policy
    assert not re.search(r"""(src|href)\s*=\s*["']?(https?:)?//""", html)


def test_hostile_strings_are_data_alone(tmp_path: Path) -> None:
    names = [f"{HOSTILE}{k}" for k in range(3)]
    document = outcome(names[0], names[1], network=HOSTILE, reason=HOSTILE, notes=[HOSTILE])
    source = {"label": HOSTILE, "mode": HOSTILE, "origin": HOSTILE, "parent": None, "source": HOSTILE}
    run = make_run(tmp_path / "run", names=names, told=document, written=manifest(planners={"a" * 64: source}))
    html = make_page(run)
    assert "<img" not in html and "<!--" not in html and html.count("</script>") == 2 and "\u202e" not in html
    data = data_of(html)
    assert data["outcome"]["network"] == HOSTILE and data["planners"][0]["source"] == HOSTILE
    assert data["scene"]["attempts"][0]["vehicles"][0][0] == names[0]


def test_closest_approach_of_two_that_meet(tmp_path: Path) -> None:
    data = data_of(make_page(make_run(tmp_path / "run", vehicles=2, frames=100, pose=meeting)))
    times = {m["key"]: m["time"] for m in data["moments"]}
    # front to front they close at 20 m/s; the boxes lie beside one another from (100 - 4.8) / 20 = 4.76 s on
    assert times["closest"] == times["raw_closest"] == pytest.approx(4.8)
    assert times["trigger"] == 2.0 and times["min_ttc"] == 4.5 and "contact" not in times
    assert [m["time"] for m in data["moments"]] == sorted(times.values())


def test_what_the_modifier_changed(tmp_path: Path) -> None:
    base = {"label": "Cut-in", "mode": "side", "origin": "seed", "parent": None, "source": "GAP = 3\nSIDE = 1\n"}
    changed = {**base, "origin": "a model", "parent": "a" * 64, "source": "GAP = 2\nSIDE = 1\n"}
    orphan = {**base, "parent": "f" * 64}
    document = outcome(attempts=[attempt(0, "a" * 64), attempt(1, "b" * 64), attempt(2, "c" * 64)], best=1)
    planners = {"a" * 64: base, "b" * 64: changed, "c" * 64: orphan}
    run = make_run(tmp_path / "run", told=document, written=manifest(planners=planners, attempt={"planner": "b" * 64}))
    first, second, third = data_of(make_page(run))["planners"]
    assert first["diff"] is None and third["diff"] is None
    assert second["diff"] == ["@@ -1,2 +1,2 @@", "-GAP = 3", "+GAP = 2", " SIDE = 1"]
    assert second["counts"] and second["attempts"] == [1] and not first["counts"]


@pytest.mark.parametrize("ending", ["no_encounter", "simulation_failed"])
def test_a_run_without_states_has_a_page_in_words(tmp_path: Path, ending: str) -> None:
    document = outcome(
        ending=ending, outcome=None, intent=None, intents=[], attempts=[], best=None, adversaries=[], raw=None,
        encounter=None, trigger_time=None, agents=None, ego={"id": None, "controller": "idm"},
    )  # fmt: skip
    (tmp_path / "outcome.json").write_text(json.dumps(document))
    assert data_of(make_page(tmp_path))["scene"] is None


def test_what_is_no_run_or_damaged_is_said_in_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="holds no outcome"):
        make_page(tmp_path)
    run = make_run(tmp_path / "run")
    whole_file = (run / "states.csv.gz").read_bytes()
    for data, problem in (
        (whole_file[:-20], "states.csv.gz is damaged"),
        (gzip.compress(b"a,b\n1,2\n"), "its columns are others"),
        (gzip.compress((HEADER + "nan,a,ego,0,0,0,0,0,1,1,\n").encode()), "not finite"),
        (gzip.compress((HEADER + "0,a,pilot,0,0,0,0,0,1,1,\n").encode()), "pilot"),
    ):
        (run / "states.csv.gz").write_bytes(data)
        with pytest.raises(UsageError, match=problem):
            make_page(run)
    (run / "states.csv.gz").write_bytes(whole_file)
    (run / "outcome.json").write_text('{"attempts": 3}')
    with pytest.raises(UsageError, match="not as this program writes it"):
        make_page(run)


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory, caches: Path) -> Path:
    """A run in which a later attempt than the first counts: without a tuner one seed in three or four has one."""
    program = Program(tmp_path_factory.mktemp("real"), caches)
    for seed in range(3, 20):
        command = ("run", "motorway_cut_in_left", "--seed", str(seed), "--until", "valid", "--learn", "off")
        done = program.here(*command, "--tuner", "off", "--out", "out", "--force")
        assert done.status == 0, done.err
        if done.outcome["best"] > 0:
            return done.folder
    raise AssertionError("No seed has a second attempt.")


def test_the_first_attempt_is_kept_where_another_counts(real: Path) -> None:
    document = json.loads((real / "outcome.json").read_text())
    first = read_states(real / "first.csv.gz")
    assert set(first) == {document["ego"]["id"], document["attempts"][0]["adversaries"][0]}
    assert [{r["role"] for r in rows.values()} for rows in first.values()] == [{"ego"}, {"adversary"}]
    start = document["encounter"]["time"]
    times = sorted(first[document["ego"]["id"]])
    assert times[0] == pytest.approx(start - 0.1)
    before = read_states(real / "states.csv.gz")[document["ego"]["id"]]
    assert [first[document["ego"]["id"]][t]["x"] for t in times[:2]] == [before[t]["x"] for t in times[:2]]
    with gzip.open(real / "first.csv.gz", "rt", encoding="utf-8") as text:
        assert ",".join(next(csv.reader(text))) + "\n" == HEADER


def test_the_command_writes_the_page(real: Path, program: Program) -> None:
    done = program.here("report", real, "--json")
    assert done.status == 0, done.err
    summary = json.loads(done.out)
    assert Path(summary["page"]) == real / "report.html" and summary["bytes"] == (real / "report.html").stat().st_size
    data = data_of((real / "report.html").read_text())
    assert [a["key"] for a in data["scene"]["attempts"]] == ["best", "first", "raw"]
    assert data["outcome"] == json.loads((real / "outcome.json").read_text())
    assert program.here("report", real, "--out", "deep/page.html").status == 0
    assert (program.folder / "deep" / "page.html").read_bytes() == (real / "report.html").read_bytes()


def test_the_command_refuses_what_is_no_run(program: Program, tmp_path: Path) -> None:
    done = program.here("report", tmp_path)
    assert done.status == 2 and "is not the folder of a run or of a batch" in done.err and "Traceback" not in done.err
