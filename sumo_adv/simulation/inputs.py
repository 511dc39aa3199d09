"""What a run can start from: a network, a SUMO configuration, a scenario, a map, or the name of a shipped one.

``load_input`` resolves and checks the input. Every fault raises a UsageError of one sentence before anything starts.
``scan.py`` finds the faults of the files that the input names.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from sumo_adv.asked import Asked, Attacker
from sumo_adv.ego_sensing import EgoSensing
from sumo_adv.ego_way import EgoMove, SightStretch
from sumo_adv.errors import UsageError, nearest
from sumo_adv.script import Script
from sumo_adv.simulation.maps import MAPS, MapConversion, convert_map, is_map
from sumo_adv.simulation.playback_spec import PlaybackSpec, scenario_playback
from sumo_adv.simulation.scan import DemandScan, NetworkScan, scan_demand, scan_network
from sumo_adv.simulation.scenario import DEFAULT_WARM_UP_S, SCENARIO_FILE, Ego, Label, Scenario, load_scenario
from sumo_adv.simulation.sumocfg import is_sumocfg, read_sumocfg

_NETWORK_SUFFIXES = (".net.xml", ".net.xml.gz", ".xml", ".xml.gz")
_INPUT_SUFFIXES = (
    *sorted(MAPS, key=len, reverse=True),
    ".net.xml.gz", ".net.xml", ".xml.gz", ".xml", ".sumocfg", ".sumo.cfg", ".toml",
)  # fmt: skip
ROOT_ELEMENT_BYTES = 4096  # the root element of a CommonRoad scenario begins within these first bytes


@dataclass(frozen=True, slots=True)
class EgoRoute:
    """An ego that the scenario inserts.

    Attributes:
        edges: The edge ids from first to last.
        depart: The departure [s].
        lane: SUMO's departLane.
        position: SUMO's departPos [m].
        speed: SUMO's departSpeed [m/s].
    """

    edges: tuple[str, ...]
    depart: float
    lane: int | str = "best"
    position: float | str = "base"
    speed: float | str = "max"


@dataclass(frozen=True, slots=True)
class WaymoSource:
    """The Waymo record that an input was made from.

    Attributes:
        file: The file of the record.
        id: The id of the record.
        content: The SHA-256 of the record's bytes, in hex.
    """

    file: Path
    id: str
    content: str


@dataclass(frozen=True, slots=True)
class RunInput:
    """Everything that a run needs to know about its input. Times are simulation times [s]. Paths exist.

    Attributes:
        name: The name of the input.
        path: The file that was given.
        network: The network file.
        routes: The route files.
        additional: The additional files.
        begin: The time at which the simulation begins [s]; None means the default.
        end: The time at which it ends [s]; None means the default.
        density: Departures per minute over the whole network; None means the default if ``routes`` is empty.
        demand_seed: The seed of generated traffic; None means the default.
        ego: An id in the demand, or an EgoRoute; None means that the ego is chosen later.
        ego_type: The vType of the ego.
        ego_controller: The controller of the ego.
        ego_parameters: Parameters of the controller.
        ego_sensing: The sensors of the ego's driver.
        trigger: A time [s], or "auto".
        warm_up: The time after the ego's insertion during which no trigger is sought [s].
        horizon: The horizon [s]; None means the default.
        candidates: Vehicles that may attack; empty means no restriction.
        supports: Vehicles that may support the attack; empty means no restriction.
        intents: Intents that may be used; empty means no restriction.
        scripts: Intents that the scenario brings along.
        label: The label of the scenario.
        files: All files that a manifest must copy.
        playback: What a log moves.
        seed: The seed of the user's own simulation; None means this program's.
        step_length: The step length of the user's own simulation [s]; None means this program's.
        options: SUMO's options of the user's own simulation; None means this program's.
        notes: Sentences on what of the user's simulation is not kept, or was converted.
        asked: What must be true of the attack.
        attackers: The vehicles that attack together; empty if one adversary is chosen among the candidates.
        words: The description that the scenario was made from.
        conversion: How a map was converted that is no SUMO network.
        waymo: The Waymo record that was converted.
        moves: The ego's own moves.
        sight: The stretches of the ego's way from which it sees less far.
    """

    name: str
    path: Path
    network: Path
    routes: tuple[Path, ...] = ()
    additional: tuple[Path, ...] = ()
    begin: float | None = None
    end: float | None = None
    density: float | None = None
    demand_seed: int | None = None
    ego: str | EgoRoute | None = None
    ego_type: str | None = None
    ego_controller: str | None = None
    ego_parameters: Mapping[str, bool | int | float | str] = field(default_factory=dict)
    ego_sensing: EgoSensing | None = None
    trigger: float | Literal["auto"] = "auto"
    warm_up: float = DEFAULT_WARM_UP_S
    horizon: float | None = None
    candidates: tuple[str, ...] = ()
    supports: tuple[str, ...] = ()
    intents: tuple[str, ...] = ()
    scripts: tuple[Script, ...] = ()
    label: Label | None = None
    files: tuple[Path, ...] = ()
    playback: PlaybackSpec | None = None
    seed: int | None = None
    step_length: float | None = None
    options: Mapping[str, str] | None = None
    notes: tuple[str, ...] = ()
    asked: Asked | None = None
    attackers: tuple[Attacker, ...] = ()
    words: str = ""
    conversion: MapConversion | None = None
    waymo: WaymoSource | None = None
    moves: tuple[EgoMove, ...] = ()
    sight: tuple[SightStretch, ...] = ()

    def settings(self, named: Collection[str] = ()) -> dict[str, Any]:
        """Return the settings that the input implies.

        They are the horizon, the sensors of the ego's driver, and the level and number of adversaries of the attack
        that the input asks for.

        Args:
            named: Names of settings that the user gave. If another goal is among them, it overrides the level.

        Returns:
            The settings by name.
        """
        brought: dict[str, Any] = {"horizon": self.horizon}
        if self.ego_sensing is not None:
            brought["ego_sensing"] = self.ego_sensing.model_dump()
        if self.asked is not None:
            brought |= {} if {"until", "ttc", "min_delta_v"} & set(named) else self.asked.settings
            brought |= {"adversaries": 1 + len(self.supports)} if self.supports else {}
        if self.attackers:
            brought["adversaries"] = len(self.attackers) + len(self.supports)
        return brought


def load_input(path: Path) -> RunInput:
    """Resolve and check an input.

    Args:
        path: A file, or the name of a shipped scenario or network.

    Returns:
        The input.

    Raises:
        UsageError: Something is missing, damaged, undrivable or mismatched.
    """
    file = find_input(path)
    lower = file.name.lower()
    if ".tfrecord" in lower:
        raise UsageError(f"{file} is a file of Waymo records: convert it to scenarios first (sumo-adv convert).")
    if lower.endswith(".toml"):
        return _from_scenario(file)
    if is_sumocfg(file):
        return _from_configuration(file)
    if is_map(file):
        made = convert_map(file)
        scan_network(made.network, shown=file)
        return RunInput(
            name=input_name(file), path=file, network=made.network, files=(file, made.network),
            notes=made.said, conversion=made,
        )  # fmt: skip
    if is_commonroad(file):
        raise UsageError(f"{file} is a CommonRoad scenario: convert it to a scenario first (sumo-adv convert).")
    if lower.endswith(_NETWORK_SUFFIXES):
        scan_network(file)
        return RunInput(name=input_name(file), path=file, network=file, files=(file,))
    raise UsageError(f"{file} is not an input: give a .net.xml, .net.xml.gz, .sumocfg, scenario .toml, .xodr or .osm.")


def is_commonroad(path: Path) -> bool:
    """Return whether an XML file begins like a CommonRoad scenario."""
    if path.suffix.lower() != ".xml":
        return False
    try:
        with path.open("rb") as file:
            return b"<commonRoad" in file.read(ROOT_ELEMENT_BYTES)
    except OSError:  # the code that reads it reports why
        return False


def own_simulation(run_input: RunInput) -> dict[str, float | int]:
    """Return the settings of the user's own simulation that are given: ``seed`` and ``step_length``."""
    brought = {"seed": run_input.seed, "step_length": run_input.step_length}
    return {name: value for name, value in brought.items() if value is not None}


