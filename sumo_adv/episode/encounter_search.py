"""Goes through the simulation until an encounter begins, with the ego that was asked for or one that it chooses."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from sumo_adv.datatypes import Ending, VehicleState
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.encounter import LOOK_EVERY, ON, ON_RECORDED, Candidate, EncounterDetector, ego_path
from sumo_adv.episode.road_here import RoadHere
from sumo_adv.episode.task import NoEncounter, Task
from sumo_adv.errors import UsageError
from sumo_adv.geometry import PATH_STEP
from sumo_adv.simulation.inputs import EgoRoute
from sumo_adv.simulation.network import RoadMap

PATIENCE = 15.0  # s one automatically chosen ego is watched without an encounter
INSERTED_EGO = "ego"
LINE_AHEAD, LINE_FRESH = 120.0, 40.0  # m: how far a driver is told its lane, and how long that serves
MOVING, CROWD, LEFT = 5.0, 60.0, 150.0  # m/s, m, m: what makes a vehicle worth being the ego


class LaneLine:
    """The centreline of the ego's lane and route ahead; the same object while it still reaches far enough."""

    def __init__(self, road: RoadMap, drive: Drive) -> None:
        self._road, self._drive = road, drive
        self._lane, self._from, self._line = "", (0.0, 0.0), list[tuple[float, float]]()

    def __call__(self, ego: VehicleState) -> Sequence[tuple[float, float]] | None:
        """(x, y) every metre from the ego on, None off the road."""
        if ego.lane != self._lane or math.hypot(ego.x - self._from[0], ego.y - self._from[1]) > LINE_FRESH:
            path = ego_path(self._road, self._drive)
            if path is None:
                return None
            count = round(LINE_AHEAD / PATH_STEP)
            self._line = list(zip(path.x[:count:2].tolist(), path.y[:count:2].tolist(), strict=True))
            self._lane, self._from = ego.lane, (ego.x, ego.y)
        return self._line


