"""Programs that connect to SUMO's own port: they find none, or the simulation is started again without them."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from gate_samples import Script, connected, needs_sumo, spec

from sumo_adv.errors import SimulationError
from sumo_adv.serve.events import Event, Events
from sumo_adv.serve.gate import Gate
from sumo_adv.serve.session import MAX_SUMO_STARTS, shared_sumo
from sumo_adv.serve.sumo_process import SumoProcess, strangers

pytestmark = [
    needs_sumo,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems do not show who connects"),
]
HUNTER = """
import socket, sys, time
from pathlib import Path
held, before = [], None
def listening():
    rows = [row.split() for row in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return {int(row[1][9:], 16) for row in rows if row[3] == "0A" and row[1].startswith("00000000")}
before = listening()
print("ready", flush=True)
while True:
    for port in listening() - before:
        try: held.append(socket.create_connection(("127.0.0.1", port), 1)); print("in", flush=True)
        except OSError: pass
        if len(held) >= int(sys.argv[1]): time.sleep(600)
        before.add(port)
"""
"""Connects at once to each new port that is open on all interfaces, until it got into so many."""


@pytest.fixture
def hunter(request: pytest.FixtureRequest) -> Iterator[subprocess.Popen[str]]:
    with subprocess.Popen(
        [sys.executable, "-c", HUNTER, str(request.param)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
        yield process
        process.kill()


def can_be_private(folder: Path) -> bool:
    with SumoProcess(spec(folder).arguments(), private=True) as sumo:
        sumo.dial(20.0).close()
        return sumo.is_private


def driven(folder: Path, sent: list[Event], *, private: bool) -> float:
    """Time [s] after ten steps of a simulation with a client as the ego's driver."""
    with Gate() as gate:
        events = Events(lambda e: sent.append(dict(e)))
        sumo, ours = shared_sumo(
            spec(folder).arguments(), gate, own=("ego",), kept=("ego",), events=events, private=private
        )
        with sumo:
            script = Script(gate.port, connected("for _ in range(5): client.simulationStep()\nclient.close()"))
            assert gate.wait_connected(20.0)
            for _ in range(10):
                ours.simulationStep()
            script.end()
            assert gate.client_steps == 5
            time = float(ours.simulation.getTime())
            gate.detach()
            ours.close()
            assert sumo.wait(10.0)
    return time


@pytest.mark.parametrize("hunter", [10], indirect=True)
def test_nobody_finds_a_sumo_with_a_network_of_its_own(tmp_path: Path, hunter: subprocess.Popen[str]) -> None:
    if not can_be_private(tmp_path):
        pytest.skip("this system allows no network namespace")
    sent: list[Event] = []
    assert driven(tmp_path, sent, private=True) == 1.0
    assert sent == []
    with SumoProcess(spec(tmp_path).arguments(), private=True) as sumo:
        sumo.dial(20.0).close()
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", sumo.port))


@pytest.mark.parametrize("hunter", [1], indirect=True)
def test_a_stranger_that_is_faster_costs_a_start_of_sumo(tmp_path: Path, hunter: subprocess.Popen[str]) -> None:
    """Where the system allows no namespace. The faster one depends on the machine; either way the simulation runs."""
    sent: list[Event] = []
    try:
        assert driven(tmp_path, sent, private=False) == 1.0
    except SimulationError as error:
        if len(sent) == MAX_SUMO_STARTS and f"{MAX_SUMO_STARTS} times in a row" in str(error):
            pytest.skip("another program on this machine connects to each port that opens")
        raise
    assert [(e["event"], e["tries"]) for e in sent] == [("stranger", n + 1) for n in range(len(sent))]
    assert len(sent) < MAX_SUMO_STARTS


def test_a_stranger_at_a_port_is_seen() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as ours:
            assert not strangers(port, [ours.getsockname()[1]])
            with socket.create_connection(("127.0.0.1", port)):
                assert strangers(port, [ours.getsockname()[1]])
    assert not strangers(port, [])


@pytest.mark.parametrize("hunter", [1000], indirect=True)
def test_after_some_tries_the_run_ends_with_a_sentence(tmp_path: Path, hunter: subprocess.Popen[str]) -> None:
    """A stranger that never has enough; the run may be faster once in a while."""
    sent: list[Event] = []
    with Gate() as gate:
        events = Events(lambda e: sent.append(dict(e)))
        try:
            sumo, ours = shared_sumo(spec(tmp_path).arguments(), gate, own=(), kept=(), events=events, private=False)
        except SimulationError as error:
            assert f"{MAX_SUMO_STARTS} times in a row" in str(error) and len(sent) == MAX_SUMO_STARTS
        else:
            gate.detach()
            ours.close()
            sumo.close()
