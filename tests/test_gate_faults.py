"""Clients that die, hang, lie and trespass: SUMO goes on, and the log has a sentence."""

from __future__ import annotations

import os
import random
import signal
import socket
import sys
import time
from pathlib import Path
from textwrap import dedent

import pytest
import traci
from gate_samples import Script, attached, connected, needs_sumo, opened, scene, spec
from traci import constants as tc

from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.serve.gate import EventKind, Gate, Stepper
from sumo_adv.serve.policy import Rules
from sumo_adv.serve.sumo_process import SumoProcess

pytestmark = needs_sumo
RAW = 'raw = socket.create_connection(("127.0.0.1", PORT))\n'
HANG = "time.sleep(600)\n"
DRIVE = """
print("ready", flush=True)
while True:
    client.vehicle.setSpeed("ego", 8.0)
    client.vehicle.getPosition("ego")
    client.simulationStep()
"""


def test_without_a_client_the_gate_steps(tmp_path: Path) -> None:
    with scene(tmp_path) as simulation:
        simulation.step(20)
        assert simulation.time() == 2.0
        gate = simulation.gate
        assert (gate.stepped_by, gate.client_steps, gate.connected) == (Stepper.GATE, 0, False)
        simulation.end()
        assert simulation.kinds() == [EventKind.RESTARTED]


def test_a_late_client_gets_the_next_turn_and_its_close_ends_only_itself(tmp_path: Path) -> None:
    with scene(tmp_path) as simulation:
        simulation.step(10)
        script = simulation.client("for _ in range(5): client.simulationStep()\nclient.close()")
        simulation.step()
        assert simulation.gate.stepped_by is Stepper.CLIENT
        simulation.step(4)
        assert simulation.sentence_of(EventKind.CLOSED).endswith("closed the connection.")
        simulation.step(5)
        script.end()
        assert (simulation.time(), simulation.gate.client_steps, simulation.gate.stepped_by) == (2.0, 5, Stepper.GATE)


@pytest.mark.parametrize("seed", range(2))
def test_killed_at_a_random_time(tmp_path: Path, seed: int) -> None:
    with scene(tmp_path) as simulation:
        script = Script(simulation.gate.port, connected(DRIVE))
        assert script.line() == "ready"
        until = time.monotonic() + random.Random(seed).uniform(0.0, 0.05)
        while time.monotonic() < until:
            simulation.step()
        script.process.kill()
        killed_at = simulation.time()
        simulation.step(20)
        assert simulation.time() == pytest.approx(killed_at + 2.0)
        assert simulation.gate.stepped_by is Stepper.GATE and "was lost" in simulation.sentence_of(EventKind.LOST)
        script.kill()
        again = simulation.client("client.simulationStep(); client.close()")
        simulation.step(2)
        again.end()


def test_a_client_that_hangs_is_late_and_hears_why(tmp_path: Path) -> None:
    with scene(tmp_path, deadline=0.3) as simulation:
        hang = """
            client.simulationStep()
            print("stepped", flush=True)
            sys.stdin.readline()
            try:
                client.vehicle.getSpeed("ego")
            except traci.TraCIException as error:
                print(error)
        """
        script = simulation.client(hang)
        simulation.step()
        assert script.line() == "stepped"
        simulation.step(3)
        assert "more than 0.3 s" in simulation.sentence_of(EventKind.LATE)
        assert not simulation.gate.connected and simulation.gate.stepped_by is Stepper.GATE
        assert "went on without it" in script.process.communicate("\n", timeout=20.0)[0]


def test_a_client_that_asks_for_ever_is_late_too(tmp_path: Path) -> None:
    ask = """
        try:
            while True:
                client.vehicle.getIDList()
        except traci.TraCIException as error:
            print(error)
    """
    with scene(tmp_path, deadline=0.3) as simulation:
        script = simulation.client(ask)
        simulation.step(3)
        assert "more than 0.3 s" in simulation.sentence_of(EventKind.LATE)
        assert "went on without it" in script.end()


