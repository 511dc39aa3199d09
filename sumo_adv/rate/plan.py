"""What an estimate is of: the input, the ego, the traffic and the model. All of it is in ``plan.json``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from sumo_adv.config import load_settings
from sumo_adv.drivers import make_ego
from sumo_adv.drivers.registry import trusted_driver
from sumo_adv.episode.task import Task, make_task, refuse_density
from sumo_adv.errors import UsageError
from sumo_adv.rate.model import PER_HOUR
from sumo_adv.simulation.demand import generate_flows
from sumo_adv.simulation.inputs import load_input
from sumo_adv.simulation.scan import scan_demand

SCHEMA = 1
WAIT = 60.0  # s after the warm-up within which the ego must come


@dataclass(frozen=True, slots=True)
class RatePlan:
    """An estimate. source: as the command line names it; ego None = as the input says, else idm; density: departures a
    minute of generated traffic; warm_up, duration [s]: of a run; factor: of all error rates; pilot: number of runs."""

    source: Path
    ego: str | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)
    density: float | None = None
    warm_up: float = 20.0
    duration: float = 60.0
    factor: float = 1.0
    pilot: int = 200
    plain: bool = False
    seed: int = 0

    def task(self, folder: Path) -> Task:
        """What SUMO is started with; traffic is generated into ``folder`` if the input has none.

        Raises UsageError: the input cannot be read, or is a recording; there is no such ego.
        """
        given = load_input(self.source)
        if given.playback is not None:
            raise UsageError(f"{self.source} plays a recording, where vehicles do not react; give a network.")
        refuse_density(given, self.density)
        driven = any(scan.vehicles or scan.flows for scan in map(scan_demand, given.additional))
        if not given.routes and not driven:
            end = self.warm_up + WAIT + self.duration
            density = given.density if self.density is None else self.density
            flows = generate_flows(given.network, folder / "flows.rou.xml", density=density, end=end)
            given = replace(given, routes=(flows,), begin=0.0)
        ego = trusted_driver(self.ego, given.ego_controller, given.source)
        chosen = {} if ego is None else {"ego": ego}
        settings = load_settings(None, **chosen, ego_parameters=dict(self.parameters), seed=self.seed)
        task = make_task(given, settings, folder)
        make_ego(task.ego_driver, task.ego_parameters)
        return task

    def content(self) -> str:
        """The SHA-256 of all files of the input. Raises UsageError or OSError."""
        files = load_input(self.source).files
        return sha256(b"".join(sha256(file.read_bytes()).digest() for file in files)).hexdigest()

    def document(self) -> dict[str, Any]:
        """The plan as JSON, with the content of the input and the rates of the model."""
        return {
            "schema": SCHEMA, **asdict(self), "source": str(self.source), "parameters": dict(self.parameters),
            "content": self.content(), "errors_per_hour": {str(kind): value for kind, value in PER_HOUR.items()},
        }  # fmt: skip
