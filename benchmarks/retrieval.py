"""How long the memory takes.  ``python benchmarks/retrieval.py``; medians, one core, under 10 s in all.

Bounds (issue 4): a retrieval by words and a recall of a scene under 1 ms, with 7 intents and with 5,000.  Opening has
no bound: it is done once a run, and checks and reads the whole file.  A memory hit is a retrieval by words, the planner
loaded into a fresh session of a warm sandbox, its endpoint, and two seconds of trajectory towards that.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sumo_adv.datatypes import Limits, Planner
from sumo_adv.geometry import make_path
from sumo_adv.memory.bank import MemoryBank
from sumo_adv.memory.records import Evidence, IntentRecord, SceneSignature, StoredIntent
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.trajectory import PathEndpoint, PathRow, Scalar, advance, start, steer
from sumo_adv.planners.trial import probes

MANY = 5000
QUESTIONS = 200
SHIPPED = Path(__file__).resolve().parent.parent / "memory_bank.sqlite"
WORDS = [
    "brakes", "oncoming", "lane", "sudden", "front", "merges", "follows", "close", "left", "right", "turns", "crossing",
    "speeds", "swerves", "overtakes", "queue", "ramp", "roundabout", "zebra", "parked", "door", "cyclist", "tram",
    "bus", "siren", "fog", "gravel", "tunnel", "bridge", "exit", "toll", "shoulder", "median", "signal", "amber",
]  # fmt: skip


def median(work: Callable[[int], object], runs: int) -> float:
    """Median time of ``work(i)`` [ms]; the first call, which fills the caches, is not counted."""
    work(0)
    took = []
    for i in range(runs):
        start = time.perf_counter()
        work(i)
        took.append(time.perf_counter() - start)
    return 1000 * float(np.median(took))


def scene(number: int) -> SceneSignature:
    """One of ``MANY`` scenes, all of one kind, which is the slowest case."""
    rng = np.random.default_rng(number)
    relative = {"ahead": rng.uniform(-40, 40), "left": rng.uniform(-4, 4), "heading": rng.uniform(-0.2, 0.2)}
    relative |= {"speed": rng.uniform(0, 30), "ego_speed": rng.uniform(0, 30)}
    return SceneSignature("straight", "neighbour", {k: round(float(v), 2) for k, v in relative.items()}, "idm")


def stored_intents() -> list[StoredIntent]:
    """``MANY`` intents with a planner and a success each."""
    rng = np.random.default_rng(0)
    made = []
    for i in range(MANY):
        label = f"{' '.join(rng.choice(WORDS, 3))} v{chr(97 + i % 26)}{chr(97 + i // 26 % 26)}{chr(97 + i // 676)}"
        planner = Planner(label, "plain", f"PARAMETERS = {{}}  # {i}\n", (), "expert")
        evidence = Evidence(
            label=label, planner_hash=planner.hash, scene=scene(i), attempts=1, min_ttc=0.5, collided=False,
            critical=True, feasible=True, rear_end=False, valid=None, strict=None, version="0", network="n", seed=i,
        )  # fmt: skip
        intent = IntentRecord(label, " ".join(rng.choice(WORDS, 25)), ("neighbour",))
        made.append(StoredIntent(intent, (planner,), evidence=(evidence,)))
    return made


def hit_time(bank: MemoryBank) -> float:
    """A whole memory hit [ms]: a leader 18 m ahead on a straight road."""
    probe = probes("leader")[3]
    line = make_path([(0.0, 0.0), (250.0, 0.0)])
    road, limits = PathRow(line), Limits()

    def hit(i: int) -> float:
        retrieved = bank.retrieve(f"Sudden stop {i}", "The lead car brakes hard and unexpectedly.")
        planner = bank.planners(str(retrieved.hit))[0]
        with sandbox.session(planner, {"bv": probe.road}) as session:
            end = session.endpoint("bv", probe.bv, probe.ego, planner.defaults(), 0.0, 8.0)
        motion = start(Scalar, 18.0, 0.0, 0.0, float(probe.bv["speed"]), 0.0)
        goal = PathEndpoint(end["x"], end["y"], end["speed"], end["time"])
        motion = steer(Scalar, motion, goal, 0.0)
        for _ in range(20):
            motion = advance(Scalar, motion, goal, road, limits, 30.0, 0.1, True)
        return float(motion.s)

    with Sandbox() as sandbox:
        return median(hit, 50)


def reopen(path: Path) -> None:
    """Open and close."""
    MemoryBank.open(path, read_only=True).close()


def main() -> int:
    """Print a line a figure; 1 if one is over its bound."""
    rows: list[tuple[str, float, float | None]] = []
    query = "A vehicle ahead of us stops suddenly on the bridge, and the tram follows."
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "many.sqlite"
        with MemoryBank.open(path) as bank:
            bank.absorb(stored_intents())
        with MemoryBank.open(SHIPPED, read_only=True) as bank:
            count = len(bank.intents())
            rows.append(
                (f"retrieve by words, {count} intents", median(lambda i: bank.retrieve(f"{i}", query), 200), 1.0)
            )
            rows.append((f"whole memory hit, {count} intents", hit_time(bank), None))
        rows.append((f"open, {count} intents", median(lambda i: reopen(SHIPPED), 15), None))
        with MemoryBank.open(path) as bank:
            labels = [record.label for record in bank.intents()]
            rows.append((f"retrieve by words, {MANY} intents", median(lambda i: bank.retrieve("x", query), 200), 1.0))
            rows.append(
                (f"retrieve a known label, {MANY} intents", median(lambda i: bank.retrieve(labels[i]), 200), 1.0)
            )
            near = [scene(i) for i in range(QUESTIONS)]
            rows.append((f"recall a scene, {MANY} rows", median(lambda i: bank.recall_scene(near[i]), QUESTIONS), 1.0))
            start = time.perf_counter()
            bank.refresh()
            bank.recall_scene(near[0])
            rows.append((f"the first recall, {MANY} rows, with reading", 1000 * (time.perf_counter() - start), None))
        rows.append((f"open, {MANY} intents, planners and rows", median(lambda i: reopen(path), 3), None))
    for name, took, bound in rows:
        print(f"{name:<45} {took:9.3f} ms{'' if bound is None else f'   (bound {bound:g} ms)'}")
    return int(any(bound is not None and took > bound for _, took, bound in rows))


if __name__ == "__main__":
    sys.exit(main())
