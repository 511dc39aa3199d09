"""The verdict on an attempt: by gates as soon as it was driven, and by reference drivers in the same encounter.

For a reference driver the adversary repeats its recorded motion and then its plan from the trigger on, and the driver
drives the ego on the path that it took in the attempt. Other traffic reacts. The drivers, their view and the rules of
contact are those of the kinematic counterfactual (``metrics/reference``); the two forms differ only in the motion of
other traffic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import Boxes, Floats, PrescribedMotion, Preventability, Proposal, Track, VehicleState, Verdict
from sumo_adv.drivers import Observation, Pose
from sumo_adv.drivers.careful import is_noticed
from sumo_adv.episode.attempt import Driven
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.metrics.avoidance import OnRoad, manoeuvre_poses
from sumo_adv.metrics.boxes import height_as, on_grid, on_layer, row_of
from sumo_adv.metrics.case import Case, make_case
from sumo_adv.metrics.levels import AVOIDS, COLLIDES, NOT_APPLICABLE, encounter_of, judged, with_level
from sumo_adv.metrics.reference import BRAKERS, REFERENCE_DRIVERS, Braker
from sumo_adv.metrics.reference.counterfactual import Counterfactual, Encounters
from sumo_adv.metrics.reference.view import HISTORY, EgoPaths, Views
from sumo_adv.metrics.validity import judge
from sumo_adv.simulation.tracks import tracks_of

# -- gates ----------------------------------------------------------------------------------------------------------


def gate_verdict(
    drive: Drive, found: FoundEncounter, settings: Settings, trigger_step: int, bvs: tuple[str, ...], start: float,
    driven: Driven,
) -> Verdict | None:  # fmt: skip
    """The verdict on the attempt that began at ``start`` [s]; None if ego or collider left before it moved.

    Reference drivers are asked as far as the level depends on them; where a model reads what they did, all of them.
    ``bvs``: all adversaries, the collider first. ``trigger_step``: how many snapshots the recording had at the trigger.
    """
    assert drive.ego is not None
    first = first_judged(found, settings, trigger_step, start)
    logged = settings.limits.limits() if drive.follows_log() else None
    case = make_case(drive.tracks(*bvs, start=first), drive.ego, bvs, start, driven.beyond, logged)
    if case is None:
        return None
    half = found.half_lane(start)
    verdict = judge(
        case.ego, case.adversary, case.others, trigger_time=start, ttc_threshold=settings.critical_ttc,
        limits=settings.limits.of(case.adversary), on_road=found.drivable, lane_half_width=half,
        supports=case.supports,
    )  # fmt: skip
    verdict = replace(verdict, log_gates=case.log_gates)
    itself = own_reference(drive)
    verdict = with_level(
        verdict, case.ego, case.adversary, case.others, trigger_time=start, on_road=found.drivable,
        lane_half_width=half, unattacked=unattacked(found, settings),
        only_level=settings.player("modifier") is None and itself is None,
    )  # fmt: skip
    return verdict if itself is None else shown_to_collide(verdict, itself)


def shown_to_collide(verdict: Verdict, driver: str) -> Verdict:
    """The verdict on a collision of an ego that this reference driver drove: it does not avoid the collision."""
    prevention = verdict.preventability
    if prevention is None or prevention.answers.get(driver) != AVOIDS:
        return verdict
    answers = {**prevention.answers, driver: COLLIDES}
    return judged(replace(verdict, preventability=replace(prevention, answers=answers)))


def own_reference(drive: Drive) -> str | None:
    """The reference driver that drives the ego itself: in a collision of the ego it has not avoided it."""
    return getattr(drive.controller, "reference", None)


def first_judged(found: FoundEncounter, settings: Settings, trigger_step: int, start: float) -> int:
    """The recorded step from which an attempt that began at ``start`` [s] is judged: the history before it counts."""
    return max(0, trigger_step + settings.steps(start - found.time) - settings.steps(settings.history))


def unattacked(found: FoundEncounter, settings: Settings) -> Track | None:
    """The ego's motion without the attack, from the trigger on; None if it was only foreseen."""
    tracks = tracks_of(found.baseline, found.sizes, {}, settings.step_length, (found.ego,))
    return tracks[0] if tracks and len(tracks[0].time) > 1 else None


# -- reference drivers ----------------------------------------------------------------------------------------------

MEMORY = HISTORY + 0.1  # s of past states that a view needs


@dataclass(frozen=True, slots=True)
class Order:
    """The encounter that a reference driver drives. ``courses``: by adversary its recorded and planned motion.

    ego: the ego of the attempt, from some steps before ``start`` [s] to the end of the check; roster: length and width
    [m] of the vehicles that drivers may see; plan: poses of the ego by step after ``start``, for ``manoeuvre``.
    """

    proposal: Proposal
    courses: Mapping[str, PrescribedMotion]
    ego: Track
    start: float
    steps: int
    roster: Mapping[str, tuple[float, float]]
    lane_half_width: float
    plan: Boxes | None = None


