"""Clients that want to hold the simulation, or to drive on after they have gone: neither works."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
from gate_samples import Script, connected, needs_sumo, scene

from sumo_adv.serve.gate import EventKind, Stepper

pytestmark = needs_sumo
RAW = r"""
raw = socket.create_connection(("127.0.0.1", PORT))
def message(*commands): return struct.pack("!i", 4 + sum(map(len, commands))) + b"".join(commands)
def receive():
    size = struct.unpack("!i", raw.recv(4, socket.MSG_WAITALL))[0]
    return raw.recv(size - 4, socket.MSG_WAITALL)
VERSION, LOAD, STEP = b"\2\0", b"\x0a\1" + bytes(8), b"\x0a\2" + bytes(8)
GETTER = struct.pack("!BBBi", 10, 0xa4, 0x40, 3) + b"ego"
raw.sendall(message(VERSION)); receive()
"""
FAREWELL = """
print(receive()[7:], flush=True)
"""


def test_a_message_of_very_many_commands_is_cut(tmp_path: Path) -> None:
    """1.2 million getters, 12 MB, which SUMO would need half a minute for."""
    with scene(tmp_path) as simulation:
        script = simulation.script(RAW + "raw.sendall(message(GETTER * 1_200_000))\ntime.sleep(600)")
        simulation.step(3)  # the first of them waits for the message
        assert "more than 50000 commands" in simulation.sentence_of(EventKind.LOST)
        assert simulation.gate.stepped_by is Stepper.GATE
        script.kill()


def test_a_long_message_ends_at_the_deadline(tmp_path: Path) -> None:
    """As many getters as a message may have: SUMO needs about a second for them."""
    with scene(tmp_path, deadline=0.2) as simulation:
        script = simulation.script(RAW + "raw.sendall(message(GETTER * 50_000))" + FAREWELL)
        simulation.step(3)
        assert "more than 0.2 s" in simulation.sentence_of(EventKind.LATE)
        assert "went on without it" in script.end()


@pytest.mark.parametrize("call", ["LOAD", "VERSION"], ids=["that is refused", "that needs no SUMO"])
def test_a_client_that_only_asks_what_sumo_never_sees_is_late_too(tmp_path: Path, call: str) -> None:
    flood = f"""
import threading
threading.Thread(target=lambda: [raw.recv(65536) for _ in iter(int, 1)], daemon=True).start()
print("flood", flush=True)
try:
    while True: raw.sendall(message({call}) * 1000)
except OSError:
    pass
"""
    with scene(tmp_path, deadline=0.2) as simulation:
        script = Script(simulation.gate.port, RAW + flood)
        assert script.line() == "flood" and simulation.gate.wait_connected(10.0)
        simulation.step(3)
        assert "more than 0.2 s" in simulation.sentence_of(EventKind.LATE)
        script.kill()


ASKED = {
    "in one message": "raw.sendall(message(STEP * 3000))",
    "in as many messages": "raw.sendall(message(STEP) * 3000)",
    "as one long step": r'raw.sendall(message(b"\x0a\2" + struct.pack("!d", 300.0)))',
}


@pytest.mark.parametrize("way", ASKED)
def test_a_client_that_asks_for_3000_steps_and_vanishes_drives_no_further(tmp_path: Path, way: str) -> None:
    with scene(tmp_path) as simulation:
        script = simulation.script(RAW + ASKED[way] + "\nprint('sent', flush=True)\ntime.sleep(600)")
        assert script.line() == "sent"
        simulation.step(10)
        assert simulation.gate.stepped_by is Stepper.CLIENT
        script.kill()
        simulation.step(3)  # the first of them it may have made before
        assert simulation.gate.stepped_by is Stepper.GATE and not simulation.gate.connected
        assert "was lost" in simulation.sentence_of(EventKind.LOST)
        assert simulation.gate.client_steps <= 11
        simulation.step(5)
        assert simulation.time() == pytest.approx(1.8)


def test_a_long_step_brings_its_client_where_it_wanted(tmp_path: Path) -> None:
    """To 1.25 s in steps of 0.1 s are 13 steps; then 0.05 s more is none, and another step is one."""
    walk = """
        client.vehicle.subscribe("ego")
        client.simulationStep(1.25)
        print(client.simulation.getTime(), len(client.vehicle.getAllSubscriptionResults()))
        client.simulationStep(1.28)
        print(client.simulation.getTime())
        client.simulationStep()
        print(client.simulation.getTime())
        client.close()
    """
    with scene(tmp_path) as simulation:
        script = simulation.client(walk)
        simulation.step(16)
        assert script.end().split("\n")[:3] == ["1.3 1", "1.3", "1.4"]
        assert simulation.gate.client_steps == 14


@pytest.mark.parametrize("keep", [False, True], ids=["sent away", "stays"])
def test_a_simulation_can_end_in_the_middle_of_a_long_step(tmp_path: Path, keep: bool) -> None:
    """Its client is answered at once, not after the hour that it asked for."""
    with scene(tmp_path) as simulation:
        script = Script(
            simulation.gate.port, connected('client.simulationStep(3600.0); print("back", flush=True); time.sleep(600)')
        )
        assert simulation.gate.wait_connected(10.0)
        simulation.step(5)
        simulation.end(keep=keep)
        began = time.monotonic()
        assert script.line() == "back" and time.monotonic() - began < 20.0
        script.kill()
