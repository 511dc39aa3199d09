"""Cases for the tests of ``keep``, ``regress`` and ``compare``, and drivers that meet them in their own way."""

from __future__ import annotations

import atexit
import hashlib
import json
import shutil
import tempfile
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

from cli_samples import PATIENCE, Program, without_progress
from ego_samples import CalmEgo

import sumo_adv
from sumo_adv.drivers import LaneSpeed, Observation
from sumo_adv.regression.case import Expectation
from sumo_adv.regression.keep import keep_run

FOUND = "priority_straight_from_right"
SLOWEST = 30.0  # s for a case on a busy machine
LOOPS = """\
PARAMETERS = {"gap": (3.0, 1.0, 9.0, "m", "not used")}


def endpoint(bv, ego, road, parameters, acc, horizon):
    while True:
        pass
"""


class StandingEgo(CalmEgo):
    """Comes to a stop and stays there, so it never reaches a trigger's situation."""

    name = "standing"

    def act(self, seen: Observation) -> LaneSpeed | None:
        """Stop."""
        return LaneSpeed(lane=None, speed=max(0.0, seen.ego.speed - 5.0 * seen.dt))


class SlowerEgo(CalmEgo):
    """Drives at 11 m/s at most, so it comes to the trigger 3 m/s slower than SUMO's driver."""

    name = "slower"

    def act(self, seen: Observation) -> LaneSpeed | None:
        """Keep to the speed."""
        return LaneSpeed(lane=None, speed=min(11.0, seen.ego.speed + 2.0 * seen.dt))


class FarStoppingEgo(CalmEgo):
    """Drives like SUMO until a vehicle is within 60 m, and then comes to a stop far before the adversary."""

    name = "far_stopping"

    def act(self, seen: Observation) -> LaneSpeed | None:
        """Stop for whatever is near."""
        near = any((o.x - seen.ego.x) ** 2 + (o.y - seen.ego.y) ** 2 < 60.0**2 for o in seen.others)
        return LaneSpeed(lane=None, speed=max(0.0, seen.ego.speed - 6.0 * seen.dt)) if near else None


class BreakingDownEgo(CalmEgo):
    """Drives like SUMO until a vehicle is within 25 m, and then raises."""

    name = "breaking_down"

    def act(self, seen: Observation) -> LaneSpeed | None:
        """Fail in the attack."""
        if any((o.x - seen.ego.x) ** 2 + (o.y - seen.ego.y) ** 2 < 25.0**2 for o in seen.others):
            raise RuntimeError("the driver lost its head")
        return None


class BrokenEgo(CalmEgo):
    """Raises as soon as it drives."""

    name = "broken"

    def act(self, seen: Observation) -> LaneSpeed | None:
        """Fail."""
        raise RuntimeError("the driver fell asleep")


def results(folder: Path) -> list[dict[str, Any]]:
    """Of each case all that does not depend on the clock."""
    cases = json.loads((folder / "regress.json").read_text(encoding="utf-8"))["cases"]
    return [{key: value for key, value in case.items() if key != "seconds"} for case in cases]


def answers_of(program: Program, times: int) -> Counter[str]:
    """A case repeated in one suite on two processes: the different answers, and how often each was given.

    An answer is the result, all measurements and every state of every vehicle.
    """
    suite = suite_in(program.folder, *(f"case{k}" for k in range(times)))
    with program.start("regress", suite, "--ego", "idm", "--workers", "2", "--out", "out") as process:
        _, errors = process.communicate(timeout=PATIENCE + SLOWEST * times)
    assert (process.returncode, without_progress(errors)) == (3, "")
    answers: Counter[str] = Counter()
    for case in results(program.folder / "out"):
        states = (program.folder / "out" / "runs" / case.pop("case") / "states.csv.gz").read_bytes()
        answers[json.dumps(case) + hashlib.sha256(states).hexdigest()] += 1
    return answers


@cache
def attacked() -> Path:
    """The folder of a run in which SUMO's IDM is hit by a vehicle that crosses its way."""
    home = Path(tempfile.mkdtemp(prefix="sumo_adv-tests-"))
    atexit.register(shutil.rmtree, home, ignore_errors=True)
    settings = {"until": "valid", "attempts": 8, "learn": "off", "memory": home / "bank.sqlite"}
    return sumo_adv.run(FOUND, out=home / "run", ego="idm", **settings).folder


def suite_in(folder: Path, *names: str, expect: Expectation | None = None) -> Path:
    """A suite with the attack kept once under each name, by default once."""
    for name in names or ("crossing",):
        keep_run(attacked(), folder / "suite", expect or Expectation(avoid="collision"), name)
    return folder / "suite"
