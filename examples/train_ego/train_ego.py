"""Train an ego by PPO of stable-baselines3, without attacks, against a fixed set of them, or against some that keep up.

    python train_ego.py                     half an hour; writes trained_ego.npz and trained_ego.csv
    python train_ego.py --attacks fixed --minutes 5 --actors 2 --scenario motorway_cut_in_left
    python train_ego.py --decisions 100000  so that egos are comparable that a busy machine trained

Each actor is a process with an environment and a copy of the policy in numpy; it drives for ``STEPS`` steps at a time,
while stable-baselines3 learns from the steps before. (``PPO(.., SubprocVecEnv(..))`` works, too, but then all
environments wait wherever one of them judges an attack or goes back to its trigger.)
"""

from __future__ import annotations

import argparse
import csv
import multiprocessing as mp
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from encounters import training
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.logger import configure
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import nn
from trained_ego import CUT, ENVIRONMENT, FILE, FIRST, OTHER, OWN, PEDALS, ROW, SCALE, VEHICLES, Network

import sumo_adv.gym  # registers the environment
from sumo_adv.errors import SumoAdvError

ATTACKS: dict[str, dict[str, Any]] = {
    "none": {"attacker": None},
    "fixed": {"attacker": "expert", "unattacked": 0.3},
    "keep_up": {"attacker": "expert", "unattacked": 0.3, "adapts": True},
}
STARTS = {"idm": (1.5, 0.0), "braking": (1.5, 3.0), "nothing": (0.0, 0.0)}
"""What is added, before anything is learnt, to the logit of full acceleration, and to that of full braking while the
observation shows a danger. An ego that always accelerates drives as SUMO's IDM, so the first imitates that at no cost,
and still brakes in one decision of seven. The second also brakes where the careful driver sees a danger."""
STEPS = 256  # of an actor at a time, of 0.3 s each
REWARD = 0.2  # rewards are multiplied by it, so that returns are about 1
WIDTH = 48  # features of a vehicle
COLUMNS = ("minutes", "steps", "episodes", "return", "attacked", "contact", "valid", "serious", "behind")
FAILURES = 20  # scenarios in a row that cannot be opened
OPENED = 5  # resets for each scenario before the first step: opening one takes seconds, in which all others would wait


class Vehicles(BaseFeaturesExtractor):
    """The part of ``trained_ego.Network`` that looks at the vehicles, in torch."""

    def __init__(self, observation_space: spaces.Box) -> None:
        super().__init__(observation_space, FIRST + WIDTH)
        self.register_buffer("scale", torch.as_tensor(SCALE))
        self.encoder = nn.Sequential(nn.Linear(ROW, WIDTH), nn.Tanh(), nn.Linear(WIDTH, WIDTH), nn.Tanh())

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        x = torch.clip(observations * self.scale, -CUT, CUT)
        vehicles = x[:, FIRST:].reshape(-1, VEHICLES, OTHER)
        rows = torch.cat([vehicles, x[:, None, [0, 5]].expand(-1, VEHICLES, -1)], dim=2)
        return torch.cat([x[:, :FIRST], self.encoder(rows).amax(dim=1)], dim=1)


class Spaces(gymnasium.Env[Any, Any]):
    """Tells stable-baselines3 what the actors' environments look like."""

    observation_space = sumo_adv.gym.views.Viewing(VEHICLES, danger=True).space(adversary=False)
    action_space = spaces.Discrete(len(PEDALS))


def learner(actors: int, seed: int, start: str) -> PPO:
    """A policy that has learnt nothing yet, and what trains it. ``start``: one of ``STARTS``."""
    torch.set_num_threads(1)
    model = PPO(
        "MlpPolicy", DummyVecEnv([Spaces] * actors), n_steps=STEPS, batch_size=128, n_epochs=8, gamma=0.97,
        learning_rate=1e-3, ent_coef=0.01, target_kl=0.08, seed=seed, device="cpu",
        policy_kwargs={"features_extractor_class": Vehicles, "net_arch": [64, 64]},
    )  # fmt: skip
    accelerating, braking = STARTS[start]
    with torch.no_grad():
        policy = model.policy
        policy.action_net.bias[-1] = accelerating
        if braking:  # one unit of each layer passes the danger on, as about 1
            for layer, source in zip(policy.mlp_extractor.policy_net[::2], (OWN, 0), strict=True):
                layer.weight[0], layer.bias[0] = 0.0, 0.0
                layer.weight[0, source] = 2.0
            policy.action_net.weight[:, 0] = torch.tensor([braking, 0.0, 0.0, -accelerating])
    model.set_logger(configure(None, [""]))
    return model


