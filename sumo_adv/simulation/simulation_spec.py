"""What SUMO is started with, as a command line."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from sumo_adv.errors import UsageError
from sumo_adv.simulation.given_options import HOME, VARIABLE, check
from sumo_adv.simulation.sumo_options import DEFAULTS, FORCED


@dataclass(frozen=True, slots=True)
class SimulationSpec:
    """What SUMO is started with.

    Attributes:
        network: The network file.
        routes: The route files.
        additional: The additional files.
        begin: The time at which the simulation begins [s].
        seed: The seed.
        step_length: The step length [s].
        options: Options by SUMO's long names, without those that this program forces.
        empty_steps: The number of initial steps before the first departure. SUMO runs them, and nothing is recorded.

    Raises:
        UsageError: An option may not be given, its value has the wrong type, or SUMO's options cannot hold a file name.
    """

    network: Path
    routes: tuple[Path, ...]
    additional: tuple[Path, ...]
    begin: float
    seed: int
    step_length: float = 0.1
    options: Mapping[str, str] = field(default_factory=lambda: dict(DEFAULTS))
    empty_steps: int = 0

    @property
    def recorded_from(self) -> float:
        """The time [s] from which states are recorded."""
        return round(self.begin + self.empty_steps * self.step_length, 6)

    def __post_init__(self) -> None:
        check(self.options)
        for file in (self.network, *self.routes, *self.additional):
            check_nameable(file)

    @property
    def all_options(self) -> dict[str, str]:
        """The options of SUMO, including those that this program forces."""
        return {**self.options, **FORCED}

    def arguments(self) -> list[str]:
        """Return the command line without the program's name."""
        files = {"net-file": (self.network,), "route-files": self.routes, "additional-files": self.additional}
        named = {name: ",".join(map(str, paths)) for name, paths in files.items() if paths}
        times = {"begin": repr(self.begin), "step-length": repr(self.step_length), "seed": str(self.seed)}
        return [f"--{name}={value}" for name, value in {**named, **times, **self.all_options}.items()]


def check_nameable(file: Path) -> None:
    """Refuse a file whose name SUMO's options cannot hold.

    SUMO reads UTF-8, splits lists at commas and semicolons, and replaces environment variables and the home folder in
    names.

    Raises:
        UsageError: SUMO's options cannot hold the name.
    """
    name = str(file)
    if not name.isprintable() or {",", ";"} & set(name) or VARIABLE in name or name.startswith(HOME):
        raise UsageError(
            f"SUMO cannot open a file with the name {name!r}: rename it, or its folder, to a name in UTF-8 without "
            f"commas, semicolons, control characters and '{VARIABLE}', and without '{HOME}' at its start."
        )
