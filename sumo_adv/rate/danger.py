"""How dangerous an error would be if it began now: both vehicles extrapolated, from their present states alone.

The other vehicle drives straight on as the error has it. The ego goes straight on, once at its speed, once braking.
Whether such an error ends in a collision is learnt from pilot runs for each level (``proposal.py``); the extrapolation
only has to sort errors.
"""

from __future__ import annotations

import numpy as np

from sumo_adv.datatypes import Boxes, Floats, Ints
from sumo_adv.metrics.boxes import separation
from sumo_adv.rate.model import KINDS
from sumo_adv.simulation.human_errors import BRAKING, DRIFT, REACTION, SIDE, ErrorKind

AHEAD = np.arange(0.25, 6.01, 0.25)  # s
CLOSE = 1.5  # m between the boxes
EGO_REACTION, EGO_BRAKING = 1.0, 4.5  # s, m/s2
SIDEWAYS, LANE = 1.0, 3.2  # m/s of SUMO's lane changes, m
GO_SPEED, GO_ACCELERATION = 8.0, 2.0  # m/s, m/s2 of a driver that enters a junction from a low speed


def danger(ego: Boxes, others: Boxes) -> Ints:
    """The level of danger of each kind of error ``(vehicles, kinds)``, from 0 to 3.

    0: nothing comes near; 1: less than 1.5 m apart; 2: contact if the ego does not brake; 3: also if it brakes.
    ego: 0-d arrays; others: ``(vehicles,)``.
    """
    speed = np.asarray(others.speed, float)[:, None, None]
    along, left = _motions(speed)
    c, s = np.cos(others.heading)[:, None, None], np.sin(others.heading)[:, None, None]
    size = [np.asarray(v, float).reshape(-1, 1, 1) for v in (others.length, others.width)]
    x, y = others.x[:, None, None] + along * c - left * s, others.y[:, None, None] + along * s + left * c
    moved = Boxes(x, y, np.broadcast_to(others.heading[:, None, None], x.shape), speed, *size)
    keeps, brakes = (separation(_straight(ego, d), moved).min(axis=-1) for d in _distances(float(ego.speed)))
    return (np.asarray(keeps < CLOSE, np.intp) + (keeps <= 0.0) + ((keeps <= 0.0) & (brakes <= 0.0))).astype(np.intp)


def _distances(speed: float) -> tuple[Floats, Floats]:
    """How far the ego goes at its speed, and braking, by ``AHEAD`` [m]."""
    braking = np.clip(AHEAD - EGO_REACTION, 0.0, speed / EGO_BRAKING)
    return speed * AHEAD, speed * (np.minimum(AHEAD, EGO_REACTION) + braking) - EGO_BRAKING * braking**2 / 2


def _straight(ego: Boxes, distance: Floats) -> Boxes:
    x, y = ego.x + distance * np.cos(ego.heading), ego.y + distance * np.sin(ego.heading)
    return Boxes(x, y, np.asarray(ego.heading), ego.speed, ego.length, ego.width)


def _motions(speed: Floats) -> tuple[Floats, Floats]:
    """How far a vehicle goes along its heading and to the left of it [m], ``(vehicles, kinds, times)``."""
    along = np.repeat(speed * AHEAD, len(KINDS), axis=1)
    left = np.zeros_like(along)
    braking = np.clip(AHEAD - REACTION, 0.0, speed[:, 0] / BRAKING)
    stopped = speed[:, 0] * (np.minimum(AHEAD, REACTION) + braking) - BRAKING * braking**2 / 2
    begun = np.minimum(speed[:, 0], GO_SPEED)
    gaining = np.minimum(AHEAD, (GO_SPEED - begun) / GO_ACCELERATION)
    gone = begun * gaining + GO_ACCELERATION * gaining**2 / 2 + np.maximum(speed[:, 0], GO_SPEED) * (AHEAD - gaining)
    for k, kind in enumerate(KINDS):
        if kind is ErrorKind.LATE_BRAKING:
            along[:, k] = stopped
        elif kind in (ErrorKind.PRIORITY, ErrorKind.RED_LIGHT):
            along[:, k] = gone
        elif kind in SIDE:
            wide = DRIFT if kind in (ErrorKind.DRIFT_LEFT, ErrorKind.DRIFT_RIGHT) else LANE
            left[:, k] = SIDE[kind] * np.minimum(SIDEWAYS * AHEAD, wide)
    return along, left
