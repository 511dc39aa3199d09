"""Human errors in SUMO: when each is possible, and what the vehicle then does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from sumo_adv.simulation.human_errors import ErrorKind, HumanErrors, speed_in_error
from sumo_adv.simulation.inputs import find_input
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.sumo_states import Snapshot


@contextmanager
def traffic(network: str, routes: dict[str, tuple[tuple[str, ...], float, int, float]]) -> Iterator[Simulation]:
    """Vehicles by name, each with its edges, position [m], lane and speed [m/s], after the first step."""
    simulation = Simulation(SimulationSpec(find_input(Path(network)), (), (), 0.0, 1))
    try:
        for name, (edges, position, lane, speed) in routes.items():
            depart = {"departPos": str(position), "departLane": str(lane), "departSpeed": str(speed), "depart": "0"}
            simulation.add(name, edges, "DEFAULT_VEHTYPE", depart)
        simulation.step()
        yield simulation
    finally:
        simulation.close()


def drive(simulation: Simulation, errors: HumanErrors, seconds: float) -> Snapshot:
    for _ in range(round(seconds * 10)):
        errors.before_step()
        simulation.step()
    return simulation.read()


EAST = ("eastbound",)


def test_late_braking_keeps_the_speed_for_a_reaction_time_and_then_brakes() -> None:
    speeds = [speed_in_error(ErrorKind.LATE_BRAKING, 15.0, after) for after in (0.0, 1.5, 2.5, 4.5)]
    assert speeds == [15.0, 15.0, 9.0, 0.0]
    assert speed_in_error(ErrorKind.INATTENTION, 15.0, 2.9) == 15.0


def test_what_is_possible_depends_on_lanes_and_speed() -> None:
    cars = {"right": (EAST, 100.0, 0, 14.0), "left": (EAST, 100.0, 1, 14.0), "standing": (EAST, 200.0, 1, 0.0)}
    with traffic("straight_2lane", cars) as simulation:
        errors, raw = HumanErrors(simulation), simulation.read().raw
        both = {ErrorKind.INATTENTION, ErrorKind.LATE_BRAKING}
        assert set(errors.possible("right", raw["right"])) == both | {ErrorKind.CHANGE_LEFT, ErrorKind.DRIFT_LEFT}
        assert set(errors.possible("left", raw["left"])) == both | {ErrorKind.CHANGE_RIGHT, ErrorKind.DRIFT_RIGHT}
        assert errors.possible("standing", raw["standing"]) == ()
        errors.begin("left", ErrorKind.INATTENTION, 14.0)
        assert errors.possible("left", raw["left"]) == ()


def test_inattention_lets_a_driver_run_into_a_slower_one() -> None:
    """The leader, 17.5 m ahead, brakes with 4.5 m/s2: 21.7 m in 2.9 s. A car that keeps 14 m/s drives 40.6 m."""
    cars = {"leader": (EAST, 130.0, 0, 14.0), "car": (EAST, 107.5, 0, 14.0)}
    gaps = []
    for err in (False, True):
        with traffic("straight_2lane", cars) as simulation:
            simulation.api.vehicle.setMaxSpeed("leader", 1.0)
            simulation.api.vehicle.setLaneChangeMode("car", 0)
            errors = HumanErrors(simulation)
            if err:
                errors.begin("car", ErrorKind.INATTENTION, simulation.read().raw["car"][3])
            raw = drive(simulation, errors, 2.9).raw
            gaps.append(raw["leader"][0] - 5.0 - raw["car"][0])  # of default cars, 5 m long
            drive(simulation, errors, 0.3)
            assert errors.active == {}
    assert gaps[0] > 0.0 > gaps[1]


@pytest.mark.parametrize(("kind", "metres"), [(ErrorKind.DRIFT_RIGHT, -2.0), (ErrorKind.CHANGE_RIGHT, -3.5)])
def test_a_driver_comes_into_the_next_lane_though_a_vehicle_is_there(kind: ErrorKind, metres: float) -> None:
    cars = {"beside": (EAST, 100.0, 0, 14.0), "car": (EAST, 101.0, 1, 14.0)}
    with traffic("straight_2lane", cars) as simulation:
        errors, before = HumanErrors(simulation), simulation.read().raw["car"]
        errors.begin("car", kind, before[3])
        after = drive(simulation, errors, 3.9).raw["car"]
        assert after[1] - before[1] == pytest.approx(metres, abs=0.4)
        drive(simulation, errors, 0.2)
        assert errors.active == {} and errors.last["car"].kind is kind


def test_a_driver_runs_a_red_light() -> None:
    for err in (False, True):
        with traffic("signalised_crossing", {"car": (("south_in", "north_out"), 160.0, 0, 13.0)}) as simulation:
            simulation.api.trafficlight.setRedYellowGreenState("centre", "r" * len(simulation.light("centre")))
            errors = HumanErrors(simulation)
            snapshot = drive(simulation, errors, 0.7)
            assert ErrorKind.RED_LIGHT in errors.possible("car", snapshot.raw["car"])
            if err:
                errors.begin("car", ErrorKind.RED_LIGHT, snapshot.raw["car"][3])
            assert (drive(simulation, errors, 5.0).raw["car"][4] == "north_out_0") is err


def test_a_driver_does_not_give_way() -> None:
    cars = {
        "car": (("north_in", "south_out"), 165.0, 0, 8.0), "other": (("east_in", "west_out"), 145.0, 0, 14.0)
    }  # fmt: skip
    slowest = []
    for err in (False, True):
        with traffic("priority_crossing", cars) as simulation:
            errors = HumanErrors(simulation)
            snapshot = drive(simulation, errors, 2.0)
            assert ErrorKind.PRIORITY in errors.possible("car", snapshot.raw["car"])
            assert ErrorKind.PRIORITY not in errors.possible("other", snapshot.raw["other"])
            if err:
                errors.begin("car", ErrorKind.PRIORITY, snapshot.raw["car"][3])
            slowest.append(min(drive(simulation, errors, 0.1).raw["car"][3] for _ in range(30)))
    assert slowest[0] < 5.0 < 7.0 < slowest[1]