def test_our_own_thinking_is_not_the_clients(tmp_path: Path) -> None:
    with scene(tmp_path, deadline=0.3) as simulation:
        script = simulation.client("for _ in range(3): client.simulationStep()\nclient.close()")
        for _ in range(3):
            time.sleep(0.6)
            simulation.step()
        script.end()
        assert EventKind.LATE not in simulation.kinds() and simulation.gate.client_steps == 3


LIES = {
    "half a message": r'raw.sendall(b"\0\0\0\x0a\x06\2")',
    "negative length": r'raw.sendall(struct.pack("!i", -5) + b"\2\0")',
    "2 GB length": r'raw.sendall(struct.pack("!i", 2**31 - 1) + b"\2\0")',
    "empty message": r'raw.sendall(struct.pack("!i", 4))',
    "command longer than its message": r'raw.sendall(struct.pack("!i", 6) + b"\x20\0")',
    "random bytes": "raw.sendall(os.urandom(10000))",
}


@pytest.mark.parametrize("begin", ["", r'raw.sendall(b"\0\0\0\6\2\0"); raw.recv(100)' + "\n"], ids=["first", "later"])
def test_what_is_no_message_is_cut(tmp_path: Path, begin: str) -> None:
    """One liar after the other, in one simulation."""
    with scene(tmp_path, deadline=0.3) as simulation:
        for number, lie in enumerate(LIES.values(), 1):
            script = Script(simulation.gate.port, RAW + begin + lie + '\nprint("sent", flush=True)\n' + HANG)
            assert script.line() == "sent"
            time.sleep(0.1)
            simulation.step(10)
            assert simulation.time() == pytest.approx(number)
            until = time.monotonic() + 5.0
            while sum(map(simulation.kinds().count, (EventKind.LOST, EventKind.LATE, EventKind.REFUSED))) < number:
                assert time.monotonic() < until, lie
                time.sleep(0.02)
            assert not simulation.gate.connected
            script.kill()


DRIP = """
raw.sendall(struct.pack("!i", 1_000_000))
print("sent", flush=True)
while True:
    raw.sendall(b"x")
    time.sleep(0.02)
"""


def test_a_client_that_drips_is_late_like_one_that_hangs(tmp_path: Path) -> None:
    with scene(tmp_path, deadline=0.3) as simulation:
        script = Script(simulation.gate.port, RAW + r'raw.sendall(b"\0\0\0\6\2\0"); raw.recv(100)' + DRIP)
        assert script.line() == "sent"
        began = time.monotonic()
        simulation.step(10)
        assert time.monotonic() - began < 3.0
        assert "took more than 0.3 s for a turn" in simulation.sentence_of(EventKind.LATE)
        script.kill()


def test_strangers_that_drip_leave_room_for_an_honest_client(tmp_path: Path) -> None:
    with scene(tmp_path, deadline=0.3) as simulation:
        strangers = [Script(simulation.gate.port, RAW + DRIP) for _ in range(16)]
        assert [s.line() for s in strangers] == ["sent"] * 16
        until = time.monotonic() + 5.0
        while simulation.kinds().count(EventKind.REFUSED) < 16:
            assert time.monotonic() < until
            time.sleep(0.02)
        honest = simulation.client("client.simulationStep(); client.close()")
        simulation.step(2)
        honest.end()
        for stranger in strangers:
            stranger.kill()


