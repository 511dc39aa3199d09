"""What the workers of a hunt spend their time on, with a driver that takes 30 ms a step.

    python benchmarks/hunt_shares.py [INPUT ...] [--minutes 2] [--ego benchmarks.hunt_shares:Thinker] [--json]

part        share of the time of all workers (worker processes x time of the hunt)
attempts    attempts; ``robustness``: neighbours of a success; ``references``: reference drivers in the loop
seek        the simulation until an encounter comes; ``unattacked``: the drive without an attack from there on
between     workers start, or wait for the last episode of a round

The hunt must end within a tenth of its minutes after them, and attempts, neighbours and reference drivers must take at
least half of the time (exit status 1 otherwise).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import sumo_adv

INPUTS = ("motorway", "signalised_wide", "urban_street")
ATTACKING = ("attempts", "robustness", "references")
LEAST_SHARE = 0.5
LATEST = 1.1  # of the minutes


class Thinker:
    """Lets SUMO drive, but takes 30 ms for each answer."""

    name = "thinker"
    forkable = True

    def reset(self, seed: int) -> None:
        """Do nothing: there is nothing to forget."""

    def act(self, seen: sumo_adv.Observation) -> None:
        """Return None, late."""
        time.sleep(0.03)


def main() -> int:
    reader = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    reader.add_argument("inputs", nargs="*", default=INPUTS)
    reader.add_argument("--minutes", type=float, default=2.0)
    reader.add_argument("--ego", default="benchmarks.hunt_shares:Thinker")
    reader.add_argument("--json", action="store_true")
    given = reader.parse_args()
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        hunt = sumo_adv.hunt(given.inputs, ego=given.ego, minutes=given.minutes, out=Path(folder) / "hunt").found
    took, total = time.perf_counter() - began, sum(hunt.spent.values())
    shares = {part: seconds / total for part, seconds in sorted(hunt.spent.items(), key=lambda each: -each[1])}
    attacking = sum(shares.get(part, 0.0) for part in ATTACKING)
    in_time, enough = took <= 60.0 * given.minutes * LATEST, attacking >= LEAST_SHARE
    if given.json:
        print(json.dumps({"seconds": took, "episodes": hunt.episodes, "attempts": hunt.attempts, "shares": shares}))
    else:
        print(f"{took:.1f} s, {hunt.episodes} episodes, {hunt.attempts} attempts, {len(hunt.failures)} failures")
        for part, share in shares.items():
            print(f"{part:12} {share:.3f}")
        print(f"attempts, robustness and references: {attacking:.2f} (bound {LEAST_SHARE:g})")
    return 0 if in_time and enough else 1


if __name__ == "__main__":
    sys.exit(main())
