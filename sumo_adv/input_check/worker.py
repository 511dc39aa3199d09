"""Run a simulation of this program unattacked in the engine process, with the same adapter and files as in a run."""

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
    """The result of a simulation of this program.

    Attributes:
        motions: The motions of the vehicles and persons.
        classes: The number of vehicles and persons on foot, by SUMO's class.
    """

    motions: Motions
    classes: Mapping[str, int]


class WatchWorker:
    """Runs simulations in the engine process."""

    def __init__(self, slots: Sequence[Connection]) -> None:
        """Accept the connections ``slots``, which are not used because no fork runs."""

    def watch(self, spec: SimulationSpec, until: float) -> Watched:
        """Run a simulation.

        Args:
            spec: The simulation.
            until: The time at which to stop [s].

        Raises:
            UsageError: SUMO does not run the simulation.
            SimulationError: SUMO does not run the simulation.
        """
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