class ReferenceEgo:
    """An ego controller: repeats the recorded motion until the reference driver brakes, then obeys it on that path."""

    needs_observation = True
    forkable = True
    sumo_type: Mapping[str, str] = {}

    def __init__(self, order: Order, driver: type[Braker] | None, history: Sequence[Track]) -> None:
        """``driver`` None: drive the poses of ``order.plan``.  ``history``: tracks up to the start."""
        self.name = "reference" if driver is None else driver.name
        self._order, self._ego = order, order.ego
        self._names = [n for n in order.roster if n != order.ego.id]
        self._paths = EgoPaths(row_of(self._ego))
        self._acting, self._acceleration = False, 0.0
        self._step = 0
        self._dt = float(np.diff(self._ego.time).min())
        self._driver = None if driver is None else driver((1, len(self._names)), self._dt)
        self._seen: Floats = np.empty((7, len(self._names), 0))  # by vehicle and step, see ``_look``
        self._warm_up(history)

    def reset(self, seed: int) -> None:
        """Does nothing: each attempt gets a new object."""

    def act(self, observation: Observation) -> Pose:
        k, self._step = self._step, self._step + 1
        state = observation.ego
        if self._driver is None:
            plan = self._order.plan
            assert plan is not None
            i = min(k + 1, plan.x.shape[-1] - 1)
            return Pose(*(float(v[i]) for v in (plan.x, plan.y, plan.heading, plan.speed)))
        self._look({s.id: (s.x, s.y, s.heading, s.speed) for s in observation.others if is_noticed(s)})
        station = float(self._paths.locate(np.array([[state.x]]), np.array([[state.y]]))[0][0, 0])
        commanded = float(self._driver.step(self._view(station, state.speed, self._acceleration))[0])
        index = int(np.searchsorted(self._ego.time, observation.time - 1e-6))
        recorded = index + 1 < len(self._ego.time)
        change = (self._ego.speed[index + 1] - self._ego.speed[index]) / self._dt if recorded else 0.0
        self._acting = self._acting or np.isfinite(commanded)
        if not self._acting:
            return self._as_recorded(index, state)
        braking = min(commanded if np.isfinite(commanded) else np.inf, change)
        pace = self._ego.speed[index + 1] if recorded else state.speed
        after = min(max(state.speed + braking * self._dt, 0.0), max(float(pace), state.speed))
        moved = (state.speed + after) / 2 * self._dt
        if after == 0.0 and braking < 0.0:
            moved = min(moved, state.speed**2 / (-2 * braking))
        self._acceleration = (after - state.speed) / self._dt
        x, y, heading = self._paths.poses(np.array([[station + moved]]))
        return Pose(float(x[0, 0]), float(y[0, 0]), float(heading[0, 0]), after)

    def _as_recorded(self, index: int, state: VehicleState) -> Pose:
        e, i = self._ego, index + 1
        if i < len(e.time):
            self._acceleration = float(e.speed[i] - e.speed[i - 1]) / self._dt
            return Pose(float(e.x[i]), float(e.y[i]), float(e.heading[i]), float(e.speed[i]))
        self._acceleration = 0.0
        on, h = state.speed * self._dt, state.heading
        return Pose(float(state.x + on * np.cos(h)), float(state.y + on * np.sin(h)), h, state.speed)

    def _warm_up(self, history: Sequence[Track]) -> None:
        """Show the driver the states before the start."""
        tracks = {t.id: t for t in history}
        if self._driver is None or self._ego.id not in tracks:
            return
        ego = tracks[self._ego.id]
        there = [n for n in self._names if n in tracks]
        others = on_layer(row_of(ego), on_grid([tracks[n] for n in there], ego.time))
        states = np.stack([others.x, others.y, others.heading, others.speed])
        for k in range(len(ego.time) - 1):  # the last state is seen when the driver acts
            self._look(dict(zip(there, states[:, :, k].T, strict=True)))
            station = float(self._paths.locate(ego.x[None, k : k + 1], ego.y[None, k : k + 1])[0][0, 0])
            self._driver.step(self._view(station, float(ego.speed[k]), float(ego.acceleration[k])))

    def _look(self, vehicles: Mapping[str, Sequence[float] | Floats]) -> None:
        """Note where the vehicles are in a step: x, y, heading and speed, then station, offset and heading of the path
        there; those that are not there are NaN."""
        column: Floats = np.full((4, len(self._names)), np.nan)
        for row, name in enumerate(self._names):
            if (state := vehicles.get(name)) is not None:
                column[:, row] = state
        located = self._paths.locate(column[0][None], column[1][None])
        keep = max(2, round(MEMORY / self._dt) + 1)
        newest = np.concatenate([column, *located])[:, :, None]
        self._seen = np.concatenate([self._seen[:, :, 1 - keep :], newest], axis=2)

    def _view(self, station: float, speed: float, acceleration: float) -> Any:
        size = np.array([self._order.roster[n] for n in self._names], dtype=np.float64).reshape(-1, 2)
        x, y, heading, pace, there, left, path_heading = (v[None] for v in self._seen)
        boxes = Boxes(x, y, heading, pace, size[None, :, :1], size[None, :, 1:])
        ego = (self._ego.length, self._ego.width)
        views = Views(boxes, (there, left, path_heading), ego, self._dt, self._order.lane_half_width)
        motion = (np.array([v]) for v in (station, speed, acceleration))
        return views.at(self._seen.shape[2] - 1, *motion)


