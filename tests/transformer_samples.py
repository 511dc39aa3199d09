"""Cars for the motion predictor."""

from __future__ import annotations

import numpy as np

from sumo_adv.transformer.scene import HISTORY_COUNT, POSITION_STEP_S, SceneVehicles, light_of


def driving(*cars: tuple[float, float, float]) -> SceneVehicles:
    """Cars of 5 x 2 m that have gone east evenly: x, y [m] and speed [m/s] now; their lights are unknown."""
    x, y, speed = np.array(cars).T
    past = np.stack(
        [
            x[:, None] + speed[:, None] * POSITION_STEP_S * np.arange(1 - HISTORY_COUNT, 1),
            y[:, None] + np.zeros(HISTORY_COUNT),
        ],
        2,
    )
    n = len(cars)
    return SceneVehicles(past, np.zeros(n), speed, np.full((n, 2), (5.0, 2.0)), np.array([light_of(None)] * n))
