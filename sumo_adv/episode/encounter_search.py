"""Simulate until an encounter begins, with the ego of the task or with an ego that is chosen here."""

from __future__ import annotations

import math
import time
from collections.abc import Collection

import numpy as np

from sumo_adv.datatypes import Ending
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.ego_way import EgoWay
from sumo_adv.episode.encounter_detector import LOOK_INTERVAL_S, EncounterDetector, RankedVehicle, vehicles_of
from sumo_adv.episode.right_of_way import Meetings
from sumo_adv.episode.surroundings import Surroundings
from sumo_adv.episode.task import NoEncounter, Task
from sumo_adv.errors import MissingVehicleError, UsageError
from sumo_adv.simulation.inputs import EgoRoute
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.permissions import OFF_ROAD_CLASSES

EGO_PATIENCE_S = 15.0  # s after which a chosen ego without an encounter is replaced by another
DRIVER_LEAD_S = 3.0  # s for which the driver drives a chosen ego before an encounter may begin
SAME_ENCOUNTER_S = 15.0  # s after an encounter was left in which its vehicles begin no other one
WHOLE_RECORDING_S = 10.0  # s; a recording that is no longer, or the rest of a longer one, is one encounter
INSERTED_EGO = "ego"
MIN_CHOSEN_EGO_SPEED_M_S = 5.0  # m/s, of an ego that is chosen
TRAFFIC_COUNT_RADIUS_M = 60.0  # m within which traffic is counted to choose an ego
MIN_ROUTE_LEFT_M = 150.0  # m, for an ego that is chosen


