"""Clients that are none of stock Python: a C++ program that drives the ego, and a client that knows TraCI only up to
21.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
from pathlib import Path

import pytest
from gate_samples import Script, attached, connected, needs_sumo, opened, scene

from sumo_adv.serve.gate import EventKind

pytestmark = needs_sumo
STOPS = """
client.vehicle.setStop("ego", "east_in", 180.0, 0, 5.0)
client.vehicle.setStop("ego", "west_out", 50.0, 0, 7.0, tc.STOP_PARKING)
print(client.getVersion()[0])
print(client.vehicle.getNextStops("ego"))
client.vehicle.subscribe("ego", [tc.VAR_SPEED, tc.VAR_NEXT_STOPS, tc.VAR_LANE_ID])
def subscribed():
    found = client.vehicle.getSubscriptionResults("ego")
    assert sorted(found) == [tc.VAR_SPEED, tc.VAR_LANE_ID, tc.VAR_NEXT_STOPS], found
    return found[tc.VAR_NEXT_STOPS]
print(subscribed())
for _ in range(150):
    client.simulationStep()
    asked = client.vehicle.getNextStops("ego")
    assert subscribed() == asked, (subscribed(), asked)
    if asked and asked[0][3] & 1: print("stands", flush=True); break
client.vehicle.subscribe("ego", [tc.VAR_SPEED])  # adds to the others
client.simulationStep()
print(sorted(client.vehicle.getSubscriptionResults("ego")))
client.close()
"""
CPP = r"""
#include <iostream>
#include <libsumo/libtraci.h>
int main(int, char** arguments) {
    libtraci::Simulation::init(std::stoi(arguments[1]), 10, "127.0.0.1");
    libtraci::Simulation::setOrder(2);
    for (int k = 0; k < 20; k++) {
        libtraci::Vehicle::setSpeed("ego", 3.0);
        libtraci::Simulation::step();
    }
    std::cout << libtraci::Vehicle::getSpeed("ego") << std::endl;
    try { libtraci::Vehicle::setSpeed("other", 3.0); }
    catch (libsumo::TraCIException& error) { std::cout << error.what() << std::endl; }
    libtraci::Simulation::close();
}
"""


def test_a_client_of_version_21_reads_and_subscribes_to_stops(tmp_path: Path) -> None:
    """By the reader that stock ``traci`` has for the old form."""
    with opened(tmp_path, older=True) as (gate, events), attached(gate, events, tmp_path) as simulation:
        simulation.step()
        script = Script(
            gate.port, "import warnings; warnings.simplefilter('ignore')\nfrom traci import constants as tc\n"
            + connected(STOPS),
        )  # fmt: skip
        assert gate.wait_connected(10.0)
        while script.process.poll() is None and simulation.time() < 60.0:
            simulation.step()
        version, queried, subscribed, stands, after = script.end().splitlines()
        assert version == "21" and queried == subscribed and stands == "stands" and after == "[64, 81, 115]"
        assert "('east_in_0', 180.0, '', 0, 5.0, -1073741824.0)" in queried
        assert "'west_out_0', 50.0, '', 2, 7.0" in queried
        simulation.end()


def test_others_hear_the_version_of_sumo(tmp_path: Path) -> None:
    with scene(tmp_path) as simulation:
        script = Script(simulation.gate.port, connected("print(client.getVersion()[0])"))
        simulation.step()
        assert script.end() == "22\n"


def sumo_folder() -> Path:
    """The wheel of SUMO's programs, which has the C++ library and its headers."""
    wheel = importlib.util.find_spec("sumo")
    assert wheel is not None and wheel.origin is not None
    return Path(wheel.origin).parent


@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no C++ compiler (g++)")
def test_a_cpp_program_drives_the_ego(tmp_path: Path) -> None:
    """It lets the ego drive 3 m/s, and is refused another vehicle."""
    library = sumo_folder() / "lib64"
    if not (library / "libtracicpp.so").exists():
        pytest.skip("SUMO's wheel has no C++ library here")
    source, program = tmp_path / "driver.cpp", tmp_path / "driver"
    source.write_text(CPP)
    subprocess.run(
        ["g++", str(source), "-o", str(program), f"-I{sumo_folder() / 'include'}", f"-L{library}", "-ltracicpp"],
        check=True,
    )
    with scene(tmp_path) as simulation:
        simulation.step()
        with subprocess.Popen(
            [str(program), str(simulation.gate.port)], env={**os.environ, "LD_LIBRARY_PATH": str(library)},
            stdout=subprocess.PIPE, text=True,
        ) as client:  # fmt: skip
            assert simulation.gate.wait_connected(20.0)
            simulation.step(21)  # it says the rest in the turn after its last step
            output, _ = client.communicate(timeout=30.0)
        speed, refusal = output.splitlines()
        assert float(speed) == pytest.approx(3.0, abs=0.01)
        assert "'other' is not the client's" in refusal
        assert simulation.gate.client_steps == 20
        simulation.sentence_of(EventKind.CLOSED)
