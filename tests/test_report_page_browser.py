"""The replay page in a real headless Chromium, opened from disk: plays, jumps, says what the files say."""

from __future__ import annotations

import gzip
import html
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from page_samples import ROOT, Visit, attempt, chromium, make_run, manifest, meeting, outcome, states
from test_report_page import HOSTILE

from sumo_adv.report.page import make_page

PHONE = {"viewport": {"width": 375, "height": 720}, "has_touch": True, "is_mobile": True}
FRAME = "window.replay.then((p) => p.frame)"
ORIGIN = "window.replay.then((p) => p.scene.origin)"
TIME = "window.replay.then((p) => p.timeOf(p.frame))"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as started:
        yield started


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of three attempts, of which the second counts; two vehicles that meet, and two others."""
    document = outcome(attempts=[attempt(0, "a" * 64), attempt(1, "b" * 64)], best=1)
    base = manifest()["planners"]["a" * 64]
    planners = {"a" * 64: base, "b" * 64: {**base, "parent": "a" * 64, "source": "GAP = 2\nSIDE = 1\n"}}
    written = manifest(planners=planners, attempt={"planner": "b" * 64})
    run = make_run(
        tmp_path_factory.mktemp("page") / "run", vehicles=4, frames=80, pose=meeting, told=document, written=written
    )
    (run / "first.csv.gz").write_bytes(states(["ego", "adversary"], range(19, 60), meeting))
    page = run / "report.html"
    page.write_text(make_page(run), encoding="utf-8")
    return page


def painted(page: Any, canvas: str) -> int:
    """How many different colours a canvas shows."""
    script = """(id) => { const c = document.getElementById(id);
        const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
        return new Set(new Uint32Array(d.buffer)).size; }"""
    return int(page.evaluate(script, canvas))


def test_it_opens_shortly_before_the_point_with_both_vehicles_in_sight(browser: Any, file: Path) -> None:
    """The two are closest at 4.8 s. At 3.3 s the ego is at x = 33 and the adversary at x = 67; they meet at 50."""
    with Visit(browser, file) as visit:
        page = visit.page
        assert page.evaluate(TIME) == pytest.approx(3.3)
        view, box = page.evaluate("window.replay.then((p) => p.map.view)"), page.locator("#map").bounding_box()
        assert view["x"] + page.evaluate(ORIGIN)[0] == pytest.approx(50.0, abs=1.0)
        # 34 m apart along the road and 3 m across it, and 12 m around them
        assert view["scale"] == pytest.approx(min(box["width"] / 58, box["height"] / 27), rel=0.03)
        visit.clean()


def test_the_scale_is_under_the_map_and_true(browser: Any, file: Path) -> None:
    with Visit(browser, file) as visit:
        page = visit.page
        frame, bar = (page.locator(name).bounding_box() for name in (".frame", "#scale"))
        assert bar["y"] >= frame["y"] + frame["height"]
        metres = float(page.inner_text("#scale").removesuffix(" m"))
        scale = page.evaluate("window.replay.then((p) => p.map.view.scale)")  # px/m
        assert bar["width"] == pytest.approx(metres * scale, abs=1)
        visit.clean()


def test_badges_say_level_severity_and_who_avoids_it(browser: Any, tmp_path: Path) -> None:
    document = outcome()
    document["outcome"] |= {
        "collided": True, "valid": True, "level": "serious", "severity": "moderate", "delta_v": 6.5,
        "preventable_by": ["cc_human", "fsm"], "contact_time": 4.5,
    }  # fmt: skip
    run = make_run(tmp_path / "run", told=document)
    page = run / "report.html"
    page.write_text(make_page(run), encoding="utf-8")
    with Visit(browser, page) as visit:
        badges = [text.replace("\u202f", " ") for text in visit.page.locator("#badges li").all_text_contents()]
        assert badges[:3] == [
            "level: serious", "severity: moderate, delta-v 6.5 m/s", "preventable by cc_human, fsm",
        ]  # fmt: skip
        visit.clean()


LAMPS = """window.replay.then((p) => { const c = p.map.canvas.getContext("2d");
    const found = new Set();
    for (const { x, y } of p.map.lit) {
        const at = (q) => q * p.map.view.scale;
        const px = p.map.width / 2 + at(0.75 * x[0] + 0.25 * x[1] - p.map.view.x);
        const py = p.map.height / 2 - at(0.75 * y[0] + 0.25 * y[1] - p.map.view.y);
        const [r, g, b, a] = c.getImageData(Math.round(px * p.map.ratio), Math.round(py * p.map.ratio), 1, 1).data;
        if (a === 255) found.add([r, g, b].join());
    }
    return [...found].sort(); })"""


def test_stop_lines_have_the_colours_of_their_lights(browser: Any, tmp_path: Path) -> None:
    """Red for all until 3 s, then green; the road is another network's, at the place where the vehicles are."""
    network = "signalised_crossing.net.xml"
    run = make_run(tmp_path / "run", pose=meeting, frames=80, written=manifest(network=f"0-{network}"))
    shutil.copyfile(ROOT / "networks" / network, run / "inputs" / f"0-{network}")
    rows = f"time,tls,state\n0.10,centre,{'r' * 16}\n3.00,centre,{'G' * 16}\n"
    (run / "signals.csv.gz").write_bytes(gzip.compress(rows.encode()))
    page = run / "report.html"
    page.write_text(make_page(run), encoding="utf-8")
    with Visit(browser, page, color_scheme="light") as visit:
        assert visit.page.evaluate("window.replay.then((p) => p.map.lit.length)") == 8
        visit.page.evaluate("window.replay.then((p) => { p.map.view = { x: -p.scene.origin[0], y: 0, scale: 3 }; })")
        for time, colour in ((2.9, "196,22,28"), (3.0, "18,129,63")):
            visit.page.evaluate("(t) => window.replay.then((p) => { p.jump(t); p.draw(); })", time)
            assert visit.page.evaluate(LAMPS) == [colour]
        visit.wrong[:] = [text for text in visit.wrong if "willReadFrequently" not in text]  # of reading the canvas
        visit.clean()