class EncounterSearch:
    """Searches one simulation for encounters.

    Attributes:
        drive: The simulation.
        road: The map.
        task: What the engine was opened with.
    """

    def __init__(self, drive: Drive, road: RoadMap, task: Task) -> None:
        """Prepare the simulation, now and whenever it is loaded again.

        Args:
            drive: The simulation.
            road: The map.
            task: What the engine was opened with.
        """
        self.drive, self.road, self.task = drive, road, task
        self._meetings = Meetings(road)
        self._left_egos = set[str]()
        self._left_vehicles, self._left_at = frozenset[str](), -math.inf
        drive.on_load = self.begin
        self.begin()

    def begin(self) -> None:
        """Prepare a simulation that was just loaded: forget the road ahead, and insert the ego if it has a route."""
        self.drive.observe = Surroundings(self.road, self._meetings, self.drive, self.task.spec.additional)
        demanded = self.task.moves or self.task.sight
        self.drive.way = EgoWay(self.road, self.task.moves, self.task.sight) if demanded else None
        route = self.task.ego
        if isinstance(route, EgoRoute):
            depart = {
                "depart": repr(max(route.depart, self.task.spec.begin)), "departLane": str(route.lane),
                "departPos": str(route.position), "departSpeed": str(route.speed),
            }  # fmt: skip
            self.drive.simulation.add(INSERTED_EGO, route.edges, self.task.ego_base_type or "DEFAULT_VEHTYPE", depart)
            if self.task.ego_base_type is None:  # it has no factor of the limit, and SUMO would draw one
                self.drive.simulation.set_speed_factor(INSERTED_EGO, 1.0)

    def leave(self, ranked: Collection[str]) -> None:
        """Leave the encounter that began now, and look for another one.

        An ego that was chosen here is replaced by another one, except in a recording. Otherwise, the next encounter has
        other vehicles or begins later.

        Args:
            ranked: The vehicles of the encounter.
        """
        drive = self.drive
        self._left_vehicles, self._left_at = frozenset(ranked), drive.now
        if self.task.ego is None and drive.ego is not None and not drive.recorded():
            self._left_egos.add(drive.ego)
            drive.release()

    def until_encounter(self, ends_at: float = math.inf) -> list[RankedVehicle] | NoEncounter:
        """Step until an encounter begins.

        Args:
            ends_at: When the search ends without one, as ``time.perf_counter()`` [s].

        Returns:
            The ranking, highest risk first, or why there is no encounter. The ranking may be empty at a given trigger,
            and in the last ``WHOLE_RECORDING_S`` of a recording, which are one encounter as soon as the ego's history
            is known.

        Raises:
            UsageError: The requested ego or adversary cannot have its role.
            MissingVehicleError: The requested ego or adversary was never inserted.
        """
        task, drive, every = self.task, self.drive, self.task.settings.steps(LOOK_INTERVAL_S)
        requested = INSERTED_EGO if isinstance(task.ego, EgoRoute) else task.ego
        wait = max(task.settings.history, task.warm_up if requested is not None else 0.0)  # before the first look
        detector = self.watch()
        since, tried = -math.inf, set(self._left_egos)
        if drive.ego is not None:
            since = drive.now - task.warm_up
        while drive.now < task.end:
            if time.perf_counter() >= ends_at:
                return NoEncounter(
                    Ending.NO_ENCOUNTER, f"The time was used up before an encounter began ({drive.now:.0f} s)."
                )
            snapshot = drive.tick()
            step = len(drive.recording.snapshots)
            if self._drives_another():
                continue
            if drive.ego is None:
                name = requested if requested is not None and self._may_begin(requested) else None
                if requested is None and step % every == 0 and drive.now >= task.spec.recorded_from + task.warm_up:
                    name = self._choose_ego(tried)
                if name is not None and requested is None and self._scouts:
                    drive.watch(name)
                    since, detector = drive.now, self.watch()
                elif name is not None:
                    drive.take_over(name)
                    # a recorded vehicle is there before the driver takes over
                    seen = (s.time for s in drive.recording.snapshots if name in s.raw)
                    since, detector = drive.now if requested is None else next(seen), self.watch()
            elif drive.ego not in snapshot.raw:
                if requested is not None:
                    self._refuse_unknown()
                    return NoEncounter(
                        Ending.EGO_LEFT,
                        f"The vehicle '{requested}' was gone at {drive.now:.1f} s; {detector.needed}. "
                        "A driver of yours may be faster than road.limit."
                        f"{drive.way.missed if drive.way is not None else ''}",
                    )
                drive.release()
            elif drive.way is not None and drive.way.awaits_move(drive):
                continue
            elif task.trigger is not None:
                if drive.now >= task.trigger - 1e-6:
                    self._refuse_unknown()
                    return detector.rank(drive)
            elif self.nearly_over() and drive.now - since >= task.settings.history - 1e-6:
                return detector.rank(drive)
            elif step % every == 0 and drive.now - since >= wait:
                ranking = detector.look(drive)
                later = drive.now >= self._left_at + SAME_ENCOUNTER_S
                if ranking and (later or not self._left_vehicles.issuperset(c.id for c in ranking)):
                    if not drive.watched:
                        return ranking
                    drive.take_over(drive.ego)
                    since = drive.now + DRIVER_LEAD_S - wait
                    continue
                if requested is None and drive.now - since > EGO_PATIENCE_S:
                    tried.add(drive.ego)
                    drive.release()
            if not drive.to_come():
                break
        return self._nothing(requested, detector)

    @property
    def _scouts(self) -> bool:
        """Whether SUMO drives a chosen ego until an encounter comes, because its driver takes longer."""
        return self.drive.controller.needs_observation and not self.drive.recorded() and self.task.trigger is None

    def _drives_another(self) -> bool:
        """Have the driver drive vehicles before the ego, as the task says; return whether it drives one now."""
        drive, half = self.drive, self.task.settings.step_length / 2
        for name, begin, end in self.task.driven_before:
            if drive.ego == name and abs(drive.now - end) < half:
                drive.release()
            if begin - half < drive.now < end - half:
                if drive.ego is None and name in drive.snapshot.raw:
                    drive.take_over(name)
                return drive.ego == name
        return False

    def _may_begin(self, requested: str) -> bool:
        """Return whether the requested ego is there and its driver may take over now."""
        drive, earliest = self.drive, self.task.driven_from
        if requested in drive.obstacles:
            raise UsageError(f"'{requested}' is not a vehicle, so it cannot be the ego; name another.")
        there = requested in drive.snapshot.raw and drive.may_take_over(requested)
        return there and (earliest is None or drive.now >= earliest - 1e-6)

    def nearly_over(self) -> bool:
        """Return whether the rest of a recording is short enough to be attacked as a whole."""
        log = self.drive.playback if self.drive.recorded() else None
        return log is not None and log.spec.end - self.drive.now <= WHOLE_RECORDING_S

    def watch(self) -> EncounterDetector:
        """Return a detector for an ego."""
        return EncounterDetector(
            self.road, self.task.settings.shortlist, self.task.only, self.task.settings.kind,
            recorded=self.drive.recorded(), odd=self.task.settings.odd,
        )  # fmt: skip

    def _nothing(self, requested: str | None, detector: EncounterDetector) -> NoEncounter:
        """Return why no encounter began; raise if a requested vehicle is missing or unsuitable."""
        if requested is not None and self.drive.ego is None and requested not in self.drive.simulation.fleet.sizes:
            raise self._missing(requested, "check --ego-id")
        self._refuse_unknown()
        if requested is not None and self.drive.ego is None:
            why = f"The recorded vehicle '{requested}' was on no lane where a driver could have taken it over."
            return NoEncounter(Ending.NO_ENCOUNTER, why)
        if self.drive.recorded():
            return NoEncounter(Ending.NO_ENCOUNTER, f"{detector.missing} Try another --ego-id.")
        missed = "" if self.drive.way is None else self.drive.way.missed
        return NoEncounter(
            Ending.NO_ENCOUNTER,
            f"No {vehicles_of(self.task.settings.kind)} came into a position to endanger the ego before "
            f"{self.drive.now:.0f} s ({detector.needed}); "
            f"try a longer --end, more --density, another --seed or --ego-id. {detector.outside}".rstrip()
            + missed,
        )

    def _refuse_unknown(self) -> None:
        """Raise UsageError for a requested adversary that is the ego, was never inserted or cannot attack."""
        if self.drive.ego in self.task.only:
            raise UsageError(f"Vehicle '{self.drive.ego}' is the ego, so it cannot be the adversary; name another.")
        unknown = [n for n in self.task.only if n not in self.drive.simulation.fleet.sizes]
        if unknown:
            advice = "check --adversary or the scenario's candidates"
            raise self._missing(unknown[0], advice)
        kinds = {name: self.drive.kind(name) for name in self.task.only if name in self.drive.snapshot.raw}
        bound = next((name for name, kind in kinds.items() if kind in OFF_ROAD_CLASSES), None)
        if bound is not None:
            why = f"is a {kinds[bound]}, and no vehicle of that class can attack: it drives on no road"
            raise UsageError(f"Vehicle '{bound}' {why}; name another adversary.")

    def _missing(self, vehicle: str, advice: str) -> MissingVehicleError:
        words = f"No vehicle '{vehicle}' was inserted before {self.drive.now:.0f} s; {advice}."
        return MissingVehicleError(words, vehicle)

    def _choose_ego(self, tried: set[str]) -> str | None:
        """Return the moving car with the most moving traffic within ``TRAFFIC_COUNT_RADIUS_M``; the first of equals.

        Return None if no car that the driver may take over has moving traffic near it and enough of its route left.
        """
        drive, raw, simulation = self.drive, self.drive.snapshot.raw, self.drive.simulation
        moving = [
            (n, *drive.pose(n)[:2])
            for n, r in raw.items()
            if r[3] > MIN_CHOSEN_EGO_SPEED_M_S and n not in drive.obstacles
        ]
        best, best_count = None, 0
        points = np.array([(x, y) for _, x, y in moving]).reshape(-1, 2)
        for name, x, y in moving:
            if name in tried or not drive.may_take_over(name):
                continue
            if simulation.vehicle_class(name) not in ("passenger", "private", "taxi"):
                continue
            lanes, edges = self.road.lanes, self.road.edges
            left = sum(lanes[edges[e][0]].length for e in simulation.ahead(name) if e in edges)
            if left < MIN_ROUTE_LEFT_M or raw[name][4] not in self.road.lanes:
                continue
            near = np.hypot(points[:, 0] - x, points[:, 1] - y)
            count = int((near < TRAFFIC_COUNT_RADIUS_M).sum()) - 1
            if count > best_count:
                best, best_count = name, count
        return best
