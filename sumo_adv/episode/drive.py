"""One simulation with its ego's driver, stepped and recorded."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from sumo_adv.datatypes import Role, Track, VehicleState
from sumo_adv.world.egos import EgoController, LaneSpeed, Observation, ReplayEgo, Steer, apply_steer
from sumo_adv.world.egos import Pose as EgoPose
from sumo_adv.world.remote import Remote
from sumo_adv.world.simulation import Pose, Recording, Simulation, SimulationSpec, Snapshot

EGO_TYPE = "sumo_adv_ego"
LineAhead = Callable[[VehicleState], Sequence[tuple[float, float]] | None]
OBSERVED = 120.0  # m: how far the ego's driver sees


def ego_type_file(controller: EgoController, folder: Path) -> Path:
    """An additional file with the vType of the ego's driver."""
    attributes = {"vClass": "passenger", "speedDev": "0", **controller.sumo_type}
    text = " ".join(f'{k}="{v}"' for k, v in attributes.items())
    target = folder / "ego_type.add.xml"
    target.write_text(f'<additional>\n  <vType id="{EGO_TYPE}" {text}/>\n</additional>\n')
    return target


class Drive:
    """Steps SUMO, lets the ego's driver act, puts adversaries where they belong, and records everything."""

    def __init__(
        self, spec: SimulationSpec, controller: EgoController, seed: int, remote: Remote | None = None
    ) -> None:
        self.simulation = Simulation(spec, remote)
        self.controller = controller
        self.seed = seed
        self.ego: str | None = None
        self.recording = Recording(spec.step_length)
        self._takeovers: list[tuple[int, str | None]] = []
        self._playing = False
        self.line_ahead: LineAhead | None = None
        self.on_load: Callable[[], None] | None = None  # what is done to a simulation that was just loaded

    @property
    def now(self) -> float:
        """Simulated time [s]."""
        return self.simulation.time

    @property
    def snapshot(self) -> Snapshot:
        """The newest states."""
        return self.recording.snapshots[-1]

    def take_over(self, vehicle: str) -> None:
        """Make a vehicle the ego: it gets the driver under test."""
        if self.controller.sumo_type:
            self.simulation.set_type(vehicle, EGO_TYPE)
        self.controller.reset(self.seed)
        self.ego = vehicle
        self._takeovers.append((len(self.recording.snapshots), vehicle))

    def release(self) -> None:
        """The vehicle is no longer the ego; it keeps its driver's model, but nobody acts for it."""
        self.ego = None
        self._takeovers.append((len(self.recording.snapshots), None))

    def tick(self, poses: Mapping[str, Pose] | None = None) -> Snapshot:
        """One step: the ego acts, ``poses`` are injected, SUMO steps, the states are kept."""
        driven = dict(poses or {})
        if self.ego is not None and self.recording.snapshots and self.ego in self.snapshot.raw:
            self._let_ego_act(driven)
        if driven:
            self.simulation.inject(driven)
        self.simulation.step()
        snapshot = self.simulation.read()
        self.recording.append(snapshot)
        return snapshot

    def rewind(self, steps: int) -> None:
        """Load the simulation again and repeat the first ``steps`` steps with the same commands."""
        takeovers = dict(self._takeovers)
        self.simulation.reload()
        if self.on_load is not None:
            self.on_load()
        self.ego, self._takeovers, self._playing = None, [], False
        self.recording = Recording(self.recording.step_length)
        for k in range(steps):
            self._change_ego(takeovers, k)
            self.tick()
        self._change_ego(takeovers, steps)

    def _change_ego(self, takeovers: Mapping[int, str | None], step: int) -> None:
        if step in takeovers:
            name = takeovers[step]
            self.release() if name is None else self.take_over(name)

    def state(self, vehicle: str) -> VehicleState:
        """A vehicle's newest state."""
        return self.simulation.state(self.snapshot, vehicle, self.recording.acceleration(vehicle))

    def tracks(self, adversary: str | None = None, start: int = 0) -> list[Track]:
        """All tracks from recorded step ``start`` on."""
        roles = {adversary: Role.ADVERSARY} if adversary else {}
        if self.ego is not None:
            roles[self.ego] = Role.EGO
        part = Recording(self.recording.step_length)
        part.snapshots = self.recording.snapshots[start:]
        return part.tracks(self.simulation.fleet.sizes, roles)

    def _let_ego_act(self, driven: dict[str, Pose]) -> None:
        assert self.ego is not None
        waits = isinstance(self.controller, ReplayEgo) and not self._playing
        if waits or not self.controller.needs_observation:
            return
        observation = self._observe(self.ego)
        action = self.controller.act(observation)
        if isinstance(action, Steer):
            after = apply_steer(observation.ego, action, observation.dt)
            driven[self.ego] = Pose(after.x, after.y, after.heading, after.speed)
        elif isinstance(action, EgoPose):
            driven[self.ego] = Pose(action.x, action.y, action.heading, action.speed)
        elif isinstance(action, LaneSpeed):
            self.simulation.set_speed(self.ego, action.speed)
            if action.lane is not None:
                self.simulation.change_lane(self.ego, action.lane)
        else:
            self.simulation.set_speed(self.ego, None)

    def _observe(self, ego: str) -> Observation:
        me = self.state(ego)
        raw = self.snapshot.raw
        near = [n for n, r in raw.items() if n != ego and math.hypot(r[0] - me.x, r[1] - me.y) < OBSERVED]
        line = self.line_ahead(me) if self.line_ahead is not None else None
        return Observation(self.now, self.recording.step_length, me, tuple(self.state(n) for n in near), path=line)

    def replay(self, track: Track) -> None:
        """From now on the ego plays a recorded motion back, if it is one that does; others go on as they are."""
        if isinstance(self.controller, ReplayEgo):
            self.controller.load(track)
            self._playing = True
