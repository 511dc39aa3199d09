"""Scenes to learn from, in files: a file a run of SUMO or a Waymo file, which later commands read.

Runs of SUMO are on networks of ours and on generated ones, with drivers of many kinds. Everything is drawn from a seed
and the number of the run. Networks of ``HELD_OUT_NETWORKS`` and the generated networks of held-out runs are never
trained on.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from sumo_adv.datatypes import Floats
from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.files import scratch_prefix, write_text, write_whole
from sumo_adv.geometry import PATH_STEP_M, stations
from sumo_adv.simulation.demand import Journey, default_density, journeys
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.network import RoadMap, read_network
from sumo_adv.simulation.programs import find_netconvert
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.sumo_states import RawState, pose_of
from sumo_adv.situation import Signal
from sumo_adv.transformer.scene import (
    FUTURE_COUNT,
    HISTORY_COUNT,
    MAX_AGENTS,
    POSITION_STEP_S,
    Features,
    SceneVehicles,
    Segments,
    light_of,
    scene_features,
    segments_of,
    to_local,
)

HELD_OUT_NETWORKS = (
    "curved_4lane", "onramp_merge", "priority_crossing", "roundabout", "signalised_wide", "straight_3lane",
    "t_junction", "two_way_4lane",
)  # fmt: skip
"""Shipped networks that are kept for the evaluation."""

TRAFFIC_WARM_UP_S, TRAFFIC_RUN_S = 30.0, 180.0  # the network fills; of a run in all
SCENE_INTERVAL_STEPS = 15  # between two scenes of a run
MAX_NETGENERATE_TRIES = 5  # for a run
DRIVER_KIND_COUNT = 24  # kinds of drivers in a run
DENSITY_FACTORS = (0.6, 2.2)  # of the usual density
MAX_DEPARTURES_PER_MINUTE = 60.0
CAR_FOLLOWING_MODELS = ("Krauss", "IDM", "EIDM")
VEHICLE_SIZES_M = ((4.8, 1.8), (4.4, 1.8), (5.0, 1.9), (6.0, 2.1), (4.0, 1.7))
JUNCTION_TYPES = ("traffic_light", "traffic_light", "priority", "right_before_left", "allway_stop")
TRAINING_RUNS_PER_HELD_OUT = 8  # runs to train on for each held-out one
TRAIN, HELD_OUT = "train", "held_out"  # how the names of files begin
SCENES_PER_MOMENT = 2  # scenes at a moment of a run
SCENE_RADIUS_M = 150.0  # a scene is the vehicles that are this near to the one in its middle
STANDING_SCENE_SPEED_M_S, KEPT_STANDING_SHARE = 0.5, 0.15  # of scenes around a standing vehicle
MIN_MOVING_DISTANCE_M = 2.0  # in 8 s: a vehicle that goes less far stands
UNKNOWN_LIGHT_SHARE = 0.3  # of the vehicles but the middle one: as in an encounter
MAX_FOLLOWED_LANES = 6  # that lane following tries
Scene = tuple[Features, Any, Any, Any]
"""One scene: its features, and what ``Scenes`` has of it: future, known, followed."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """A run: for each step of 0.1 s the vehicles' states, and at the steps of ``lights`` the lights ahead of each;
    length and width [m] by vehicle."""

    network: Path
    steps: Sequence[Mapping[str, RawState]]
    lights: Mapping[int, Mapping[str, Sequence[Signal]]]
    sizes: Mapping[str, tuple[float, float]]


def record(number: int, seed: int, folder: Path, *, held_out: bool, seconds: float = TRAFFIC_RUN_S) -> Recorded:
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
        while simulation.time < TRAFFIC_WARM_UP_S:
            simulation.step()
        for k in range(round((seconds - TRAFFIC_WARM_UP_S) / simulation.spec.step_length)):
            simulation.step()
            steps.append(simulation.read().raw)
            if k % SCENE_INTERVAL_STEPS == 0:
                lights[k] = {name: simulation.signals(name) for name in steps[-1]}
        return Recorded(network, steps, lights, dict(simulation.fleet.sizes))
    finally:
        simulation.close()


def _network(number: int, draw: Random, folder: Path, *, held_out: bool) -> tuple[Path, list[Journey]]:
    """Shipped networks and generated ones in turn, with the routes through them."""
    if number % 2 == 0:
        shipped = sorted(data_folder("networks").glob("*.net.xml"))
        chosen = [path for path in shipped if (path.name.removesuffix(".net.xml") in HELD_OUT_NETWORKS) == held_out]
        network = chosen[number // 2 % len(chosen)]
        return network, journeys(network, draw)
    for _ in range(MAX_NETGENERATE_TRIES):
        network = _generated(draw, folder / "generated.net.xml")
        with suppress(UsageError):  # no route leads through it
            return network, journeys(network, draw)
    tries = MAX_NETGENERATE_TRIES
    raise SimulationError(f"netgenerate made no network with a route in {tries} tries; give another --seed.")


def _generated(draw: Random, target: Path) -> Path:
    """A small network by netgenerate: a grid or a random one."""
    program = find_netconvert()
    program = program.with_name(program.name.replace("netconvert", "netgenerate"))  # they are installed together
    flags = [
        "--default-junction-type", draw.choice(JUNCTION_TYPES), "--default.lanenumber", str(draw.randint(1, 3)),
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
    """Vehicles of ``DRIVER_KIND_COUNT`` kinds on the routes."""
    density = min(default_density(journeys) * draw.uniform(*DENSITY_FACTORS), MAX_DEPARTURES_PER_MINUTE)
    lines = ["<routes>\n", *(_driver(k, draw) for k in range(DRIVER_KIND_COUNT))]
    depart, number = 0.0, 0
    while depart < seconds:
        journey = draw.choices(journeys, weights=[j.lanes for j in journeys])[0]
        lane = draw.choice(("best", "best", "random", "free"))
        lines.append(
            f'<vehicle id="v{number}" type="driver{draw.randrange(DRIVER_KIND_COUNT)}" '
            f'depart="{depart:.2f}" departLane="{lane}" '
            f'departSpeed="max"><route edges={quoteattr(" ".join(journey.edges))}/></vehicle>\n'
        )
        depart += draw.expovariate(density / 60.0)
        number += 1
    target.write_text("".join([*lines, "</routes>\n"]), encoding="utf-8")
    return target


def _driver(number: int, draw: Random) -> str:
    """A vType: car following, lane changing, speed and size."""
    model, (length, width) = draw.choice(CAR_FOLLOWING_MODELS), draw.choice(VEHICLE_SIZES_M)
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


@dataclass(frozen=True, slots=True)
class Scenes:
    """Scenes as arrays with a leading axis.

    future ``(n, AGENTS, FUTURE, 2)``: where the vehicles went, in their own frames [m]; known ``(n, AGENTS, FUTURE)``:
    whether they were there; followed ``(n, AGENTS, WAYS, FUTURE, 2)``: along their lanes' ways at constant speed, nan
    where there is none; only of held-out scenes.
    """

    features: Features
    future: Any
    known: Any
    followed: Any = None

    def __len__(self) -> int:
        return len(self.future)


def scene_of(agents: SceneVehicles, future: Floats, segments: Segments, followed: Floats | None = None) -> Scene:
    """One scene for ``together``; future: the vehicles' next ``FUTURE_COUNT`` positions in the world, nan = not there,
    ``(n, FUTURE, 2)``; ``followed``: see ``Scenes``."""
    n = len(future)
    known_steps = np.asarray(np.isfinite(future).all(axis=2))
    whole, there = np.zeros((MAX_AGENTS, FUTURE_COUNT, 2), np.float32), np.zeros((MAX_AGENTS, FUTURE_COUNT), bool)
    whole[:n], there[:n] = np.where(known_steps[..., None], to_local(future, agents), 0.0), known_steps
    ways = None
    if followed is not None:
        ways = np.full((MAX_AGENTS, MAX_FOLLOWED_LANES, FUTURE_COUNT, 2), np.nan, np.float32)
        ways[:n] = followed
    return scene_features(agents, segments), whole, there, ways


def together(scenes: Sequence[Scene]) -> Scenes:
    """Scenes of ``scene_of`` as one value."""
    parts, future, known_steps, followed = zip(*scenes, strict=True)
    inputs = Features(*(np.stack(column) for column in zip(*parts, strict=True)))
    return Scenes(inputs, np.stack(future), np.stack(known_steps), None if followed[0] is None else np.stack(followed))


def scenes_of(run: Recorded, rng: np.random.Generator, *, held_out: bool) -> Scenes | None:
    """The scenes of a run: ``SCENES_PER_MOMENT`` every ``SCENE_INTERVAL_STEPS`` steps, each around a vehicle that is
    drawn; None if there are none."""
    road = read_network(run.network)
    segments, scenes = segments_of(road), []
    for k in range(0, len(run.steps) - FUTURE_COUNT, SCENE_INTERVAL_STEPS):
        current, before = run.steps[k], run.steps[max(k - HISTORY_COUNT + 1, 0)]
        names = [name for name in current if name in before] if k >= HISTORY_COUNT - 1 else []
        for focus in (names[i] for i in rng.permutation(len(names))[:SCENES_PER_MOMENT]):
            if current[focus][3] < STANDING_SCENE_SPEED_M_S and rng.random() > KEPT_STANDING_SHARE:
                continue
            chosen = _around(focus, names, current)
            lights_known = [name == focus or rng.random() > UNKNOWN_LIGHT_SHARE for name in chosen]
            agents, future = _agents(run, k, chosen, lights_known)
            ways = (
                np.stack([follow(road, agents, i, current[n][4]) for i, n in enumerate(chosen)]) if held_out else None
            )
            scenes.append(scene_of(agents, future, segments, ways))
    return together(scenes) if scenes else None


def _around(focus: str, names: Sequence[str], current: Any) -> list[str]:
    x, y = current[focus][:2]
    far = {name: float(np.hypot(current[name][0] - x, current[name][1] - y)) for name in names}
    near = sorted((name for name in names if far[name] < SCENE_RADIUS_M), key=lambda name: (far[name], name))
    return near[:MAX_AGENTS]


def _agents(run: Recorded, k: int, names: Sequence[str], lights_known: Sequence[bool]) -> tuple[SceneVehicles, Floats]:
    """The vehicles at step ``k`` and where they are afterwards, in the world.

    lights_known: for each vehicle, whether its traffic light is known.
    """
    place = np.full((len(names), HISTORY_COUNT + FUTURE_COUNT, 2), np.nan)
    for j, states in enumerate(run.steps[k - HISTORY_COUNT + 1 : k + FUTURE_COUNT + 1]):
        for i, name in enumerate(names):
            if name in states:
                place[i, j] = pose_of(states[name], run.sizes[name][0])[:2]
    current = [run.steps[k][name] for name in names]
    heading = [pose_of(state, 0.0)[2] for state in current]
    lights = [run.lights[k][n] if is_known else None for n, is_known in zip(names, lights_known, strict=True)]
    agents = SceneVehicles(
        place[:, :HISTORY_COUNT], np.array(heading), np.array([state[3] for state in current]),
        np.array([run.sizes[name] for name in names]), np.array([light_of(light) for light in lights]),
    )  # fmt: skip
    return agents, place[:, HISTORY_COUNT:]


def follow(road: RoadMap, agents: SceneVehicles, i: int, lane: str) -> Floats:
    """Lane following: vehicle ``i`` keeps its speed and its offset on every way on from its ``lane``, in its own frame,
    ``(WAYS, FUTURE, 2)``; straight on where it is on no lane. The straightest way is the first."""
    ways = np.full((MAX_FOLLOWED_LANES, FUTURE_COUNT, 2), np.nan)
    speed = float(agents.speed[i])
    ahead = np.asarray(speed * POSITION_STEP_S * np.arange(1, FUTURE_COUNT + 1), float)
    ways[0] = np.column_stack([ahead, 0.0 * ahead])
    if lane not in road.lanes:
        return ways
    x, y = agents.past[i, -1]
    shape = road.lanes[lane].shape
    station = stations(*shape.T)
    at = float(station[np.argmin(np.hypot(shape[:, 0] - x, shape[:, 1] - y))])
    me = SceneVehicles(
        *(values[i : i + 1] for values in (agents.past, agents.heading, agents.speed, agents.size, agents.light))
    )
    for way, path in enumerate(
        w.path for w in road.ways(lane, max(at - 2 * PATH_STEP_M, 0.0), float(ahead[-1]) + 30.0)
    ):
        s, d = path.project(float(x), float(y))
        px, py, _ = path.at(s + ahead, d)
        ways[way] = to_local(np.column_stack([px, py])[None], me)[0]
    return ways


def make(
    folder: Path, *, seed: int, runs: int, progress: Callable[[int, int], None], seconds: float = TRAFFIC_RUN_S
) -> int:
    """Write the scenes of ``runs`` runs to train on, and of an eighth as many held-out ones; those that are there stay.

    progress: told how many of how many are done; seconds: that a run simulates. Returns how many files there are.

    Raises:
        UsageError: the folder holds other scenes; a program of SUMO is missing.
        SimulationError: SUMO fails.
    """
    begin(folder, f"sumo, seed {seed}, {seconds:g} s a run")
    files = [(TRAIN, k) for k in range(runs)] + [(HELD_OUT, k) for k in range(-(-runs // TRAINING_RUNS_PER_HELD_OUT))]
    for done, (kind, number) in enumerate(files, 1):
        target = folder / f"{kind}-{number:04d}.npz"
        held_out = kind == HELD_OUT
        if not target.exists():
            with tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch:
                run = record(number, seed, Path(scratch), held_out=held_out, seconds=seconds)
                scenes = scenes_of(run, np.random.default_rng([seed, held_out, number]), held_out=held_out)
            if scenes is not None:
                save(scenes, target)
        progress(done, len(files))
    return len(files)


def begin(folder: Path, what: str) -> None:
    """Note what scenes a folder holds. Raises UsageError if it holds others."""
    note = folder / "scenes.txt"
    before = note.read_text(encoding="utf-8").strip() if note.exists() else what
    if before != what:
        raise UsageError(f"{folder} holds other scenes ({before}, not {what}); give another --out.")
    write_text(note, what + "\n")


# -- files --------------------------------------------------------------------------------------------------------


def save(scenes: Scenes, target: Path) -> None:
    """Write scenes; the same scenes are the same bytes. Features are rounded to half precision."""
    arrays: dict[str, Any] = {name: values.astype(np.float16) for name, values in scenes.features._asdict().items()}
    arrays |= {"future": scenes.future, "known": scenes.known}
    if scenes.followed is not None:
        arrays["followed"] = scenes.followed
    write_whole(target, lambda part: np.savez(part, **arrays))


def load(folder: Path, kind: str) -> Scenes:
    """All scenes of a kind (``TRAIN``, ``HELD_OUT``) in a folder.

    Raises:
        UsageError: there are none, or a file is damaged.
    """
    files = sorted(folder.glob(f"{kind}-*.npz"))
    if not files:
        raise UsageError(f"{folder} has no scenes ({kind}-*.npz); make them with benchmarks/transformer.py data.")
    parts = [_load(file) for file in files]
    names = (*Features._fields, "future", "known", *(["followed"] if all("followed" in p for p in parts) else []))
    joined = {name: np.concatenate([part[name] for part in parts]) for name in names}
    return Scenes(
        Features(*(joined[name] for name in Features._fields)), joined["future"], joined["known"],
        joined.get("followed"),
    )  # fmt: skip


def _load(file: Path) -> dict[str, Any]:
    try:
        with np.load(file, allow_pickle=False) as arrays:
            return dict(arrays)
    except (OSError, ValueError) as error:
        raise UsageError(f"{file} cannot be read ({error}); delete it and make the scenes again.") from error
