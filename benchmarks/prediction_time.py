"""How long the network of the row ``transformer`` takes for a scene.  ``python benchmarks/prediction_time.py``.

The median CPU time of features and prediction of ``MAX_AGENTS`` vehicles, on three networks, in numpy on one thread.
Bound (issue 44): 20 ms.
"""

from __future__ import annotations

import os

os.environ.update({"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"})  # before numpy is loaded

import argparse
import sys
import time

import numpy as np

from sumo_adv.simulation.inputs import data_folder
from sumo_adv.simulation.network import read_network
from sumo_adv.transformer.model import TransformerPredictor
from sumo_adv.transformer.scene import (
    HISTORY_COUNT,
    MAX_AGENTS,
    POSITION_STEP_S,
    SceneVehicles,
    Segments,
    light_of,
    segments_of,
)

BOUND = 20.0  # ms
NETWORKS = ("straight_3lane", "signalised_wide", "roundabout_large")


def scene(segments: Segments, rng: np.random.Generator) -> SceneVehicles:
    """Vehicles that go evenly along drawn pieces of lanes."""
    ends = segments.ends[rng.choice(len(segments.ends), MAX_AGENTS)]
    heading = np.arctan2(ends[:, 3] - ends[:, 1], ends[:, 2] - ends[:, 0])
    speed = rng.uniform(0.0, 20.0, MAX_AGENTS)
    back = POSITION_STEP_S * speed[:, None] * np.arange(1 - HISTORY_COUNT, 1)
    past = ends[:, None, :2] + np.stack([np.cos(heading)[:, None] * back, np.sin(heading)[:, None] * back], axis=2)
    return SceneVehicles(
        past, heading, speed, np.full((MAX_AGENTS, 2), (4.8, 1.8)), np.array([light_of(None)] * MAX_AGENTS)
    )


def main() -> int:
    """Print a row a network; 1 if one is over the bound."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=50)
    scenes = parser.parse_args().scenes
    predictor, over = TransformerPredictor(), False
    for name in NETWORKS:
        segments = segments_of(read_network(data_folder("networks") / f"{name}.net.xml"))
        rng = np.random.default_rng(0)
        took = []
        for _ in range(scenes + 1):
            agents = scene(segments, rng)
            begun = time.process_time()
            predictor.predict(agents, segments)
            took.append(1000.0 * (time.process_time() - begun))
        median = float(np.median(took[1:]))  # the first one allocates
        over |= median > BOUND
        print(f"{name:<20} {len(segments.ends):5} pieces of lanes {median:8.2f} ms   (bound {BOUND:g} ms)")
    return int(over)


if __name__ == "__main__":
    sys.exit(main())