def test_unknown_and_misshapen_commands_are_answered_as_errors(tmp_path: Path) -> None:
    """SUMO itself ends on most of these: a getter without its object, one with too much, one with the wrong type."""
    ask = r"""
        def ask(number, payload):
            raw.sendall(struct.pack("!iBB", 6 + len(payload), 2 + len(payload), number) + payload)
            return raw.recv(4096)
        name = struct.pack("!i", 3) + b"ego"
        for number, payload in (
            (0x99, b"abc"), (0xa4, b""), (0xa4, b"\x40"), (0xa4, b"\x40" + struct.pack("!i", 999)),
            (0xa4, b"\x40" + name + b"\0"), (0xa4, b"\x68" + name + b"\x09\0\0\0\1"), (0xa4, b"\x68" + name),
            (0xc4, b"\x40" + name), (0xc4, b"\x40" + name + b"\x0b\0"), (0xd4, b"\0" * 16 + name + b"\xff"),
            (0x84, b"\0" * 16 + name), (0x7e, b""), (0x7e, b"\x01\x7f"), (0x02, b""), (0x02, b"\x7f\xf8" + bytes(6)),
            (0x02, struct.pack("!d", 1e9)), (0x12, b"x" * 100), (0x96, b""),
        ):
            answer = ask(number, payload)
            print(hex(number), answer[5] == number and answer[6] in (1, 0xff), flush=True)
        print(ask(0xa4, b"\x00" + struct.pack("!i", 0))[6], flush=True)
    """
    with scene(tmp_path) as simulation:
        simulation.step()
        script = simulation.script(RAW + dedent(ask))
        simulation.step()
        *answers, last = script.end().split("\n")[:-1]
        assert len(answers) == 18 and all(answer.endswith("True") for answer in answers), answers
        assert last == "0"


def test_subscribing_to_what_is_not_there_yet(tmp_path: Path) -> None:
    """SUMO itself ends on it, with ten variables: its error is longer than its own format allows."""
    early = """
        try:
            client.vehicle.subscribe("not_there_yet", list(range(0x40, 0x4a)))
        except traci.TraCIException as error:
            print(error, flush=True)
        client.vehicle.subscribe("ego", list(range(0x40, 0x44)))
        client.simulationStep()
        print(sorted(client.vehicle.getSubscriptionResults("ego")))
        client.close()
    """
    with scene(tmp_path) as simulation:
        simulation.step()
        script = simulation.client(early)
        simulation.step(3)
        assert "not_there_yet" in script.line()
        assert script.end() == "[64, 65, 66, 67]\n"


def test_only_one_client_at_a_time_and_the_second_hears_why(tmp_path: Path) -> None:
    with scene(tmp_path) as simulation:
        first = Script(simulation.gate.port, connected(DRIVE))
        assert first.line() == "ready"
        simulation.step(2)
        second = Script(
            simulation.gate.port,
            'try: traci.init(PORT, host="127.0.0.1")\nexcept traci.TraCIException as error: print(error)',
        )
        assert "Another client" in second.end()
        assert "another client" in simulation.sentence_of(EventKind.REFUSED)
        simulation.step(2)
        assert simulation.gate.stepped_by is Stepper.CLIENT
        first.kill()
        simulation.step()


def test_load_save_and_the_adversary_are_refused_by_an_error(tmp_path: Path) -> None:
    trespass = """
        def says(call, *given):
            try:
                call(*given)
                print("done")
            except traci.TraCIException as error:
                print("refused:", error)
        says(client.load, ["-n", "other.net.xml"])
        says(client.simulation.saveState, "state.xml")
        says(client.simulation.loadState, "state.xml")
        says(client.simulation.executeMove)
        says(client.vehicle.setSpeed, "other", 0.0)
        says(client.vehicle.moveToXY, "other", "", -1, 0.0, 0.0)
        says(client.vehicle.remove, "other")
        says(client.vehicletype.setMaxSpeed, "car", 1.0)
        says(client.trafficlight.setPhase, "centre", 0)
        says(client.edge.setMaxSpeed, "east_in", 1.0)
        says(client.route.remove, "through")
        says(client.vehicle.setSpeed, "ego", 3.0)
        says(client.vehicle.add, "other", "through")
        says(client.vehicle.setSpeed, "other", 0.0)
        client.simulationStep()
        client.close()
    """
    with scene(tmp_path) as simulation:
        simulation.step()
        script = simulation.client(trespass)
        simulation.step(2)
        lines = script.end().splitlines()
        assert [line.split(":")[0] for line in lines] == ["refused"] * 11 + ["done"] + ["refused"] * 2
        assert "'other' is not the client's" in lines[4]
        # SUMO's own refusal does not count, and a call made twice counts once.
        assert simulation.kinds().count(EventKind.REFUSED) == 11


