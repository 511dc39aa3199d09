"""Put vehicles that a log moves into SUMO, take them out, and hand them over to SUMO's drivers.

Measured with SUMO 1.28: a vehicle that is added and moved in one step is at its pose after that step. This holds on a
lane, off the road, beyond the road's end, and without a route. Its first speed is right only if it departs with that
speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from sumo_adv.errors import SimulationError, UsageError
from sumo_adv.geometry import Pose
from sumo_adv.simulation.moved_vehicles import SUMO_SPEED_MODE
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.sumo_states import PERSON

LOGGED_TYPE = "sumo_adv_logged"
LOGGED_TYPE_XML = f'<vType id="{LOGGED_TYPE}" vClass="passenger" speedFactor="10" speedDev="0"/>'
"""SUMO's default driver. The factor allows it to depart at any recorded speed, and a hand-over resets the factor."""


class Stage:
    """The operations on one loaded simulation that playback needs."""

    def __init__(self, simulation: Simulation) -> None:
        """Work on a loaded simulation."""
        self._simulation = simulation
        self._sumo = simulation.api
        self._routes: set[str] = set()
        self._programs: dict[str, str] = {}

    def spawn(self, name: str, edges: Sequence[str], pose: Pose, size: tuple[float, float]) -> None:
        """Insert a vehicle. Inject it at ``pose`` in the same step.

        SUMO refuses a speed above ten times the limit of the route's first edge. Such a vehicle departs as fast as SUMO
        allows, and the injected pose sets its speed.

        Args:
            name: The id of the vehicle.
            edges: The edges of its route; may be empty.
            pose: Its pose.
            size: Its length and width [m].

        Raises:
            SimulationError: SUMO does not accept the vehicle at any speed.
        """
        route = f"{name}.log" if edges else ""
        try:
            if route and route not in self._routes:
                self._sumo.route.add(route, list(edges))
                self._routes.add(route)
            self._add(name, route, max(0.0, pose.speed))
            self._sumo.vehicle.setLength(name, size[0])
            self._sumo.vehicle.setWidth(name, size[1])
        except self._simulation.errors as error:
            raise SimulationError(f"SUMO could not insert the recorded vehicle '{name}' ({error}).") from error
        self._simulation.fleet.sizes[name] = size

    def _add(self, name: str, route: str, speed: float) -> None:
        """Add a vehicle at this speed [m/s] or, if SUMO refuses it, at the highest speed that SUMO allows."""
        vehicle = self._sumo.vehicle
        try:
            vehicle.add(name, route, LOGGED_TYPE, depart="now", departSpeed=f"{speed:.6f}")
        except self._simulation.errors:
            vehicle.add(name, route, LOGGED_TYPE, depart="now", departSpeed="max")

    def embody(self, person: str, pose: Pose) -> None:
        """Replace a person by a vehicle of its name and size. Inject it at ``pose`` in the same step.

        Measured with SUMO 1.28: ``person.moveToXY`` has no effect in the pedestrian model nonInteracting. In the model
        striping, drivers see a moved person only with ``keepRoute`` 6, and its speed is 0.

        Args:
            person: ``person:ID`` of the person.
            pose: Its pose.

        Raises:
            SimulationError: SUMO does not accept the vehicle.
        """
        fleet = self._simulation.fleet
        self._sumo.person.removeStages(person.removeprefix(PERSON))
        self.spawn(person, (), pose, fleet.sizes[person])
        fleet.persons.discard(person)

    def remove(self, name: str) -> None:
        """Remove a vehicle from SUMO."""
        self._sumo.vehicle.remove(name)

    def hand_over(self, name: str, speed: float, edges: Sequence[str], factor: float | None = None) -> None:
        """Let SUMO drive a vehicle from the next step on.

        Args:
            name: The id of the vehicle.
            speed: Its present speed [m/s].
            edges: The edges of its whole route.
            factor: The share of the speed limit that its driver aims for. None means 1, or the share at its present
                speed if that is more.
        """
        vehicle = self._sumo.vehicle
        vehicle.setPreviousSpeed(name, speed)
        vehicle.setSpeed(name, -1.0)
        vehicle.setSpeedMode(name, SUMO_SPEED_MODE)
        vehicle.setSpeedFactor(name, factor or 1.0)
        allowed = vehicle.getAllowedSpeed(name)
        if factor is None and 0.0 < allowed < speed:
            vehicle.setSpeedFactor(name, speed / allowed)
        self.direct(name, tuple(edges))

    def direct(self, name: str, edges: tuple[str, ...]) -> None:
        """Give a vehicle its route, starting where it is.

        If moveToXY took the vehicle off the route, it drives to the route's end. If no way leads there, SUMO's own
        route stays.

        Args:
            name: The id of the vehicle.
            edges: The edges of its whole route.
        """
        vehicle = self._sumo.vehicle
        route, at = tuple(vehicle.getRoute(name)), max(0, int(vehicle.getRouteIndex(name)))
        if not edges or not route:
            return
        here, lane = route[at], vehicle.getLaneID(name)
        links = self._sumo.lane.getLinks(lane) if lane.startswith(":") else ()
        into = {link[0].rpartition("_")[0] for link in links}
        onward = edges[edges.index(here) :] if here in edges else ()
        with suppress(*self._simulation.errors):  # if no way leads there from here, SUMO's own route stays
            if onward and (not into or (len(onward) > 1 and onward[1] in into)):
                vehicle.setRoute(name, list(onward))
            elif edges[-1] != here:
                vehicle.changeTarget(name, edges[-1])

    def set_signal(self, name: str, state: str | None) -> None:
        """Make a traffic light show a state.

        Args:
            name: The id of the light.
            state: The state; None returns the light to its own program.

        Raises:
            UsageError: There is no such light, or the state does not fit it.
        """
        lights = self._sumo.trafficlight
        try:
            self._programs.setdefault(name, lights.getProgram(name))
            if state is None:
                lights.setProgram(name, self._programs[name])
            else:
                lights.setRedYellowGreenState(name, state)
        except self._simulation.errors as error:
            raise UsageError(
                f"The recorded signal '{name}' cannot show '{state}' in this network ({error})."
            ) from error
