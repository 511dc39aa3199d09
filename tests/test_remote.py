"""Our own end of a TraCI connection, against the real SUMO program: its bytes say what its getters say."""

from __future__ import annotations

import importlib.util
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import traci
from person_samples import WALKS, street_spec
from sumo_samples import make_spec, over_the_line, vehicle

from sumo_adv.drivers import SumoEgo
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.unprotected import may_attack
from sumo_adv.errors import SimulationError
from sumo_adv.simulation.remote import Remote
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("sumo") is None, reason="the SUMO program is not installed: pip install sumo-adv[sumo]"
)


@contextmanager
def program(spec: SimulationSpec) -> Iterator[tuple[Simulation, subprocess.Popen[bytes]]]:
    """A SUMO program of its own and a simulation connected to it."""
    import sumo

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    binary = str(Path(sumo.SUMO_HOME) / "bin" / "sumo")
    process = subprocess.Popen(
        [binary, *spec.arguments(), "--remote-port", str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        yield Simulation(spec, Remote(connected(port))), process
    finally:
        process.kill()
        process.wait()


def connected(port: int) -> traci.connection.Connection:
    for _ in range(100):
        try:
            return traci.connect(port, numRetries=0, host="127.0.0.1")
        except traci.FatalTraCIError:
            time.sleep(0.05)
    raise AssertionError("SUMO did not open its port")


def test_states_are_those_of_the_getters_whatever_the_ids_are(tmp_path: Path) -> None:
    names = ["ego", "x", "ü-1.0", *("n" * size for size in (200, 220, 228, 229, 230, 231, 236, 238, 245, 300))]
    vehicles = [vehicle(name, "eastbound", k % 3, 20.0 + 30.0 * k, 15.0) for k, name in enumerate(names)]
    with program(make_spec(tmp_path, "straight_3lane", vehicles)) as (simulation, _):
        for _ in range(10):
            simulation.step()
        snapshot = simulation.read()
        assert set(snapshot.raw) == set(names) and snapshot.time == simulation.time == 1.0
        ask = simulation.api.vehicle
        for name in names:
            expected = (*ask.getPosition(name), ask.getAngle(name), ask.getSpeed(name), ask.getLaneID(name))
            assert snapshot.raw[name] == expected
            assert simulation.lane_position(name) == ask.getLanePosition(name)
        assert simulation.fleet.sizes["ego"] == (5.0, 2.0) and simulation.vehicle_class("ego") == "passenger"
        simulation.close()


def test_the_program_and_the_library_say_the_same(tmp_path: Path) -> None:
    spec = make_spec(tmp_path, "straight_3lane", [vehicle("ego", "eastbound", 0, 100.0, 12.0)])
    library = Simulation(spec)
    with program(spec) as (remote, _):
        for k in range(60):
            for simulation in (library, remote):
                if k >= 10:
                    simulation.inject({"ego": over_the_line(k - 10)})
                simulation.step()
            assert remote.read() == library.read()
        remote.close()
    library.close()


def test_persons_are_those_of_the_library_and_none_of_them_attacks(tmp_path: Path) -> None:
    """A shared SUMO is not ours alone: an attack would have to take the person out of it."""
    rider = '<person id="rider" depart="1" departPos="49"><ride from="ab" to="bc" lines="car"/></person>'
    waits = vehicle("car", "ab bc", 1, 10.0, 10.0).replace(
        "</vehicle>", '<stop lane="ab_1" endPos="50" triggered="true"/></vehicle>'
    )
    spec = street_spec(tmp_path, [waits, vehicle("walker", "cb ba", 1, 10.0, 10.0), WALKS, rider])
    library = Drive(spec, SumoEgo("idm", {}), 0)
    with program(spec) as (simulation, _):
        remote = Drive(spec, SumoEgo("idm", {}), 0, simulation.remote)
        present = []
        for _ in range(120):
            states = [drive.tick() for drive in (library, remote)]
            assert states[0] == states[1]
            present.append(set(states[0].raw))
        everyone = {"car", "walker", "person:walker", "person:rider"}
        assert (present[20], present[-1]) == (everyone, everyone - {"person:rider"})
        assert [may_attack(drive, "person:walker", ()) for drive in (library, remote)] == [True, False]
        remote.simulation.close()
    library.simulation.close()


def test_a_program_that_dies_is_one_sentence(tmp_path: Path) -> None:
    spec = make_spec(tmp_path, "straight_3lane", [vehicle("ego", "eastbound", 0, 100.0, 12.0)])
    with program(spec) as (simulation, process):
        simulation.step()
        process.kill()
        with pytest.raises(SimulationError, match="SUMO ended or closed the connection"):
            for _ in range(3):
                simulation.step()
        simulation.close()


def test_it_cannot_be_loaded_again(tmp_path: Path) -> None:
    spec = make_spec(tmp_path, "straight_3lane", [vehicle("ego", "eastbound", 0, 100.0, 12.0)])
    with program(spec) as (simulation, _):
        with pytest.raises(SimulationError, match="cannot be loaded again"):
            simulation.reload()
        simulation.close()
