"""What a client of the gate cannot do to the user's files, and which programs of this machine are let in."""

from __future__ import annotations

import http.client
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from gate_samples import Script, connected, needs_sumo, scene

from sumo_adv.serve.events import StatusPage
from sumo_adv.serve.gate import MAX_STRANGERS, EventKind, Gate, GateEvent
from sumo_adv.serve.policy import Rules

SETS = """
def tried(call):
    try:
        call()
        return "done"
    except traci.TraCIException as error:
        return str(error)
types, vehicle, lights = client.vehicletype, client.vehicle, client.trafficlight
types.copy("car", "mine")
for key in ("device.ssm.file", "device.toc.file", "has.ssm.device", "file", "device.new.output", "SWARMLOG"):
    print(tried(lambda: types.setParameter("mine", key, FILE)))
    print(tried(lambda: vehicle.setParameter("ego", key, FILE)))
logic = traci.trafficlight.Logic("own", 3, 0, [traci.trafficlight.Phase(9, "GGGgrrrrGGGgrrrr", 5, 9)], {"file": FILE})
print(tried(lambda: lights.setProgramLogic("centre", logic)))
print(tried(lambda: lights.setParameter("centre", "file", FILE)))
print("then")
for key in ("has.driverstate.device", "laneChangeModel.lcStrategic", "colour"):
    print(tried(lambda: vehicle.setParameter("ego", key, "1")))
logic = traci.trafficlight.Logic("own", 3, 0, [traci.trafficlight.Phase(9, "GGGgrrrrGGGgrrrr", 5, 9)], {"max-gap": "3"})
print(tried(lambda: lights.setProgramLogic("centre", logic)))
"""


@needs_sumo
def test_a_client_cannot_have_sumo_write_by_a_parameter(tmp_path: Path) -> None:
    """14 tries at a file, and 4 parameters of which SUMO writes nothing. A text of more than 80 bytes is refused as
    such, and the name of the file is longer in some temporary folders."""
    file = tmp_path / "user.txt"
    with scene(tmp_path, 30.0, rules=Rules(frozenset({"trafficlight"}))) as simulation:
        script = Script(simulation.gate.port, connected(f"FILE = {str(file)!r}\n{SETS}\nclient.close()"))
        assert simulation.gate.wait_connected(10.0)
        simulation.step(2)
        refused, allowed = script.end().split("then\n")
        by_key, by_length = (
            "A client cannot set this parameter: it could make SUMO write a file.",
            "is not what SUMO 1.28 reads",
        )
        assert len(refused.splitlines()) == 14
        assert all(line == by_key or by_length in line for line in refused.splitlines())
        assert allowed.splitlines()[1:] == ["done"] * 3
        assert "make SUMO write" not in allowed
    assert not file.exists()


def said(events: list[GateEvent], kind: EventKind, timeout: float = 5.0) -> list[str]:
    """The sentences of a kind, once there is one."""
    until = time.monotonic() + timeout
    while not (found := [event.sentence for event in events if event.kind is kind]):
        assert time.monotonic() < until, events
        time.sleep(0.01)
    return found


KNOCK = "import socket, sys; socket.create_connection(('127.0.0.1', int(sys.argv[1]))).recv(1)"
NOBODY = 65534


@pytest.mark.skipif(
    not sys.platform.startswith("linux") or os.geteuid() != 0, reason="needs Linux, and root to be another user"
)
def test_programs_of_other_users_are_not_let_in_unless_they_are_allowed() -> None:
    events: list[GateEvent] = []
    with Gate(on_event=events.append) as gate:
        subprocess.run(["/usr/bin/env", "python3", "-c", KNOCK, str(gate.port)], user=NOBODY, timeout=20, check=False)
        assert "it is another user's; --allow 127.0.0.1 lets all users of this machine in" in said(
            events, EventKind.REFUSED
        )[0]  # fmt: skip
    events.clear()
    with Gate(deadline=0.3, allow=("127.0.0.1",), on_event=events.append) as gate:
        subprocess.run(["/usr/bin/env", "python3", "-c", KNOCK, str(gate.port)], user=NOBODY, timeout=20, check=False)
        assert "it did not send a whole message" in said(events, EventKind.REFUSED)[0]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems do not say whose a connection is")
@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_a_program_of_the_same_user_is_let_in(host: str) -> None:
    events: list[GateEvent] = []
    with Gate(host, deadline=0.3, on_event=events.append) as gate, socket.create_connection((host, gate.port)) as own:
        own.settimeout(5.0)
        assert own.recv(1) == b""
        assert "it did not send a whole message" in said(events, EventKind.REFUSED)[0]


@needs_sumo
def test_connections_that_say_nothing_shut_no_client_out(tmp_path: Path) -> None:
    with scene(tmp_path) as simulation:
        idle = [socket.create_connection(("127.0.0.1", simulation.gate.port)) for _ in range(3 * MAX_STRANGERS)]
        script = Script(simulation.gate.port, connected("print(client.getVersion()[0])\nclient.close()"))
        assert simulation.gate.wait_connected(10.0)
        simulation.step(2)
        assert script.line().isdecimal()
        for each in idle:
            each.close()
        script.end()


@pytest.mark.parametrize(
    ("host", "status"), [("127.0.0.1", 200), ("localhost:80", 200), ("attacker.example:8080", 403), ("[", 403)]
)
def test_the_status_page_answers_this_machine_alone(host: str, status: int) -> None:
    """A page of another site, whose name was made to mean 127.0.0.1, has that name as its host."""
    with StatusPage(0, lambda: {"health": "ok"}) as page:
        connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=5)
        connection.putrequest("GET", "/health", skip_host=True)
        connection.putheader("Host", host)
        connection.endheaders()
        assert connection.getresponse().status == status