def test_it_plays_pauses_and_comes_to_the_end(browser: Any, file: Path) -> None:
    with Visit(browser, file) as visit:
        page = visit.page
        before = page.evaluate(FRAME)
        page.click("#play")
        visit.until("(b) => window.replay.then((p) => p.frame > b + 3)", before)
        assert page.get_attribute("#play", "aria-label") == "Pause"
        page.click("#play")
        stopped = page.evaluate(FRAME)
        page.wait_for_timeout(120)
        assert page.evaluate(FRAME) == stopped
        page.select_option("#speed", "4")
        page.click("#play")
        visit.until("window.replay.then((p) => !p.playing && p.frame === p.to)")
        assert page.get_attribute("#play", "aria-label") == "Play"
        visit.clean()


def test_it_scrubs_steps_and_jumps(browser: Any, file: Path) -> None:
    with Visit(browser, file) as visit:
        page = visit.page
        page.fill("#scrub", "35")
        assert page.evaluate(TIME) == pytest.approx(3.6)  # frame 0 is at 0.1 s
        page.click("#later")
        assert page.evaluate(TIME) == pytest.approx(3.7)
        page.click("#moments a[href='#closest']")
        assert page.evaluate(TIME) == pytest.approx(4.8)
        visit.until("document.getElementById('clock').textContent === '4.80 s (trigger + 2.80 s)'")
        row = page.locator("#now tbody tr").first.locator("td").all_text_contents()
        # beside one another, 1.2 m apart; the boxes never meet, both drive 10 m/s
        assert row == ["–", "1.20", "10.0", "10.0", "0.0", "0.0"]
        page.click("#curves", position={"x": 44, "y": 100})
        visit.until("window.replay.then((p) => p.frame === p.from)")
        page.goto(visit.address + "#t=3")
        visit.until("window.replay.then((p) => Math.abs(p.timeOf(p.frame) - 3) < 1e-6)")
        visit.clean()


