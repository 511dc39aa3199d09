"""Runs' folders written by hand: any number of vehicles and frames on a shipped network, nothing simulated."""

from __future__ import annotations

import gzip
import json
import math
import shutil
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
STEP = 0.1  # s
HEADER = "time,id,role,x,y,heading,speed,acceleration,length,width,lane\n"
EGO, ADVERSARY = "ego", "adversary"
NETWORK = "straight_3lane.net.xml"

Pose = Callable[[int, int], tuple[float, float, float, float]]
"""Vehicle and frame -> x, y [m], heading [rad], speed [m/s]."""


def along(vehicle: int, frame: int) -> tuple[float, float, float, float]:
    """Vehicles on three lanes around the first one, that sway, change speed, and tremble by up to 2 cm."""
    row = vehicle // 3
    speed = 12.0 + 2.0 * math.sin(vehicle + frame / 40)
    phase = frame / 17 + vehicle
    chance = zlib.crc32(f"{vehicle} {frame}".encode()) % 5 - 2
    x = 8.0 * (row + 1) // 2 * (-1) ** row + 12.0 * frame * STEP - 8.0 * math.cos(vehicle + frame / 40) + chance / 100
    return x, -1.6 - 3.2 * (vehicle % 3) + 0.3 * math.sin(phase), 0.02 * math.cos(phase), speed


def meeting(vehicle: int, frame: int) -> tuple[float, float, float, float]:
    """The ego at 10 m/s from x = 0; the adversary comes the other way at 10 m/s from x = 100, 3 m to the left."""
    forward = vehicle == 0
    return (frame * 1.0 if forward else 100.0 - frame, -1.6 if forward else 1.4, 0.0 if forward else math.pi, 10.0)


def states(names: Sequence[str], frames: range, pose: Pose = along, roles: Sequence[str] = ()) -> bytes:
    """A table of states; the first vehicle is the ego, the second the adversary."""
    roles = roles or ["ego", "adversary", *["background"] * len(names)]
    rows = [HEADER]
    for k in frames:
        for i, name in enumerate(names):
            x, y, heading, speed = pose(i, k)
            quoted = '"' + name.replace('"', '""') + '"'
            motion = f"{x:.4f},{y:.4f},{heading:.6f},{speed:.4f},0.0000"
            rows.append(f"{k * STEP:.2f},{quoted},{roles[i]},{motion},4.80,1.80,lane_0\n")
    return gzip.compress("".join(rows).encode(), mtime=0)


def attempt(index: int, planner: str, adversary: str = ADVERSARY, **changes: Any) -> dict[str, Any]:
    """An attempt as ``outcome.json`` lists it."""
    return {
        "index": index, "by": "expert", "phase": "analyzer", "adversaries": [adversary], "intent": "Cut-in",
        "planner": {"mode": "side", "hash": planner, "origin": "seed"}, "parameters": {"gap": 3.0},
        "acceleration": 0.0, "trigger_time": 2.0, "min_ttc": 0.72, "min_distance": 1.2, "collided": False,
        "critical": True, "feasible": True, "rear_end": False, "valid": None, "strict": None, "level": "critical",
        "kind": "", "delta_v": None, "failed_gates": [], "ending": "passed", "message": "", **changes,
    }  # fmt: skip


def outcome(ego: str = EGO, adversary: str = ADVERSARY, **changes: Any) -> dict[str, Any]:
    """An ``outcome.json`` of a run without contact: min TTC 0.72 s, 9.87 s unattacked."""
    intent = {
        "bv": adversary, "label": "Cut-in", "description": "It cuts in.", "risk": "high", "acceleration": 0.0,
        "reason": "least TTC 0.31 s", "source": "memory",
    }  # fmt: skip
    verdict = {
        "min_ttc": 0.7213, "min_ttc_any": 0.65, "min_pet": None, "max_drac": 3.5979, "min_distance": 1.2345,
        "collided": False, "critical": True, "feasible": True, "rear_end": False, "valid": None, "strict": None,
        "fault": None, "failed_gates": [], "log_gates": [], "contact_time": None, "min_ttc_time": 4.5,
        "level": "critical", "preventable_by": None, "references": None, "alarms": None, "inconclusive": None,
        "simulated": None, "in_loop": None, "ego_stationary": None, "ego_blocking": None, "humanlike": None,
        "beyond_human": [], "contact_side": None, "delta_v": None, "adversary_delta_v": None, "severity": None,
        "injury_risk": None, "impact_speed": None, "overlap": None, "impact": None,
    }  # fmt: skip
    return {
        "schema": 2, "ending": "critical", "reason": "An attempt met the criterion.", "network": "sample", "seed": 7,
        "ego": {"id": ego, "controller": "idm"}, "adversaries": [{"id": adversary}], "trigger_time": 2.0,
        "encounter": {"time": 2.0, "ranking": [{"id": adversary, "relation": "neighbour", "risk": 0.5}]},
        "agents": {"analyzer": "expert", "note": "Built-in expert."}, "intent": intent, "intents": [intent],
        "raw": {"min_ttc": 9.8765, "collided": False}, "attempts": [attempt(0, "a" * 64, adversary)], "best": 0,
        "outcome": verdict, "realism": {"speed_kl": 1.5731}, "timing": {"total": 2.0}, "notes": [], **changes,
    }  # fmt: skip


