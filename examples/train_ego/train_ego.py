"""Train an ego against the built-in expert, and measure how often it is hit before and after.

    python train_ego.py                     about ten minutes on one core; writes trained_ego.zip
    python train_ego.py --steps 2000 --episodes 5 --scenario motorway_cut_in_left

The agent chooses target speed and lane five times a second (``trained_ego.py:ENVIRONMENT``). It is trained against the
attacks that the expert plans with seed 0, and measured against those that it plans with seed 1.
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import Any

import gymnasium
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from trained_ego import ENVIRONMENT, FILE

import sumo_adv.gym
from sumo_adv.metrics.statistics import wilson

SCENARIOS = ("motorway_cut_in_left", "neighbour_ahead_left", "neighbour_behind_right", "leader_two_lanes")
STEPS = 100_000  # of 0.2 s
VALID = ("valid", "strict", "serious")


def environment(scenarios: list[str], seed: int) -> gymnasium.Env[Any, Any]:
    """The environment, known since ``sumo_adv.gym`` was imported, with the attacks that are planned with a seed."""
    return gymnasium.make("sumo_adv/Ego-v0", scenario=scenarios, settings={"seed": seed}, **ENVIRONMENT)


def measured(model: PPO, env: gymnasium.Env[Any, Any], episodes: int) -> str:
    """A row of the table: in how many episodes the attack was valid, serious, and what else happened."""
    levels: Counter[str] = Counter()
    endings: Counter[str] = Counter()
    speeds: list[float] = []
    for episode in range(episodes):
        seen, _ = env.reset(seed=episode)
        over = False
        while not over:
            seen, _, terminated, truncated, info = env.step(model.predict(seen, deterministic=True)[0])
            speeds.append(float(seen[0]) * sumo_adv.gym.views.FAST)
            over = terminated or truncated
        levels[info.get("level", "none")] += 1
        endings[info["ending"]] += 1
    valid = sum(levels[level] for level in VALID)
    counts = (valid, levels["serious"], endings["contact"])
    rates = " | ".join(wilson(count, episodes).text() for count in counts)
    return f"{rates} | {sum(speeds) / len(speeds):.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=STEPS, help="of training")
    parser.add_argument("--episodes", type=int, default=200, help="of measuring, before and after")
    parser.add_argument("--scenario", action="append", help=f"repeatable (default: {', '.join(SCENARIOS)})")
    parser.add_argument("--out", type=Path, default=Path(FILE))
    parser.add_argument("--seed", type=int, default=0, help="of the training")
    given = parser.parse_args()
    torch.set_num_threads(1)
    scenarios = given.scenario or list(SCENARIOS)
    training, measuring = Monitor(environment(scenarios, 0)), environment(scenarios, 1)
    model = PPO(
        "MlpPolicy", training, n_steps=min(1024, given.steps), batch_size=min(128, given.steps), gamma=0.98,
        seed=given.seed, device="cpu",
    )  # fmt: skip
    print("| ego | valid | serious | any contact | mean speed [m/s] |\n|---|---|---|---|---|")
    print(f"| before training | {measured(model, measuring, given.episodes)} |", flush=True)
    model.learn(given.steps)
    model.save(given.out)
    print(f"| after {model.num_timesteps} steps | {measured(model, measuring, given.episodes)} |")
    training.close()
    measuring.close()


if __name__ == "__main__":
    main()
