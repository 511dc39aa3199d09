"""The environments, with real SUMO: the checks of gymnasium and PettingZoo, endings, rewinding, processes."""

from __future__ import annotations

import copy
import importlib.util
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from cli_samples import ROOT
from gymnasium.utils.env_checker import check_env
from model_server import ModelServer
from pettingzoo.test import parallel_api_test
from scripted_models import Author

import sumo_adv.gym
from sumo_adv.datatypes import Verdict
from sumo_adv.drivers import Action, Observation
from sumo_adv.errors import UsageError
from sumo_adv.gym.rewards import CONTACT_LOSS_S, LOSS_S_PER_DELTA_V, Transition

QUICK = {"proposals": 4, "delays": (0.0,), "duration": 6.0}  # little to predict
STILL, COAST = np.zeros(2, np.float32), np.zeros(1, np.float32)  # of two numbers, and of pedals


@pytest.fixture(autouse=True)
def own_bank(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The shipped bank, copied; matplotlib draws into nothing."""
    monkeypatch.setenv("SUMO_ADV_MEMORY", str(tmp_path / "bank.sqlite"))
    monkeypatch.setenv("MPLBACKEND", "Agg")
    return iter([None])


def made(name: str, scenario: object = "neighbour_ahead_left", **options: Any) -> gymnasium.Env[Any, Any]:
    return gymnasium.make(f"sumo_adv/{name}", scenario=scenario, **options)


def episode(env: gymnasium.Env[Any, Any], action: np.ndarray, seed: int | None = None) -> tuple[list[Any], Any, Any]:
    """Observations, the last step, and its info, of an episode with one action throughout."""
    seen, info = env.reset(seed=seed)
    all_seen, over, last = [seen], False, None
    while not over:
        last = env.step(action)
        all_seen.append(last[0])
        over = last[2] or last[3]
    return all_seen, last, last[4] if last else info


# ---- the checks of both packages


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("Ego-v0", {"attacker": None, "actions": "lane", "observations": "dict"}),
        ("Ego-v0", {"settings": QUICK, "unattacked": 0.0, "danger": True}),
        ("Adversary-v0", {"actions": "endpoint", "observations": "dict"}),
        ("Adversary-v0", {"actions": "controls", "ego": "careful"}),
    ],
)
def test_gymnasium_finds_nothing_to_say(name: str, options: dict[str, Any]) -> None:
    env = made(name, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env.unwrapped, skip_render_check="lane" not in options.values())  # each check opens two more of them


def test_pettingzoo_finds_nothing_to_say() -> None:
    env = sumo_adv.gym.parallel_env("neighbour_ahead_left", settings={"duration": 4.0})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        parallel_api_test(env, num_cycles=60)
    env.close()


# ---- endings


def test_without_an_attack_the_time_is_over_after_the_duration() -> None:
    env = made("Ego-v0", attacker=None, actions="lane", settings={"duration": 2.0}, interval=0.2)
    seen, last, info = episode(env, STILL)
    env.close()
    assert (len(seen), last[2:4]) == (11, (False, True))
    assert (info["ending"], info["attack"], info["scenario"]) == ("time_limit", "", "neighbour_ahead_left")
    assert "verdict" not in info
    assert info["time"] == pytest.approx(env.reset()[1]["time"] + 2.0)
    env.close()


def test_the_expert_hits_an_ego_that_goes_straight_on() -> None:
    env = made("Ego-v0", settings=QUICK, unattacked=0.0)
    _, (_, reward, terminated, truncated, _), info = episode(env, COAST, seed=0)
    env.close()
    assert info["ending"] == "contact"
    assert (terminated, truncated) == (True, False)
    assert reward < -(CONTACT_LOSS_S + LOSS_S_PER_DELTA_V * info["verdict"].delta_v) + 0.1
    assert info["touched"]
    assert isinstance(info["verdict"], Verdict)
    assert info["verdict"].collided
    assert info["level"] in ("collision", "valid", "strict", "serious")


def test_a_language_model_attacks_as_it_chose(monkeypatch: pytest.MonkeyPatch) -> None:
    with ModelServer(Author("Aggressive Cut-in")) as server:
        for name, value in server.environment().items():
            monkeypatch.setenv(name, value)
        env = made("Ego-v0", attacker="scripted", settings=QUICK, unattacked=0.0)
        attacks = [env.reset(seed=0)[1]["attack"], env.reset()[1]["attack"]]
        env.close()
    assert attacks == ["Aggressive Cut-in"] * 2
    assert len(server.asked) == 1  # once an encounter


@pytest.mark.parametrize("name", ["Ego-v0", "Adversary-v0"])
def test_a_vehicle_that_turns_off_the_road_ends_the_episode(name: str) -> None:
    options: dict[str, Any] = {"attacker": None} if name == "Ego-v0" else {}
    env = made(name, actions="controls", **options)
    _, last, info = episode(env, np.array([0.0, 1.0], np.float32))
    env.close()
    assert (info["ending"], last[2], last[3]) == ("off_road", True, False)
    assert info.get("level", "none") == "none"


def test_both_agents_are_there_to_the_end() -> None:
    env = sumo_adv.gym.parallel_env("neighbour_ahead_left", rewards={"ego": lambda t: 7.0}, interval=0.5)
    env.reset(seed=1)
    steps = 0
    while env.agents:
        _, rewards, terminated, truncated, infos = env.step({"ego": STILL, "adversary": STILL})
        steps += 1
        assert rewards["ego"] == 7.0
    env.close()
    assert set(terminated) == set(truncated) == {"ego", "adversary"}
    assert infos["ego"]["ending"] in ("time_limit", "passed", "off_road")
    assert 2 <= steps <= 24


def test_an_ego_that_fails_truncates_the_episode_and_the_next_one_begins() -> None:
    env = made("Adversary-v0", ego=FailsWhenOvertaken, actions="controls", render_mode="rgb_array")
    env.reset(seed=0)
    truncated = False
    while not truncated:
        _, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0], np.float32))
    assert (reward, terminated, truncated, info["ending"]) == (0.0, False, True, "crashed")
    assert "No idea what to do" in info["why"]
    assert np.unique(env.render()).size <= 3  # a picture of one colour
    assert "ending" not in env.reset()[1]
    env.close()


class FailsWhenOvertaken:
    """Traffic goes at 20 m/s, unless an agent drives it."""

    forkable = True

    def reset(self, seed: int) -> None:
        pass

    def act(self, observation: Observation) -> Action:
        if any(v.speed > 24.0 for v in observation.others):
            raise ValueError("No idea what to do")
        return None


# ---- rewinding and seeds


@pytest.mark.parametrize("fork", [True, False])
def test_a_seed_repeats_its_episodes_bit_for_bit(fork: bool) -> None:
    env = made("Adversary-v0", ["neighbour_ahead_left", "motorway_cut_in_left"], actions="controls",
               settings={"fork": fork, "duration": 3.0})  # fmt: skip
    soft = np.array([0.5, -0.05], np.float32)
    first = [episode(env, soft, seed=5), episode(env, soft)]
    again = [episode(env, soft, seed=5), episode(env, soft)]
    env.close()
    for (seen, _, info), (seen_again, _, info_again) in zip(first, again, strict=True):
        assert info["scenario"] == info_again["scenario"]
        assert np.array_equal(np.array(seen), np.array(seen_again))


def test_an_expert_that_adapts_tries_other_attacks_until_a_seed_makes_it_forget() -> None:
    env = made("Ego-v0", adapts=True, unattacked=0.0, settings=QUICK, interval=0.5)
    first = episode(env, COAST, seed=2)
    second = episode(env, COAST)
    again = episode(env, COAST, seed=2)
    env.close()
    assert not np.array_equal(first[0][-1], second[0][-1])
    assert np.array_equal(np.array(first[0]), np.array(again[0]))


def test_a_share_of_the_episodes_has_no_attack() -> None:
    env = made("Ego-v0", unattacked=0.5, settings=QUICK, interval=0.5)
    env.reset(seed=0)
    attacks = [env.reset()[1]["attack"] for _ in range(12)]
    env.close()
    assert 2 <= attacks.count("") <= 10


def test_who_drives_on_as_unattacked_loses_nothing_and_who_stands_falls_behind() -> None:
    env = made("Ego-v0", attacker=None, settings={"duration": 4.0}, interval=0.5)
    env.reset(seed=0)
    gone = [env.step(np.array([0.5], np.float32)) for _ in range(4)]
    env.reset(seed=0)
    braked = [env.step(np.array([-1.0], np.float32)) for _ in range(4)]
    env.close()
    assert sum(reward for _, reward, *_ in gone) == pytest.approx(0.0, abs=0.02)
    assert gone[-1][4]["behind"] < 0.5
    assert braked[-1][4]["behind"] > 10.0  # 8 m/s2 for 2 s
    assert sum(reward for _, reward, *_ in braked) < -1.0


def test_the_reward_is_the_users_own_function() -> None:
    transitions: list[Transition] = []

    def reward(t: Transition) -> float:
        transitions.append(t)
        return t.seconds

    env = made("Adversary-v0", reward=reward)
    env.reset(seed=0)
    assert env.step(np.zeros(4, np.float32))[1] == pytest.approx(0.5)
    env.close()
    ego, adversary = transitions[0].ego, transitions[0].adversary
    assert ego is not None
    assert adversary is not None
    assert transitions[0].apart == pytest.approx(float(np.hypot(ego.x - adversary.x, ego.y - adversary.y)))


# ---- processes and pictures


def test_environments_run_side_by_side_in_processes() -> None:
    many = gymnasium.make_vec(
        "sumo_adv/Ego-v0", num_envs=2, scenario=["neighbour_ahead_left", "leader_two_lanes"], attacker=None,
        settings={"duration": 1.0},
    )  # fmt: skip
    seen, info = many.reset(seed=4)
    assert seen.shape == (2, 133)
    assert list(info["scenario"]) == ["neighbour_ahead_left", "leader_two_lanes"]
    for _ in range(12):
        *_, truncated, info = many.step(np.zeros((2, 1), np.float32))
        if truncated.any():
            break
    many.close()
    assert list(info["ending"]) == ["time_limit", "time_limit"]


def test_two_in_one_process_do_not_disturb_each_other() -> None:
    alone, beside = made("Ego-v0", attacker=None), made("Ego-v0", "motorway_cut_in_left", attacker=None)
    alone.reset(seed=0)
    undisturbed = copy.deepcopy(alone.step(COAST)[0])
    alone.reset(seed=0)
    beside.reset(seed=0)
    beside.step(COAST)
    assert np.array_equal(alone.step(COAST)[0], undisturbed)
    alone.close()
    beside.close()


def test_a_picture_shows_ego_and_adversary_in_their_colours() -> None:
    env = made("Adversary-v0", render_mode="rgb_array")
    with pytest.raises(UsageError, match="nothing to show before the first reset"):
        env.unwrapped.render()
    env.reset(seed=0)
    picture = np.asarray(env.render())
    env.close()
    assert (picture.shape, picture.dtype) == ((480, 480, 3), np.uint8)
    blue, red = (np.all(picture == colour, axis=-1) for colour in ((31, 102, 184), (200, 48, 40)))
    assert blue[240, 240]  # the ego is in the middle
    assert 40 < red.sum() < 400  # a car of 5 by 2 m at 4 pixels a metre, without its outline


# ---- wrong use


@pytest.mark.parametrize(
    ("name", "options", "sentence"),
    [
        ("Ego-v0", {"actions": "wheel"}, "There are no actions 'wheel'; choose pedals or controls or lane."),
        ("Adversary-v0", {"actions": "lane"}, "There are no actions 'lane'; choose endpoint or controls."),
        ("Ego-v0", {"observations": "image"}, "There are no observations 'image'; choose vector or dict."),
        ("Ego-v0", {"interval": 0.0}, "interval is 0 s; it must be above 0 and at most 5."),
        ("Ego-v0", {"vehicles": 0}, "vehicles is 0; it must be 1 or more."),
        ("Ego-v0", {"unattacked": 30.0}, "unattacked is 30; it is a share, from 0 to 1."),
        ("Ego-v0", {"scenario": []}, "An environment needs a scenario."),
        ("Ego-v0", {"scenario": "no_such_place"}, "no_such_place"),
        ("Ego-v0", {"settings": {"ego": "idm"}}, "The setting 'ego' of an environment follows from"),
        ("Ego-v0", {"settings": {"durration": 3}}, "durration"),
        ("Adversary-v0", {"ego": "fangio"}, "There is no ego 'fangio'"),
    ],
)
def test_wrong_use_is_refused_in_a_sentence(name: str, options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(UsageError) as refused:
        made(name, **{"scenario": "neighbour_ahead_left", **options}).reset(seed=0)
    assert sentence in str(refused.value)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(("kind", "count"), [("pedals", 1), ("controls", 2), ("lane", 2)])
def test_an_action_that_is_not_finite_is_named_and_nothing_moves(kind: str, count: int, bad: float) -> None:
    env = made("Ego-v0", attacker=None, actions=kind).unwrapped
    _, info = env.reset(seed=0)
    action = np.zeros(count, np.float32)
    action[-1] = bad
    with pytest.raises(UsageError, match=rf"action of the agent 'ego' is \[.*{bad}\]: its numbers must be finite"):
        env.step(action)
    assert env.step(np.zeros(count, np.float32))[4]["time"] == pytest.approx(info["time"] + 0.1)
    env.close()


@pytest.mark.parametrize("kind", ["endpoint", "controls"])
def test_an_adversarys_action_is_checked_too(kind: str) -> None:
    env = made("Adversary-v0", actions=kind).unwrapped
    env.reset(seed=0)
    count = env.action_space.shape[0]
    with pytest.raises(UsageError, match=r"action of the agent 'adversary' is .*nan.*: its numbers must be finite"):
        env.step(np.full(count, np.nan, np.float32))
    for wrong in (np.zeros((1, count)), np.zeros(count + 1), np.float32(0.5)):
        with pytest.raises(UsageError, match=rf"has the shape .*; its space has the shape \({count},\)"):
            env.step(wrong)
    with pytest.raises(UsageError, match="of the agent 'adversary' holds no numbers"):
        env.step(["fast"] * count)
    env.close()


def test_of_two_agents_the_one_with_a_bad_action_is_named() -> None:
    env = sumo_adv.gym.parallel_env("neighbour_ahead_left")
    env.reset(seed=1)
    with pytest.raises(UsageError, match=r"The action of the agent 'adversary' is \[nan, 0.0\]"):
        env.step({"ego": STILL, "adversary": np.array([np.nan, 0.0], np.float32)})
    with pytest.raises(UsageError, match="The agent 'adversary' has no action"):
        env.step({"ego": STILL})
    env.close()


# ---- the example


def test_the_shipped_policy_drives() -> None:
    spec = importlib.util.spec_from_file_location("trained_ego", ROOT / "examples" / "train_ego" / "trained_ego.py")
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    env = made("Ego-v0", attacker=None, settings={"duration": 2.0}, **example.ENVIRONMENT)
    seen, _ = env.reset(seed=0)
    env.close()
    with np.load(example.FILE) as weights:
        action = example.Network(weights)(seen)
    assert action.tolist() == [1.0]  # nothing attacks: it accelerates, and SUMO drives as IDM


def test_the_example_trains(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed (extra ppo)")
    folder = ROOT / "examples" / "train_ego"
    done = subprocess.run(
        [sys.executable, str(folder / "train_ego.py"), "--minutes", "0.01", "--actors", "1", "--scenario",
         "neighbour_ahead_left", "--out", str(tmp_path / "ego.npz")],
        cwd=tmp_path, capture_output=True, text=True, timeout=300.0, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    header, first = (tmp_path / "ego.csv").read_text().splitlines()
    assert header.startswith("minutes,steps,episodes,return")
    assert first.split(",")[1] == "256"
    with np.load(tmp_path / "ego.npz") as weights:
        assert weights["encoder.0.weight"].shape == (48, 15)
