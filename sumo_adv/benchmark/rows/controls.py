"""A kinematic bicycle's controls as a vector: what random search and CMA-ES search over.

``KNOTS`` steering values and ``KNOTS`` accelerations, each held for an equal part of the horizon. A unit of the vector
is ``STEERING_UNIT`` of the sharpest turn that the limits allow at its speed, on top of the bend of the way it is on,
and ``ACCELERATION_UNIT`` of the strongest braking or acceleration. So the zero vector drives on along its way, and a
standard normal one wanders by about a lane. After the horizon it turns back to the direction of its way and keeps its
speed. The vehicle is the bicycle of ``drivers/protocol.py`` (Polack et al. 2017). Acceleration, jerk and grip are
bound as for any adversary (``planners/trajectory.py:faster``); the front wheel turns by at most ``STEERING_RATE``.
Where the motion leaves the road it ends, standing: nothing after that can count, and SUMO has crashed on what went on
there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.benchmark.nouns import Encounter
from sumo_adv.datatypes import Boxes, Floats, PrescribedMotion, Verdict
from sumo_adv.drivers.protocol import MAX_STEERING, WHEELBASE, Steer, apply_steer
from sumo_adv.geometry import PATH_STEP, wrap
from sumo_adv.metrics.gates import off_road
from sumo_adv.planners.trajectory import Scalar, faster
from sumo_adv.simulation.network import Drivable
from sumo_adv.situation import ReferencePath, Target

KNOTS = 6
SIZE = 2 * KNOTS
STEERING_UNIT, ACCELERATION_UNIT = 0.06, 0.4
STEERING_RATE = 0.5  # rad/s at the front wheel
BACK, SLOWEST = 1.0, 3.0  # s, m: how fast it turns back after the horizon
SHARE = 0.95  # of lateral acceleration and curvature that is used
FARTHEST, LONGEST = 50.0, 10.0  # m, s: the objective knows no more


@dataclass(frozen=True, slots=True)
class Start:
    """What a search moves: a vehicle, on which of its ways, from which delay [s] on."""

    delay: float
    target: Target
    way: ReferencePath


def starts(encounter: Encounter) -> list[Start]:
    """All of them, earliest first, then most dangerous first; of a vehicle's ways those first that meet the ego's."""
    return [
        Start(delay, target, way)
        for delay in sorted(encounter.situations)
        for target in encounter.situations[delay].target_list()
        for way in sorted(target.ways, key=lambda w: w.conflict is None)
    ]


def drive(start: Start, vector: Sequence[float] | Floats, encounter: Encounter) -> PrescribedMotion:
    """The motion that controls come to, over the duration of an attempt."""
    settings, way = encounter.settings, start.way.path
    dt, limits, state = settings.step_length, settings.limits.limits(), start.target.state
    shares = np.clip(np.reshape(vector, (2, KNOTS)).T * (STEERING_UNIT, ACCELERATION_UNIT), -1.0, 1.0).tolist()
    poses = np.empty((settings.steps(settings.duration), 4))
    steering, travelled, a = 0.0, start.target.station, state.acceleration
    for k in range(len(poses)):
        knot = int((k + 0.5) * dt / settings.horizon * KNOTS)
        at = min(max(int(travelled / PATH_STEP), 0), len(way.curvature) - 1)
        tightest = SHARE * min(limits.curvature, limits.lateral / max(state.speed, 1.0) ** 2)
        push, curvature = 0.0, float(way.curvature[at])
        if knot < KNOTS:
            turn, push = shares[knot]
            curvature += turn * tightest
        else:
            curvature += wrap(float(way.heading[at]) - state.heading) / max(state.speed * BACK, SLOWEST)
        steering = _towards(steering, _wheel(_towards(0.0, curvature, tightest)), STEERING_RATE * dt)
        want, v = push * (limits.acceleration if push > 0 else limits.braking), state.speed
        _, a = faster(Scalar, v, a, want, v * v * abs(curvature), limits, start.target.fastest, dt)
        state = apply_steer(state, Steer(a, steering), dt)
        travelled += (v + state.speed) / 2 * dt
        poses[k] = state.x, state.y, state.heading, state.speed
    return _on_road(poses, start.target, encounter.drivable)


def _on_road(poses: Floats, target: Target, drivable: Drivable) -> PrescribedMotion:
    """The motion up to the step in which a corner leaves the road, as the gate sees it, and there it stands."""
    x, y, heading, speed = (np.ascontiguousarray(column) for column in poses.T)
    boxes = Boxes(x, y, heading, speed, target.state.length, target.state.width)
    off = np.flatnonzero(off_road(boxes, np.ones(len(x), bool), drivable))
    if not len(off):
        return PrescribedMotion(x, y, heading, speed)
    n = int(off[0]) + 1
    x, y, heading = (np.append(column[:n], column[n - 1]) for column in (x, y, heading))
    return PrescribedMotion(x, y, heading, np.append(speed[:n], 0.0))


def _wheel(curvature: float) -> float:
    """The front wheel's angle [rad] for a curvature of the centre's path (the bicycle's k = cos(b) tan(d) / L)."""
    c = curvature * WHEELBASE
    return min(max(math.atan(c / math.sqrt(1.0 - c * c / 4.0)), -MAX_STEERING), MAX_STEERING)


def _towards(value: float, goal: float, most: float) -> float:
    """``wanted``, or as near to it as ``most`` from ``value``."""
    return min(max(goal, value - most), value + most)


def objective(verdict: Verdict) -> float:
    """What a search makes least: 0 valid, 1 a collision that counts, else 2 to 8 by distance and TTC, and 3 more each
    for an infeasible motion and for running into the ego's back."""
    if verdict.valid:
        return 0.0
    if verdict.collided and verdict.counts:
        return 1.0
    near = min(verdict.min_distance, FARTHEST) / 10.0 + min(verdict.min_ttc, LONGEST) / 10.0
    return 2.0 + near + 3.0 * (not verdict.feasible) + 3.0 * verdict.rear_end