def test_keys_alone_are_enough(browser: Any, file: Path) -> None:
    with Visit(browser, file) as visit:
        page = visit.page

        def pressed(*keys: str) -> float:
            for key in keys:
                page.keyboard.press(key)
            return float(page.evaluate(TIME))

        assert pressed("t") == pytest.approx(2.0)
        assert pressed("ArrowRight", "ArrowRight") == pytest.approx(2.2)
        assert pressed("Shift+ArrowRight") == pytest.approx(3.2)
        assert pressed("h") == pytest.approx(3.0)
        assert pressed("c") == pytest.approx(4.8)
        assert pressed("Home") == pytest.approx(0.1) and pressed("End") == pytest.approx(8.0)
        scale = page.evaluate("window.replay.then((p) => p.map.view.scale)")
        page.keyboard.press("+")
        assert page.evaluate("window.replay.then((p) => p.map.view.scale)") == pytest.approx(1.3 * scale)
        for key, state in (("f", "p.map.follow"), ("v", "p.map.beside"), ("r", "p.whole")):
            page.keyboard.press(key)
            assert page.evaluate(f"window.replay.then((p) => {state})") is True
        page.keyboard.press("3")
        assert not page.is_checked("#show-raw")
        page.keyboard.press("Home")
        page.keyboard.press(" ")
        visit.until("window.replay.then((p) => p.frame > 3)")
        page.keyboard.press(" ")
        assert page.evaluate("window.replay.then((p) => p.playing)") is False
        reached = set()
        for _ in range(25):
            page.keyboard.press("Tab")
            reached.add(page.evaluate("document.activeElement.id"))
        assert {"play", "scrub", "speed", "layout", "show-best", "follow", "in", "fit", "whole", "map"} <= reached
        visit.clean()


def test_it_says_what_the_files_say(browser: Any, file: Path) -> None:
    with Visit(browser, file) as visit:
        words = visit.page.inner_text("#beside").replace("\u202f", " ")
        for text in ("9.88 s", "0.72 s", "0.65 s", "1.23 m", "3.60 m/s²", "never", "no third party hit"):
            assert text in words
        assert visit.page.inner_text("#title") == "sample — Cut-in by adversary"
        panels = visit.page.inner_text("#panels")
        assert "least TTC 0.31 s" in panels and "2 (counts)" in panels
        changed = visit.page.locator("pre .added, pre .removed").all_text_contents()
        assert changed == ["-GAP = 3", "+GAP = 2"]
        visit.page.click("summary:has-text('outcome.json')")
        shown = visit.page.locator("details:has(> summary:has-text('outcome.json')) pre").inner_text()
        assert json.loads(shown) == json.loads((file.parent / "outcome.json").read_text())
        visit.clean()


def test_zoom_pan_and_follow_by_mouse(browser: Any, file: Path) -> None:
    with Visit(browser, file) as visit:
        page = visit.page
        view = "window.replay.then((p) => ({...p.map.view}))"
        before = page.evaluate(view)
        box = page.locator("#map").bounding_box()
        page.mouse.move(box["x"] + 200, box["y"] + 100)
        page.mouse.down()
        page.mouse.move(box["x"] + 240, box["y"] + 130)
        page.mouse.up()
        after = page.evaluate(view)
        assert after["x"] == pytest.approx(before["x"] - 40 / before["scale"])
        assert after["y"] == pytest.approx(before["y"] + 30 / before["scale"])
        page.mouse.wheel(0, -200)
        visit.until("(s) => window.replay.then((p) => p.map.view.scale > s)", before["scale"])
        page.click("#follow")
        page.fill("#scrub", "50")
        visit.until("window.replay.then((p) => Math.abs(p.map.view.x + p.scene.origin[0] - 51) < 0.01)")
        visit.clean()


def pinch(visit: Visit, box: Any) -> None:
    """Two fingers on the middle of a box, 40 px apart, then 80."""
    session = visit.context.new_cdp_session(visit.page)
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def touch(kind: str, *apart: float) -> None:
        points = [{"x": x + sign * a / 2, "y": y, "id": k} for a in apart for k, sign in ((0, -1), (1, 1))]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    touch("touchStart", 40)
    touch("touchMove", 60)
    touch("touchMove", 80)
    touch("touchEnd")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_phone_and_both_schemes(browser: Any, file: Path, scheme: str) -> None:
    with Visit(browser, file, **PHONE, color_scheme=scheme) as visit:
        page = visit.page
        assert page.evaluate("document.documentElement.scrollWidth") <= 375
        assert painted(page, "road") > 2 and painted(page, "map") > 10 and painted(page, "curves") > 10
        ground = page.evaluate("getComputedStyle(document.body).backgroundColor")
        assert ground == {"light": "rgb(247, 247, 244)", "dark": "rgb(20, 22, 26)"}[scheme]
        page.tap("#later")
        before = page.evaluate("window.replay.then((p) => p.map.view.scale)")
        pinch(visit, page.locator("#map").bounding_box())
        visit.until("(s) => window.replay.then((p) => p.map.view.scale > 1.9 * s)", before)
        page.select_option("#layout", "beside")
        assert (
            page.evaluate("window.replay.then((p) => p.map.panels(p.attempts()).map((q) => q.width))")
            == [page.evaluate("window.replay.then((p) => p.map.width)")] * 3
        )
        visit.clean()


