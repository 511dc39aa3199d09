"""Make ``memory_bank/experience.json``: numbers of the planners' modes that come off, by prediction.

``python benchmarks/experience.py --out FILE EGO:FOLDER ...``; some two seconds an encounter and core, ``lattice`` nine.
``EGO:FOLDER`` are suites that ``sumo-adv bench make --seed N --out FOLDER`` made, each with the driver to try it on.
In every encounter ``--draws`` proposals are drawn evenly; of each intent's mode and relation the best ``--best`` that
somebody could have avoided are kept.  Nobody drives: it is the expert's predictions alone.

What is shipped is from suites of seeds 41 to 43, on which no table of ``docs/results.md`` is measured:
``lattice:s41 careful:s41 krauss:s42 careful:s43 replay:s42``.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from attempt_cost import library

from sumo_adv.agents.experience import driver_class, scene_of
from sumo_adv.agents.expert import AVOIDABLE, Expert
from sumo_adv.agents.ways import families
from sumo_adv.config import load_settings
from sumo_adv.datatypes import Proposal
from sumo_adv.episode.foresight import Foresight
from sumo_adv.episode.loop import make_task
from sumo_adv.episode.task import Found
from sumo_adv.episode.worker import body
from sumo_adv.planning.sandbox import Sandbox
from sumo_adv.world.engine import Engine
from sumo_adv.world.inputs import load_input

AT_ONCE = 200  # proposals predicted together
Row = dict[str, Any]


def worked(ego: str, file: str, draws: int, best: int) -> list[Row]:
    """What comes off in one encounter."""
    source = load_input(Path(file))
    settings = load_settings(None, ego=ego, horizon=source.horizon)
    with (
        tempfile.TemporaryDirectory(prefix="sumo_adv-") as folder,
        Sandbox() as sandbox,
        Engine(body) as engine,
    ):
        engine.request("open", make_task(source, settings, Path(folder)))
        found = engine.request("seek", "")
        if not isinstance(found, Found):
            return []
        return _drawn(found, Foresight(sandbox, settings, found.drivable, found.situations), ego, draws, best)


def _drawn(found: Found, foresight: Foresight, ego: str, draws: int, best: int) -> list[Row]:
    ways, draw = families(found.situations, library()), random.Random(0)
    expert, good = Expert(foresight, proposals=4, seed=0), list[Proposal]()
    for first in range(0, draws if ways else 0, AT_ONCE):
        some = [ways[k % len(ways)].proposal(draw) for k in range(first, min(first + AT_ONCE, draws))]
        good += [p for p in foresight.score(some) if p.score < AVOIDABLE]
    groups: dict[tuple[str, str, str], list[Proposal]] = {}
    for p in sorted(good, key=expert.price):
        relation = found.situations[p.delay].targets[p.bv].relation
        groups.setdefault((relation, p.label, p.planner.mode), []).append(p)
    return [_row(found, p, relation, ego) for (relation, _, _), ones in groups.items() for p in ones[:best]]


def _row(found: Found, p: Proposal, relation: str, ego: str) -> Row:
    situation = found.situations[p.delay]
    scene = scene_of(situation, situation.targets[p.bv])
    numbers = [*scene, p.acceleration, *p.parameters.values()]
    return {
        "driver": driver_class(ego), "relation": relation, "mode": p.planner.mode, "parameters": list(p.parameters),
        "row": [round(float(v), 3) for v in numbers],  # type: ignore[arg-type]
    }  # fmt: skip


def written(rows: Iterable[Row]) -> str:
    """The file's text: a table for each driver, relation and mode, a line a row."""
    tables: dict[tuple[str, str, str, tuple[str, ...]], list[list[float]]] = {}
    for r in rows:
        key = (r["driver"], r["relation"], r["mode"], tuple(r["parameters"]))
        tables.setdefault(key, []).append(r["row"])
    texts = []
    for (driver, relation, mode, names), found in sorted(tables.items()):
        head = {"driver": driver, "relation": relation, "mode": mode, "parameters": names}
        lines = ",\n".join(json.dumps(row) for row in sorted(found))
        texts.append(f'{json.dumps(head)[:-1]}, "rows": [\n{lines}\n]}}')
    return '{"schema": 1, "modes": [\n' + ",\n".join(texts) + "\n]}\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """0, or 2 if there is nothing to draw from."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suites", nargs="+", metavar="EGO:FOLDER")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--draws", type=int, default=600, help="proposals drawn in each encounter")
    parser.add_argument("--best", type=int, default=2, help="kept of a mode and relation in each encounter")
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args(arguments)
    jobs = [
        (ego, str(file)) for ego, folder in (s.split(":", 1) for s in asked.suites)
        for file in sorted(Path(folder).glob("*.toml")) if file.name != "suite.toml"
    ]  # fmt: skip
    if not jobs:
        print("No scenario is in these folders: make one with `sumo-adv bench make`.", file=sys.stderr)
        return 2
    rows: list[Row] = []
    with ProcessPoolExecutor(asked.workers, mp_context=get_context("spawn")) as pool:
        tasks = [pool.submit(worked, ego, file, asked.draws, asked.best) for ego, file in jobs]
        for k, task in enumerate(tasks, 1):
            rows += task.result()
            print(f"{k} of {len(jobs)}: {len(rows)} came off", end="\r", file=sys.stderr)
    asked.out.write_text(written(rows))
    print(f"\n{asked.out}: {len(rows)} rows from {len(jobs)} encounters")
    return 0


if __name__ == "__main__":
    sys.exit(main())