def weights_of(model: PPO) -> dict[str, np.ndarray[Any, Any]]:
    """The weights of the policy as ``trained_ego.Network`` wants them."""
    policy = model.policy
    parts = (
        ("encoder", policy.features_extractor.encoder), ("policy", policy.mlp_extractor.policy_net),
        ("action", policy.action_net),
    )  # fmt: skip
    return {f"{part}.{n}": v.detach().numpy().copy() for part, module in parts for n, v in module.named_parameters()}


def save(model: PPO, out: Path) -> None:
    """Write the weights. Where the program is ended, the last ones are whole."""
    half = out.with_suffix(".half.npz")
    np.savez_compressed(half, **weights_of(model))
    half.replace(out)


# -- the actors ---------------------------------------------------------------------------------------------------


def drive(connection: Connection, options: dict[str, Any], seed: int) -> None:
    """An actor: gets weights, drives ``STEPS`` steps with them, and sends what happened, until it gets None."""
    env = gymnasium.make("sumo_adv/Ego-v0", **options, **ENVIRONMENT)
    draws = np.random.default_rng(seed)
    for k in range(OPENED * len(options["scenario"])):
        _begin(env, None if k else seed)
    seen, start, total = _begin(env, None), True, 0.0
    while (weights := connection.recv()) is not None:
        network = Network(weights)
        steps: dict[str, list[Any]] = {name: [] for name in ("seen", "action", "reward", "start")}
        cut: list[tuple[int, Any]] = []  # step and last observation of episodes that were truncated
        episodes: list[dict[str, Any]] = []
        for k in range(STEPS):
            action = int(np.argmax(network.logits(seen) + draws.gumbel(size=len(PEDALS))))  # a draw by their chances
            after, reward, terminated, truncated, info = env.step(PEDALS[[action]])
            for name, value in zip(steps, (seen, action, REWARD * float(reward), start), strict=True):
                steps[name].append(value)
            seen, start, total = after, terminated or truncated, total + float(reward)
            if start:
                if truncated:
                    cut.append((k, seen))
                episodes.append({
                    "return": total, "attacked": bool(info["attack"]), "contact": info["ending"] == "contact",
                    "level": info.get("level", ""), "behind": info["behind"],
                })  # fmt: skip
                seen, total = _begin(env, None), 0.0
        connection.send(({name: np.array(values) for name, values in steps.items()}, seen, start, cut, episodes))
    env.close()


def _begin(env: gymnasium.Env[Any, Any], seed: int | None) -> Any:
    """The first observation of an episode. Where a scenario cannot be opened, the next draw may be another one."""
    for _ in range(FAILURES):
        try:
            return env.reset(seed=seed)[0]
        except SumoAdvError as error:
            print(f"left out: {error}", flush=True)
            seed = None
    raise SystemExit("No scenario can be opened.")


@contextmanager
def running(scenarios: Sequence[Any], attacks: str, actors: int, seed: int) -> Iterator[list[Connection]]:
    """Actors, each with its share of the scenarios."""
    context = mp.get_context("spawn")
    connections, processes = [], []
    for k in range(actors):
        own = list(scenarios[k::actors]) or [scenarios[k % len(scenarios)]]
        here, there = context.Pipe()
        options = {"scenario": own, **ATTACKS[attacks]}
        processes.append(context.Process(target=drive, args=(there, options, 1000 * seed + k)))
        processes[-1].start()
        there.close()
        connections.append(here)
    try:
        yield connections
    finally:
        for connection in connections:
            connection.close()
        for process in processes:
            process.join(10.0)
            process.terminate()


# -- the learner --------------------------------------------------------------------------------------------------


