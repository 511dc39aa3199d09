"""Human errors of SUMO's drivers: which errors are possible now, and how one begins, continues and ends.

===================  ================================================================================================
error                what the driver does, and by which means of SUMO
===================  ================================================================================================
inattention          keeps speed and lane, whatever is ahead: ``setSpeed`` with all checks off
late braking         the same for a reaction time, then brakes hard: ``setSpeed`` with all checks off, step by step
change left, right   changes lane into whatever gap there is: ``changeSublane``, other vehicles not respected
drift left, right    leaves the lane sideways for a while and keeps its speed: ``changeSublane``, ``setSpeed``
priority             enters the junction though it must give way: speed mode without right of way
red light            enters the junction at red: speed mode without right of way and lights
===================  ================================================================================================

A driver makes one error at a time. After the error, SUMO drives the vehicle as before.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from sumo_adv.simulation.centreline import Centreline, centreline
from sumo_adv.simulation.moved_vehicles import FREE_SPEED_MODE, SUMO_SPEED_MODE
from sumo_adv.simulation.network import is_left_hand
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.sumo_states import RawState

# Speed modes: bit 3 is right of way before the junction, bit 5 is right of way on it, bit 4 is lights.
PRIORITY_IGNORING_SPEED_MODE = 55
LIGHTS_IGNORING_SPEED_MODE = 39
UNRULED_LANE_MODE, SUMO_LANE_MODE = 0, 1621  # lane change modes
MIN_ERRING_SPEED_M_S = 2.0  # a slower driver does nothing wrong by keeping its speed or lane
STOP_LINE_DECISION_DISTANCE_M = 40.0  # before a stop line; from there on, a driver can decide to ignore it
LATE_REACTION_S, LATE_BRAKING_M_S2 = 1.5, 6.0  # reaction time and braking of late braking
DRIFT_DISTANCE_M = 2.0  # lateral; in a lane of 3.5 m, a car of 1.8 m is then 1.15 m beyond the line


class ErrorKind(StrEnum):
    """What a driver does wrong."""

    INATTENTION = "inattention"
    LATE_BRAKING = "late_braking"
    CHANGE_LEFT = "change_left"
    CHANGE_RIGHT = "change_right"
    DRIFT_LEFT = "drift_left"
    DRIFT_RIGHT = "drift_right"
    PRIORITY = "priority"
    RED_LIGHT = "red_light"


ERROR_SIDES = {ErrorKind.CHANGE_LEFT: 1, ErrorKind.DRIFT_LEFT: 1, ErrorKind.CHANGE_RIGHT: -1, ErrorKind.DRIFT_RIGHT: -1}
"""The change of lane that an error leads to, in lanes to the left."""
ERROR_DURATIONS_S = {
    ErrorKind.INATTENTION: 3.0, ErrorKind.LATE_BRAKING: 4.0, ErrorKind.CHANGE_LEFT: 4.0, ErrorKind.CHANGE_RIGHT: 4.0,
    ErrorKind.DRIFT_LEFT: 4.0, ErrorKind.DRIFT_RIGHT: 4.0, ErrorKind.PRIORITY: 6.0, ErrorKind.RED_LIGHT: 6.0,
}  # fmt: skip
"""How long each error lasts [s]."""
SPEED_KEEPING_ERRORS = frozenset(
    {ErrorKind.INATTENTION, ErrorKind.LATE_BRAKING, ErrorKind.DRIFT_LEFT, ErrorKind.DRIFT_RIGHT}
)


def speed_in_error(kind: ErrorKind, begun: float, after: float) -> float:
    """Return the speed of a driver during an error that keeps its speed.

    Args:
        kind: The error.
        begun: The speed at which the error began [m/s].
        after: The time since then [s].

    Returns:
        The speed [m/s]. It equals ``begun``, except that late braking reduces it after the reaction time.
    """
    if kind is ErrorKind.LATE_BRAKING and after > LATE_REACTION_S:
        return max(0.0, begun - LATE_BRAKING_M_S2 * (after - LATE_REACTION_S))
    return begun


@dataclass(frozen=True, slots=True)
class Begun:
    """An error that has begun.

    Attributes:
        kind: The error.
        since: When it began [s].
        speed: The driver's speed at that time [m/s].
    """

    kind: ErrorKind
    since: float
    speed: float


class HumanErrors:
    """The errors of one simulation. Create a new object when the simulation is reloaded.

    Attributes:
        active: The present error of each vehicle that is making one.
        last: The latest error of each vehicle, including errors that are over.
    """

    def __init__(self, simulation: Simulation) -> None:
        """Start without errors.

        Args:
            simulation: The simulation.
        """
        self._simulation = simulation
        self._api: Any = simulation.api
        self._hand = -1 if is_left_hand(simulation.spec.network) else 1  # SUMO counts lanes from the outer side
        self._lanes: dict[str, int] = {}  # number of lanes by edge
        self._lines: dict[str, Centreline | None] = {}  # lines by lane; None if the lane leads to no other lane
        self.active: dict[str, Begun] = {}
        self.last: dict[str, Begun] = {}  # the latest error of each vehicle, even if it is over

    def possible(self, vehicle: str, raw: RawState) -> tuple[ErrorKind, ...]:
        """Return the errors that a driver can begin now.

        Args:
            vehicle: The id of the vehicle.
            raw: Its state in the newest snapshot.

        Returns:
            The errors; empty if the driver is making one.
        """
        lane, kinds = raw[4], list[ErrorKind]()
        if vehicle in self.active:
            return ()
        if raw[3] > MIN_ERRING_SPEED_M_S:
            kinds += [ErrorKind.INATTENTION, ErrorKind.LATE_BRAKING]
        if not lane or lane.startswith(":"):
            return tuple(kinds)
        if raw[3] > MIN_ERRING_SPEED_M_S:
            edge, _, index = lane.rpartition("_")
            lanes = self._lanes.get(edge)
            if lanes is None:
                lanes = self._lanes[edge] = int(self._api.edge.getLaneNumber(edge))
            kinds += [kind for kind, side in ERROR_SIDES.items() if 0 <= int(index) + self._hand * side < lanes]
        if lane not in self._lines:
            api = self._api.lane
            leads_on = bool(api.getLinks(lane))
            self._lines[lane] = centreline(api.getShape(lane), api.getLength(lane)) if leads_on else None
        line = self._lines[lane]
        if (
            line is not None
            and line.length - line.station_of(self._simulation.lane_position(vehicle)) < STOP_LINE_DECISION_DISTANCE_M
        ):
            kinds += self._at_line(vehicle)
        return tuple(kinds)

    def _at_line(self, vehicle: str) -> tuple[ErrorKind, ...]:
        """Return the errors that are possible at the stop line ahead."""
        links = self._api.vehicle.getNextLinks(vehicle)
        state = links[0][5] if links else "M"
        if state in "ruyY":
            return (ErrorKind.RED_LIGHT,)
        return (ErrorKind.PRIORITY,) if state in "m=swgZ" else ()

    def begin(self, vehicle: str, kind: ErrorKind, speed: float) -> None:
        """Make a driver commit an error from the next step on.

        Args:
            vehicle: The id of the vehicle.
            kind: The error.
            speed: Its present speed [m/s].
        """
        v, side, lane = self._api.vehicle, self._hand * ERROR_SIDES.get(kind, 0), self._api.lane
        self.active[vehicle] = self.last[vehicle] = Begun(kind, self._simulation.time, speed)
        if kind in SPEED_KEEPING_ERRORS:
            v.setSpeedMode(vehicle, FREE_SPEED_MODE)
        elif kind is ErrorKind.PRIORITY:
            v.setSpeedMode(vehicle, PRIORITY_IGNORING_SPEED_MODE)
        elif kind is ErrorKind.RED_LIGHT:
            v.setSpeedMode(vehicle, LIGHTS_IGNORING_SPEED_MODE)
        v.setLaneChangeMode(vehicle, UNRULED_LANE_MODE)
        if kind in (ErrorKind.DRIFT_LEFT, ErrorKind.DRIFT_RIGHT):
            v.changeSublane(vehicle, side * DRIFT_DISTANCE_M)
        elif side:  # not changeLane, which waits beside a vehicle in every mode
            here = str(v.getLaneID(vehicle))
            edge, _, index = here.rpartition("_")
            there = f"{edge}_{int(index) + side}"
            v.changeSublane(vehicle, side * (lane.getWidth(here) + lane.getWidth(there)) / 2)

    def before_step(self) -> None:
        """Continue the active errors, and end those whose time is over. Call it before each step."""
        time, v = self._simulation.time, self._api.vehicle
        there = set(v.getIDList()) if self.active else set()
        for vehicle, error in list(self.active.items()):
            after = time - error.since
            if vehicle not in there:
                del self.active[vehicle]
            elif after >= ERROR_DURATIONS_S[error.kind] - 1e-6:
                del self.active[vehicle]
                v.setSpeed(vehicle, -1.0)
                v.setSpeedMode(vehicle, SUMO_SPEED_MODE)
                v.setLaneChangeMode(vehicle, SUMO_LANE_MODE)
            elif error.kind in SPEED_KEEPING_ERRORS:
                step = self._simulation.spec.step_length
                v.setSpeed(vehicle, speed_in_error(error.kind, error.speed, after + step))
