"""What a driver does to what it was given, or to its process: it changes nothing, or the error names the driver."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest
from cli_samples import Program

from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.forks import can_fork
from sumo_adv.simulation.programs import find_sumo
from sumo_adv.simulation.watch import sumo_at_work

needs_fork = pytest.mark.skipif(not can_fork(), reason="this system cannot fork a simulation")
RUN = ("run", "motorway_cut_in_left", "--attempts", "3", "--until", "serious", "--out", "out", "--learn", "off")


def essence(attempt: Mapping[str, Any]) -> tuple[object, ...]:
    """What an attempt came to."""
    return attempt["ending"], tuple(attempt["adversaries"]), attempt["collided"], attempt["min_ttc"]


@needs_fork
@pytest.mark.parametrize(
    ("driver", "says"),
    [
        (
            "ChangesLane",
            "The ego 'strange_drivers:ChangesLane' failed in act at 6.5 s: ValueError: output array is read",
        ),
        ("ChangesEdges", "failed in act at 6.5 s: ValueError: assignment destination is read-only (strange_drivers.py"),
        ("Forces", "failed in act at 6.5 s: ValueError: cannot set WRITEABLE flag"),
        ("Interrupts", "The ego 'strange_drivers:Interrupts' failed in act at 6.5 s: KeyboardInterrupt"),
        ("OwnBase", "The ego 'strange_drivers:OwnBase' failed in act at 6.5 s: Mine: as I like (strange_drivers.py, "),
        ("FarLane", "The ego 'strange_drivers:FarLane' returned LaneSpeed(lane=1000000"),
    ],
)
def test_the_sentence_names_the_driver(program: Program, driver: str, says: str) -> None:
    done = program.here(*RUN, "--ego", f"strange_drivers:{driver}")
    assert (done.status, done.outcome["ending"]) == (1, "simulation_failed")
    assert says in done.err


@needs_fork
@pytest.mark.parametrize("driver", ["IgnoresChildren", "Closes", "Forks", "LeavesSleeper"])
def test_a_process_that_a_driver_has_changed_goes_on(program: Program, driver: str) -> None:
    """Each drives as SUMO does, so its three attempts are those of a driver that does nothing strange."""
    done = program.here(*RUN, "--ego", f"strange_drivers:{driver}")
    assert done.status == 0, done.err
    assert [each["ending"] for each in done.outcome["attempts"]] != ["crashed"] * 3
    plain = program.here(*(word if word != "out" else "plain" for word in RUN), "--ego", "strange_drivers:Strange")
    assert plain.status == 0
    of = json.loads((program.folder / "plain" / "outcome.json").read_text(encoding="utf-8"))["attempts"]
    assert list(map(essence, done.outcome["attempts"])) == list(map(essence, of))


# -- SUMO that does not return ----------------------------------------------------------------------------------------


class Stuck:
    """A worker in which SUMO works for ten minutes."""

    def __init__(self, slots: list[Connection]) -> None:
        pass

    def work(self) -> None:
        with sumo_at_work("in a step", 0.2):
            time.sleep(600.0)


def test_a_step_of_sumo_that_does_not_return_is_a_sentence() -> None:
    with (
        Engine(Stuck) as engine,
        pytest.raises(Exception, match=r"SUMO did not return within 0\.2 s in a step") as said,
    ):
        engine.call(Stuck.work)
    assert type(said.value).__name__ == "SimulationError"
    assert engine.lost


NODES = '<nodes><node id="a" x="0" y="0"/><node id="b" x="300" y="0"/></nodes>'
EDGES = '<edges><edge id="ab" from="a" to="b" numLanes="2" sidewalkWidth="2"/></edges>'
ROUTES = """<routes><vehicle id="ego" depart="0"><route edges="ab"/></vehicle>
<person id="p" depart="2"><walk edges="ab"/></person>
<vehicle id="other" depart="3"><route edges="ab"/></vehicle></routes>"""
LOOP = """<configuration><net-file value="n.net.xml"/><route-files value="r.rou.xml"/>
<begin value="0"/><end value="60"/><step-length value="0.1"/>
<pedestrian.striping.stripe-width value="0.0000002"/></configuration>"""


def looping(folder: Path) -> None:
    """A simulation in which SUMO counts ten million stripes of a sidewalk for each pedestrian and step."""
    (folder / "n.nod.xml").write_text(NODES)
    (folder / "n.edg.xml").write_text(EDGES)
    (folder / "r.rou.xml").write_text(ROUTES)
    (folder / "loop.sumocfg").write_text(LOOP)
    netconvert = find_sumo().with_name("netconvert")
    command = [str(netconvert), "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)


def below(pid: int) -> list[int]:
    """The children of a process, and theirs."""
    try:
        children = [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []
    return [*children, *(each for child in children for each in below(child))]


def looping_in(pid: int, within: float) -> list[int]:
    """Processes below one that have used much of a processor, as soon as there are some; and all beside them."""
    until = time.monotonic() + within
    while time.monotonic() < until:
        time.sleep(0.2)
        if any(seconds_of(each) > 4.0 for each in below(pid)):
            return below(pid)
    return []


def ends(pid: int, within: float) -> bool:
    until = time.monotonic() + within
    while time.monotonic() < until:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return True
        if state == "Z":
            return True
        time.sleep(0.05)
    return False


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_run_whose_sumo_loops_can_be_ended(program: Program, number: signal.Signals) -> None:
    looping(program.folder)
    with program.start("run", "loop.sumocfg", "--ego-id", "ego", "--learn", "off", "--out", "out") as process:
        try:
            busy = looping_in(process.pid, 60.0)
            assert busy, "SUMO does not loop"
            os.kill(process.pid, number)
            assert ends(process.pid, 15.0)
            for pid in busy:
                assert ends(pid, 5.0), "SUMO goes on without the command"
        finally:
            process.kill()


def seconds_of(pid: int) -> float:
    """Processor time of a process [s]."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