def train(
    scenarios: Sequence[Any], attacks: str, minutes: float, most: int, actors: int, seed: int, start: str, out: Path
) -> None:
    """Train for some minutes, or until ``most`` decisions; the weights and the course of the training are written all
    the while."""
    model = learner(actors, seed, start)
    episodes: list[dict[str, Any]] = []
    began = time.monotonic()
    with running(scenarios, attacks, actors, seed) as connections, out.with_suffix(".csv").open("w") as file:
        course = csv.writer(file)
        course.writerow(COLUMNS)
        for connection in connections:
            connection.send(weights_of(model))
        while True:
            rollouts = [connection.recv() for connection in connections]
            spent = (time.monotonic() - began) / 60
            goes_on = spent < minutes and model.num_timesteps + STEPS * actors < most
            for connection in connections:  # they drive on while the learner learns
                connection.send(weights_of(model) if goes_on else None)
            _learn(model, rollouts)
            fresh = [episode for *_, ended in rollouts for episode in ended]
            episodes += fresh
            course.writerow([f"{v:.4g}" for v in _row(spent, model, len(episodes), fresh)])
            file.flush()
            save(model, out)
            if not goes_on:
                break


def _learn(model: PPO, rollouts: Sequence[Any]) -> None:
    """An update of PPO by the steps of all actors. They were driven with the policy of one update before: its
    probabilities count, and values are those of now."""
    buffer, policy = model.rollout_buffer, model.policy
    buffer.reset()
    for k, (steps, _, _, cut, _) in enumerate(rollouts):
        for step, last in cut:  # the episode would have gone on
            steps["reward"][step] += model.gamma * float(_values(model, last[None])[0])
        with torch.no_grad():
            seen, action = torch.as_tensor(steps["seen"]), torch.as_tensor(steps["action"])
            values, log_probs, _ = policy.evaluate_actions(seen, action)
        buffer.observations[:, k], buffer.actions[:, k, 0] = steps["seen"], steps["action"]
        buffer.rewards[:, k], buffer.episode_starts[:, k] = steps["reward"], steps["start"]
        buffer.values[:, k], buffer.log_probs[:, k] = values.flatten().numpy(), log_probs.numpy()
    buffer.full = True
    last = torch.as_tensor(np.array([seen for _, seen, *_ in rollouts]))
    buffer.compute_returns_and_advantage(_values(model, last), np.array([start for _, _, start, *_ in rollouts]))
    model.num_timesteps += STEPS * len(rollouts)
    model.train()


def _values(model: PPO, seen: Any) -> torch.Tensor:
    with torch.no_grad():
        return model.policy.predict_values(torch.as_tensor(seen))


def _row(minutes: float, model: PPO, count: int, fresh: Sequence[dict[str, Any]]) -> tuple[float, ...]:
    attacked = [e for e in fresh if e["attacked"]]
    alone = [e for e in fresh if not e["attacked"]]

    def share(*levels: str) -> float:
        return float(np.mean([e["level"] in levels for e in attacked])) if attacked else np.nan

    return (
        minutes, model.num_timesteps, count, _mean([e["return"] for e in fresh]), len(attacked),
        _mean([e["contact"] for e in fresh]), share("valid", "strict", "serious"), share("serious"),
        _mean([e["behind"] for e in alone]),
    )  # fmt: skip


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else np.nan


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--attacks", choices=ATTACKS, default="keep_up")
    parser.add_argument("--start", choices=STARTS, default="idm", help="how the ego drives before it has learnt")
    parser.add_argument("--minutes", type=float, default=30.0, help="0: leave the policy untrained")
    parser.add_argument("--decisions", type=int, default=sys.maxsize, help="end after this number (default: none)")
    parser.add_argument("--actors", type=int, default=os.cpu_count() or 2, help="processes that drive")
    parser.add_argument("--scenario", action="append", help="repeatable (default: those of encounters.py)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=FILE)
    given = parser.parse_args()
    if given.minutes > 0:
        scenarios = given.scenario or training()
        train(
            scenarios, given.attacks, given.minutes, given.decisions, given.actors, given.seed, given.start, given.out
        )
    else:
        save(learner(1, given.seed, given.start), given.out)


if __name__ == "__main__":
    main()
