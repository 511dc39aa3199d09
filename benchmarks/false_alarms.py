"""How often reference drivers brake without need in unattacked traffic.

Traffic of SUMO's own (generated demand, sigma 0.5) on the shipped networks; egos are drawn from it.  Each reference
driver watches an ego's recorded drive without driving it.  It brakes without need where it asks for more than 2 m/s2
and no vehicle is within 2 s of two-dimensional TTC of the ego in the 2 s that follow.  The aim is at most one such
event in 10 km for each driver.

    python benchmarks/false_alarms.py [--seeds 2] [--seconds 180]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from sumo_adv.datatypes import Boxes, Floats, Track
from sumo_adv.metrics.boxes import on_grid
from sumo_adv.metrics.criticality import ttc
from sumo_adv.metrics.reference import BRAKERS
from sumo_adv.metrics.reference.view import EgoPaths, Views, located_on
from sumo_adv.simulation.demand import generate_demand
from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.tracks import Recording, tracks_of

DT = 0.1  # s
BRAKES, NEAR, WITHIN, APART = 2.0, 2.0, 2.0, 2.0  # m/s2, s of TTC, s after the braking, s between two events
EGOS, LEAST, REACH = 12, 100, 100.0  # egos a network and seed, states, m
DENSITY = 40.0  # departures a minute


def traffic(network: Path, seed: int, seconds: float) -> list[Track]:
    """The tracks of one run."""
    with tempfile.TemporaryDirectory() as folder:
        routes = generate_demand(
            network, Path(folder) / "demand.rou.xml", seed=seed, density=DENSITY, begin=0.0, end=seconds
        )
        simulation = Simulation(SimulationSpec(network, (routes,), (), 0.0, seed))
        recording = Recording(DT)
        try:
            for _ in range(round(seconds / DT)):
                simulation.step()
                recording.append(simulation.read())
            return tracks_of(recording.snapshots, simulation.fleet.sizes, {}, DT)
        finally:
            simulation.close()


def events(ego: Track, others: list[Track]) -> tuple[dict[str, int], dict[str, int]]:
    """By driver: how often it brakes without need, and how often it brakes at all."""
    near = [t for t in others if t.id != ego.id and _meets(ego, t)]
    row = Boxes(ego.x[None], ego.y[None], ego.heading[None], ego.speed[None], ego.length, ego.width)
    if not near:
        return dict.fromkeys(BRAKERS, 0), dict.fromkeys(BRAKERS, 0)
    grid = on_grid(near, ego.time)
    least: Floats = np.nanmin(np.where(np.isfinite(grid.x), ttc(ego.boxes(), grid), np.inf), axis=0)
    length, width = (np.asarray(size)[None] for size in (grid.length, grid.width))
    wide = Boxes(grid.x[None], grid.y[None], grid.heading[None], grid.speed[None], length, width)
    views = Views(wide, located_on(EgoPaths(row), wide), (ego.length, ego.width), DT, 1.6)
    station = EgoPaths(row).station[0]
    needless, braked = dict.fromkeys(BRAKERS, 0), dict.fromkeys(BRAKERS, 0)
    for name, driver in BRAKERS.items():
        braker, last = driver((1, len(near)), DT), -np.inf
        for k in range(len(ego.time)):
            ego_state = (np.array([v]) for v in (station[k], ego.speed[k], ego.acceleration[k]))
            acceleration = float(braker.step(views.at(k, *ego_state))[0])
            if not acceleration < -BRAKES:
                continue
            if ego.time[k] - last > APART:
                braked[name] += 1
                needless[name] += bool(least[k : k + round(WITHIN / DT) + 1].min() > NEAR)
            last = ego.time[k]
    return needless, braked


def _meets(ego: Track, other: Track) -> bool:
    common, i, j = np.intersect1d(np.round(ego.time, 1), np.round(other.time, 1), return_indices=True)
    return bool(len(common)) and bool((np.hypot(ego.x[i] - other.x[j], ego.y[i] - other.y[j]) < REACH).any())


def main() -> None:
    """Print a line a driver."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=180.0)
    args = parser.parse_args()
    metres, total, every = 0.0, dict.fromkeys(BRAKERS, 0), dict.fromkeys(BRAKERS, 0)
    for network in sorted(data_folder("networks").glob("*.net.xml")):
        for seed in range(args.seeds):
            tracks = traffic(network, seed, args.seconds)
            drawn = np.random.default_rng(seed).permutation([k for k, t in enumerate(tracks) if len(t.time) > LEAST])
            for k in drawn[:EGOS]:
                needless, braked = events(tracks[k], tracks)
                metres += float(np.hypot(np.diff(tracks[k].x), np.diff(tracks[k].y)).sum())
                for name in total:
                    total[name] += needless[name]
                    every[name] += braked[name]
    print(f"{metres / 1000:.1f} km driven")
    for name, count in total.items():
        print(f"{name:10s} needless {count:4d} ({count / metres * 1e4:.2f} in 10 km), braked {every[name]:4d} times")


if __name__ == "__main__":
    main()
