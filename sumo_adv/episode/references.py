"""Reference drivers in the loop: would this driver have avoided the collision if the adversary had planned again?

The attempt is driven once more from the trigger on. The driver under test drives until the reference driver's own alarm
and reaction. From then on, the reference driver brakes. While it does not brake, SUMO's driver continues in the lane.
The reference driver does not steer. The adversary plans again against the ego's new motion, and other traffic reacts.
The driver avoids the collision if the ego touches no vehicle except those that run into it from behind in its lane.

The kinematic check (``metrics/reference/counterfactual.py``) repeats the adversary's motion. It is cheap and filters
the attempts. A level is claimed only if a driver avoids the collision in both checks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from sumo_adv.datatypes import Boxes, Track, VehicleState
from sumo_adv.drivers import Action, EgoController, LaneSpeed, Observation, Pose, ReplayEgo
from sumo_adv.drivers.protocol import wishes_of
from sumo_adv.drivers.watching import Watcher, lane_half_width_of, path_of
from sumo_adv.geometry import same_layer
from sumo_adv.metrics.avoidance import manoeuvre_poses
from sumo_adv.metrics.boxes import on_grid, row_of
from sumo_adv.metrics.case import Case
from sumo_adv.metrics.preventability import encounter_of
from sumo_adv.metrics.reference import BRAKERS, Braker
from sumo_adv.metrics.reference.counterfactual import Counterfactual, Encounters
from sumo_adv.metrics.reference.sight import SightLimits
from sumo_adv.metrics.reference.view import EgoPaths

WARM_UP_S = 3.0
"""A reference driver sees this time before the attack [s]: longer than perception and reaction together (1.15 s)."""


class ReferenceEgo:
    """The ego's driver in the loop: the tested driver until the reference driver brakes, then the reference driver.

    Attributes:
        name: The name of the reference driver.
        wishes: What the tested driver asks of the engine.
    """

    needs_observation = True
    forkable = True
    sumo_type: Mapping[str, str] = {}

    def __init__(
        self, tested: EgoController, driver: type[Braker], history: Sequence[Track], ego: str,
        take_over: Callable[[], None], log: Track | None = None, sight: SightLimits | None = None,
    ) -> None:  # fmt: skip
        """Make the driver of one run.

        Args:
            tested: The driver under test, as it is when the attack begins.
            driver: The reference driver.
            history: The recorded motions up to the start of the attack. The reference driver sees them first.
            ego: The ego's id.
            take_over: Called when the reference driver first brakes.
            log: The ego's motion if a log moves it. The ego follows its path and pace while the driver does not brake.
            sight: How far the ego saw along its way up to the start; None without a limit.
        """
        self.name = driver.name
        self.wishes = wishes_of(tested)
        self._tested: EgoController = tested if log is None else _following(log)
        self._driver, self._log = driver, log
        self._way = None if log is None else EgoPaths(row_of(log))
        self._take_over = take_over
        self._ego, self._history, self._sight = ego, {t.id: t for t in history}, sight
        self._watcher: Watcher | None = None
        self._acting = False

    def reset(self, seed: int) -> None:
        """Do nothing, because each run gets a new object."""

    def act(self, observation: Observation) -> Action:
        """Return the tested driver's action until the reference driver first brakes, then the reference driver's."""
        half = lane_half_width_of(observation)
        if self._watcher is None:
            self._watcher = Watcher(self._driver, observation.dt)
            self._look_back(self._watcher, observation, half)
        path, others = path_of(observation), observation.others
        target = self._watcher.speed(observation.ego, others, path, half, observation.sight)
        if not self._acting and not math.isinf(target):
            self._acting = True
            self._take_over()
        if not self._acting:
            return self._tested.act(observation) if self._tested.needs_observation else None
        if self._log is not None and self._way is not None:
            return _braked_along(observation, self._log, self._way, target)
        return None if math.isinf(target) else LaneSpeed(None, target)

    def _look_back(self, watcher: Watcher, observation: Observation, half: float) -> None:
        """Show the driver the states before the start of the attack."""
        ego = self._history.pop(self._ego, None)
        if ego is None:
            return
        path = path_of(observation, np.stack([ego.x, ego.y], axis=1))
        reach = np.full(len(ego.time), math.inf) if self._sight is None else self._sight.along(ego)
        for k in range(len(ego.time) - 1):  # the last state is the present one, shown by ``act``
            me, states = _state(ego, k), (state_at(t, float(ego.time[k])) for t in self._history.values())
            others = [state for state in states if state is not None and same_layer(me.z, state.z)]
            watcher.speed(me, others, path, half, float(reach[k]))
        self._history.clear()


class PlannedEgo:
    """An ego that drives poses given in advance, one for each step from the start of the attack."""

    name = "manoeuvre"
    needs_observation = True
    forkable = True
    sumo_type: Mapping[str, str] = {}

    def __init__(self, plan: Boxes) -> None:
        """Start at the first pose.

        Args:
            plan: The poses, arrays ``(steps,)``. The first one is the present pose.
        """
        self._plan, self._step = plan, 0

    def reset(self, seed: int) -> None:
        """Do nothing, because each run gets a new object."""

    def act(self, observation: Observation) -> Pose:
        """Return the next pose; after the last one, go straight on."""
        p, last = self._plan, self._plan.x.shape[-1] - 1
        self._step += 1
        k = min(self._step, last)
        on = (self._step - k) * observation.dt * float(p.speed[k])
        heading = float(p.heading[k])
        x, y = float(p.x[k]) + on * math.cos(heading), float(p.y[k]) + on * math.sin(heading)
        return Pose(x, y, heading, float(p.speed[k]))


def _following(log: Track) -> ReplayEgo:
    """Return a driver that repeats a logged motion."""
    driver = ReplayEgo()
    driver.load(log)
    return driver


def _braked_along(observation: Observation, log: Track, way: EgoPaths, target: float) -> Pose:
    """Return the next pose on the path of a log.

    The speed changes as in the log, but is at most ``target`` [m/s] and does not rise above the log's speed.
    """
    ego, dt = observation.ego, observation.dt
    now, pace = (float(v) for v in np.interp([observation.time, observation.time + dt], log.time, log.speed))
    after = min(max(min(ego.speed + pace - now, target), 0.0), max(pace, ego.speed))
    moved = (ego.speed + after) / 2 * dt
    station = float(way.locate(np.array([[ego.x]]), np.array([[ego.y]]))[0][0, 0])
    x, y, heading = (float(v[0, 0]) for v in way.poses(np.array([[station + moved]])))
    return Pose(x, y, heading, after)


def state_at(track: Track, time: float) -> VehicleState | None:
    """Return the state of a track at a time.

    Args:
        track: The track.
        time: A time of the track's grid [s].

    Returns:
        The state; None if the track has none at that time.
    """
    k = int(np.searchsorted(track.time, time - 5e-4))
    return _state(track, k) if k < len(track.time) and abs(float(track.time[k]) - time) < 5e-4 else None


def _state(t: Track, k: int) -> VehicleState:
    """Return state ``k`` of a track."""
    x, y, heading, speed, acceleration = (float(v[k]) for v in (t.x, t.y, t.heading, t.speed, t.acceleration))
    z = float(np.broadcast_to(t.z, t.time.shape)[k])
    return VehicleState(t.id, x, y, heading, speed, acceleration, t.length, t.width, t.lane[k] if t.lane else "", z)


def manoeuvre_plan(case: Case, contact_time: float) -> Boxes | None:
    """Return the poses of the manoeuvre that avoids a collision in the kinematic check.

    Args:
        case: The recorded attempt.
        contact_time: The time of the collision [s].

    Returns:
        The pose at each step from the start of the attack, arrays ``(steps,)``; None if no manoeuvre avoids the
        collision.
    """
    given = encounter_of(case, contact_time)
    check = Counterfactual(given)
    alarm = check.roll_out(BRAKERS["cc_human"])[2]
    _, best = check.manoeuvring(alarm, case.on_road)
    if best[0] < 0:
        return None
    first, begin = round(float(alarm[0]) / given.dt), int(given.start[0])
    poses = manoeuvre_poses(check.ego, np.array([first]), check.steps - 1 - first, given.dt)
    k = int(best[0])
    parts = []
    for name in ("x", "y", "heading", "speed"):
        before, after = getattr(check.ego, name)[0, begin:first], getattr(poses, name)[k, 0]
        parts.append(np.concatenate([before, after]) if first >= begin else after[begin - first :])
    x, y, heading, speed = parts
    return Boxes(x, y, heading, speed, float(np.ravel(check.ego.length)[0]), float(np.ravel(check.ego.width)[0]))


def avoids(tracks: Sequence[Track], ego_id: str, adversary: str, start: float, lane_half_width: float) -> bool:
    """Return whether an ego touched no vehicle; vehicles that run into it from behind in its lane do not count.

    Args:
        tracks: The recorded motions.
        ego_id: The ego's id.
        adversary: The collider's id.
        start: The time from which contacts count [s].
        lane_half_width: Half the width of the ego's lane [m].

    Returns:
        Whether the ego avoided all contacts. True if the ego or the adversary left before they met.
    """
    named = {t.id: t for t in tracks}
    if ego_id not in named or adversary not in named:
        return True  # one of the two left the network before they met
    ego, foe = named.pop(ego_id), named.pop(adversary)
    begin = max(float(ego.time[0]), float(foe.time[0]))
    checked = ego.between(begin, np.inf)
    if len(checked.time) < 2:
        return True
    dt = float(np.diff(checked.time).min())
    first = int(np.searchsorted(checked.time, start - 5e-4))
    others = list(named.values())
    grid = on_grid(others, np.round(begin + np.arange(len(checked.time)) * dt, 6)) if others else None
    given = Encounters(
        row_of(checked), row_of(foe.between(begin, np.inf)), np.array([first]), np.array([len(checked.time) - 1]), dt,
        grid, lane_half_width,
    )  # fmt: skip
    return bool(Counterfactual(given, beyond=0.0).unchanged().avoids[0])