def test_what_the_client_adds_is_its_own_until_it_removes_it(tmp_path: Path) -> None:
    adds = """
        client.route.add("mine", ["south_in", "north_out"])
        client.vehicletype.copy("car", "mine")
        client.vehicletype.setMaxSpeed("mine", 7.0)
        client.vehicle.add("friend", "mine", "mine")
        client.vehicle.setSpeed("friend", 2.0)
        client.simulationStep()
        print("added", flush=True)
        print(client.vehicle.getTypeID("friend"), flush=True)
        client.simulationStep()
        client.vehicle.remove("friend")
        client.simulationStep()
        client.close()
    """
    with scene(tmp_path) as simulation:
        simulation.step()
        script = simulation.client(adds)
        simulation.step()
        assert script.line() == "added" and simulation.gate.own == {"ego", "friend"}
        simulation.step(3)
        assert script.end() == "mine\n"
        assert simulation.gate.own == {"ego"}


def test_a_domain_can_be_allowed(tmp_path: Path) -> None:
    with scene(tmp_path, rules=Rules(frozenset({"trafficlight"}))) as simulation:
        script = Script(
            simulation.gate.port, connected(
                'client.trafficlight.setRedYellowGreenState("centre", "r" * 16)\n'
                'print("done", flush=True)\nclient.simulationStep(); client.close()'
            ),
        )  # fmt: skip
        length = len(simulation.ours.trafficlight.getRedYellowGreenState("centre"))
        script.kill() if length != 16 else None
        assert simulation.gate.wait_connected(10.0)
        simulation.step(2)
        assert script.end() == "done\n"
        assert simulation.ours.trafficlight.getRedYellowGreenState("centre") == "r" * 16


def test_subscriptions_of_a_lost_client_end_with_it_and_ours_stay(tmp_path: Path) -> None:
    with opened(tmp_path) as (gate, events), attached(gate, events, tmp_path) as simulation:
        simulation.ours.poi.add("server", 0.0, 0.0, (0, 0, 0, 0))
        simulation.ours.poi.subscribeContext("server", tc.CMD_GET_VEHICLE_VARIABLE, 1e6, [tc.VAR_SPEED])
        subscribe = """
            client.simulationStep()
            client.vehicle.subscribe("ego", [0x40])
            client.simulationStep()
            print(sorted(client.vehicle.getAllSubscriptionResults()), flush=True)
            os.kill(os.getpid(), 9)
        """
        script = Script(gate.port, connected(subscribe))
        assert gate.wait_connected(10.0)
        simulation.step(3)
        assert script.line() == "['ego']"
        simulation.sentence_of(EventKind.LOST)
        simulation.step(2)
        assert simulation.ours.vehicle.getAllSubscriptionResults() == {}
        assert set(simulation.ours.poi.getContextSubscriptionResults("server")) >= {"ego", "other", "crossing"}
        script.kill()
        simulation.end()


@pytest.mark.parametrize("keep", [False, True], ids=["sent away", "stays"])
def test_the_next_simulation(tmp_path: Path, keep: bool) -> None:
    """Sent away, the client connects to the same port again; if it may stay, its time begins again."""
    leave = """
        times = []
        for _ in range(8):
            try:
                client.simulationStep()
                times.append(client.simulation.getTime())
            except traci.FatalTraCIError:
                print("closed", flush=True)
                client = traci.connect(PORT, host="127.0.0.1")
        print(times, flush=True)
    """
    with opened(tmp_path) as (gate, events):
        script = Script(gate.port, connected(leave))
        assert gate.wait_connected(10.0)
        with attached(gate, events, tmp_path) as simulation:
            simulation.step(3)
            simulation.end(keep=keep)
        with attached(gate, events, tmp_path) as simulation:
            assert keep or script.line() == "closed"
            assert gate.wait_connected(10.0)
            while script.process.poll() is None and simulation.time() < 20.0:
                simulation.step()
            times = script.line()
            script.end()
            numbers = [float(x) for x in times.strip("[]").split(",")]
            restart = next(k for k in range(1, len(numbers)) if numbers[k] < numbers[k - 1])
            assert restart in (2, 3) and numbers[:restart] == [0.1, 0.2, 0.3][:restart]
            assert numbers[restart] <= 0.1 and numbers == sorted(numbers[:restart]) + sorted(numbers[restart:])
            assert simulation.gate.client_steps >= 4
            simulation.end()