def test_with_reduced_motion_whole_frames_are_shown(browser: Any, file: Path) -> None:
    with Visit(browser, file, reduced_motion="reduce") as visit:
        visit.page.evaluate("""window.replay.then((p) => { window.drawn = []; const old = p.map.draw.bind(p.map);
            p.map.draw = (a, f) => { window.drawn.push(f); old(a, f); }; })""")
        assert visit.page.evaluate("window.replay.then((p) => p.playing)") is False
        visit.page.keyboard.press(" ")
        visit.until("window.drawn.length > 10")
        visit.page.keyboard.press(" ")
        assert all(f == round(f) for f in visit.page.evaluate("window.drawn.slice(0, -1)"))
        visit.clean()


def test_hostile_strings_are_shown_and_do_nothing(browser: Any, tmp_path: Path) -> None:
    names = [f"{HOSTILE}{k}" for k in range(3)]
    document = outcome(
        names[0], names[1], network=HOSTILE, reason=HOSTILE, notes=[HOSTILE],
        attempts=[attempt(0, "a" * 64, names[1], intent=HOSTILE, message=HOSTILE, failed_gates=[HOSTILE])],
    )  # fmt: skip
    document["intents"][0] |= {"label": HOSTILE, "reason": HOSTILE, "risk": HOSTILE, "description": HOSTILE}
    source = {"label": HOSTILE, "mode": HOSTILE, "origin": HOSTILE, "parent": None, "source": HOSTILE}
    run = make_run(tmp_path / "run", names=names, told=document, written=manifest(planners={"a" * 64: source}))
    page = run / "report.html"
    page.write_text(make_page(run), encoding="utf-8")
    with Visit(browser, page) as visit:
        visible = "</script><img src=x onerror=alert(1)>\"'<!--⟨202E⟩⟨2066⟩"
        assert visit.page.inner_text("#title").startswith(visible)
        assert visible in visit.page.inner_text("#panels")
        assert visit.page.locator("img, iframe, object, embed").count() == 0
        visit.page.click("#play")
        visit.until("window.replay.then((p) => p.frame > 25)")
        visit.clean()


def test_it_works_inside_another_page_as_notebooks_show_it(browser: Any, file: Path, tmp_path: Path) -> None:
    host = tmp_path / "notebook.html"
    text = html.escape(file.read_text(encoding="utf-8"), quote=True)
    host.write_text(f'<!DOCTYPE html><iframe srcdoc="{text}" width="1000" height="900"></iframe>', encoding="utf-8")
    with Visit(browser, host) as visit:
        inside = visit.page.frame_locator("iframe")
        inside.locator("#moments a[href='#closest']").click()
        inside.locator("#clock", has_text="4.80 s (trigger + 2.80 s)").wait_for(timeout=10_000)
        assert len(visit.page.frames) == 2 and visit.page.url == visit.address
        visit.clean()


def test_a_run_without_states_is_told_in_words(browser: Any, tmp_path: Path) -> None:
    document = outcome(
        ending="no_encounter", reason="No encounter.", outcome=None, intent=None, intents=[], attempts=[], best=None,
        adversaries=[], raw=None, encounter=None, trigger_time=None, agents=None, ego={"id": None, "controller": "idm"},
    )  # fmt: skip
    (tmp_path / "outcome.json").write_text(json.dumps(document))
    page = tmp_path / "report.html"
    page.write_text(make_page(tmp_path), encoding="utf-8")
    with Visit(browser, page) as visit:
        assert "There was no attempt: No encounter." in visit.page.inner_text("main")
        assert not visit.page.is_visible("#stage")
        visit.clean()
