"""What the replay page costs: its size, and the script time of each picture while it plays, in a headless Chromium.

    python benchmarks/replay_page.py [VEHICLES FRAMES]      default 100 vehicles, 900 frames, played once at 4x

Prints for the whole map and for following the ego (where the road is drawn anew for each picture): pictures a second,
milliseconds of script a picture (median, 95 % and most by the clock), and the mean processor time by Chromium's count.
Then an index of 5,000 rows: script time to sort, to filter and to scroll one screen.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))

from page_samples import Visit, chromium, make_run, outcome  # type: ignore[import-not-found]

from sumo_adv.report.index import MadePages, ResultsTable, make_index, road_of
from sumo_adv.report.page import make_page

SECONDS = 8.0  # of playing
TIMED = """async () => {
    const p = await window.replay, old = p.draw.bind(p);
    window.times = [];
    p.draw = () => { const began = performance.now(); old(); window.times.push(performance.now() - began); };
    p.seek(p.from); p.setSpeed(4); p.play();
}"""
ROWS = 5000


def script_seconds(visit: Visit, session: Any) -> float:
    """Seconds that Chromium has spent in the page's script."""
    metrics = session.send("Performance.getMetrics")["metrics"]
    return float(next(m["value"] for m in metrics if m["name"] == "ScriptDuration"))


def play(browser: Any, file: Path, follow: bool) -> None:
    """Play for some seconds and print what it cost."""
    with Visit(browser, file, viewport={"width": 1400, "height": 950}) as visit:
        page, session = visit.page, visit.context.new_cdp_session(visit.page)
        session.send("Performance.enable", {"timeDomain": "threadTicks"})  # its own time, whatever else runs
        page.evaluate("(on) => window.replay.then((p) => { p.setWhole(true); p.setFollow(on); })", follow)
        page.wait_for_timeout(500)
        before, began = script_seconds(visit, session), perf_counter()
        page.evaluate(TIMED)
        page.wait_for_timeout(int(1000 * SECONDS))
        times = sorted(page.evaluate("window.times"))
        seconds, spent = perf_counter() - began, script_seconds(visit, session) - before
        print(
            f"{'following the ego' if follow else 'the whole map':18} {len(times) / seconds:5.1f} pictures/s  "
            f"median {statistics.median(times):.1f} ms  95 % {times[int(0.95 * len(times))]:.1f} ms  "
            f"most {times[-1]:.1f} ms  processor time {1000 * spent / len(times):.2f} ms a picture"
        )


def rows(count: int) -> list[dict[str, Any]]:
    """Made-up rows of a batch."""
    return [
        {
            "id": f"{k:016x}", "network": f"network{k % 25}", "ego": ("idm", "careful")[k % 2], "seed": k % 100,
            "intent": f"intent {k % 7}", "ending": "critical", "failure": "" if k % 50 else "It failed.",
            "level": ("serious" if k % 2 == 0 else "collision") if k % 37 == 0 else "none",
            "severity": "" if k % 37 else "minor", "relation": "neighbour", "road": "motorway",
            "preventable_by": "" if k % 74 else "cc_human", "delta_v": None if k % 37 else 2.5,
            "raw_min_ttc": None if k % 3 else k % 11 / 1.7, "min_ttc": k % 37 / 9, "collided": k % 37 == 0,
            "valid": (k % 2 == 0) if k % 37 == 0 else None, "critical": k % 37 < 10, "attempts": k % 25,
            "seconds": k % 13 / 3,
        }
        for k in range(count)
    ]  # fmt: skip


def index(browser: Any, folder: Path) -> None:
    """The index's figures."""
    name = "straight_3lane.net.xml"
    road = road_of(Path(__file__).resolve().parent.parent / "networks" / name)
    table = ResultsTable(rows(ROWS))
    made = {r["id"]: MadePages(0, (k % 400 - 200.0, -4.8 + k % 3 * 3.2), name) for k, r in enumerate(table.rows)}
    file = folder / "index.html"
    began = perf_counter()
    file.write_text(make_index("made up", table, made, {name: road}), encoding="utf-8")
    print(f"index of {ROWS} rows: {file.stat().st_size / 1000:.0f} kB, made in {perf_counter() - began:.2f} s")
    with Visit(browser, file, viewport={"width": 1400, "height": 950}) as visit:
        for words, act in (
            ("sort by min TTC", "document.querySelectorAll('#heads button')[5].click()"),
            ("filter by intent", "(() => { const s = document.getElementById('intent'); s.value = 'intent 3'; "
             "s.dispatchEvent(new Event('change')); })()"),
            ("show all", "document.getElementById('reset').click()"),
        ):  # fmt: skip
            script = f"() => {{ const t = performance.now(); {act}; return performance.now() - t; }}"
            times = sorted(visit.page.evaluate(script) for _ in range(9))
            print(f"{words:18} {times[4]:6.1f} ms median of 9, most {times[-1]:.1f} ms")
        scroll = """() => new Promise((done) => { const box = document.getElementById("list"), times = []; let n = 0;
            box.addEventListener("scroll", () => {}, { passive: true });
            const next = (then) => { times.push(performance.now() - then); if (++n > 120) return done(times.slice(1));
                box.scrollTop += 700; requestAnimationFrame(next); };
            requestAnimationFrame(next); })"""
        times = sorted(visit.page.evaluate(scroll))
        print(
            f"scroll one screen  {statistics.median(times):6.1f} ms median, 95 % {times[int(0.95 * len(times))]:.1f} ms"
        )


def main() -> None:
    """All of it, where there is a browser."""
    try:
        measure()
    except pytest.skip.Exception as absent:
        print(f"{absent}: nothing to do")


def measure() -> None:
    """Both pages."""
    vehicles, frames = (int(a) for a in (sys.argv[1:3] or ("100", "900")))
    with tempfile.TemporaryDirectory() as scratch, chromium() as browser:
        document = outcome(trigger_time=frames / 10 - 5.0, encounter=None)
        document["trigger_time"] = 60.0
        run = make_run(Path(scratch) / "run", vehicles=vehicles, frames=frames, told=document)
        file = run / "report.html"
        began = perf_counter()
        file.write_text(make_page(run), encoding="utf-8")
        size, seconds = file.stat().st_size / 1000, perf_counter() - began
        print(f"{vehicles} vehicles, {frames} frames: {size:.0f} kB in {seconds:.2f} s")
        for follow in (False, True):
            play(browser, file, follow)
        index(browser, Path(scratch))


if __name__ == "__main__":
    main()
