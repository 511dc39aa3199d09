"""Recorded traffic lights: their states, how long these hold, and refusals."""

from __future__ import annotations

from pathlib import Path

import pytest

from sumo_adv.errors import UsageError
from sumo_adv.geometry import Pose
from sumo_adv.simulation.inputs import data_folder, load_input
from sumo_adv.simulation.network import read_network
from sumo_adv.simulation.playback import Playback
from sumo_adv.simulation.signals import read_signals
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec

RED, GREEN = "r" * 16, "G" * 16
TRACKS = "time,id,kind,valid,x,y,heading,speed,length,width\n" + "".join(
    f"{0.1 * k:.1f},far,vehicle,1,-150,60,0,0,4.5,1.9\n" for k in range(31)
)


def played(folder: Path, signals: str, tracks: str = "") -> tuple[Simulation, Playback]:
    """The signalised crossing (north and south have green at first in its own program) with recorded lights."""
    network = data_folder("networks") / "signalised_crossing.net.xml"
    (folder / "lights.csv").write_text(signals)
    (folder / "log.csv").write_text(tracks)
    text = f'schema = 1\nnetwork = "{network}"\n' + ('tracks = "log.csv"\n' if tracks else "")
    (folder / "case.toml").write_text(text + '[signals]\nlog = "lights.csv"\n')
    run_input = load_input(folder / "case.toml")
    assert run_input.playback is not None
    log = Playback(run_input.playback, read_network(network), begin=0.0, step=0.1, ego=None, warm_up=0.0)
    types = folder / "types.add.xml"
    types.write_text('<additional><vType id="sumo_adv_logged"/></additional>')
    simulation = Simulation(SimulationSpec(network, (), (types,), 0.0, 1))
    log.start(simulation)
    return simulation, log


def shown(simulation: Simulation, log: Playback, until: float) -> list[str]:
    """What the light shows after each step."""
    seen: list[str] = []
    while simulation.time < until - 1e-6:
        driven: dict[str, Pose] = {}
        log.before_step(simulation.read().raw, simulation.time, driven)
        simulation.inject(driven)
        simulation.step()
        seen.append(simulation.api.trafficlight.getRedYellowGreenState("centre"))
    return seen


def test_a_recorded_state_holds_until_the_next(tmp_path: Path) -> None:
    simulation, log = played(tmp_path, f"time,tls,state\n0.3,centre,{RED}\n1.0,centre,{GREEN}\n")
    try:
        states = shown(simulation, log, 40.0)
        assert states[1] == "rrrrGGGgrrrrGGGg"  # at 0.2 s: the program's own
        assert states[2:9] == [RED] * 7  # 0.3 to 0.9 s
        assert set(states[9:]) == {GREEN}  # for good, as no log ends
        assert len(states) == 400
    finally:
        simulation.close()


def test_after_the_log_the_program_goes_on_and_it_repeats(tmp_path: Path) -> None:
    simulation, log = played(tmp_path, f"time,tls,state\n0.0,centre,{RED}\n", TRACKS)
    try:
        states = shown(simulation, log, 4.0)
        assert set(states[:30]) == {RED}
        assert RED not in states[30:]
        simulation.reload()
        log.start(simulation)
        assert shown(simulation, log, 4.0) == states
    finally:
        simulation.close()


@pytest.mark.parametrize("row", ["0.0,nowhere,rr", "0.0,centre,rr"])
def test_a_light_that_the_network_lacks_is_refused(tmp_path: Path, row: str) -> None:
    simulation, log = played(tmp_path, f"time,tls,state\n{row}\n")
    try:
        with pytest.raises(UsageError, match="recorded signal"):
            log.before_step({}, 0.0, {})
            simulation.step()
    finally:
        simulation.close()


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("", "line 1 must be 'time,tls,state'"),
        ("time,tls,state\nnow,a,rr\n", "line 2 is not"),
        ("time,tls,state\n0.0,a,rr\n0.1,a,purple\n", "line 3 is not"),
        ("time,tls,state\n0.0,a\n", "line 2 is not"),
        ("time,tls,state\n0.5,a,rr\n0.1,a,GG\n", "the times of 'a' must rise"),
    ],
)
def test_bad_files_are_refused_by_line(tmp_path: Path, text: str, part: str) -> None:
    path = tmp_path / "lights.csv"
    path.write_text(text)
    with pytest.raises(UsageError) as caught:
        read_signals(path)
    assert part in str(caught.value)
