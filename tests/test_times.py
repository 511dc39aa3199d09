"""SUMO counts time in whole milliseconds: so does what a driver is told, and what one command writes for the next."""

from __future__ import annotations

import gzip
import json

import pytest
from cli_samples import Program
from sumo_samples import TYPES, vehicle

from sumo_adv.config import Settings
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.times import seconds_text, whole_milliseconds

ROAD = data_folder("networks") / "straight_3lane.net.xml"


@pytest.mark.parametrize("given", [0.0333, 0.0335, 0.0325, 0.0016, 0.04166666, 0.1])
def test_a_step_is_the_one_that_sumo_takes(given: float) -> None:
    simulation = Simulation(SimulationSpec(ROAD, (), (), 0.0, 0, given))
    try:
        taken = float(simulation.api.simulation.getDeltaT())
    finally:
        simulation.close()
    assert whole_milliseconds(given) == taken == Settings(step_length=given).step_length


def test_sumo_takes_no_step_below_a_millisecond() -> None:
    with pytest.raises(ValueError, match=r"shorter than SUMO's shortest step of 0.001 s"):
        Settings(step_length=0.0004)


@pytest.mark.parametrize(
    ("time", "text"), [(0.1, "0.10"), (12.0, "12.00"), (0.033, "0.033"), (3.3, "3.30"), (1 / 30, "0.033333")]
)
def test_times_have_the_digits_that_they_need(time: float, text: str) -> None:
    assert seconds_text(time) == text


OWN = f"""<configuration><input><net-file value="{ROAD}"/><route-files value="own.rou.xml"/></input>
<time><begin value="0"/><end value="40"/><step-length value="0.0333"/></time></configuration>"""
CARS = [
    vehicle("lead", "eastbound", 1, 150.0, 14.0), vehicle("ego", "eastbound", 1, 100.0, 15.0),
    vehicle("left", "eastbound", 2, 95.0, 15.0),
]  # fmt: skip
DRIVER = """
class Own:
    forkable = True
    def reset(self, seed): pass
    def act(self, seen):
        assert seen.dt == 0.033, seen.dt
"""


def test_what_a_run_with_steps_of_a_thirtieth_writes_the_other_commands_read(program: Program) -> None:
    """0.0333 s are 33 ms in SUMO: rows come at 0.033, 0.066, 0.099, 0.132 s ..."""
    (program.folder / "own.sumocfg").write_text(OWN)
    (program.folder / "own.rou.xml").write_text(f"<routes>{TYPES}{''.join(CARS)}</routes>")
    (program.folder / "own_driver.py").write_text(DRIVER)
    options = ("--attempts", "1", "--until", "collision", "--learn", "off", "--out", "out", "--json")
    first = program.here("run", "own.sumocfg", "--ego-id", "ego", "--ego", "own_driver:Own", *options)
    assert first.status == 0, first.err
    rows = gzip.decompress((first.folder / "states.csv.gz").read_bytes()).decode().splitlines()[1:]
    times = sorted({float(row.split(",")[0]) for row in rows})
    assert times == [pytest.approx(0.033 * (k + 1), abs=1e-9) for k in range(len(times))]
    again = program.here("run", "--replay", first.folder, "--ego", "own_driver:Own", "--out", "again", "--json")
    assert again.status == 0, again.err
    states = [(program.folder / name / "states.csv.gz").read_bytes() for name in ("out", "again")]
    assert states[0] == states[1]
    level = json.loads((first.folder / "outcome.json").read_text())["outcome"]["level"]
    judged = json.loads(program.here("judge", "out", "--json").out)
    assert [run["level"] for run in judged["runs"]] == [level]
    kept = program.here("keep", "out", "--suite", "suite", "--all")
    assert kept.status == 0, kept.err
    regressed = program.here("regress", "suite", "--ego", "own_driver:Own", "--json")
    assert json.loads(regressed.out)["cases"][0]["level"] == level