def test_sumo_that_dies_is_told_and_the_next_simulation_runs(tmp_path: Path) -> None:
    with opened(tmp_path) as (gate, events):
        script = Script(gate.port, connected(DRIVE))
        with attached(gate, events, tmp_path) as simulation:
            assert gate.wait_connected(10.0)
            simulation.step(3)
            os.kill(simulation.sumo.pid, signal.SIGKILL)
            with pytest.raises(traci.FatalTraCIError):
                simulation.step(1)
            assert "ended by itself" in simulation.sentence_of(EventKind.ENDED)
            assert gate.wait_detached(5.0)
        script.kill()
        with attached(gate, events, tmp_path) as simulation:
            simulation.step(3)
            simulation.end()


def test_a_sumo_that_does_not_start_says_why() -> None:
    refused = pytest.raises(SimulationError, match=r"did not start \(.*no-such-option")
    with Gate() as gate, SumoProcess(["--no-such-option", "1"]) as sumo, refused:
        gate.attach(sumo)


def test_a_sumo_that_cannot_load_its_network_says_why(tmp_path: Path) -> None:
    """SUMO reads it only once its clients are there."""
    with opened(tmp_path) as (gate, events), SumoProcess(["-n", str(tmp_path / "none.net.xml")]) as sumo:
        gate.attach(sumo)
        ours = traci.connect(sumo.port, numRetries=0, host="127.0.0.1")
        with pytest.raises(traci.FatalTraCIError):
            ours.setOrder(1)
            ours.simulationStep()
        assert gate.wait_detached(5.0)
        assert [event.kind for event in events] == [EventKind.ENDED] and "none.net.xml" in events[0].sentence


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems have no such signal")
@pytest.mark.parametrize("connected", [False, True], ids=["before its clients", "in a simulation"])
def test_no_sumo_is_left_behind_when_the_server_is_killed(tmp_path: Path, connected: bool) -> None:
    code = f"""
        from sumo_adv.serve.sumo_process import SumoProcess
        from sumo_adv.serve.gate import Gate
        sumo = SumoProcess({spec(tmp_path).arguments()!r})
        if {connected}:
            gate = Gate(); gate.start(); gate.attach(sumo)
            ours = traci.connect(sumo.port, host="127.0.0.1"); ours.setOrder(1); ours.simulationStep()
        print(sumo.pid, flush=True)
        time.sleep(600)
    """
    script = Script(0, code)
    pid = int(script.line())
    assert Path(f"/proc/{pid}").exists()
    script.kill()
    until = time.monotonic() + 5.0
    while Path(f"/proc/{pid}").exists() and "Z" not in Path(f"/proc/{pid}/stat").read_text().split()[2]:
        assert time.monotonic() < until, "SUMO outlived its server"
        time.sleep(0.02)


def test_other_interfaces_need_addresses(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--allow"):
        Gate("0.0.0.0")
    with pytest.raises(UsageError, match="is not an address or network"):
        Gate("0.0.0.0", allow=("everybody",))
    with pytest.raises(UsageError, match="is not an address to listen at"):
        Gate("nowhere")
    with pytest.raises(UsageError, match="cannot be allowed"):
        Rules(frozenset({"simulation"}))
    with Gate("0.0.0.0", allow=("10.1.2.0/24",)) as gate:
        assert gate.opens is not None and "10.1.2.0/24" in gate.opens
        with pytest.raises(UsageError, match="Cannot listen"):
            Gate(port=gate.port).start()
    with Gate() as gate:
        assert gate.opens is None
        with socket.create_connection(("127.0.0.1", gate.port)):
            assert not gate.wait_connected(0.1)
