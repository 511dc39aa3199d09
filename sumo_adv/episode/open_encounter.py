"""An encounter at its trigger, in the engine process: attempts and reference drivers start from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import AS_FOUND, Arrival, Boxes, Proposal, Track
from sumo_adv.drivers import ReplayEgo
from sumo_adv.drivers.protocol import MAX_BRAKING_M_S2
from sumo_adv.episode.attempt import Driven, attack, box_of, controller_of
from sumo_adv.episode.drive import Drive
from sumo_adv.episode.references import WARM_UP_S, PlannedEgo, ReferenceEgo, avoids
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.episode.verdict import first_judged, recorded_case, verdict_of_attackers
from sumo_adv.errors import SimulationError
from sumo_adv.geometry import Pose, wrap
from sumo_adv.metrics.boxes import overlaps
from sumo_adv.metrics.case import Case
from sumo_adv.metrics.reference import BRAKERS
from sumo_adv.planners.answers import AskOne
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.stored_snapshots import StoredSnapshots
from sumo_adv.simulation.tracks import tracks_of
from sumo_adv.situation import Situation

ROOM_M = 60.0  # m within which other vehicles may be in the way of an ego that arrives differently


@dataclass(frozen=True, slots=True)
class OpenEncounter:
    """An encounter at its trigger, in the engine process. ``attempt`` and ``avoids`` each simulate on from the trigger.

    Attributes:
        drive: The simulation with the ego.
        found: The encounter.
        settings: The run's settings.
        road: The map.
        trigger_step: The number of recorded snapshots at the trigger.
        baseline_ego: The ego's motion without an attack.
    """

    drive: Drive
    found: FoundEncounter
    settings: Settings
    road: RoadMap
    trigger_step: int
    baseline_ego: Track

    def situation_for(self, proposal: Proposal) -> Situation:
        """Return the situation in which a proposal's attack begins.

        Args:
            proposal: The proposal.

        Raises:
            SimulationError: One of its adversaries cannot attack then.
        """
        situation = self.found.situations.get(proposal.delay)
        for bv in proposal.bvs:
            if situation is None or bv not in situation.targets:
                raise SimulationError(f"Vehicle '{bv}' cannot attack {proposal.delay:g} s after the trigger.")
        assert situation is not None
        return situation

    def attempt(self, proposal: Proposal, asks: Sequence[AskOne]) -> AttemptResult:
        """Drive an attempt and judge it.

        Args:
            proposal: The candidate to attempt.
            asks: For each of the proposal's adversaries, what asks its planner.

        Returns:
            The result.
        """
        drive = self.drive
        start = self._begin(proposal)
        driven = self._attack(proposal, asks)
        verdict = verdict_of_attackers(drive, self.found, self.settings, self.trigger_step, proposal, start, driven)
        snapshots = StoredSnapshots(drive.recording.snapshots[self.trigger_step :])
        return AttemptResult(
            driven, verdict, start, snapshots, dict(drive.simulation.fleet.sizes), drive.actions.total(),
            tuple(drive.inside),
        )  # fmt: skip

    def avoids(
        self, proposal: Proposal, asks: Sequence[AskOne], driver: str, manoeuvre: Boxes | None, lane_half_width: float
    ) -> bool:  # fmt: skip
        """Return whether a reference driver avoids an attempt's collision in the loop.

        Args:
            proposal: The candidate that was attempted.
            asks: For each of the proposal's adversaries, what asks its planner.
            driver: The reference driver's name.
            manoeuvre: The ego's motion if the driver is the manoeuvre; otherwise None.
            lane_half_width: Half the width of the ego's lane [m].
        """
        drive, settings, tested = self.drive, self.settings, self.drive.controller
        assert drive.ego is not None
        start = self._begin(proposal)
        if manoeuvre is not None:
            drive.controller = PlannedEgo(manoeuvre)
        else:
            first = max(0, len(drive.recording.snapshots) - settings.steps(WARM_UP_S))
            log = self.baseline_ego if drive.replayed() or isinstance(tested, ReplayEgo) else None
            strong = partial(drive.simulation.strengthen, drive.ego, MAX_BRAKING_M_S2)
            sight = None if drive.way is None else drive.way.limits(drive)
            drive.controller = ReferenceEgo(
                tested, BRAKERS[driver], drive.tracks(start=first), drive.ego, strong, log, sight
            )  # fmt: skip
        try:
            self._attack(proposal, asks)
        finally:
            drive.controller = tested
        tracks = drive.tracks(*proposal.bvs, start=max(0, self.trigger_step - 1))
        return avoids(tracks, drive.ego, proposal.bv, start, lane_half_width)

    def case(self, proposal: Proposal, result: AttemptResult) -> Case | None:
        """Return what the verdict on an attempt is based on.

        Args:
            proposal: The candidate that was attempted.
            result: The result of the attempt.

        Returns:
            The case; None if the ego or the collider left before it moved.
        """
        drive, settings = self.drive, self.settings
        first = first_judged(self.found, settings, self.trigger_step, result.start)
        snapshots = [*drive.recording.snapshots[: self.trigger_step], *result.snapshots][first:]
        sizes = {**drive.simulation.fleet.sizes, **result.sizes}
        tracks = tracks_of(snapshots, sizes, drive.roles(*proposal.bvs), settings.step_length)
        return recorded_case(
            tracks, self.found, settings, proposal.bvs, result.start, result.driven.beyond,
            follows_log=drive.follows_log(),
        )  # fmt: skip

    def _begin(self, proposal: Proposal) -> float:
        """Simulate until a proposal's attack begins, and return that time [s]."""
        self.drive.replay(self.baseline_ego)
        for _ in range(self.settings.steps(proposal.delay)):
            self.drive.tick()
        return self.drive.now

    def _attack(self, proposal: Proposal, asks: Sequence[AskOne]) -> Driven:
        """Drive a proposal's adversaries against the ego from now on."""
        drive, settings, situation = self.drive, self.settings, self.situation_for(proposal)
        members = {
            p.bv: controller_of(situation, p, settings.limits.of(situation.targets[p.bv].state), ask)
            for p, ask in zip(proposal.members, asks, strict=True)
        }
        steps, replan = drive.within(settings.steps(settings.duration)), settings.steps(settings.replan)
        ego = None if proposal.arrival == AS_FOUND else self._displaced(proposal.arrival, situation)
        return attack(drive, members, steps=steps, replan=replan, ego=ego)

    def _displaced(self, arrival: Arrival, situation: Situation) -> Pose:
        """Return the ego's pose after a step if it arrives differently; nearer to its place if a vehicle is there."""
        drive, dt = self.drive, self.settings.step_length
        assert drive.ego is not None
        ego, path = drive.state(drive.ego), situation.baseline.path
        s, d = path.project(ego.x, ego.y)
        turned = ego.heading - float(path.at(np.asarray(s))[2])
        others = [box_of(drive.state(name)) for name in drive.near(ego, ROOM_M)]
        speed = ego.speed * arrival.pace
        for share in (1.0, 0.5, 0.0):
            station = np.asarray(s + share * arrival.earlier * ego.speed + speed * dt)
            x, y, heading = (float(q) for q in path.at(station, d))
            pose = Pose(x, y, wrap(heading + turned), speed)
            box = box_of(replace(ego, x=x, y=y, heading=pose.heading))
            if not any(bool(overlaps(box, other)) for other in others):
                break
        return pose