def input_name(path: Path) -> str:
    """Return a file's name without its known ending, such as ``crossing`` for ``crossing.net.xml.gz``.

    A file called ``scenario.toml`` takes the name of its folder.
    """
    if path.name == SCENARIO_FILE and path.resolve().parent.name:
        return path.resolve().parent.name
    for suffix in _INPUT_SUFFIXES:
        if path.name.lower().endswith(suffix) and len(path.name) > len(suffix):
            return path.name[: -len(suffix)]
    return path.stem


def data_folder(name: str) -> Path:
    """Return a shipped folder or file (networks, memory_bank.sqlite, ...).

    It is that of the package or, if the package has none, that of the checkout.

    Raises:
        UsageError: It is missing.
    """
    package = Path(__file__).resolve().parent.parent
    for folder in (package / "data" / name, package.parent / name):
        if folder.exists():
            return folder
    raise UsageError(f"The shipped '{name}' is missing: reinstall the package or run from a full checkout.")


def shipped_files(folder: str, ending: str) -> list[str]:
    """Return the names of the inputs in a shipped folder.

    Args:
        folder: The folder (``networks``, ``suites``).
        ending: The ending of the files.

    Returns:
        The names without endings, sorted.
    """
    return sorted(input_name(path) for path in data_folder(folder).glob(f"*{ending}"))


