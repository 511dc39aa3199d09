"""Two versions of one driver, for docs/first_week.md: the first looks ahead in its lane, the second all around."""

import math
from dataclasses import replace

from sumo_adv import LaneSpeed, Observation
from sumo_adv.datatypes import DriverModel, VehicleState

HORIZON, STEP = 3.0, 0.25  # s: how far ahead the second version looks, and in which steps
ROOM = 0.4  # m that it wants to have between itself and another vehicle
BRAKING = 7.0  # m/s2


class First:
    """Follows its lane and the vehicle ahead as SUMO's driver does, and sees nothing else."""

    name, forkable = "first", True  # nothing inside that could not be copied

    def reset(self, seed: int) -> None:
        """There is nothing to forget."""

    def act(self, seen: Observation) -> LaneSpeed | None:
        """Leave the step to SUMO."""
        return None

    def model_of(self, numbers: DriverModel) -> DriverModel:
        """SUMO's IDM drives, so the search need not find that out by trying."""
        return replace(numbers, kind="idm", known=True)


class Second(First):
    """Drives like the first, and brakes for every vehicle that crosses its way within three seconds."""

    name = "second"

    def act(self, seen: Observation) -> LaneSpeed | None:
        """Brake where another vehicle, going on as it does now, would come too near; else leave the step to SUMO."""
        if any(meet(seen.ego, vehicle) for vehicle in seen.others):
            return LaneSpeed(lane=None, speed=max(0.0, seen.ego.speed - BRAKING * seen.dt))
        return super().act(seen)

    def model_of(self, numbers: DriverModel) -> DriverModel:
        """No model brakes so: the search asks this driver by attempts."""
        return numbers


def meet(ego: VehicleState, vehicle: VehicleState) -> bool:
    """Whether two vehicles that keep speed and heading come too near to each other. One behind is left out."""
    forward, side = math.cos(ego.heading), math.sin(ego.heading)
    x, y = vehicle.x - ego.x, vehicle.y - ego.y
    turned = vehicle.heading - ego.heading
    ahead, left = x * forward + y * side, y * forward - x * side
    length = (ego.length + vehicle.length * abs(math.cos(turned)) + vehicle.width * abs(math.sin(turned))) / 2
    width = (ego.width + vehicle.width * abs(math.cos(turned)) + vehicle.length * abs(math.sin(turned))) / 2
    if ahead < -length:
        return False
    for k in range(1, round(HORIZON / STEP) + 1):
        time = k * STEP
        along = ahead + (vehicle.speed * math.cos(turned) - ego.speed) * time
        across = left + vehicle.speed * math.sin(turned) * time
        if abs(along) < length + ROOM and abs(across) < width + ROOM:
            return True
    return False
