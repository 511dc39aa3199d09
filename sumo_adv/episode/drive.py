"""One simulation with its ego's driver, stepped and recorded."""

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

LIMITED_BY_M_S = 0.05  # below the speed that was asked for: more than rounding, less than any braking


@dataclass(frozen=True, slots=True)
class EgoActions:
    """counts: how often each kind of answer came, from the takeover of the ego on; ``None`` is counted as ``SUMO``.
    limited: after how many ``LaneSpeed`` SUMO's safe speed was lower than the speed that was asked for."""

    counts: Mapping[str, int]
    limited: int


class ActionCount:
    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._limited = 0
        self._expected: float | None = None

    def answered(self, action: Action, reachable: float) -> None:
        """``reachable``: the highest speed [m/s] that the ego can have after the step, without other vehicles."""
        name = "Pose" if isinstance(action, Pose) else type(action).__name__
        self._counts["SUMO" if action is None else name] += 1
        self._expected = min(action.speed, reachable) if isinstance(action, LaneSpeed) else None

    def stepped(self, speed: float) -> None:
        """``speed``: the ego's after the step [m/s]."""
        if self._expected is not None and speed < self._expected - LIMITED_BY_M_S:
            self._limited += 1
        self._expected = None

    def total(self) -> EgoActions:
        return EgoActions(dict(sorted(self._counts.items())), self._limited)


Observe = Callable[[VehicleState, Sequence[str]], Observation]
OBSERVED_RADIUS_M = 120.0  # how far the ego's driver sees


def ego_type_file(controller: EgoController, folder: Path, demand: Sequence[Path] = ()) -> Path:
    """An additional file with the vTypes of the ego's driver and of recorded vehicles.

    demand: the files with the vTypes of the vehicles that may become the ego.
    """
    types = ego_types_xml(controller.sumo_type, defaults_of(controller.sumo_type), vehicle_types(demand))
    target = folder / "ego_type.add.xml"
    target.write_text(f"<additional>\n  {types}\n  {LOGGED_TYPE_XML}\n</additional>\n", encoding="utf-8")
    return target


class EarlierEgo(NamedTuple):
    """A vehicle that the driver under test drove from one time [s] to another, before it took over the ego."""

    id: str
    begin: float
    end: float


