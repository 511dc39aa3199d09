"""``serve`` with supports: all adversaries of an attack are steered, told and given back."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

from cli_samples import TESTS, Program
from serve_samples import needs_sumo
from several_samples import pinch
from sumo_samples import make_spec, vehicle

from sumo_adv.config import load_settings
from sumo_adv.geometry import Pose
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.serve import Options
from sumo_adv.serve.encounter import AttackScene, EncounterMonitor, LiveAttempts, collided, describe
from sumo_adv.serve.events import Events
from sumo_adv.serve.gate import Gate
from sumo_adv.serve.session import EgoPlan, Session
from sumo_adv.simulation.inputs import EgoRoute
from sumo_adv.simulation.network import read_network

pytestmark = needs_sumo
OTHERS = (vehicle("left", "eastbound", 2, 112.0, 15.0), vehicle("right", "eastbound", 0, 94.0, 15.0))


def test_a_collider_and_its_support_are_driven_together_and_given_back(tmp_path: Path) -> None:
    """The vehicle on the left cuts in; the one on the right keeps beside the ego."""
    sent: list[dict[str, Any]] = []
    events = Events(lambda event: sent.append(dict(event)))
    spec, settings = make_spec(tmp_path, "straight_3lane", OTHERS), load_settings(None, duration=5.0, adversaries=2)
    road = read_network(spec.network)
    plan = EgoPlan("ego", "calm", lambda: EgoRoute(("eastbound",), 0.0, 1, 100.0, 15.0))
    with Gate() as gate, Sandbox() as sandbox:
        session = Session(spec, gate, Options(), plan, events, lambda: None)
        client = subprocess.Popen([sys.executable, str(TESTS / "serve_client.py"), str(gate.port)])
        try:
            assert gate.wait_connected(20.0)
            watch = EncounterMonitor(session, road, settings, (), 0.0)
            scene = describe(session, road, settings, watch.until_encounter(20.0, trigger=3.0), ())
            assert isinstance(scene, AttackScene), scene
            both = pinch("left", "right", "side")
            live = LiveAttempts(session, scene, road, settings, sandbox, events)
            (result,) = live.attempt([both])
            assert result.driven.ending in ("contact", "time_limit"), result.driven.message
            assert result.verdict is not None
            (attack,) = (e for e in sent if e["event"] == "attack")
            assert (attack["adversary"], attack["composition"]) == ("left", "Pinch")
            assert attack["supports"] == [both.supports[0].as_adversary()]
            assert ["left", "right"] in [e["adversary"] for e in sent if e["event"] == "owners"]
            assert [e["vehicle"] for e in sent if e["event"] == "released"] == ["left", "right"]
            assert abs(session.snapshot.raw["right"][1] - session.snapshot.raw["ego"][1]) > 2.0  # it kept its lane
            session.tick()
            assert [e["adversary"] for e in sent if e["event"] == "owners"][-1] == []
            assert collided(session, ("left", "right"), with_ego=True) == {}
            ego = session.state("ego")
            onto = Pose(ego.x, ego.y + 1.0, ego.heading, ego.speed)
            session.tick({"left": onto, "right": onto})
            assert collided(session, ("left", "right"), with_ego=False) == dict.fromkeys(
                ("left", "right"), "another adversary"
            )
            assert collided(session, ("left", "right"), with_ego=True) == dict.fromkeys(("left", "right"), "the ego")
            assert collided(session, ("left",), with_ego=False) == {"left": "another vehicle"}  # "right", as traffic
        finally:
            client.kill()
            client.wait()
            session.close()


def test_in_real_time_one_adversary_is_the_most(program: Program) -> None:
    done = program.here("serve", "straight_3lane", "--real-time", "--adversaries", "2")
    assert done.status == 2
    assert "it allows only one adversary: leave out --real-time or --adversaries." in done.err