def order_of(
    proposal: Proposal, result: AttemptResult, case: Case, contact_time: float, lane_half_width: float,
    on_road: OnRoad | None, unattacked: Track | None,
) -> Order:  # fmt: skip
    """The order for an attempt that collided; ``case``: the tracks that were judged."""
    driven = [t.between(result.start + 1e-3, np.inf) for t in (case.adversary, *case.supports)]
    courses = {t.id: PrescribedMotion(t.x, t.y, t.heading, t.speed) for t in driven if len(t.time)}
    given = encounter_of(
        case.ego, case.adversary, case.others, result.start, contact_time, lane_half_width, unattacked
    )  # fmt: skip
    check = Counterfactual(given)
    roster = {t.id: (t.length, t.width) for t in (case.adversary, *case.others)}
    begin = max(float(case.ego.time[0]), float(case.adversary.time[0]))
    e = check.ego
    pace = np.diff(e.speed[0], prepend=e.speed[0, :1]) / given.dt
    ego = Track(
        case.ego.id, case.ego.role, np.round(begin + check.time, 6), e.x[0], e.y[0], e.heading[0], e.speed[0], pace,
        case.ego.length, case.ego.width, z=height_as(e, lambda z: z[0]),
    )  # fmt: skip
    steps = check.steps - 1 - int(given.start[0])
    plan = _manoeuvre_plan(check, on_road)
    return Order(proposal, courses, ego, result.start, steps, roster, lane_half_width, plan)


def _manoeuvre_plan(check: Counterfactual, on_road: OnRoad | None) -> Boxes | None:
    """The poses of the best manoeuvre from the start on; None if no manoeuvre avoids the collision kinematically."""
    alarm = check.roll_out(BRAKERS["cc_human"])[2]
    _, best = check.manoeuvring(alarm, on_road)
    if best[0] < 0:
        return None
    first, start = round(float(alarm[0]) / check.given.dt), int(check.given.start[0])
    _, poses = manoeuvre_poses(check.ego, np.array([first]), check.steps - 1 - first, check.given.dt)
    k = int(best[0])
    parts = []
    for name in ("x", "y", "heading", "speed"):
        before, after = getattr(check.ego, name)[0, start:first], getattr(poses, name)[k, 0]
        parts.append(np.concatenate([before, after]) if first >= start else after[start - first :])
    x, y, heading, speed = parts
    return Boxes(x, y, heading, speed, float(np.ravel(check.ego.length)[0]), float(np.ravel(check.ego.width)[0]))


def avoids(order: Order, tracks: Sequence[Track]) -> bool:
    """Whether an ego with a reference driver touched no vehicle, rear-ends by others not counted."""
    named = {t.id: t for t in tracks}
    if order.ego.id not in named or order.proposal.bv not in named:
        return True  # one of the two left the network before they met
    ego, foe = named[order.ego.id], named[order.proposal.bv]
    others = [t for n, t in named.items() if n in order.roster and n not in (ego.id, foe.id)]
    begin = max(float(ego.time[0]), float(foe.time[0]))
    checked = ego.between(begin, np.inf)
    dt = float(np.diff(checked.time).min())
    start = int(np.searchsorted(checked.time, order.start - 5e-4))
    grid = on_grid(others, np.round(begin + np.arange(len(checked.time)) * dt, 6)) if others else None
    given = Encounters(
        row_of(checked), row_of(foe.between(begin, np.inf)), np.array([start]), np.array([len(checked.time) - 1]), dt,
        grid, order.lane_half_width,
    )  # fmt: skip
    return bool(Counterfactual(given, beyond=0.0).unchanged().avoids[0])


def simulated(kinematic: Preventability, avoided: Mapping[str, bool]) -> Preventability:
    """The kinematic answers, replaced by those of the simulation if it has any."""
    answers = {
        name: NOT_APPLICABLE if kinematic.answers.get(name) == NOT_APPLICABLE else AVOIDS if avoided[name] else COLLIDES
        for name in avoided
    }
    every = {**kinematic.answers, **answers}
    answers = {name: every[name] for name in REFERENCE_DRIVERS if name in every}
    return replace(kinematic, answers=answers, simulated=True)
