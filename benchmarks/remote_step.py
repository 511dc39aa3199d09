"""What our own TraCI connection costs a step, beside libsumo and stock ``traci`` with a context subscription.

``python benchmarks/remote_step.py``; about a minute.  20 and 100 vehicles that crawl along
``straight_3lane``.  Windows of 10 steps alternate: all states read by libsumo, by our connection, and by stock
``traci`` (position, angle, speed, lane, lane position subscribed for all vehicles at once: a step with that less a step
without).  Figures are medians over all steps.  Bound: ours reads in at most 0.6 of stock's time, at 100 vehicles.
"""

from __future__ import annotations

import argparse
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import traci
from traci import constants

from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.programs import find_sumo
from sumo_adv.simulation.remote import VEHICLE_STATE, Remote
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec

BOUND = 0.6
WINDOW, WARM_UP = 10, 300  # steps
Step = Callable[[], Any]


def demand(folder: Path, count: int) -> Path:
    """Vehicles that crawl along three lanes in line: they all stay on the road."""
    crawling = "".join(
        f'<vehicle id="v{k}" type="t" depart="0" departLane="{k % 3}" departPos="{20 + 14 * (k // 3)}" '
        'departSpeed="1"><route edges="eastbound"/></vehicle>'
        for k in range(count)
    )
    file = folder / f"{count}.rou.xml"
    file.write_text(f'<routes><vType id="t" maxSpeed="1.2" sigma="0"/>{crawling}</routes>')
    return file


def connected(spec: SimulationSpec) -> tuple[traci.connection.Connection, subprocess.Popen[bytes]]:
    """A SUMO program and a stock connection to it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = subprocess.Popen(
        [str(find_sumo()), *spec.arguments(), "--remote-port", str(port)], stdout=subprocess.DEVNULL
    )
    for _ in range(200):
        try:
            return traci.connect(port, numRetries=0, host="127.0.0.1"), process
        except traci.FatalTraCIError:
            time.sleep(0.05)
    raise SystemExit("SUMO did not start")


def timed(samples: list[float], timed_part: Step, before: Step = lambda: None) -> None:
    """Add the microseconds that a part takes, each time after something that is not timed."""
    for _ in range(WINDOW):
        before()
        began = time.perf_counter()
        timed_part()
        samples.append((time.perf_counter() - began) * 1e6)


def measure(spec: SimulationSpec, windows: int) -> dict[str, list[float]]:
    """Microseconds, a sample a step: reading by libsumo and by us, a step of stock ``traci`` without and with it."""
    library = Simulation(spec)
    (ours, first), (stock, second) = connected(spec), connected(spec)
    remote = Remote(ours)
    samples: dict[str, list[float]] = {
        n: [] for n in ("libsumo read", "our read", "our step", "stock step", "stock all")
    }
    for step in (library.step, remote.step, stock.simulationStep):
        for _ in range(WARM_UP):
            step()
    for _ in range(windows):
        timed(samples["libsumo read"], library.read, library.step)
        timed(samples["our read"], remote.read, remote.step)
        timed(samples["our step"], remote.step)
        timed(samples["stock step"], stock.simulationStep)
        stock.simulation.subscribeContext("", constants.CMD_GET_VEHICLE_VARIABLE, -1, list(VEHICLE_STATE))
        timed(samples["stock all"], stock.simulationStep)
        stock.simulation.unsubscribeContext("", constants.CMD_GET_VEHICLE_VARIABLE, -1)
    library.close()
    for connection, process in ((ours, first), (stock, second)):
        connection.close(wait=False)
        process.wait()
    return samples


def main() -> int:
    """Print the table; 1 if the bound is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--windows", type=int, default=80)
    windows = parser.parse_args().windows
    broken = False
    print("vehicles  libsumo read  our read  stock read  ours / stock   our step  stock step   [us, medians]")
    with tempfile.TemporaryDirectory() as folder:
        for count in (20, 100):
            net = data_folder("networks") / "straight_3lane.net.xml"
            spec = SimulationSpec(net, (demand(Path(folder), count),), (), 0.0, 1)
            median = {name: statistics.median(values) for name, values in measure(spec, windows).items()}
            stock = median["stock all"] - median["stock step"]
            ratio = median["our read"] / stock
            print(
                f"{count:8d} {median['libsumo read']:13.0f} {median['our read']:9.0f} {stock:11.0f} {ratio:13.2f} "
                f"{median['our step']:10.0f} {median['stock step']:11.0f}"
            )
            broken |= count == 100 and ratio > BOUND
    return int(broken)


if __name__ == "__main__":
    sys.exit(main())
