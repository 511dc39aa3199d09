"""What a search comes to at other step lengths of the simulation: for each scenario and step one run.

    python benchmarks/steps.py [--scenarios NAME,NAME] [--steps 0.05,0.1,0.2,0.5] [--until strict] [--attempts 60]

A cell has the level and the intent of the attempt that counts, and in how many attempts it was found. Each run makes
its attempts however long they take, so that a slow machine gives the same table.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

SCENARIOS = (
    "motorway_cut_in_left,onramp_cut_in,oncoming_country_road,signals_left_turn,priority_straight_from_right,"
    "neighbour_behind_left"
)


def outcome(scenario: str, step: str, until: str, attempts: int) -> dict[str, Any]:
    """``outcome.json`` of one run. Raises CalledProcessError."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "sumo_adv", "run", scenario, "--until", until, "--attempts", str(attempts)]
        command += ["--seconds", "3600", "--total-seconds", "0", "--learn", "off", "--out", "out", "--json"]
        home = {"XDG_DATA_HOME": folder, "SUMO_ADV_STEP_LENGTH": step}
        subprocess.run(command, cwd=folder, env={**os.environ, **home}, check=True, stdout=subprocess.DEVNULL)
        made: dict[str, Any] = json.loads((Path(folder) / "out" / "outcome.json").read_text(encoding="utf-8"))
        return made


def cell(made: dict[str, Any]) -> str:
    """What a run came to, in words."""
    verdict, best = made["outcome"], made["best"]
    if verdict is None or best is None:
        return f"{made['ending']} ({len(made['attempts'])})"
    return f"{verdict['level']}, {made['adversaries'][0]['intent']} ({best + 1} of {len(made['attempts'])})"


def main() -> None:
    """Print the table as Markdown."""
    reader = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    reader.add_argument("--scenarios", default=SCENARIOS)
    reader.add_argument("--steps", default="0.05,0.1,0.2,0.5")
    reader.add_argument("--until", default="strict")
    reader.add_argument("--attempts", type=int, default=60)
    given = reader.parse_args()
    steps = given.steps.split(",")
    print("| scenario | " + " | ".join(f"{step} s" for step in steps) + " |", "|" + "---|" * (len(steps) + 1), sep="\n")
    for scenario in given.scenarios.split(","):
        cells = [cell(outcome(scenario, step, given.until, given.attempts)) for step in steps]
        print(f"| `{scenario}` | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