class EncounterSearch:
    """Finds encounters for one drive."""

    def __init__(self, drive: Drive, road: RoadMap, task: Task) -> None:
        self.drive, self.road, self.task = drive, road, task
        drive.on_load = self.begin
        self.begin()

    def begin(self) -> None:
        """Make a simulation that was just loaded ready: nothing is known of the lane ahead, the ego is inserted."""
        self.drive.line_ahead = LaneLine(self.road, self.drive)
        self.drive.road_here = RoadHere(self.road, self.drive.simulation)
        route = self.task.ego
        if isinstance(route, EgoRoute):
            depart = {
                "depart": repr(max(route.depart, self.task.spec.begin)), "departLane": str(route.lane),
                "departPos": str(route.position), "departSpeed": str(route.speed),
            }  # fmt: skip
            self.drive.simulation.add(INSERTED_EGO, route.edges, self.task.ego_base_type or "DEFAULT_VEHTYPE", depart)

    def until_encounter(self) -> list[Candidate] | NoEncounter:
        task, drive, every = self.task, self.drive, self.task.settings.steps(LOOK_EVERY)
        wanted = INSERTED_EGO if isinstance(task.ego, EgoRoute) else task.ego
        encounter = self._watch()
        since, tried = -math.inf, set[str]()
        if drive.ego is not None:
            since = drive.now - task.warm_up
        while drive.now < task.end:
            snapshot = drive.tick()
            step = len(drive.recording.snapshots)
            if drive.ego is None:
                name = wanted
                if wanted is not None and not (wanted in snapshot.raw and drive.may_take_over(wanted)):
                    name = None
                if wanted is None and step % every == 0 and drive.now >= task.spec.begin + task.warm_up:
                    name = self._choose_ego(tried)
                if name is not None:
                    drive.take_over(name)
                    since = drive.now if wanted is None else self._inserted(name)
                    encounter = self._watch()
            elif drive.ego not in snapshot.raw:
                if wanted is not None:
                    return NoEncounter(Ending.EGO_LEFT, f"The ego '{wanted}' left the network before an encounter.")
                drive.release()
            elif task.trigger is not None:
                if drive.now >= task.trigger - 1e-6:
                    self._refuse_unknown()
                    return encounter.rank(drive)
            elif step % every == 0 and drive.now - since >= self._wait(wanted):
                ranking = encounter.look(drive)
                if ranking:
                    return ranking
                if wanted is None and drive.now - since > PATIENCE:
                    tried.add(drive.ego)
                    drive.release()
            if not drive.to_come():
                break
        return self._nothing(wanted, encounter.best)

    def _watch(self) -> EncounterDetector:
        return EncounterDetector(
            self.road, self.task.settings.shortlist, self.task.only, recorded=self.drive.recorded()
        )

    def _inserted(self, name: str) -> float:
        """When a vehicle was first seen [s]: a recorded one was there before its driver."""
        return next(s.time for s in self.drive.recording.snapshots if name in s.raw)

    def _wait(self, wanted: str | None) -> float:
        """Seconds an ego is driven before the first look: the history, and a scenario's warm-up."""
        return max(self.task.settings.history, self.task.warm_up if wanted is not None else 0.0)

    def _nothing(self, wanted: str | None, best: float) -> NoEncounter:
        if wanted is not None and self.drive.ego is None and wanted not in self.drive.simulation.fleet.sizes:
            raise UsageError(f"No vehicle '{wanted}' was inserted before {self.drive.now:.0f} s; check --ego-id.")
        self._refuse_unknown()
        if wanted is not None and self.drive.ego is None:
            why = f"The recorded vehicle '{wanted}' was on no lane where a driver could have taken it over."
            return NoEncounter(Ending.NO_ENCOUNTER, why)
        return NoEncounter(
            Ending.NO_ENCOUNTER,
            f"No vehicle came into a position to endanger the ego before {self.drive.now:.0f} s "
            f"(highest risk seen {best:.2f}, {ON_RECORDED if self.drive.recorded() else ON:.2f} is needed); "
            "try a longer --end, more --density, another --seed or --ego-id.",
        )

    def _refuse_unknown(self) -> None:
        """Raises UsageError for an adversary that was asked for and never came."""
        if self.drive.ego in self.task.only:
            raise UsageError(f"Vehicle '{self.drive.ego}' is the ego, so it cannot be the adversary; name another.")
        unknown = [n for n in self.task.only if n not in self.drive.simulation.fleet.sizes]
        if unknown:
            asked = "check --adversary or the scenario's candidates"
            raise UsageError(f"No vehicle '{unknown[0]}' was inserted before {self.drive.now:.0f} s; {asked}.")

    def _choose_ego(self, tried: set[str]) -> str | None:
        """The moving car with most moving traffic within 60 m; a tie goes to the first id."""
        raw = self.drive.snapshot.raw
        simulation = self.drive.simulation
        still = self.drive.obstacles
        moving = [(n, r[0], r[1]) for n, r in raw.items() if r[3] > MOVING and n not in still]
        best, best_count = None, 0
        points = np.array([(x, y) for _, x, y in moving]).reshape(-1, 2)
        for k, (name, x, y) in enumerate(moving):
            if name in tried or not self.drive.may_take_over(name):
                continue
            if simulation.vehicle_class(name) not in ("passenger", "private", "taxi"):
                continue
            edges, at = simulation.route(name)
            left = sum(
                self.road.lanes[self.road.edges[e][0]].length for e in edges[max(at, 0) :] if e in self.road.edges
            )
            if left < LEFT or raw[name][4] not in self.road.lanes:
                continue
            near = np.hypot(points[:, 0] - x, points[:, 1] - y)
            count = int((near < CROWD).sum()) - 1
            if count > best_count:
                best, best_count = moving[k][0], count
        return best
