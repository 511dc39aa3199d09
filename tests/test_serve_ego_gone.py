"""A client that removes the ego, or has it depart at another time, costs no server: the ego departs again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from gate_samples import Script, connected
from serve_samples import needs_sumo
from sumo_samples import make_spec, vehicle

from sumo_adv.serve import Options
from sumo_adv.serve.events import Event, Events
from sumo_adv.serve.gate import Gate
from sumo_adv.serve.session import EgoPlan, Session
from sumo_adv.simulation.inputs import EgoRoute

pytestmark = needs_sumo
ROUTE = EgoRoute(("eastbound",), 0.0, 0, 100.0, 15.0)
TRAFFIC = (vehicle("ahead", "eastbound", 1, 125.0, 15.0), vehicle("mine", "eastbound", 0, 100.0, 15.0))
PLANS: dict[str, Callable[[], EgoPlan]] = {
    "inserted": lambda: EgoPlan("ego", "calm", lambda: ROUTE, warm_up=1.0),
    "of the demand": lambda: EgoPlan("mine", "calm"),
    "added by its client": lambda: EgoPlan("own", "calm", added=True),
}
TRY = """
def attempt(call, *given, **named):
    try: call(*given, **named)
    except traci.TraCIException as error: print(error, flush=True)
v = client.vehicle
add = lambda depart: attempt(v.add, NAME, "road", typeID="calm", depart=depart, departPos="100")
attempt(client.route.add, "road", ["eastbound"])
"""
STEP = "for _ in range(20): client.simulationStep()\n"
ATTACKS = {
    "takes the name of its route": 'attempt(client.route.add, f"sumo_adv.{NAME}.route.0", ["eastbound"])\n' + STEP,
    "removes it": STEP + "attempt(v.remove, NAME)\n",
    "removes it, subscribed": STEP + 'attempt(v.subscribe, NAME); attempt(v.remove, NAME)\n',
    "removes it, with a context": STEP
    + 'attempt(v.subscribeContext, NAME, 0xa4, 50.0, [0x40]); attempt(v.remove, NAME)\n',
    "removes it and adds it for later": STEP + 'attempt(v.remove, NAME); add("9999")\n',
    "adds it for later": 'add("9999")\n' + STEP,
    "adds it twice": 'add("now"); add("now")\n' + STEP,
    "adds it and removes it at once": 'add("now"); attempt(v.remove, NAME)\n' + STEP,
    "gives it a route that is gone": STEP + 'attempt(v.setRoute, NAME, []); attempt(client.route.remove, "road")\n',
    "gives it a type of its own and removes it": STEP
    + 'attempt(client.vehicletype.copy, "calm", "odd"); attempt(v.setType, NAME, "odd"); attempt(v.remove, NAME)\n',
}  # fmt: skip


WHOLE, TWICE = "inserted", ("removes it", "adds it for later", "adds it twice")
"""The plan against which all are tried in ``make test``, and those that the other two plans meet there, too."""


@pytest.mark.parametrize(
    ("plan", "attack"),
    [pytest.param(plan, attack, marks=[] if plan == WHOLE or attack in TWICE else pytest.mark.soak)
     for plan in PLANS for attack in ATTACKS],
)  # fmt: skip
def test_the_simulation_goes_on(tmp_path: Path, plan: str, attack: str) -> None:
    sent: list[Event] = []
    with Gate() as gate:
        ego = PLANS[plan]()
        code = f"NAME = {ego.id!r}\n{TRY}{ATTACKS[attack]}" + "while True: client.simulationStep()"
        spec = make_spec(tmp_path, "straight_3lane", TRAFFIC)
        session = Session(spec, gate, Options(), ego, Events(lambda e: sent.append(dict(e))), lambda: None)
        script = Script(gate.port, connected(code))
        try:
            assert gate.wait_connected(20.0)
            for _ in range(150):
                session.tick()
        finally:
            script.kill()
            session.close()
    assert session.steps == 150
    if plan != "added by its client":
        states = [e["state"] for e in sent if e["event"] == "ego"]
        assert states[-1] == "departed", states