def shipped_names() -> tuple[str, ...]:
    """Return the names that ``load_input`` accepts instead of a path: scenarios, then networks."""
    return (*shipped_files("scenarios", ".toml"), *shipped_files("networks", ".net.xml"))


def find_input(path: Path) -> Path:
    """Return ``path`` if it is a file, and otherwise the shipped scenario or network that it names.

    Raises:
        UsageError: There is no such file or name.
    """
    if path.is_file():
        return path
    shipped = _shipped(path)
    if shipped is not None:
        return shipped
    if path.is_dir():
        raise UsageError(f"{path} is a folder: give a .net.xml, .sumocfg or scenario file in it.")
    like = nearest(input_name(path), shipped_names())
    raise UsageError(f"There is no file {path}, nor a shipped scenario or network of that name{like}.")


def _shipped(path: Path) -> Path | None:
    """Return the shipped file for a name, ``networks/x.net.xml`` or ``scenarios/x.toml``; None if there is none."""
    parts = path.parts
    for folder, ending in (("scenarios", ".toml"), ("networks", ".net.xml")):
        if len(parts) == 1 or (len(parts) == 2 and parts[0] == folder):
            for name in (parts[-1], f"{parts[-1]}{ending}"):
                if name.endswith(ending) and (data_folder(folder) / name).is_file():
                    return data_folder(folder) / name
    return None


def _from_configuration(path: Path) -> RunInput:
    """Return the input of a .sumocfg: its network, demand, additional files, begin, end and options."""
    given = read_sumocfg(path)
    if not given.networks:
        raise UsageError(f"{path} names no network: it needs a net-file.")
    network = given.networks[0]
    _, scans = _scan_all(path, network, (*given.routes, *given.additional))
    return RunInput(
        name=input_name(path), path=path, network=network, routes=given.routes, additional=given.additional,
        begin=given.begin, end=given.end,
        files=(path, network, *given.routes, *given.additional, *_named(scans)), seed=given.seed,
        step_length=given.step, options=given.options, notes=given.notes,
    )  # fmt: skip


