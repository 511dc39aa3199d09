"""Step and record one simulation with its ego's driver."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from sumo_adv.datatypes import Role, Track, VehicleState
from sumo_adv.drivers import (
    Action,
    EgoController,
    ExternalEgo,
    LaneSpeed,
    Observation,
    PlannedPose,
    ReplayEgo,
    Steer,
    apply_steer,
)
from sumo_adv.drivers.protocol import DriverInside, wishes_of
from sumo_adv.drivers.sumo_driven import defaults_of
from sumo_adv.episode.ego_place import EgoPlace, LanePlace, back_to_lane
from sumo_adv.episode.ego_way import EgoWay
from sumo_adv.errors import DriverError
from sumo_adv.geometry import Pose, same_layer
from sumo_adv.simulation.ego_types import EGO_TYPE, ego_types_xml, vehicle_types
from sumo_adv.simulation.layers import Heights
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.playback import Playback
from sumo_adv.simulation.remote import Remote
from sumo_adv.simulation.signals import LightsNear
from sumo_adv.simulation.simulation import Simulation
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.stage import LOGGED_TYPE_XML, Stage
from sumo_adv.simulation.sumo_states import Snapshot, pose_of
from sumo_adv.simulation.tracks import Recording, tracks_of
from sumo_adv.simulation.watch import Call, OutOfTimeError, watched

LIMITED_BY_M_S = 0.05  # a speed lower by more than this was limited: more than rounding, less than any braking


@dataclass(frozen=True, slots=True)
class EgoActions:
    """What the ego's driver answered since it took over the ego.

    Attributes:
        counts: The number of answers of each kind; ``None`` counts as ``SUMO``.
        limited: The number of ``LaneSpeed`` answers after which SUMO's safe speed was lower than the requested speed.
    """

    counts: Mapping[str, int]
    limited: int


class ActionCount:
    """Counts the answers of an ego's driver."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._limited = 0
        self._expected: float | None = None

    def answered(self, action: Action, reachable: float) -> None:
        """Count an answer.

        Args:
            action: The answer.
            reachable: The highest speed that the ego can have after the step without other vehicles [m/s].
        """
        name = "Pose" if isinstance(action, Pose) else type(action).__name__
        self._counts["SUMO" if action is None else name] += 1
        self._expected = min(action.speed, reachable) if isinstance(action, LaneSpeed) else None

    def stepped(self, speed: float) -> None:
        """Note whether SUMO limited the last answer.

        Args:
            speed: The ego's speed after the step [m/s].
        """
        if self._expected is not None and speed < self._expected - LIMITED_BY_M_S:
            self._limited += 1
        self._expected = None

    def total(self) -> EgoActions:
        """Return the counts so far."""
        return EgoActions(dict(sorted(self._counts.items())), self._limited)


Observe = Callable[[VehicleState, Sequence[str]], Observation]
OBSERVED_RADIUS_M = 120.0  # m within which the ego's driver sees other vehicles


def ego_type_file(controller: EgoController, folder: Path, demand: Sequence[Path] = ()) -> Path:
    """Write an additional file with the vTypes of the ego's driver and of recorded vehicles.

    Args:
        controller: The ego's driver.
        folder: The folder of the file.
        demand: The files with the vTypes of the vehicles that may become the ego.

    Returns:
        The path of the file.
    """
    types = ego_types_xml(controller.sumo_type, defaults_of(controller.sumo_type), vehicle_types(demand))
    target = folder / "ego_type.add.xml"
    target.write_text(f"<additional>\n  {types}\n  {LOGGED_TYPE_XML}\n</additional>\n", encoding="utf-8")
    return target


class EarlierEgo(NamedTuple):
    """A vehicle that the driver under test drove before it took over the ego.

    Attributes:
        id: The id of the vehicle.
        begin: The time of the takeover [s].
        end: The time of the release [s].
    """

    id: str
    begin: float
    end: float


