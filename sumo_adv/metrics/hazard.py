"""When the hazard shows, by the kind of encounter; a batch core over N rollouts.

Lateral positions are taken in the frame of the ego's path: the ego's recorded positions, at each point the nearest of
them with its heading, which runs straight on at both ends.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Bools, Boxes, Floats
from sumo_adv.geometry import wrap_below_pi
from sumo_adv.metrics.criticality import ttc

LEFT_LANE_KEEPING = 0.375  # m towards the ego's path, UN R157
STOPPING = 3.0  # m/s2, a crossing vehicle that could still stop this gently shows no hazard
CORRIDOR_MARGIN = 0.3  # m beside the ego's half width
FIRST_TTC = 3.0  # s, where no other rule applies
SAME, OPPOSITE = np.pi / 4, 3 * np.pi / 4  # rad of heading difference


class Kind(StrEnum):
    """Geometry of an encounter at its contact or closest approach."""

    SAME_DIRECTION = "same_direction"
    ONCOMING = "oncoming"
    CROSSING = "crossing"
    OTHER = "other"


KINDS = (Kind.SAME_DIRECTION, Kind.ONCOMING, Kind.CROSSING, Kind.OTHER)


def path_frame(ego: Boxes, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Lateral offset [m, left positive] of points ``(N, K)`` from the ego's path ``(N, T)``, and the path's heading."""
    ox, oy = ego.x[:, :1], ego.y[:, :1]
    qx, qy, px, py = ego.x - ox, ego.y - oy, x - ox, y - oy
    cross = np.matmul(np.stack([px, py], -1), np.stack([qx, qy], -2))
    nearest = np.argmin((qx * qx + qy * qy)[:, None, :] - 2 * cross, axis=-1)
    rows = np.arange(len(x))[:, None]
    heading = np.broadcast_to(ego.heading, ego.x.shape)[rows, nearest]
    dx, dy = px - qx[rows, nearest], py - qy[rows, nearest]
    return dy * np.cos(heading) - dx * np.sin(heading), heading


def hazard_index(
    ego: Boxes,
    adversary: Boxes,
    trigger_index: NDArray[np.integer],
    contact_index: NDArray[np.integer],
    dt: float,
    *,
    lane_half_width: float = 1.6,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The step at which the hazard shows and the kind (index into ``KINDS``), both ``(N,)``, of ``(N, T)`` states.

    Same direction (headings within 45 degrees at contact): the first step, after the last maximum of its lateral
    offset, at which the adversary has come 0.375 m closer to the ego's path.  Oncoming (over 135 degrees): the
    start of the final spell before contact in which its box is over the edge of the ego's lane.  Crossing (between, or
    a vehicle that turned into the ego's direction): the start of the final spell in which it could not stop at 3 m/s2
    short of the corridor of the ego's path.  A same-direction adversary that never drifted closer (a leader that
    brakes) is *other*: the first 2D TTC < 3 s, else the contact.  Never
    before ``trigger_index`` nor after ``contact_index``.
    """
    rows = np.arange(len(contact_index))
    trigger, contact = np.asarray(trigger_index), np.asarray(contact_index)
    steps = np.arange(ego.x.shape[1])
    inside = (steps >= trigger[:, None]) & (steps <= contact[:, None])
    lateral, path_heading = path_frame(ego, adversary.x, adversary.y)
    offset = np.abs(lateral)
    turn = np.abs(wrap_below_pi(np.broadcast_to(adversary.heading, offset.shape) - path_heading))
    facing = np.abs(wrap_below_pi(np.broadcast_to(adversary.heading - ego.heading, offset.shape)))[rows, contact]
    peak = _last(np.where(inside, offset, -np.inf))
    kind = np.where(facing < SAME, 0, np.where(facing > OPPOSITE, 1, 2))
    kind = np.where((kind == 0) & (turn[rows, peak] > SAME), 2, kind)

    drifted = inside & (steps > peak[:, None]) & (offset <= offset[rows, peak][:, None] - LEFT_LANE_KEEPING)
    reach = adversary.length / 2 * np.abs(np.sin(turn)) + adversary.width / 2 * np.abs(np.cos(turn))
    nearest = np.maximum(offset - reach, 0.0)
    over = _final_spell(nearest < lane_half_width, trigger, contact)
    entry = _final_spell(nearest <= ego.width / 2 + CORRIDOR_MARGIN, trigger, contact)
    committed = _final_spell(_cannot_stop(adversary, entry), trigger, contact)

    soon = inside & (ttc(ego, adversary) < FIRST_TTC)
    kind = np.where((kind == 0) & ~drifted.any(axis=1), KINDS.index(Kind.OTHER), kind)
    first_soon = np.where(soon.any(axis=1), soon.argmax(axis=1), contact)
    return np.choose(kind, [drifted.argmax(axis=1), over, committed, first_soon]), kind


def _last(values: Floats | Bools) -> NDArray[np.intp]:
    """Index of the last maximum of each row."""
    return np.asarray(values.shape[1] - 1 - values[:, ::-1].argmax(axis=1))


def _final_spell(holds: Bools, low: NDArray[np.integer], high: NDArray[np.integer]) -> NDArray[np.intp]:
    """Start of the uninterrupted spell of ``holds`` that runs up to ``high``; ``high`` itself is taken to hold."""
    steps = np.arange(holds.shape[1])
    broken = ~holds & (steps >= low[:, None]) & (steps < high[:, None])
    return np.where(broken.any(axis=1), _last(broken) + 1, low)


def _cannot_stop(adversary: Boxes, entry: NDArray[np.intp]) -> Bools:
    """Whether at each step ``(N, T)`` the way left to the step ``entry`` is no more than v^2 / 2a; true from it on."""
    step = np.hypot(np.diff(adversary.x), np.diff(adversary.y))
    travelled = np.concatenate([np.zeros((len(entry), 1)), np.cumsum(step, axis=1)], axis=1)
    left = travelled[np.arange(len(entry)), entry][:, None] - travelled
    return np.asarray(left <= adversary.speed * adversary.speed / (2 * STOPPING) + 1e-6)  # a micrometre of rounding
