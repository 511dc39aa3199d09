"""SUMO traffic to learn from: networks of ours and generated ones, with drivers of many kinds.

Everything is drawn from a seed and the number of the run. Networks of ``HELD_OUT`` and the generated networks of
held-out runs are never trained on.
"""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random
from xml.sax.saxutils import quoteattr

from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.simulation.demand import Journey, default_density, journeys
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.programs import find_netconvert
from sumo_adv.simulation.simulation import RawState, Simulation, SimulationSpec
from sumo_adv.situation import Signal

HELD_OUT = (
    "curved_4lane", "onramp_merge", "priority_crossing", "roundabout", "signalised_wide", "straight_3lane",
    "t_junction", "two_way_4lane",
)  # fmt: skip
"""Shipped networks that are kept for the evaluation."""

WARM_UP, SECONDS = 30.0, 180.0  # s: the network fills; of a run in all
EVERY = 15  # steps between two scenes of a run
TRIES = 5  # of netgenerate for a run
DRIVERS = 24  # kinds of drivers in a run
CROWD = (0.6, 2.2)  # of the usual density
MOST_DEPARTURES = 60.0  # a minute
MODELS = ("Krauss", "IDM", "EIDM")
SIZES = ((4.8, 1.8), (4.4, 1.8), (5.0, 1.9), (6.0, 2.1), (4.0, 1.7))  # m
JUNCTIONS = ("traffic_light", "traffic_light", "priority", "right_before_left", "allway_stop")


@dataclass(frozen=True, slots=True)
class Recorded:
    """A run: for each step of 0.1 s the vehicles' states, and at the steps of ``lights`` the lights ahead of each;
    length and width [m] by vehicle."""

    network: Path
    steps: Sequence[Mapping[str, RawState]]
    lights: Mapping[int, Mapping[str, Sequence[Signal]]]
    sizes: Mapping[str, tuple[float, float]]


def record(number: int, seed: int, folder: Path, *, held_out: bool, seconds: float = SECONDS) -> Recorded:
    """The traffic of one run; ``folder``: for its files.

    Raises:
        UsageError: netgenerate is not installed.
        SimulationError: SUMO or netgenerate fails.
    """
    draw = Random(f"{seed}/{held_out}/{number}")
    network, journeys = _network(number, draw, folder, held_out=held_out)
    routes = _demand(journeys, folder / "traffic.rou.xml", draw, seconds)
    simulation = Simulation(SimulationSpec(network, (routes,), (), 0.0, draw.randrange(10**6)))
    steps: list[Mapping[str, RawState]] = []
    lights: dict[int, dict[str, Sequence[Signal]]] = {}
    try:
        while simulation.time < WARM_UP:
            simulation.step()
        for k in range(round((seconds - WARM_UP) / simulation.spec.step_length)):
            simulation.step()
            steps.append(simulation.read().raw)
            if k % EVERY == 0:
                lights[k] = {name: simulation.signals(name) for name in steps[-1]}
        return Recorded(network, steps, lights, dict(simulation.fleet.sizes))
    finally:
        simulation.close()


def _network(number: int, draw: Random, folder: Path, *, held_out: bool) -> tuple[Path, list[Journey]]:
    """Shipped networks and generated ones in turn, with the routes through them."""
    if number % 2 == 0:
        shipped = sorted(data_folder("networks").glob("*.net.xml"))
        chosen = [path for path in shipped if (path.name.removesuffix(".net.xml") in HELD_OUT) == held_out]
        network = chosen[number // 2 % len(chosen)]
        return network, journeys(network, draw)
    for _ in range(TRIES):
        network = _generated(draw, folder / "generated.net.xml")
        with suppress(UsageError):  # no route leads through it
            return network, journeys(network, draw)
    raise SimulationError(f"netgenerate made no network with a route in {TRIES} tries; give another --seed.")


def _generated(draw: Random, target: Path) -> Path:
    """A small network by netgenerate: a grid or a random one."""
    program = find_netconvert()
    program = program.with_name(program.name.replace("netconvert", "netgenerate"))  # they are installed together
    flags = [
        "--default-junction-type", draw.choice(JUNCTIONS), "--default.lanenumber", str(draw.randint(1, 3)),
        "--default.speed", f"{draw.choice((30, 50, 50, 60, 70)) / 3.6:.2f}", "--default.junctions.radius",
        str(draw.choice((4, 6, 9))), "--seed", str(draw.randrange(10**6)), "--turn-lanes", str(draw.randint(0, 1)),
        "--no-turnarounds", "true", "--random-lanenumber", draw.choice(("true", "false")), "--random-priority", "true",
    ]  # fmt: skip
    if draw.random() < 0.5:
        length = str(draw.randint(90, 240))
        flags += ["--grid", "--grid.number", str(draw.randint(2, 3)), "--grid.length", length]
        flags += ["--grid.attach-length", length, "--perturb-x", f"normc(0,{draw.randint(1, 15)},-25,25)"]
    else:
        flags += ["--rand", "--rand.iterations", str(draw.randint(10, 24)), "--rand.min-distance", "90"]
        flags += ["--rand.max-distance", "250", "--rand.min-angle", "45", "--roundabouts.guess", "true"]
    done = subprocess.run([program, *flags, "-o", target], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SimulationError(f"netgenerate failed ({' '.join(done.stderr.split())}).")
    return target


def _demand(journeys: list[Journey], target: Path, draw: Random, seconds: float) -> Path:
    """Vehicles of ``DRIVERS`` kinds on the routes."""
    density = min(default_density(journeys) * draw.uniform(*CROWD), MOST_DEPARTURES)
    lines = ["<routes>\n", *(_driver(k, draw) for k in range(DRIVERS))]
    depart, number = 0.0, 0
    while depart < seconds:
        journey = draw.choices(journeys, weights=[j.lanes for j in journeys])[0]
        lane = draw.choice(("best", "best", "random", "free"))
        lines.append(
            f'<vehicle id="v{number}" type="driver{draw.randrange(DRIVERS)}" depart="{depart:.2f}" departLane="{lane}" '
            f'departSpeed="max"><route edges={quoteattr(" ".join(journey.edges))}/></vehicle>\n'
        )
        depart += draw.expovariate(density / 60.0)
        number += 1
    target.write_text("".join([*lines, "</routes>\n"]), encoding="utf-8")
    return target


def _driver(number: int, draw: Random) -> str:
    """A vType: car following, lane changing, speed and size."""
    model, (length, width) = draw.choice(MODELS), draw.choice(SIZES)
    values: dict[str, str | float] = {
        "id": f"driver{number}", "vClass": "passenger", "carFollowModel": model, "length": length, "width": width,
        "accel": draw.uniform(1.5, 3.5), "decel": draw.uniform(3.0, 6.0), "tau": draw.uniform(0.9, 2.0),
        "minGap": draw.uniform(1.0, 3.5), "speedFactor": draw.uniform(0.75, 1.25), "speedDev": 0.0,
        "lcSpeedGain": draw.uniform(0.3, 3.0), "lcKeepRight": draw.uniform(0.0, 1.5),
        "lcAssertive": draw.uniform(0.7, 2.0), "lcCooperative": draw.uniform(0.2, 1.0),
    }  # fmt: skip
    if model == "Krauss":
        values["sigma"] = draw.uniform(0.0, 0.7)
    attributes = " ".join(f'{k}="{v:.3f}"' if isinstance(v, float) else f'{k}="{v}"' for k, v in values.items())
    return f"<vType {attributes}/>\n"