class Drive:
    """One simulation: steps SUMO, lets the ego's driver act, moves the adversary, and records all states.

    Attributes:
        simulation: SUMO.
        controller: The ego's driver.
        seed: The seed that the driver is reset with.
        ego: The ego's id; None without an ego.
        recording: The recorded states.
        observe: Makes the driver's observation from the ego and the ids of the vehicles near it; None gives a plain
            one.
        watched: Whether SUMO still drives the ego, because its driver has not taken over yet.
        steered: Whether the ego's driver, not SUMO, moved the ego in the last step.
        heeding: Whether the driver also moved it with pedals and wheel, and wants SUMO's advice.
        actions: Counts the driver's answers since it took over.
        inside: The plans and notes that the driver has shown since it took over.
        on_load: Called when the simulation was loaded again.
        lights: Set if the states of traffic lights are recorded.
        heights: Set if the network's roads have heights.
        playback: The log that is played back; None without one.
        until: The time at which attempts end because the log itself soon becomes dangerous [s]; otherwise inf.
        way: Follows the ego along its way; None if the scenario demands nothing of it there.
    """

    def __init__(
        self, spec: SimulationSpec, controller: EgoController, seed: int, remote: Remote | None = None,
        playback: Playback | None = None, deadline: float = 0.0,
    ) -> None:  # fmt: skip
        """Start the simulation.

        Args:
            spec: What is simulated.
            controller: The ego's driver.
            seed: The seed that the driver is reset with.
            remote: A SUMO that is shared with other programs; None starts one.
            playback: The log to play back.
            deadline: The time within which the ego's driver must return from a call [s]; 0 means no limit.
        """
        self.simulation, self.controller, self.seed = Simulation(spec, remote), controller, seed
        self._deadline = deadline
        self.ego: str | None = None
        self._own_type = ""  # the ego's vType before it got the driver under test
        self.recording = Recording(spec.step_length)
        self._takeovers: list[tuple[int, str | None]] = []
        self._playing = False
        self.observe: Observe | None = None
        self.watched = False
        self.steered = False
        self.heeding = False
        self.actions = ActionCount()
        self.inside: list[DriverInside] = []
        self._ego_place: EgoPlace | None = None
        self._placed: tuple[float, LanePlace | None] = (-math.inf, None)  # time [s] and result of the last ``place``
        self.on_load: Callable[[], None] | None = None
        self.lights: LightsNear | None = None
        self.heights: Heights | None = None
        self.playback = playback
        self.until = math.inf
        self.way: EgoWay | None = None
        if playback is not None:
            playback.start(self.simulation)

    @property
    def now(self) -> float:
        """The simulated time [s]."""
        return self.simulation.time

    @property
    def snapshot(self) -> Snapshot:
        """The newest recorded states."""
        return self.recording.snapshots[-1]

    @property
    def driven_from(self) -> float | None:
        """The time of the newest state when the driver took over the ego [s]; None without an ego."""
        if self.ego is None or not self._takeovers:
            return None
        step = self._takeovers[-1][0]
        return self.recording.snapshots[step - 1].time if step else self.now

    @property
    def driven_before(self) -> tuple[EarlierEgo, ...]:
        """The vehicles that the driver has driven and released before the ego, in order."""
        ends = zip(self._takeovers, self._takeovers[1:], strict=False)
        return tuple(EarlierEgo(n, self._when(a), self._when(b)) for (a, n), (b, _) in ends if n is not None)

    def _when(self, step: int) -> float:
        """Return the time of a takeover or release before a step [s]."""
        return self.recording.snapshots[step - 1].time if step else self.simulation.spec.recorded_from

    def left(self) -> int | None:
        """Return the number of steps until the log or ``until`` ends the simulation; None if neither does."""
        last = min(self.until, math.inf if self.playback is None else self.playback.last(self.ego))
        return None if math.isinf(last) else max(0, round((last - self.now) / self.recording.step_length))

    def within(self, steps: int) -> int:
        """Return ``steps``, or fewer if the log or ``until`` ends the simulation before."""
        left = self.left()
        return steps if left is None else min(steps, left)

    def to_come(self) -> bool:
        """Return whether a vehicle is on the road or still to come, from SUMO's demand or from the log."""
        more = self.playback is not None and self.recorded() and self.now < self.playback.spec.end
        return more or self.simulation.expected() > 0

    def may_take_over(self, vehicle: str) -> bool:
        """Return whether the driver under test can take over a vehicle now.

        Args:
            vehicle: The id of a vehicle that is on the road.
        """
        log, replayed = self.playback, isinstance(self.controller, ReplayEgo)
        return log is None or log.may_take(vehicle, self.snapshot.raw, self.now, replayed=replayed)

    def watch(self, vehicle: str) -> None:
        """Make a vehicle the ego that SUMO goes on to drive, until ``take_over`` or ``release``."""
        self.ego, self.watched = vehicle, True

    def take_over(self, vehicle: str) -> None:
        """Make a vehicle the ego: it gets the driver under test.

        Args:
            vehicle: The id of a vehicle that is on the road.

        Raises:
            DriverError: The driver does not return from ``reset`` in time, or ends its process.
        """
        if self.controller.sumo_type:
            given = self.controller.sumo_type.keys() - defaults_of(self.controller.sumo_type)
            self._own_type = own = self.simulation.own_type(vehicle)
            keeps = "speedFactor" not in given
            self.simulation.set_type(vehicle, f"{EGO_TYPE}:{own}", EGO_TYPE, keeps_factor=keeps)
        if self.playback is not None:
            factor = float(self.controller.sumo_type.get("speedFactor", 1.0))
            speed = self.snapshot.raw[vehicle][3]
            self.playback.take(vehicle, speed, factor, replayed=isinstance(self.controller, ReplayEgo))
        with self._driver("reset"):
            self.controller.reset(self.seed)
        self.actions, self.inside, self._ego_place = ActionCount(), [], None
        self.ego, self.watched = vehicle, False
        self._takeovers.append((len(self.recording.snapshots), vehicle))

    def release(self) -> None:
        """Make the ego a background vehicle again: SUMO drives it, with the driver of its own vType."""
        if self._own_type and self.ego is not None and self.ego in self.snapshot.raw:
            self.simulation.set_speed(self.ego, None)
            self.simulation.set_type(self.ego, self._own_type)
        self._own_type = ""
        self.ego, self.watched, self.steered, self.heeding, self._ego_place = None, False, False, False, None
        self._takeovers.append((len(self.recording.snapshots), None))

    def tick(self, poses: Mapping[str, Pose] | None = None, ego: Action = None) -> Snapshot:
        """Make one step: the ego's driver acts, poses are injected, SUMO steps, and the states are recorded.

        Args:
            poses: The poses after the step of vehicles and persons that are moved from outside, by id.
            ego: What the ego does in this step; None lets its driver decide.

        Returns:
            The states after the step.

        Raises:
            DriverError: The driver does not return in time, or ends its process.
        """
        driven = dict(poses or {})
        if self.playback is not None:
            raw = self.snapshot.raw if self.recording.snapshots else {}
            self.playback.before_step(raw, self.now, driven)
        if self.ego is not None and not self.watched and self.recording.snapshots and self.ego in self.snapshot.raw:
            self._let_ego_act(driven, ego)
        if self.playback is not None:
            self.playback.injected(driven)
        for name in sorted(driven.keys() & self.simulation.fleet.persons):
            Stage(self.simulation).embody(name, driven[name])
        if driven:
            self.simulation.inject(driven, self.ego if self.heeding else None)
        self.simulation.step()
        snapshot = self.simulation.read()
        if self.playback is not None:
            snapshot = replace(snapshot, raw=self.playback.after_step(snapshot.raw, snapshot.time))
        if self.lights is not None and self.ego is not None and self.ego in snapshot.raw:
            x, y = snapshot.raw[self.ego][:2]
            snapshot = replace(snapshot, lights=self.lights.states(self.simulation, x, y))
        if self.heights is not None:
            snapshot = replace(snapshot, heights=self._heights_in(snapshot, self.heights))
        self.recording.append(snapshot)
        if self.ego is not None and self.ego in snapshot.raw:
            self.actions.stepped(snapshot.raw[self.ego][3])
        return snapshot

    def give_back(self) -> None:
        """Leave the ego to its driver again, after a step in which the ego was placed somewhere."""
        if self.ego is not None and self.ego in self.snapshot.raw and not self.replayed():
            self.simulation.set_speed(self.ego, None)

    def _heights_in(self, snapshot: Snapshot, heights: Heights) -> dict[str, float]:
        """Return the heights of all vehicles and persons of a snapshot that was just read [m]."""
        last = self.recording.snapshots[-1] if self.recording.snapshots else Snapshot(0.0, {})
        now = {}
        for name, (x, y, *_) in snapshot.raw.items():
            known = name in last.heights
            before = (*last.raw[name][:2], last.heights[name]) if known else None
            now[name] = heights.follow(self.simulation.lane_of(snapshot, name), x, y, before)
        return now

    def rewind(self, steps: int) -> None:
        """Load the simulation again and repeat its first steps, with the same takeovers and releases.

        Args:
            steps: The number of steps to repeat.
        """
        takeovers = dict(self._takeovers)
        self.simulation.reload()
        if self.playback is not None:
            self.playback.start(self.simulation)
        if self.on_load is not None:
            self.on_load()
        self.ego, self._takeovers, self._playing, self.steered, self.heeding = None, [], False, False, False
        self.watched = False
        self._own_type, self._ego_place = "", None
        self.recording = Recording(self.recording.step_length)
        for k in range(steps):
            self._change_ego(takeovers, k)
            self.tick()
        self._change_ego(takeovers, steps)

    def restart(self, seed: int) -> None:
        """Load the simulation again with another seed, without an ego.

        Args:
            seed: The seed of SUMO and of the ego's driver.
        """
        self.seed, self._takeovers = seed, []
        self.simulation.spec = replace(self.simulation.spec, seed=seed)
        self.rewind(0)

    def _change_ego(self, takeovers: Mapping[int, str | None], step: int) -> None:
        """Repeat the takeover or release before a step, if there was one."""
        if step in takeovers:
            name = takeovers[step]
            self.release() if name is None else self.take_over(name)

    def state(self, vehicle: str) -> VehicleState:
        """Return the present state of a vehicle or person."""
        return self.simulation.state(self.snapshot, vehicle, self.recording.acceleration(vehicle))

    def kind(self, vehicle: str) -> str:
        """Return SUMO's vClass of a vehicle or person, or the kind of an object that is neither."""
        if self.playback is not None and vehicle in self.playback.obstacles:
            return self.playback.kind(vehicle)
        return self.simulation.vehicle_class(vehicle)

    def pose(self, vehicle: str) -> tuple[float, float, float]:
        """Return x and y of the centre of a vehicle's box [m] and its heading [rad], now."""
        return pose_of(self.snapshot.raw[vehicle], self.simulation.fleet.sizes[vehicle][0])

    def near(self, vehicle: VehicleState, radius: float) -> list[str]:
        """Return the other vehicles near a vehicle, by the distance of the centres of their boxes.

        Vehicles above or below it are left out, unless their road leads to it within the radius.

        Args:
            vehicle: The vehicle.
            radius: The maximum distance [m].

        Returns:
            Their ids.
        """
        x, y, sizes, near = vehicle.x, vehicle.y, self.simulation.fleet.sizes, list[str]()
        for name, (front_x, front_y, *_) in self.snapshot.raw.items():
            room = radius - math.hypot(front_x - x, front_y - y)
            surely = abs(room) > sizes[name][0]  # the centre is half a length behind the front
            if name != vehicle.id and (room > 0 if surely else self._away(name, x, y) < radius):
                near.append(name)
        return near if self.heights is None else [n for n in near if self._level(vehicle, n, radius, self.heights)]

    def _away(self, vehicle: str, x: float, y: float) -> float:
        """Return the distance of the centre of a vehicle's box from a place [m]."""
        there_x, there_y, _ = self.pose(vehicle)
        return math.hypot(there_x - x, there_y - y)

    def _level(self, vehicle: VehicleState, other: str, radius: float, heights: Heights) -> bool:
        """Return whether another vehicle is on a vehicle's layer, or its road leads there within ``radius`` [m]."""
        if same_layer(vehicle.z, self.snapshot.heights.get(other, 0.0)):
            return True
        x, y, _, _, lane = self.snapshot.raw[other]
        return heights.way(vehicle.lane, vehicle.x, vehicle.y, lane, x, y, radius) <= radius

    def tracks(self, *adversaries: str, start: int = 0) -> list[Track]:
        """Return the tracks of all vehicles, persons and objects.

        Args:
            adversaries: The ids of the adversaries.
            start: The index of the recorded step from which the tracks begin.
        """
        sizes, recording = self.simulation.fleet.sizes, self.recording
        return tracks_of(recording.snapshots[start:], sizes, self.roles(*adversaries), recording.step_length)

    def roles(self, *adversaries: str) -> dict[str, Role]:
        """Return the roles by id, except those of background vehicles."""
        roles = dict.fromkeys(() if self.playback is None else self.playback.obstacles, Role.OBSTACLE)
        roles |= dict.fromkeys(adversaries, Role.ADVERSARY)
        if self.ego is not None:
            roles[self.ego] = Role.EGO
        return roles

    @property
    def obstacles(self) -> frozenset[str]:
        """Ids of all that are no vehicles: persons, and objects of a scenario or log."""
        objects = frozenset[str]() if self.playback is None else self.playback.obstacles
        persons = self.simulation.fleet.persons
        return objects | persons if persons else objects

    def placed(self, obstacle: str) -> bool:
        """Return whether the scenario or its demand, rather than a log, places a pedestrian or cyclist.

        Args:
            obstacle: The id.
        """
        if obstacle in self.simulation.fleet.persons:
            return True
        return self.playback is not None and self.playback.placed(obstacle)

    def route(self) -> tuple[str, ...]:
        """Return the edges of the ego's whole route."""
        assert self.ego is not None
        logged = self.playback.spec.routes.get(self.ego, ()) if self.playback is not None and self.replayed() else ()
        kept = self._ego_place.route if self._ego_place is not None and self._moved else ()
        return logged or kept or self.simulation.route(self.ego)[0]

    def place(self, road: RoadMap) -> LanePlace | None:
        """Return where the ego is on its route now.

        If SUMO has replaced the route because the ego's driver left its lanes, SUMO gets the route back.

        Args:
            road: The map.

        Returns:
            The place; None while the ego is off all lanes.
        """
        assert self.ego is not None
        if self._ego_place is None:
            self._ego_place = EgoPlace(road, self.simulation, self.kind(self.ego))
            self._placed = (-math.inf, None)
        if self._placed[0] != self.now:
            place = self._ego_place(self.state(self.ego), moved=self._moved, restores=self.steered)
            self._placed = (self.now, place)
        return self._placed[1]

    def closed(self, lane: str) -> bool:
        """Return whether the ego may not use a lane now."""
        assert self.ego is not None
        return self.simulation.closed(lane, self.kind(self.ego))

    @property
    def _moved(self) -> bool:
        """Whether SUMO may have replaced the ego's route because another program moves it."""
        return self.steered or isinstance(self.controller, ExternalEgo)

    def recorded(self) -> bool:
        """Return whether recorded vehicles are played back."""
        return self.playback is not None and self.playback.log is not None

    def follows_log(self) -> bool:
        """Return whether a log moves background vehicles, so that they do not react to the adversary."""
        return self.playback is not None and self.playback.spec.follows_log

    def replayed(self) -> bool:
        """Return whether a log moves the ego."""
        return self.playback is not None and self.ego is not None and self.playback.replays(self.ego)

    def _let_ego_act(self, driven: dict[str, Pose], action: Action) -> None:
        """Apply an action of the ego or, if it is None, its driver's answer; add a pose that moves it to ``driven``."""
        assert self.ego is not None
        heeds = False
        wishes = wishes_of(self.controller)
        if self.way is not None:
            self.way.look(self)
        if action is None:
            waits = isinstance(self.controller, ReplayEgo) and not self._playing
            if waits or not self.controller.needs_observation:
                if self.way is not None:
                    self.way.carry_out(self)
                return
            observation = self.observation()
            with self._driver("act"):
                action = self.controller.act(observation)
            heeds = wishes.needs_road and observation.road is not None
            self._note_inside(action)
        answer, action = action, self._led_back(action)
        self.steered = isinstance(action, Steer | Pose)
        self.heeding = isinstance(answer, Steer) and heeds
        reachable = math.inf
        if isinstance(action, Steer):
            after = apply_steer(self.state(self.ego), action, self.recording.step_length, wishes.bicycle)
            driven[self.ego] = Pose(after.x, after.y, after.heading, after.speed)
        elif isinstance(action, Pose):
            driven[self.ego] = Pose(action.x, action.y, action.heading, action.speed)
        elif isinstance(action, LaneSpeed):
            reachable = self.simulation.reachable(self.ego, self.state(self.ego).speed)
            self.simulation.set_speed(self.ego, action.speed)
            if action.lane is not None:
                self.simulation.change_lane(self.ego, action.lane)
        else:
            self.simulation.set_speed(self.ego, None)
        if self.way is not None and (action is None or (isinstance(answer, LaneSpeed) and not wishes.makes_moves)):
            self.way.carry_out(self, answer.speed if isinstance(answer, LaneSpeed) else None)
        self.actions.answered(answer, reachable)

    def _note_inside(self, action: Action) -> None:
        """Keep the plan and the notes of an answer, if it has any."""
        if isinstance(action, Steer | LaneSpeed | PlannedPose) and (action.plan or action.notes):
            self.inside.append(DriverInside(self.now, action.plan or (), action.notes))

    def _led_back(self, action: Action) -> Action:
        """Return the action, or the steering back to a lane of the ego's route.

        It steers back if the driver leaves the ego to SUMO on a lane off its route: SUMO would turn the ego round
        there.
        """
        if self._ego_place is None or not self.steered or isinstance(action, Steer | Pose):
            return action
        assert self.ego is not None
        place = self.place(self._ego_place.road)
        if place is None or not self._ego_place.astray:
            return action
        speed = action.speed if isinstance(action, LaneSpeed) else None
        return back_to_lane(place, self.state(self.ego), speed, self.recording.step_length)

    def where(self) -> str:
        """Return where the ego's driver is in words: its step, counted from 1 at the takeover, and the time."""
        first = self._takeovers[-1][0] if self.ego is not None and self._takeovers else len(self.recording.snapshots)
        return f"its step {len(self.recording.snapshots) - first + 1}, at {self.now:.1f} s"

    @contextmanager
    def _driver(self, method: str) -> Iterator[None]:
        """Guard a call of the ego's driver; raise DriverError if it does not return in time or ends its process."""
        call = Call(f"The ego's driver {self.controller.name!r}", f"in {method} ({self.where()})", self._deadline)
        process = os.getpid()
        try:
            with watched(call):
                yield
                if os.getpid() != process:  # the driver has forked; the copy must not continue as a second simulation
                    os._exit(0)
        except OutOfTimeError:
            raise call.too_late() from None
        except SystemExit as error:
            raise DriverError(call.ended(f"SystemExit: {error.code}")) from error

    def observation(self) -> Observation:
        """Return what the ego's driver sees now."""
        assert self.ego is not None
        me = self.state(self.ego)
        near = self.near(me, OBSERVED_RADIUS_M)
        if self.observe is not None:
            return self.observe(me, near)
        return Observation(self.now, self.recording.step_length, me, tuple(self.state(name) for name in near))

    def replay(self, track: Track) -> None:
        """Have a ``ReplayEgo`` repeat a recorded motion from now on. Other drivers ignore this.

        Args:
            track: The motion.
        """
        if isinstance(self.controller, ReplayEgo) and not self.replayed():
            self.controller.load(track)
            self._playing = True
