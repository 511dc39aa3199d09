"""The kinematic bicycle model, for egos that answer with pedals and wheel.

Reference point is the box centre, which lies r in front of the rear axle, by default half-way between the axles (Polack
et al. 2017, "The kinematic bicycle model"; Rajamani 2012, section 2.2, with l_r = r). For a steering angle d and a
wheelbase L:

    slip       b = atan(r tan(d) / L)          angle between velocity and heading
    curvature  k = cos(b) tan(d) / L           of the centre's path
    travelled  s = v dt + a dt^2 / 2           up to standstill, never backwards
    heading   += k s
    position  += s sinc(k s / 2) (cos, sin)(heading + b + k s / 2)

which is exact for constant a and d: the centre runs along a circular arc.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from sumo_adv.datatypes import VehicleState
from sumo_adv.drivers.protocol import Steer
from sumo_adv.geometry import wrap

WHEELBASE = 2.8  # m
MAX_STEERING = 0.6  # rad, front wheel angle to either side
MAX_BRAKING = 9.0  # m/s2, as SUMO's emergency deceleration
MAX_ACCELERATION = 4.0  # m/s2


@dataclass(frozen=True, slots=True)
class Bicycle:
    """A car's numbers. wheelbase [m]; rear_axle: from the box centre back to the rear axle [m], None = half of the
    wheelbase; max_steering: front wheel angle to either side [rad]; max_braking, max_acceleration [m/s2], positive."""

    wheelbase: float = WHEELBASE
    max_steering: float = MAX_STEERING
    max_braking: float = MAX_BRAKING
    max_acceleration: float = MAX_ACCELERATION
    rear_axle: float | None = None


DEFAULT = Bicycle()


def apply_steer(state: VehicleState, steer: Steer, dt: float, bicycle: Bicycle = DEFAULT) -> VehicleState:
    """``state`` after ``dt`` [s] of ``steer``, which is limited to what the ``bicycle`` can do.

    The speed is that of the box centre; ``acceleration`` of the answer is the mean over the step.
    """
    rear = bicycle.wheelbase / 2 if bicycle.rear_axle is None else bicycle.rear_axle
    steering = min(max(steer.steering, -bicycle.max_steering), bicycle.max_steering)
    acceleration = min(max(steer.acceleration, -bicycle.max_braking), bicycle.max_acceleration)
    speed = max(0.0, state.speed + acceleration * dt)
    travelled = state.speed * dt + 0.5 * acceleration * dt * dt
    if acceleration < 0 and speed == 0.0:
        travelled = state.speed**2 / (-2.0 * acceleration)
    slip = math.atan(rear / bicycle.wheelbase * math.tan(steering))
    turned = math.cos(slip) * math.tan(steering) / bicycle.wheelbase * travelled
    chord = travelled if turned == 0.0 else travelled * math.sin(turned / 2) / (turned / 2)
    direction = state.heading + slip + turned / 2
    return replace(
        state,
        x=state.x + chord * math.cos(direction),
        y=state.y + chord * math.sin(direction),
        heading=wrap(state.heading + turned),
        speed=speed,
        acceleration=(speed - state.speed) / dt,
    )