def manifest(**changes: Any) -> dict[str, Any]:
    """A ``manifest.json``, as much of it as a page reads."""
    planner = {"label": "Cut-in", "mode": "side", "origin": "seed", "parent": None, "source": "GAP = 3\nSIDE = 1\n"}
    return {
        "schema": 1, "versions": {"sumo_adv": "0"}, "name": "sample",
        "settings": {"step_length": STEP, "critical_ttc": 1.0},
        "network": f"0-{NETWORK}", "seed": 7, "planners": {"a" * 64: planner}, "attempt": {"planner": "a" * 64},
        **changes,
    }  # fmt: skip


def make_run(
    folder: Path, *, vehicles: int = 4, frames: int = 100, names: Sequence[str] = (), pose: Pose = along,
    told: dict[str, Any] | None = None, with_raw: bool = True, written: dict[str, Any] | None = None,
) -> Path:  # fmt: skip
    """A run's folder: ``vehicles`` over ``frames`` steps, unattacked as well."""
    names = names or [EGO, ADVERSARY, *(f"car{k}" for k in range(vehicles - 2))]
    (folder / "inputs").mkdir(parents=True)
    shutil.copyfile(ROOT / "networks" / NETWORK, folder / "inputs" / f"0-{NETWORK}")
    (folder / "outcome.json").write_text(json.dumps(outcome(names[0], names[1]) if told is None else told))
    (folder / "manifest.json").write_text(json.dumps(manifest() if written is None else written))
    (folder / "states.csv.gz").write_bytes(states(names, range(1, frames + 1), pose))
    if with_raw:
        roles = ["ego", *["background"] * len(names)]
        (folder / "raw.csv.gz").write_bytes(states(names, range(1, frames + 1), pose, roles))
    return folder


# -- a browser ---------------------------------------------------------------------------------------------------------

PATHS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@contextmanager
def chromium() -> Iterator[Any]:
    """A headless Chromium of the machine, driven by playwright; the test is skipped where one of the two is absent."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed (extra dev)")
    path = next((p for name in PATHS if (p := shutil.which(name))), None)
    if path is None:
        pytest.skip("no Chromium on this machine (apt-get install chromium)")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


class Visit:
    """A page open from disk, with everything that went wrong: console, exceptions, requests, dialogs."""

    def __init__(self, browser: Any, file: Path, **context: Any) -> None:
        self.context = browser.new_context(**context)
        self.page = self.context.new_page()
        self.wrong: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda m: self.wrong.append(m.text))
        self.page.on("pageerror", lambda e: self.wrong.append(str(e)))
        self.page.on("dialog", lambda d: (self.wrong.append(d.message), d.dismiss()))
        self.page.on("request", lambda r: self.requests.append(r.url))
        self.address = file.as_uri()
        self.page.goto(self.address)
        self.page.evaluate("window.replay")

    def until(self, expression: str, argument: object = None) -> None:
        """Wait for an expression to hold; asked from outside, since the page's policy lets nothing be evaluated."""
        for _ in range(400):
            if self.page.evaluate(expression, argument):
                return
            self.page.wait_for_timeout(25)
        raise AssertionError(f"never came true: {expression}")

    def clean(self) -> None:
        """Assert that nothing went wrong and that nothing but the file itself was loaded."""
        assert self.wrong == []
        assert {r.split("#")[0] for r in self.requests} <= {self.address, "about:srcdoc"}

    def __enter__(self) -> Visit:
        return self

    def __exit__(self, *_: object) -> None:
        self.context.close()
