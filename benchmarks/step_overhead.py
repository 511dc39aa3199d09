"""What the whole loop costs a step, against bare libsumo stepping of the same traffic.

``python benchmarks/step_overhead.py``; about a minute.  One engine process drives one simulation.  A window is an
attempt from the trigger to a collision some ten seconds later, gate verdict included; before each window the simulation
is loaded again and brought to the trigger, which is not timed.  The windows alternate: bare stepping (A), the whole
loop (B), A, B, ...; a row gives the ratio B/A pair by pair.

Whole loop: states of all vehicles read each step, ego's driver, one adversary advanced and injected each step, planner
asked every 0.5 s, verdict at the end.  The planner runs in the engine (``local``) or is asked for over the engine's
connection in the sandbox (``sandbox``).  Bounds: ego idm, base flags, local planner.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sumo_adv.config import load_settings
from sumo_adv.datatypes import Planner, Proposal, acceleration_at
from sumo_adv.episode.task import FoundEncounter, Task
from sumo_adv.episode.worker import EpisodeWorker
from sumo_adv.planners.answers import Answer, PlannerObservation, planner_road, world_endpoint
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.planners.text import HELPERS_CODE, make_planner
from sumo_adv.simulation.engine import Engine
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.simulation_spec import SimulationSpec

BOUNDS = {20: 8.0, 100: 2.2}  # vehicles -> whole loop with the verdict of its collision over bare stepping, at most
TRIGGER = 3.0  # s
SPEED, SPACING, START = 25.0, 45.0, 40.0  # m/s; m between vehicles of a lane; m from the road's begin to the last
EGO_LANE, ADVERSARY_LANE = 1, 2
STAND_IN = """\
PARAMETERS = {"ram": (9.0, 0.0, 60.0, "s", "time after the trigger at which it turns into the ego")}


def endpoint(bv, ego, road, parameters, acc, horizon):
    x, y, heading, speed = at(ego["path"], 2.0)
    aside = 3.8 if int(bv["time"] * 2 + 0.5) % 2 else 3.2
    if bv["time"] >= parameters["ram"]:
        aside = 0.0
    px, py = offset((x, y, heading), 1.0, aside)
    return {"x": px, "y": py, "heading": heading, "speed": speed, "time": 2.0}
"""  # drives beside the ego, swaying so that each answer bends its path anew, and turns into it at the end


class DurationSpec(SimulationSpec):
    """The same simulation with lane changes of 3 s instead of the sublane model."""

    def arguments(self) -> list[str]:
        """The base flags with ``--lanechange.duration 3`` for ``--lateral-resolution 0.8``."""
        kept = [each for each in super().arguments() if not each.startswith("--lateral-resolution=")]
        return [*kept, "--lanechange.duration=3"]


class Bench(EpisodeWorker):
    """The engine's worker, with windows of one and the same stretch timed."""

    def bare(self, steps: int) -> float:
        """Seconds of ``steps`` steps of SUMO alone, from the trigger on."""
        import libsumo

        self._again()
        step = libsumo.simulationStep
        began = time.perf_counter()
        for _ in range(steps):
            step()
        return time.perf_counter() - began

    def loop(self, proposal: Proposal, sandbox: bool) -> tuple[float, int, int, str]:
        """Seconds, steps and vehicles of one attempt with its verdict, and its ending."""
        self._again()
        slot = self._slots[0]
        local = _local(self._encounter.found, proposal)

        def ask(observation: PlannerObservation) -> Any:
            slot.send(observation)
            return slot.recv()

        began = time.perf_counter()
        result = self._encounter.attempt(proposal, [ask if sandbox else local])
        took = time.perf_counter() - began
        assert result.verdict is not None
        return took, len(result.snapshots), len(result.snapshots[-1].raw), result.driven.ending

    def _again(self) -> None:
        self._moved = True
        self._at_trigger()


def _local(encounter: FoundEncounter, proposal: Proposal) -> Callable[[PlannerObservation], Any]:
    """The planner as a plain function of this process."""
    space: dict[str, Any] = {}
    exec(HELPERS_CODE + proposal.planner.text, space)
    situation = encounter.situations[proposal.delay]
    road, planner = planner_road(situation, proposal.bv), space["endpoint"]

    def ask(observation: PlannerObservation) -> Any:
        acceleration = acceleration_at(proposal.acceleration, observation[0]["time"])
        answer = planner(*observation, road, proposal.parameters, acceleration, situation.horizon)
        return Answer(world_endpoint(situation, answer))

    return ask