class Drive:
    """Steps SUMO, lets the ego's driver act, moves the adversary, and records all states."""

    def __init__(
        self, spec: SimulationSpec, controller: EgoController, seed: int, remote: Remote | None = None,
        playback: Playback | None = None, deadline: float = 0.0,
    ) -> None:  # fmt: skip
        """``deadline``: in which the ego's driver must return [s]; 0: it may take any time."""
        self.simulation, self.controller, self.seed = Simulation(spec, remote), controller, seed
        self._deadline = deadline
        self.ego: str | None = None
        self._own_type = ""  # the ego's vType before it got the driver under test
        self.recording = Recording(spec.step_length)
        self._takeovers: list[tuple[int, str | None]] = []
        self._playing = False
        self.observe: Observe | None = None  # what the driver sees, given the ego and the vehicles near it
        self.steered = False  # the ego's driver, not SUMO, moved the ego in the last step
        self.heeding = False  # it did so with pedals and wheel, and asks for SUMO's advice
        self.actions = ActionCount()  # of the ego's driver since it took over
        self.inside: list[DriverInside] = []  # what the driver showed of its inside, since it took over
        self._ego_place: EgoPlace | None = None
        self._placed: tuple[float, LanePlace | None] = (-math.inf, None)  # when it was last worked out [s]
        self.on_load: Callable[[], None] | None = None  # called when the simulation was loaded again
        self.lights: LightsNear | None = None  # set if the states of traffic lights are recorded
        self.heights: Heights | None = None  # set if the network's roads have heights
        self.playback = playback
        self.until = math.inf  # s, from which on a log is dangerous by itself: attempts end before
        if playback is not None:
            playback.start(self.simulation)

    @property
    def now(self) -> float:
        """Simulated time [s]."""
        return self.simulation.time

    @property
    def snapshot(self) -> Snapshot:
        return self.recording.snapshots[-1]

    @property
    def driven_from(self) -> float | None:
        """When the driver took over the ego [s]: the time of the newest state then. None without an ego."""
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
        """The time [s] of a takeover or release before a step."""
        return self.recording.snapshots[step - 1].time if step else self.simulation.spec.recorded_from

    def left(self) -> int | None:
        """Steps until the log that is played back ends, or ``until``; None without a log."""
        last = min(self.until, math.inf if self.playback is None else self.playback.last(self.ego))
        return None if math.isinf(last) else max(0, round((last - self.now) / self.recording.step_length))

    def within(self, steps: int) -> int:
        """``steps``, or fewer if the log ends before."""
        left = self.left()
        return steps if left is None else min(steps, left)

    def to_come(self) -> bool:
        """Whether a vehicle is on the road or still to be inserted."""
        more = self.playback is not None and self.recorded() and self.now < self.playback.spec.end
        return more or self.simulation.expected() > 0

    def may_take_over(self, vehicle: str) -> bool:
        """Whether the driver under test can take over a vehicle that is on the road now."""
        log, replayed = self.playback, isinstance(self.controller, ReplayEgo)
        return log is None or log.may_take(vehicle, self.snapshot.raw, self.now, replayed=replayed)

    def take_over(self, vehicle: str) -> None:
        """Make a vehicle the ego: it gets the driver under test."""
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
        self.ego = vehicle
        self._takeovers.append((len(self.recording.snapshots), vehicle))

    def release(self) -> None:
        """Make the ego a background vehicle again: SUMO drives it, with the driver of its own vType."""
        if self._own_type and self.ego is not None and self.ego in self.snapshot.raw:
            self.simulation.set_speed(self.ego, None)
            self.simulation.set_type(self.ego, self._own_type)
        self._own_type = ""
        self.ego, self.steered, self.heeding, self._ego_place = None, False, False, None
        self._takeovers.append((len(self.recording.snapshots), None))

    def tick(self, poses: Mapping[str, Pose] | None = None, ego: Action = None) -> Snapshot:
        """One step: the ego's driver acts, ``poses`` are injected, SUMO steps, the states are recorded. ego: what the
        ego does in this step; None: its driver decides."""
        driven = dict(poses or {})
        if self.playback is not None:
            raw = self.snapshot.raw if self.recording.snapshots else {}
            self.playback.before_step(raw, self.now, driven)
        if self.ego is not None and self.recording.snapshots and self.ego in self.snapshot.raw:
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
        """Leave the ego to its driver again, after a step in which it was put somewhere."""
        if self.ego is not None and self.ego in self.snapshot.raw and not self.replayed():
            self.simulation.set_speed(self.ego, None)

    def _heights_in(self, snapshot: Snapshot, heights: Heights) -> dict[str, float]:
        """The heights of all vehicles and persons of a snapshot that was just read [m]."""
        last = self.recording.snapshots[-1] if self.recording.snapshots else Snapshot(0.0, {})
        now = {}
        for name, (x, y, *_) in snapshot.raw.items():
            known = name in last.heights
            before = (*last.raw[name][:2], last.heights[name]) if known else None
            now[name] = heights.follow(self.simulation.lane_of(snapshot, name), x, y, before)
        return now

    def rewind(self, steps: int) -> None:
        """Load the simulation again and repeat the first ``steps`` steps with the same commands."""
        takeovers = dict(self._takeovers)
        self.simulation.reload()
        if self.playback is not None:
            self.playback.start(self.simulation)
        if self.on_load is not None:
            self.on_load()
        self.ego, self._takeovers, self._playing, self.steered, self.heeding = None, [], False, False, False
        self._own_type, self._ego_place = "", None
        self.recording = Recording(self.recording.step_length)
        for k in range(steps):
            self._change_ego(takeovers, k)
            self.tick()
        self._change_ego(takeovers, steps)

    def restart(self, seed: int) -> None:
        """Load the simulation again with another seed, without an ego."""
        self.seed, self._takeovers = seed, []
        self.simulation.spec = replace(self.simulation.spec, seed=seed)
        self.rewind(0)

    def _change_ego(self, takeovers: Mapping[int, str | None], step: int) -> None:
        if step in takeovers:
            name = takeovers[step]
            self.release() if name is None else self.take_over(name)

    def state(self, vehicle: str) -> VehicleState:
        return self.simulation.state(self.snapshot, vehicle, self.recording.acceleration(vehicle))

    def kind(self, vehicle: str) -> str:
        """SUMO's vClass of a vehicle or person; what an object is that is none."""
        if self.playback is not None and vehicle in self.playback.obstacles:
            return self.playback.kind(vehicle)
        return self.simulation.vehicle_class(vehicle)

    def pose(self, vehicle: str) -> tuple[float, float, float]:
        """x, y [m] of the centre of a vehicle's box and its heading [rad], now."""
        return pose_of(self.snapshot.raw[vehicle], self.simulation.fleet.sizes[vehicle][0])

    def near(self, vehicle: VehicleState, radius: float) -> list[str]:
        """The other vehicles with their centres within ``radius`` [m] of a vehicle's centre, not above or below it."""
        x, y, sizes, near = vehicle.x, vehicle.y, self.simulation.fleet.sizes, list[str]()
        for name, (front_x, front_y, *_) in self.snapshot.raw.items():
            room = radius - math.hypot(front_x - x, front_y - y)
            surely = abs(room) > sizes[name][0]  # the centre is half a length behind the front
            if name != vehicle.id and (room > 0 if surely else self._away(name, x, y) < radius):
                near.append(name)
        return near if self.heights is None else [n for n in near if self._level(vehicle, n, radius, self.heights)]

    def _away(self, vehicle: str, x: float, y: float) -> float:
        """The distance [m] of the centre of a vehicle's box from a place."""
        there_x, there_y, _ = self.pose(vehicle)
        return math.hypot(there_x - x, there_y - y)

    def _level(self, vehicle: VehicleState, other: str, radius: float, heights: Heights) -> bool:
        """Whether another vehicle is on a vehicle's layer, or on a road that leads there within ``radius`` [m]."""
        if same_layer(vehicle.z, self.snapshot.heights.get(other, 0.0)):
            return True
        x, y, _, _, lane = self.snapshot.raw[other]
        return heights.way(vehicle.lane, vehicle.x, vehicle.y, lane, x, y, radius) <= radius

    def tracks(self, *adversaries: str, start: int = 0) -> list[Track]:
        """All tracks from recorded step ``start`` on."""
        sizes, recording = self.simulation.fleet.sizes, self.recording
        return tracks_of(recording.snapshots[start:], sizes, self.roles(*adversaries), recording.step_length)

    def roles(self, *adversaries: str) -> dict[str, Role]:
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
        """Whether the scenario or its demand has put this pedestrian or cyclist there."""
        if obstacle in self.simulation.fleet.persons:
            return True
        return self.playback is not None and self.playback.placed(obstacle)

    def route(self) -> tuple[str, ...]:
        """The edges of the ego's whole route."""
        assert self.ego is not None
        logged = self.playback.spec.routes.get(self.ego, ()) if self.playback is not None and self.replayed() else ()
        kept = self._ego_place.route if self._ego_place is not None and self._moved else ()
        return logged or kept or self.simulation.route(self.ego)[0]

    def place(self, road: RoadMap) -> LanePlace | None:
        """Where the ego is on its route now; None while it is off all lanes. SUMO gets back a route that it has
        replaced because the ego's driver left the lanes of it."""
        assert self.ego is not None
        if self._ego_place is None:
            self._ego_place = EgoPlace(road, self.simulation, self.kind(self.ego))
            self._placed = (-math.inf, None)
        if self._placed[0] != self.now:
            place = self._ego_place(self.state(self.ego), moved=self._moved, restores=self.steered)
            self._placed = (self.now, place)
        return self._placed[1]

    def closed(self, lane: str) -> bool:
        """Whether the ego may not use a lane now."""
        assert self.ego is not None
        return self.simulation.closed(lane, self.kind(self.ego))

    @property
    def _moved(self) -> bool:
        """Whether SUMO may have replaced the ego's route because another program moves it."""
        return self.steered or isinstance(self.controller, ExternalEgo)

    def recorded(self) -> bool:
        return self.playback is not None and self.playback.log is not None

    def follows_log(self) -> bool:
        """Whether a log moves background vehicles, so that they do not react to the adversary."""
        return self.playback is not None and self.playback.spec.follows_log

    def replayed(self) -> bool:
        """Whether a log moves the ego."""
        return self.playback is not None and self.ego is not None and self.playback.replays(self.ego)

    def _let_ego_act(self, driven: dict[str, Pose], action: Action) -> None:
        assert self.ego is not None
        heeds = False
        wishes = wishes_of(self.controller)
        if action is None:
            waits = isinstance(self.controller, ReplayEgo) and not self._playing
            if waits or not self.controller.needs_observation:
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
        self.actions.answered(answer, reachable)

    def _note_inside(self, action: Action) -> None:
        """Keep the plan and the notes of an answer, if it has any."""
        if isinstance(action, Steer | LaneSpeed | PlannedPose) and (action.plan or action.notes):
            self.inside.append(DriverInside(self.now, action.plan or (), action.notes))

    def _led_back(self, action: Action) -> Action:
        """The action, or a way back to the ego's own lane where its driver gives it to SUMO on a lane off its route:
        SUMO would turn it round there."""
        if self._ego_place is None or not self.steered or isinstance(action, Steer | Pose):
            return action
        assert self.ego is not None
        place = self.place(self._ego_place.road)
        if place is None or not self._ego_place.astray:
            return action
        speed = action.speed if isinstance(action, LaneSpeed) else None
        return back_to_lane(place, self.state(self.ego), speed, self.recording.step_length)

    def where(self) -> str:
        """Where the ego's driver is: its step, counted from 1 where it took over, and the time."""
        first = self._takeovers[-1][0] if self.ego is not None and self._takeovers else len(self.recording.snapshots)
        return f"its step {len(self.recording.snapshots) - first + 1}, at {self.now:.1f} s"

    @contextmanager
    def _driver(self, method: str) -> Iterator[None]:
        """Code of the ego's driver. Raises DriverError if it does not return in time, or ends its process."""
        call = Call(f"The ego's driver {self.controller.name!r}", f"in {method} ({self.where()})", self._deadline)
        process = os.getpid()
        try:
            with watched(call):
                yield
                if os.getpid() != process:  # it has forked: the copy must not go on as a second simulation
                    os._exit(0)
        except OutOfTimeError:
            raise call.too_late() from None
        except SystemExit as error:
            raise DriverError(call.ended(f"SystemExit: {error.code}")) from error

    def observation(self) -> Observation:
        assert self.ego is not None
        me = self.state(self.ego)
        near = self.near(me, OBSERVED_RADIUS_M)
        if self.observe is not None:
            return self.observe(me, near)
        return Observation(self.now, self.recording.step_length, me, tuple(self.state(name) for name in near))

    def replay(self, track: Track) -> None:
        """Have a ``ReplayEgo`` repeat a recorded motion from now on. Other drivers ignore this."""
        if isinstance(self.controller, ReplayEgo) and not self.replayed():
            self.controller.load(track)
            self._playing = True