def _from_scenario(path: Path) -> RunInput:
    """Return the input of a scenario file, after checking its demand and ids against each other."""
    scenario = load_scenario(path)
    network = _named_network(path, scenario.network)
    routes, additional = scenario.demand.files, (*scenario.signals.files, *scenario.additional)
    edges, scans = _scan_all(path, network, (*routes, *additional))
    playback = scenario_playback(scenario)
    recorded = frozenset() if playback is None else playback.vehicles | playback.obstacles
    if routes or recorded:
        _check_ids(path, scenario, scans, recorded)
    for edge in scenario.ego.route:
        if edge not in edges.edges:
            raise UsageError(f"The ego's route in {path} uses edge '{edge}', which {network} does not have.")
    return RunInput(
        name=input_name(path), path=path, network=network, routes=routes, additional=additional,
        begin=_or(scenario.demand.begin, playback.begin if recorded and playback else None),
        end=_or(scenario.demand.end, playback.end if recorded and playback else None), density=scenario.demand.density,
        demand_seed=scenario.demand.seed, ego=_ego(scenario.ego), ego_type=scenario.ego.type,
        ego_controller=scenario.ego.controller, ego_parameters=scenario.ego.parameters,
        ego_sensing=scenario.ego.sensing,
        trigger=scenario.window.trigger, warm_up=scenario.window.warm_up, horizon=scenario.window.horizon,
        candidates=scenario.adversary.candidates or tuple(each.id for each in scenario.attackers),
        supports=scenario.adversary.supports, intents=_intents(scenario), scripts=scenario.scripts,
        label=scenario.label,
        files=(path, network, *routes, *additional, *_named(scans), *(playback.files if playback else ())),
        playback=playback, asked=_asked(scenario), attackers=scenario.attackers,
        words=scenario.written.words if scenario.written else "", moves=scenario.moves, sight=scenario.sight,
    )  # fmt: skip


def _asked(scenario: Scenario) -> Asked | None:
    """Return what is asked of the attack; nothing in particular if it is only asked of its attackers."""
    of_attackers = any(attacker.asked != Asked() for attacker in scenario.attackers)
    return Asked() if scenario.asked is None and of_attackers else scenario.asked


def _intents(scenario: Scenario) -> tuple[str, ...]:
    """Return the intents that any adversary may use; empty if one of the attackers may use all."""
    if not all(attacker.intents for attacker in scenario.attackers):
        return ()
    named = (label for attacker in scenario.attackers for label in attacker.intents)
    return scenario.adversary.intents or tuple(dict.fromkeys(named))


def _named_network(path: Path, network: Path) -> Path:
    """Return the network file that a scenario names, or the shipped network of that name."""
    shipped = data_folder("networks") / f"{network.name}.net.xml"
    named = network.parent == path.parent and not network.suffix
    return shipped if named and not network.exists() and shipped.is_file() else network


def _named(scans: Sequence[DemandScan]) -> tuple[Path, ...]:
    return tuple(file for scan in scans for file in scan.files)


def _or(value: float | None, default: float | None) -> float | None:
    return default if value is None else value


def _ego(ego: Ego) -> str | EgoRoute | None:
    """Return the ego as the run needs it: an id, a route with SUMO's defaults filled in, or None."""
    if not ego.route:
        return ego.id
    chosen = {"lane": ego.lane, "position": ego.position, "speed": ego.speed}
    given = {key: value for key, value in chosen.items() if value is not None}
    return EgoRoute(edges=ego.route, depart=ego.depart or 0.0, **given)  # type: ignore[arg-type]


def _scan_all(path: Path, network: Path, demand: tuple[Path, ...]) -> tuple[NetworkScan, tuple[DemandScan, ...]]:
    """Scan the files that ``path`` names; refuse a missing file and a demand for another network."""
    for file in (network, *demand):
        if not file.is_file():
            trouble = "is a folder" if file.is_dir() else "is missing"
            raise UsageError(f"{path} names the file {file}, which {trouble}.")
    roads, scans = scan_network(network, cars=not demand), tuple(scan_demand(file) for file in demand)
    for file, scan in zip(demand, scans, strict=True):
        for edge in scan.edges:
            if edge not in roads.edges and not edge.startswith(":"):
                raise UsageError(f"The demand {file} is for another network: {network} has no edge '{edge}'.")
    return roads, scans


def _check_ids(path: Path, scenario: Scenario, scans: tuple[DemandScan, ...], recorded: frozenset[str]) -> None:
    """Raise UsageError if the scenario names a vehicle that neither its route files nor its tracks contain."""
    adversary = scenario.adversary
    named = {
        "ego": (scenario.ego.id,), "adversary candidate": adversary.candidates, "support": adversary.supports,
        "attacker": tuple(each.id for each in scenario.attackers),
    }  # fmt: skip
    for role, ids in named.items():
        for vehicle in ids:
            if vehicle is None or vehicle in recorded or any(scan.has(vehicle) for scan in scans):
                continue
            raise UsageError(f"The scenario {path} names the {role} '{vehicle}', which is not in its demand files.")
