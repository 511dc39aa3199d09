"""What the gate costs an ego's client, against native SUMO with two clients and the same traffic.

``python benchmarks/gate_cost.py``; about a minute.  Two SUMO programs run side by side, one with its second client
connected directly, one through the gate; both clients are processes of their own that speak stock ``traci``.  The
windows alternate, native (A), gate (B), A, B, ...; a row gives the ratio B/A pair by pair.

A step: the server's and the client's ``simulationStep`` and SUMO's own work.  A getter: ``vehicle.getSpeed`` in the
client's turn.  A window counts with the median of its calls, a row with the median ratio of its pairs: that is bounded.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import traci

from sumo_adv.serve.gate import Gate
from sumo_adv.serve.sumo_process import SumoProcess
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.simulation_spec import SimulationSpec

BOUNDS = {"step": 1.5, "getter": 3.5}  # gate over native, at most
SPEED, SPACING, START = 25.0, 45.0, 40.0  # m/s; m between vehicles of a lane; m from the road's begin to the last
CLIENT = """\
import statistics, sys, time, traci
client = traci.connect(int(sys.argv[1]), host="127.0.0.1")
client.setOrder(2)
client.simulationStep()
print("ready", flush=True)
for line in sys.stdin:
    what, count = line.split()
    ask = client.simulationStep if what == "step" else lambda: client.vehicle.getSpeed("v0")
    ask()
    times = []
    for _ in range(int(count)):
        began = time.perf_counter()
        ask()
        times.append(time.perf_counter() - began)
    print(statistics.median(times), flush=True)
    if what == "getter":
        client.simulationStep()
"""


def traffic(file: Path, vehicles: int) -> None:
    """Demand for the shipped motorway: ``vehicles`` cars on three lanes, all there from the first step to the last."""
    rows = (
        f'<vehicle id="v{k}" type="car" depart="0" departLane="{k % 3}" departPos="{START + SPACING * (k // 3)}" '
        f'departSpeed="{SPEED}"><route edges="eastbound"/></vehicle>'
        for k in range(vehicles)
    )
    file.write_text(f'<routes><vType id="car" sigma="0.5" maxSpeed="{SPEED}"/>{"".join(rows)}</routes>')


class Side:
    """One SUMO, our connection to it, and the ego's client."""

    def __init__(self, ours: Any, client: subprocess.Popen[str]) -> None:
        self._ours = ours
        self._client = client

    def window(self, action: str, count: int) -> float:
        """Microseconds of one step or getter, the window's median."""
        assert self._client.stdin is not None and self._client.stdout is not None
        print(action, count, file=self._client.stdin, flush=True)
        for _ in range(count + 1 if action == "step" else 1):
            self._ours.simulationStep()
        return 1e6 * float(self._client.stdout.readline())


@contextmanager
def side(arguments: Sequence[str], gate: Gate | None) -> Iterator[Side]:
    """A side that is ready, its client one step into the simulation."""
    with SumoProcess(arguments) as sumo:
        if gate is not None:
            gate.attach(sumo, own={"v0"})
        ours = connect(sumo)
        client = subprocess.Popen(
            [sys.executable, "-c", CLIENT, str(gate.port if gate else sumo.port)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert client.stdout is not None
        ours.setOrder(1)
        if gate is not None:
            gate.wait_connected(30.0)
        ours.simulationStep()
        assert client.stdout.readline() == "ready\n"
        yield Side(ours, client)
        client.kill()
        client.communicate()
        if gate is not None:
            gate.detach()


def connect(sumo: SumoProcess) -> Any:
    """Our own connection to a SUMO that may not listen yet."""
    while True:
        try:
            return traci.connect(sumo.port, numRetries=0, host="127.0.0.1")
        except traci.FatalTraCIError:
            if not sumo.alive:
                raise SystemExit(f"SUMO did not start: {sumo.last_error}") from None


def measure(vehicles: int, pairs: int, steps: int, getters: int) -> dict[str, list[tuple[float, float]]]:
    """Pairs (native, gate) of microseconds, for steps and getters."""
    with tempfile.TemporaryDirectory(prefix="sumo_adv-") as folder, ExitStack() as stack:
        routes = Path(folder) / "traffic.rou.xml"
        traffic(routes, vehicles)
        arguments = SimulationSpec(data_folder("networks") / "motorway.net.xml", (routes,), (), 0.0, 0).arguments()
        native = stack.enter_context(side(arguments, None))
        gated = stack.enter_context(side(arguments, stack.enter_context(Gate())))
        times: dict[str, list[tuple[float, float]]] = {}
        for action, count in (("step", steps), ("getter", getters)):
            both = [(native.window(action, count), gated.window(action, count)) for _ in range(pairs + 1)]
            times[action] = both[1:]
    return times


HEADER = "vehicles  what      native us   gate us   ratio: min median max"


def main() -> int:
    """Print a row a case; 1 if one is over its bound."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--vehicles", type=int, nargs="+", default=[20, 100], help="how many are on the road")
    parser.add_argument("--pairs", type=int, default=9, help="counted pairs of windows a row")
    parser.add_argument("--steps", type=int, default=25, help="steps of 0.1 s in a window")
    parser.add_argument("--getters", type=int, default=1000, help="getters in a window")
    given = parser.parse_args()
    print(HEADER)
    over = False
    for vehicles in given.vehicles:
        for action, pairs in measure(vehicles, given.pairs, given.steps, given.getters).items():
            ratios = [b / a for a, b in pairs]
            low, middle, high = min(ratios), statistics.median(ratios), max(ratios)
            native, gated = (statistics.median(column) for column in zip(*pairs, strict=True))
            over |= middle > BOUNDS[action]
            print(
                f"{vehicles:8d}  {action:8s}  {native:9.1f}  {gated:8.1f}  {low:10.2f} {middle:6.2f} {high:5.2f}"
                f"  (bound {BOUNDS[action]:g})",
                flush=True,
            )
    return int(over)


if __name__ == "__main__":
    sys.exit(main())
