"""Play a log back beside SUMO's traffic: which vehicles the log moves, when, and when they are handed over.

The hand-over is at the ego's first recorded step plus the scenario's warm-up. Until then, the log moves every recorded
vehicle. Then the ego gets its driver. Each other vehicle is handed to SUMO once it is on a lane (``background``
"sumo"), or continues as recorded ("log") until its recording ends. A vehicle that appears later is inserted when it
appears. It is handed to SUMO only if its place is free. Vehicles without a route are never handed over. Once the ego's
driver or an attack drives a vehicle, the log never moves it again.

Other objects are boxes beside SUMO. Two kinds are SUMO vehicles, so that SUMO's drivers see them: a parked object with
its centre in a lane, and a pedestrian or cyclist of the scenario who moves.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import numpy as np

from sumo_adv.datatypes import Floats, Track
from sumo_adv.geometry import Pose
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.playback_spec import PlaybackSpec, PlayedObject, Prop
from sumo_adv.simulation.signals import SignalLog, read_signals
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.stage import Stage
from sumo_adv.simulation.sumo_states import RawState, heading_of, raw_of
from sumo_adv.simulation.tracks import TrackLog, read_tracks

OBJECTS = {"pedestrian": "pedestrian", "cyclist": "bicycle"}  # SUMO's vClasses by the log's kinds
INSERTION_ROOM_M = 1.0  # free space before and behind a vehicle that is inserted for SUMO to drive


class Playback:
    """Plays one spec back in one simulation. Call ``start`` for each simulation that was just loaded.

    Attributes:
        spec: What is played back.
        log: The recorded tracks on the grid of the simulation; None without tracks.
        hand_over: The time from which vehicles can be handed over [s].
    """

    def __init__(
        self, spec: PlaybackSpec, road: RoadMap, *, begin: float, step: float, ego: str | None, warm_up: float
    ):
        """Read the files of the spec.

        Args:
            spec: What is played back.
            road: The network.
            begin: The time at which the simulation begins [s].
            step: Its step length [s].
            ego: The id of a recorded ego; None if it is chosen later.
            warm_up: How long the log moves all vehicles after the ego appears [s].
        """
        log = read_tracks(spec.tracks) if spec.tracks is not None else None
        self.spec = spec
        self.log: TrackLog | None = None if log is None else log.resampled(begin, step)
        logged = log is not None and ego is not None and ego in log.tracks
        self.hand_over = (log.first(ego) if logged and log and ego else begin) + (warm_up if log is not None else 0.0)
        tracks = {} if self.log is None else self.log.tracks
        recorded = {name: PlayedObject(track, begin, step) for name, track in tracks.items()}
        self._vehicles = {name: r for name, r in recorded.items() if r.track.kind == "vehicle"}
        props: dict[str, Prop | PlayedObject] = {p.id: p for p in spec.props}
        under = {p.id: road.lane_at(p.x, p.y, p.heading) for p in spec.props if p.speed == 0.0}
        self._in_sumo: dict[str, tuple[Prop, tuple[str, ...]]] = {
            p.id: (p, (road.lanes[at[0]].edge,)) for p in spec.props if (at := under.get(p.id))
        }
        self._in_sumo |= {p.id: (p, ()) for p in spec.props if p.speed > 0.0 and p.kind in OBJECTS}
        others = {name: r for name, r in recorded.items() if name not in self._vehicles}
        self._boxes = {n: p for n, p in {**props, **others}.items() if n not in self._in_sumo}
        self._beside = frozenset[str]()
        self._placed = {p.id: p.kind for p in spec.props}
        self._lanes = road.lanes
        self._signals: SignalLog | None = read_signals(spec.signals) if spec.signals is not None else None
        self._step = step

    def start(self, simulation: Simulation) -> None:
        """Prepare for a simulation in which nothing has been played back yet."""
        self._stage = Stage(simulation)
        self._free: set[str] = set()  # driven by SUMO, the ego's driver or an attack
        self._kept: set[str] = set()  # a replayed ego, which is never handed over
        self._moved: dict[str, Pose] = {}  # poses by the log in the present step
        self._gone: list[str] = []  # vehicles whose recording ends in the present step
        self._on_lanes: set[str] = set()  # vehicles that the log had on a lane in the last step
        self._shown: dict[str, str | None] = {}
        self._fleet = simulation.fleet
        for box in self._boxes.values():
            simulation.fleet.sizes[box.id] = (box.length, box.width)

    @property
    def obstacles(self) -> frozenset[str]:
        """Ids of all objects that are not vehicles in SUMO."""
        return self.spec.obstacles | self._beside

    @property
    def recorded(self) -> list[str]:
        """Ids of the recorded vehicles that the log moves in SUMO."""
        return list(self._vehicles)

    @property
    def beside(self) -> tuple[str, ...]:
        """Ids of the recorded vehicles that are boxes beside SUMO."""
        return tuple(sorted(self._beside))

    def put_beside(self, vehicles: Collection[str]) -> None:
        """Play these recorded vehicles, and no others, as boxes beside SUMO, because SUMO crashes on one of them.

        Call it before ``start``.
        """
        recorded = {**self._vehicles, **{name: self._boxes[name] for name in self._beside}}
        boxes = {name: box for name, box in self._boxes.items() if name not in self._beside}
        self._beside = frozenset(vehicles)
        self._vehicles = {n: r for n, r in recorded.items() if n not in self._beside and isinstance(r, PlayedObject)}
        self._boxes = {**boxes, **{name: recorded[name] for name in vehicles}}

    def kind(self, obstacle: str) -> str:
        """Return what an object that is not a vehicle is: ``pedestrian``, ``bicycle`` or ``obstacle``."""
        logged = None if self.log is None else self.log.tracks.get(obstacle)
        kind = self._placed.get(obstacle, "other") if logged is None else logged.kind
        return OBJECTS.get(kind, "obstacle")

    def placed(self, obstacle: str) -> bool:
        """Return whether the scenario itself, rather than a log, places this pedestrian or cyclist."""
        return self._placed.get(obstacle) in OBJECTS

    # -- the drivers -------------------------------------------------------------------------------------------------

    def may_take(self, vehicle: str, raw: Mapping[str, RawState], now: float, *, replayed: bool) -> bool:
        """Return whether the ego's driver can take a vehicle now.

        Args:
            vehicle: The id of the vehicle.
            raw: SUMO's present states.
            now: The present time [s].
            replayed: Whether the log will move the ego; otherwise the vehicle must be on a lane.

        Returns:
            Whether it can. A recorded vehicle cannot be taken before the hand-over.
        """
        if vehicle not in self._vehicles:
            return True
        return now >= self.hand_over - 1e-6 and (replayed or raw[vehicle][4] in self._lanes)

    def take(self, vehicle: str, speed: float, factor: float, *, replayed: bool) -> None:
        """Make a vehicle the ego.

        Args:
            vehicle: The id of the vehicle.
            speed: Its present speed [m/s].
            factor: The share of the speed limit that its driver aims for.
            replayed: Whether the log moves it instead of a driver.
        """
        if vehicle not in self._vehicles:
            return
        if replayed:
            self._kept.add(vehicle)
        elif vehicle not in self._free:
            self._free.add(vehicle)
            self._stage.hand_over(vehicle, speed, self.spec.routes.get(vehicle, ()), factor)

    def replays(self, vehicle: str) -> bool:
        """Return whether the log moves this ego."""
        return vehicle in self._kept

    def last(self, ego: str | None) -> float:
        """Return the time after which the simulation is meaningless [s].

        Args:
            ego: The id of the ego.

        Returns:
            The end of the log if it moves the background or the ego; inf otherwise.
        """
        ends = self.spec.follows_log or (ego is not None and ego in self._kept)
        return self.spec.end if ends else math.inf

    # -- one step ---------------------------------------------------------------------------------------------------

    def before_step(self, raw: Mapping[str, RawState], now: float, driven: dict[str, Pose]) -> None:
        """Insert, hand over and move recorded vehicles for the next step.

        Args:
            raw: SUMO's present states.
            now: The time at which the step begins [s].
            driven: The poses at which others place vehicles in this step. The poses of the log are added to it.
        """
        then = round(now + self._step, 6)
        self._moved, self._gone = {}, []
        hands_over = self.spec.background == "sumo" and now >= self.hand_over - 1e-6
        for name, vehicle in self._vehicles.items():
            if name in self._free:
                continue
            if name in driven:
                self._free.add(name)
                continue
            pose, here = vehicle.pose(then), name in raw
            if pose is None:
                if here:
                    self._gone.append(name)
                continue
            pose = Pose(pose.x, pose.y, pose.heading, max(0.0, pose.speed))
            released = hands_over and name not in self._kept and name in self.spec.routes
            if not here:
                if released and not self._room(vehicle, pose, raw):
                    continue
                self._spawn(vehicle, self.spec.routes.get(name, ()), pose)
            elif released and raw[name][4] in self._lanes:
                self._free.add(name)
                self._stage.hand_over(name, raw[name][3], self.spec.routes[name])
                continue
            else:
                self._keep_apart(name, vehicle, pose, raw[name][4])
            driven[name] = self._moved[name] = pose
        self._place(raw, then, driven)
        for name in sorted(self._boxes.keys() & driven.keys() - self._free):
            self._spawn(self._boxes[name], (), driven[name])  # SUMO's drivers see it from now on
            self._free.add(name)
        if self._signals is not None:
            self._show(self._signals, then)

    def _keep_apart(self, name: str, vehicle: PlayedObject, pose: Pose, lane: str) -> None:
        """Insert a vehicle again once it has left all lanes.

        Measured with SUMO 1.28: moving it further can crash SUMO after its route was rewritten to the edge that it
        left.
        """
        if lane:
            self._on_lanes.add(name)
        elif name in self._on_lanes:
            self._on_lanes.discard(name)
            self._stage.remove(name)
            self._spawn(vehicle, self.spec.routes.get(name, ()), pose)

    def injected(self, driven: Mapping[str, Pose]) -> None:
        """Note the poses of the present step, and remove vehicles without a logged pose.

        A driver in a replayed ego may have replaced the log's pose. The ego's driver has acted, so those vehicles are
        no longer needed.
        """
        self._moved = {name: driven[name] for name in self._moved}
        for name in self._gone:
            self._stage.remove(name)

    def _show(self, signals: SignalLog, then: float) -> None:
        """Show the recorded lights until the log ends."""
        states: Mapping[str, str | None] = signals.states(then)
        if then > self.spec.end + 1e-6:
            states = dict.fromkeys(states)
        for light, state in states.items():
            if self._shown.get(light) != state:
                self._stage.set_signal(light, state)
                self._shown[light] = state

    def _place(self, raw: Mapping[str, RawState], then: float, driven: dict[str, Pose]) -> None:
        """Keep the objects that are SUMO vehicles at their places."""
        for name, (prop, edges) in self._in_sumo.items():
            if name in driven or name in self._free:
                self._free.add(name)
                continue
            pose = prop.pose(then)
            if pose is None:
                if name in raw:
                    self._gone.append(name)
                continue
            if name not in raw:
                self._spawn(prop, edges, pose)
            driven[name] = self._moved[name] = pose

    def _spawn(self, vehicle: Prop | PlayedObject, edges: tuple[str, ...], pose: Pose) -> None:
        self._stage.spawn(vehicle.id, edges, pose, (vehicle.length, vehicle.width))

    def _room(self, vehicle: PlayedObject, pose: Pose, raw: Mapping[str, RawState]) -> bool:
        """Return whether the place at which a vehicle will be inserted is free, with a margin before and behind it."""
        c, s = math.cos(pose.heading), math.sin(pose.heading)
        for name, (x, y, angle_deg, speed, _) in raw.items():
            length, width = self._fleet.sizes[name]
            h, ahead = heading_of(angle_deg), speed * self._step - length / 2
            dx, dy = x + ahead * math.cos(h) - pose.x, y + ahead * math.sin(h) - pose.y
            along = (vehicle.length + length) / 2 + INSERTION_ROOM_M
            if abs(c * dx + s * dy) < along and abs(c * dy - s * dx) < (vehicle.width + width) / 2:
                return False
        return True

    def after_step(self, raw: Mapping[str, RawState], time: float) -> dict[str, RawState]:
        """Return the states with the log's speeds and with all objects beside SUMO.

        SUMO clips the speed of a moved vehicle in some steps in which it enters another lane.

        Args:
            raw: SUMO's states.
            time: Their time [s].

        Returns:
            The states by id.
        """
        states = dict(raw)
        for name, pose in self._moved.items():
            if name in raw:
                x, y, angle_deg, _, lane = raw[name]
                states[name] = (x, y, angle_deg, pose.speed, lane)
        for name, box in self._boxes.items():
            there = box.pose(time)
            if there is not None and name not in self._free:
                states[name] = raw_of(there.x, there.y, there.heading, there.speed, box.length)
        return states

    # -- what the log says --------------------------------------------------------------------------------------------

    def ahead(self, vehicle: str, now: float) -> Floats:
        """Return the box centres of a vehicle in the log from ``now`` [s] on, ``(n, 2)`` [m]."""
        if self.log is None or vehicle not in self.log.tracks:
            return np.empty((0, 2))
        track = self.log.track(vehicle)
        keep = track.time >= now - 1e-6
        return np.column_stack([track.x[keep], track.y[keep]])

    def logged(self) -> list[Track]:
        """Return the tracks of the log."""
        return [] if self.log is None else [self.log.track(name) for name in self.log.tracks]
