"""How many steps a second the environments of ``sumo_adv.gym`` make with 20 vehicles on one core.

``python benchmarks/environment_speed.py``; a minute and a half. Each row is an environment in a process of its own. It
runs whole episodes, with their resets and verdicts, and counts the CPU seconds of that process and of its engine, so
that other work on the machine does not count. What happens once, starting SUMO and planning the attacks, is taken off:
it is the time of the same process with one episode. Leaves with status 1 where a row is below ``BOUND``.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

BOUND = 200.0  # steps a second; the slowest row came to 284 to 432 on two cores of a shared machine
FEW = {"proposals": 4, "delays": (0.0,)}  # little to plan: what happens once is uncertain by a tenth of itself
ROWS: dict[str, tuple[str, dict[str, Any]]] = {
    "Ego-v0, nothing attacks": ("Ego-v0", {"attacker": None}),
    "Ego-v0, the expert attacks": ("Ego-v0", {"settings": FEW, "unattacked": 0.0}),
    "Ego-v0, attacks keep up": ("Ego-v0", {"settings": FEW, "unattacked": 0.0, "adapts": True}),
    "Ego-v0, speed and lane": ("Ego-v0", {"settings": FEW, "unattacked": 0.0, "actions": "lane"}),
    "Ego-v0, controls": ("Ego-v0", {"settings": FEW, "unattacked": 0.0, "actions": "controls"}),
    "Adversary-v0, endpoints": ("Adversary-v0", {"interval": 0.1}),
    "Adversary-v0, controls": ("Adversary-v0", {"actions": "controls"}),
    "parallel": ("parallel", {}),
}
SCENARIO = """\
schema = 1
network = "straight_3lane"

[demand]
files = ["traffic.rou.xml"]
begin = 0.0
end = 60.0

[ego]
id = "v{ego}"

[window]
warm_up = 0.0
trigger = 1.0
"""


def write_scenario(folder: Path, vehicles: int) -> Path:
    """A scenario with vehicles at 20 m/s, 30 m apart in each of three lanes; the ego drives among them."""
    rows = [
        f'<vehicle id="v{k}" depart="0" departLane="{k % 3}" departPos="{40 + 30 * (k // 3) + 10 * (k % 3)}" '
        'departSpeed="20"><route edges="eastbound"/></vehicle>'
        for k in range(vehicles)
    ]
    (folder / "traffic.rou.xml").write_text(f"<routes>{''.join(rows)}</routes>")
    target = folder / "traffic.toml"
    target.write_text(SCENARIO.format(ego=vehicles // 2))
    return target


def run(row: str, scenario: str, episodes: int) -> int:
    """Run a number of episodes in this process and return how many steps they had."""
    import gymnasium
    import numpy as np

    import sumo_adv.gym

    name, options = ROWS[row]
    steps = 0
    if name == "parallel":
        both = sumo_adv.gym.parallel_env(scenario, **options)
        for _ in range(episodes):
            both.reset(seed=0)
            while both.agents:
                both.step({agent: np.zeros(2, np.float32) for agent in both.agents})
                steps += 1
        both.close()
        return steps
    env = gymnasium.make(f"sumo_adv/{name}", scenario=scenario, **options)
    for _ in range(episodes):
        env.reset(seed=None if steps else 0)
        over = False
        while not over:
            *_, terminated, truncated, _ = env.step(np.zeros(env.action_space.shape, np.float32))
            over, steps = terminated or truncated, steps + 1
    env.close()
    return steps


def cost(row: str, scenario: Path, episodes: int) -> tuple[int, float]:
    """Steps, and CPU seconds of a process that makes them and of its engine."""
    command = [sys.executable, __file__, "--row", row, "--scenario", str(scenario), "--episodes", str(episodes)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    steps = int(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return steps, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, default=20)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--only", choices=tuple(ROWS), help="one row")
    parser.add_argument("--row", choices=tuple(ROWS), help=argparse.SUPPRESS)
    parser.add_argument("--scenario", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.row:
        print(run(given.row, given.scenario, given.episodes))
        return 0
    slow = []
    with tempfile.TemporaryDirectory() as folder:
        scenario = write_scenario(Path(folder), given.vehicles)
        for row in [given.only] if given.only else ROWS:
            (few, once), (steps, seconds) = cost(row, scenario, 1), cost(row, scenario, 1 + given.episodes)
            rate = (steps - few) / (seconds - once)
            print(f"{row:28s} {steps - few:6d} steps {rate:8.0f} steps per CPU second")
            slow += [row] if rate < BOUND else []
    print(f"At least {BOUND:.0f}: {'no: ' + ', '.join(slow) if slow else 'yes'}.")
    return 1 if slow else 0


if __name__ == "__main__":
    sys.exit(main())
