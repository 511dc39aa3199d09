"""A crossing with something of every TraCI domain on it, the gate before it, and clients that are real processes."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import traci

from sumo_adv.errors import UsageError
from sumo_adv.serve.gate import EventKind, Gate, GateEvent
from sumo_adv.serve.policy import Rules
from sumo_adv.serve.sumo_process import SumoProcess
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.programs import find_sumo
from sumo_adv.simulation.simulation_spec import SimulationSpec

try:
    find_sumo()
    HAS_SUMO = True
except UsageError:
    HAS_SUMO = False
needs_sumo = pytest.mark.skipif(not HAS_SUMO, reason="the program sumo is not installed (extra sumo)")

DEMAND = """<routes>
  <vType id="car" vClass="passenger" length="5" width="2" sigma="0.5"/>
  <route id="through" edges="east_in west_out"/>
  <vehicle id="ego" type="car" route="through" depart="0" departPos="100" departSpeed="8"/>
  <vehicle id="other" type="car" route="through" depart="0" departPos="60" departSpeed="8"/>
  <vehicle id="crossing" type="car" depart="0" departPos="80" departSpeed="8">
    <route edges="north_in south_out"/></vehicle>
  <flow id="flow" type="car" begin="1" end="60" period="4"><route edges="west_in east_out"/></flow>
</routes>"""
ADDITIONAL = """<additional>
  <inductionLoop id="loop" lane="east_in_0" pos="150" period="100" file="NUL"/>
  <laneAreaDetector id="area" lane="east_in_0" pos="100" endPos="150" period="100" file="NUL"/>
  <entryExitDetector id="gates" period="100" file="NUL"><detEntry lane="east_in_0" pos="90"/>
    <detExit lane="east_in_0" pos="160"/></entryExitDetector>
  <busStop id="stop" lane="west_in_0" startPos="20" endPos="40"/>
  <parkingArea id="park" lane="west_in_0" startPos="50" endPos="80" roadsideCapacity="2"/>
  <chargingStation id="charge" lane="west_in_0" startPos="90" endPos="110"/>
  <poi id="poi" x="10" y="10"/><poly id="poly" shape="0,0 10,0 10,10" color="red"/>
  <variableSpeedSign id="sign" lanes="west_in_0"><step time="0" speed="10"/></variableSpeedSign>
  <routeProbe id="probe" edge="west_in" period="100" file="NUL"/>
  <calibrator id="calibrator" edge="south_in" pos="0" period="100" output="NUL"/>
  <rerouter id="rerouter" edges="south_in"/>
</additional>"""


def spec(folder: Path) -> SimulationSpec:
    """The crossing."""
    routes, additional = folder / "crossing.rou.xml", folder / "crossing.add.xml"
    routes.write_text(DEMAND)
    additional.write_text(ADDITIONAL.replace('"NUL"', f'"{folder / "unread.xml"}"'))
    network = data_folder("networks") / "signalised_crossing.net.xml"
    return SimulationSpec(network, (routes,), (additional,), 0.0, 7)


def connected(code: str) -> str:
    """A script with ``client``, a connection of stock ``traci``, second in order."""
    return 'client = traci.connect(PORT, host="127.0.0.1"); client.setOrder(2)\n' + textwrap.dedent(code)


class Script:
    """A client that is a process: a file, or code that finds the port in ``PORT`` and ``traci`` imported."""

    def __init__(self, port: int, code: str | Path) -> None:
        if isinstance(code, Path):
            command = [str(code), str(port)]
        else:
            begin = f"import os, socket, struct, sys, time\nimport traci\nPORT = {port}\n"
            command = ["-c", begin + textwrap.dedent(code)]
        self.process = subprocess.Popen(
            [sys.executable, *command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True,
        )  # fmt: skip

    def line(self) -> str:
        """The next line it says."""
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def end(self, timeout: float = 30.0) -> str:
        """What else it says, once it has ended in good order."""
        assert self.process.stdout is not None and self.process.stderr is not None
        output = self.process.stdout.read()
        errors = self.process.stderr.read()
        assert self.process.wait(timeout) == 0, errors[-3000:]
        self.process.communicate()
        return output

    def kill(self) -> None:
        """As by kill -9."""
        self.process.kill()
        self.process.communicate()


@dataclass
class Scene:
    """One simulation behind the gate, with our connection to it."""

    gate: Gate
    sumo: SumoProcess
    ours: Any
    events: list[GateEvent]

    def step(self, count: int = 1) -> None:
        """``count`` steps of 0.1 s."""
        for _ in range(count):
            self.ours.simulationStep()

    def script(self, code: str) -> Script:
        """A client that is connected."""
        script = Script(self.gate.port, code)
        assert self.gate.wait_connected(10.0)
        return script

    def client(self, code: str) -> Script:
        """A client of stock ``traci`` that is connected: ``code`` follows :func:`connected`."""
        return self.script(connected(code))

    def time(self) -> float:
        """Simulated time [s]."""
        return float(self.ours.simulation.getTime())

    def kinds(self) -> list[EventKind]:
        """What happened so far."""
        return [event.kind for event in self.events]

    def sentence_of(self, kind: EventKind, timeout: float = 5.0) -> str:
        """The sentence of the last event of a kind; waits for it."""
        until = time.monotonic() + timeout
        while kind not in self.kinds():
            assert time.monotonic() < until, (kind, self.events)
            time.sleep(0.01)
        return next(event.sentence for event in reversed(self.events) if event.kind is kind)

    def end(self, *, keep: bool = False) -> None:
        """End the simulation in good order, and see that SUMO did."""
        self.gate.detach(keep)
        self.ours.close()
        assert self.sumo.wait(10.0), "SUMO did not end by itself"
        assert self.gate.wait_detached(5.0)


@contextmanager
def opened(
    folder: Path, deadline: float = 5.0, rules: Rules | None = None, *, older: bool = False
) -> Iterator[tuple[Gate, list[GateEvent]]]:
    """A gate that listens, and what happens at it."""
    events: list[GateEvent] = []
    with Gate(deadline=deadline, rules=rules or Rules(), older=older, on_event=events.append) as gate:
        yield gate, events


@contextmanager
def attached(gate: Gate, events: list[GateEvent], folder: Path) -> Iterator[Scene]:
    """A simulation behind the gate, before its first step. No SUMO is left behind."""
    with SumoProcess(spec(folder).arguments()) as sumo:
        gate.attach(sumo, own={"ego"})
        ours = traci.connect(sumo.port, numRetries=0, host="127.0.0.1")
        ours.setOrder(1)
        yield Scene(gate, sumo, ours, events)
    assert not sumo.alive


@contextmanager
def scene(folder: Path, deadline: float = 5.0, rules: Rules | None = None) -> Iterator[Scene]:
    """One simulation behind a gate of its own, ended in good order."""
    with opened(folder, deadline, rules) as (gate, events), attached(gate, events, folder) as simulation:
        yield simulation
        if simulation.sumo.alive:
            simulation.end()