def traffic(file: Path, vehicles: int) -> None:
    """Demand for the shipped motorway: ``vehicles`` cars on three lanes, all there from the first step to the last."""
    rows, middle = [], max(1, vehicles // 6)
    for k in range(vehicles):
        lane, place = k % 3, k // 3
        name = {(EGO_LANE, middle): "ego", (ADVERSARY_LANE, middle): "adversary"}.get((lane, place), f"v{k}")
        rows.append(
            f'<vehicle id="{name}" type="car" depart="0" departLane="{lane}" departPos="{START + SPACING * place}" '
            f'departSpeed="{SPEED}"><route edges="eastbound"/></vehicle>'
        )
    kind = f'<vType id="car" sigma="0.5" maxSpeed="{SPEED}" lcKeepRight="0" lcSpeedGain="0"/>'
    file.write_text(f"<routes>{kind}{''.join(rows)}</routes>")


@dataclass(frozen=True)
class Case:
    """One row: how many vehicles, which flags, which driver, where the planner runs."""

    vehicles: int
    flags: str  # base | duration
    ego: str
    planner: str  # local | sandbox

    def task(self, routes: Path, steps: int) -> Task:
        """The engine's task."""
        settings = load_settings(
            None, ego=self.ego, trigger=TRIGGER, duration=steps / 10, delays=(0.0,), adversary="adversary"
        )
        kind = SimulationSpec if self.flags == "base" else DurationSpec
        spec = kind(data_folder("networks") / "motorway.net.xml", (routes,), (), 0.0, 0, settings.step_length)
        return Task(spec, settings, "ego", None, self.ego, {}, ("adversary",), TRIGGER, 1.0, 60.0)


@dataclass(frozen=True)
class Row:
    """What a case came to: seconds of the pairs' windows."""

    case: Case
    steps: int
    vehicles: int
    ending: str
    bare: Sequence[float]
    loop: Sequence[float]

    @property
    def ratios(self) -> list[float]:
        """Whole loop over bare stepping, pair by pair."""
        return [b / a for a, b in zip(self.bare, self.loop, strict=True)]

    def __str__(self) -> str:
        low, middle, high = min(self.ratios), statistics.median(self.ratios), max(self.ratios)
        bare, loop = (1e6 * statistics.median(s) / self.steps for s in (self.bare, self.loop))
        case = self.case
        return (
            f"{self.vehicles:8d}  {case.flags:8s}  {case.ego:7s}  {case.planner:7s}  {self.steps:5d}  {bare:8.0f}"
            f"  {loop:8.0f}  {low:5.2f} {middle:5.2f} {high:5.2f}  {self.ending}"
        )


HEADER = "vehicles  flags     ego      planner  steps   bare us   loop us  ratio: min median max  ending"


def measure(case: Case, pairs: int, steps: int, sandbox: Sandbox) -> Row:
    """One case in an engine of its own, after a pair that is not counted."""
    planner = make_planner("Benchmark", "stand-in", STAND_IN, "person")
    proposal = _proposal(planner, ram=max(0.0, steps / 10 - 3.0))
    with tempfile.TemporaryDirectory(prefix="sumo_adv-") as folder, Engine(Bench) as engine:
        routes = Path(folder) / "traffic.rou.xml"
        traffic(routes, case.vehicles)
        engine.call(Bench.open, case.task(routes, steps))
        encounter = engine.call(Bench.seek)
        if not isinstance(encounter, FoundEncounter):
            raise SystemExit(f"The benchmark's own encounter was not found: {encounter.reason}")
        with Sessions(sandbox, Roads(encounter.situations), [proposal], 0) as sessions:

            def window() -> tuple[float, int, int, str]:
                remote = case.planner == "sandbox"
                return engine.call_answering(
                    lambda observation: sessions.answer(proposal, observation), Bench.loop, proposal, remote
                )

            _, count, vehicles, ending = window()
            engine.call(Bench.bare, count)
            times = [(engine.call(Bench.bare, count), window()[0]) for _ in range(pairs)]
    return Row(case, count, vehicles, ending, [a for a, _ in times], [b for _, b in times])


def _proposal(planner: Planner, ram: float) -> Proposal:
    return replace(Proposal("adversary", planner.label, planner, {}, 0.0, 0.0), parameters={"ram": ram})


def cases(vehicles: Sequence[int]) -> list[Case]:
    """The bounded rows first."""
    rows = [Case(n, "base", "idm", "local") for n in vehicles]
    for n in vehicles:
        rows += [
            Case(n, "base", "idm", "sandbox"), Case(n, "base", "careful", "local"), Case(n, "duration", "idm", "local"),
        ]  # fmt: skip
    return rows


def main() -> int:
    """Print a row a case; 1 if a bounded one is over its bound."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--vehicles", type=int, nargs="+", default=sorted(BOUNDS), help="how many are on the road")
    parser.add_argument("--pairs", type=int, default=7, help="counted pairs of windows a row")
    parser.add_argument("--steps", type=int, default=120, help="longest window, steps of 0.1 s")
    given = parser.parse_args()
    print(HEADER)
    over = False
    with Sandbox() as sandbox:
        for case in cases(given.vehicles):
            row = measure(case, given.pairs, given.steps, sandbox)
            bound = (
                BOUNDS.get(case.vehicles) if (case.flags, case.ego, case.planner) == ("base", "idm", "local") else None
            )
            over |= bound is not None and statistics.median(row.ratios) > bound
            print(f"{row}{f'  (bound {bound:g})' if bound else ''}", flush=True)
    return int(over)


if __name__ == "__main__":
    sys.exit(main())
