"""An ego given to ``sumo_adv.run`` as a class or an object, as from a notebook; what a run says of its answers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from threading import Lock
from typing import Any

import pytest

import sumo_adv
from sumo_adv import LaneSpeed, Observation, Pose, Steer
from sumo_adv.cli.progress import summary
from sumo_adv.drivers import make_ego
from sumo_adv.drivers.registry import pack_driver, trusted_driver
from sumo_adv.episode.drive import ActionCount
from sumo_adv.errors import UsageError

SMALL: Mapping[str, Any] = {"attempts": 1, "proposals": 24, "seed": 0, "learn": "off"}


def test_a_class_defined_here_drives_and_the_run_says_what_it_answered(tmp_path: Path) -> None:
    """It asks for 30 m/s behind a leader at 14 m/s: SUMO's safe speed takes over sooner or later."""
    fastest = 30.0

    class Hurried:
        forkable = True

        def reset(self, seed: int) -> None:
            self.steps = 0

        def act(self, seen: Observation) -> LaneSpeed | None:
            self.steps += 1
            return LaneSpeed(None, fastest) if self.steps % 2 else None

    out = tmp_path / "run"
    result = sumo_adv.run(
        "leader_two_lanes", ego=Hurried, out=out, memory=tmp_path / "bank.sqlite", until="serious", **SMALL
    )
    assert result.outcome.ego_driver == "object:Hurried"
    actions = result.outcome.document["ego_actions"]
    assert set(actions) == {"LaneSpeed", "SUMO", "limited"}
    assert abs(actions["LaneSpeed"] - actions["SUMO"]) <= 1 and 0 < actions["limited"] <= actions["LaneSpeed"]
    limited = f"limited the ego's driver in {actions['limited']} of {actions['LaneSpeed']} steps."
    assert f"SUMO's safe speed {limited}" in summary(result.outcome.document, out)
    with pytest.raises(UsageError, match=r"was driven by an object from Python, 'Hurried', which no file holds"):
        trusted_driver(None, "object:Hurried", out)


class Slow:
    """A driver with a number of its own."""

    def __init__(self, speed: float = 5.0) -> None:
        self.speed = speed

    def reset(self, seed: int) -> None:
        """Nothing to forget."""

    def act(self, seen: Observation) -> LaneSpeed:
        """Always as fast."""
        return LaneSpeed(None, self.speed)


SEEN = Observation(0.0, 0.1, None, ())  # type: ignore[arg-type]


def test_an_object_is_copied_and_a_class_gets_the_parameters() -> None:
    driver = Slow(3.0)
    packed = pack_driver(driver)
    driver.speed = 4.0
    assert make_ego(packed.name, {}, packed).act(SEEN) == LaneSpeed(None, 3.0)
    assert make_ego("object:Slow", {"speed": 7.0}, pack_driver(Slow)).act(SEEN) == LaneSpeed(None, 7.0)


def test_what_cannot_drive_is_refused_at_once() -> None:
    with pytest.raises(UsageError, match=r"'object:Lazy' has no method 'act'; it needs reset\(seed\) and act"):
        pack_driver(type("Lazy", (), {"reset": lambda self, seed: None}))
    held = Slow()
    held.lock = Lock()  # type: ignore[attr-defined]
    with pytest.raises(UsageError, match=r"cannot be sent to the engine's process .*TypeError.*: make what"):
        pack_driver(held)
    with pytest.raises(UsageError, match=r"could not be made: TypeError: .*'gain'"):
        make_ego("object:Slow", {"gain": 1.0}, pack_driver(Slow))


def test_without_the_object_its_name_says_nothing() -> None:
    with pytest.raises(UsageError, match=r"give it again with sumo_adv.run\(ego=...\)"):
        make_ego("object:Slow", {})


def test_answers_are_counted_and_so_are_the_steps_in_which_sumo_was_slower() -> None:
    """Asked for 12, then for 20 where 10.26 can be reached. 0.05 m/s less than that are rounding."""
    count = ActionCount()
    for action, reachable, after in (
        (LaneSpeed(None, 12.0), 13.0, 11.0),  # limited
        (LaneSpeed(None, 20.0), 10.26, 10.26),
        (LaneSpeed(None, 20.0), 10.26, 10.22),
        (Steer(1.0, 0.0), 10.0, 3.0),
        (Pose(0.0, 0.0, 0.0, 5.0), 10.0, 5.0),
        (None, 10.0, 5.0),
    ):
        count.answered(action, reachable)
        count.stepped(after)
    assert count.total().counts == {"LaneSpeed": 3, "Pose": 1, "SUMO": 1, "Steer": 1}
    assert count.total().limited == 1
