"""The simulation of this program, unattacked, in the engine process: the same adapter and files as in a run."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path

from sumo_adv.drivers import make_ego
from sumo_adv.episode.drive import ego_type_file
from sumo_adv.input_check.motions import Motions, State
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec


@dataclass(frozen=True, slots=True)
class Watched:
    """The motions of a simulation, and its vehicles and persons on foot by SUMO's class."""

    motions: Motions
    classes: Mapping[str, int]


class WatchWorker:
    """Runs simulations, in the engine process."""

    def __init__(self, slots: Sequence[Connection]) -> None:
        """No fork runs, so the connections are not used."""

    def watch(self, spec: SimulationSpec, until: float) -> Watched:
        """Run a simulation until ``until`` [s]. Raises UsageError or SimulationError: SUMO does not run it."""
        motions: dict[str, dict[int, State]] = {}
        with tempfile.TemporaryDirectory(prefix="sumo_adv-") as folder:
            types = ego_type_file(make_ego("idm", {}), Path(folder))
            simulation = Simulation(replace(spec, additional=(*spec.additional, types)))
            try:
                while simulation.time < until - spec.step_length / 2:
                    simulation.step()
                    snapshot = simulation.read()
                    time = round(1000 * snapshot.time)
                    for name, (x, y, _, speed, _) in snapshot.raw.items():
                        if name not in simulation.fleet.persons:
                            simulation.vehicle_class(name)
                        motions.setdefault(name, {})[time] = (x, y, speed)
                classes = Counter(simulation.fleet.classes.values())
            finally:
                simulation.close()
        return Watched(motions, dict(classes.most_common()))
