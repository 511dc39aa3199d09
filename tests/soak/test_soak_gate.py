"""A hundred clients killed at random times in one simulation, and two minutes of random messages: it goes on."""

from __future__ import annotations

import random
import time
from pathlib import Path

import pytest
from gate_samples import Script, connected, needs_sumo, scene
from soak.fuzz_gate import fuzz

from sumo_adv.serve.gate import EventKind, Stepper

pytestmark = [pytest.mark.soak, needs_sumo]
KILLS = 100
DRIVE = """
client.vehicle.subscribe("ego")
print("ready", flush=True)
while True:
    client.vehicle.setSpeed("other", 8.0) if time.time() < 0 else client.vehicle.getPosition("other")
    client.simulationStep()
"""


def test_a_hundred_kills(tmp_path: Path) -> None:
    chance = random.Random(0)
    with scene(tmp_path, deadline=20.0) as one:
        one.step()
        for kill in range(KILLS):
            script = Script(one.gate.port, connected(DRIVE))
            assert one.gate.wait_connected(20.0)
            until = time.monotonic() + chance.uniform(0.0, 0.03)
            while time.monotonic() < until:
                one.step()
            script.process.kill()
            before = one.time()
            one.step(3)
            assert one.time() == pytest.approx(before + 0.3), kill
            script.process.communicate()
            one.step()
            assert one.gate.stepped_by is Stepper.GATE
        assert one.kinds().count(EventKind.LOST) == KILLS
        assert one.ours.vehicle.getAllSubscriptionResults() == {}


@pytest.mark.parametrize("seed", [0, 1])
def test_a_minute_of_random_messages(tmp_path: Path, seed: int) -> None:
    assert fuzz(tmp_path, seed, 60.0)["answered"] > 500
