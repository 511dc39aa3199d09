"""One encounter of a server: detected, described from the states up to now alone, decided, and attacked.

``run`` takes the unattacked motion from a fork. Here it is forecast (``episode.traffic_forecast``), and forecast again
when the attack begins. Each adversary then replans every half second against what the ego really does.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import combinations

from sumo_adv.config import Settings
from sumo_adv.datatypes import Preventability, Proposal, Track
from sumo_adv.episode.attempt import Driven, apart_of, attack, controller_of
from sumo_adv.episode.encounter_builder import UnattackedMotion, build_encounter
from sumo_adv.episode.encounter_detector import LOOK_INTERVAL_S, EncounterDetector, RankedVehicle
from sumo_adv.episode.situation_builder import build_situation, trigger_state
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.episode.traffic_forecast import apart, traffic_forecast
from sumo_adv.episode.verdict import verdict_of_attackers
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.serve.events import Events, helpers
from sumo_adv.serve.session import EgoLost, Session
from sumo_adv.simulation.network import RoadMap
from sumo_adv.simulation.stage import Stage
from sumo_adv.simulation.sumo_states import Snapshot
from sumo_adv.situation import Situation

REACH_OF_A_VEHICLE_M = 25.0  # between the centres of two vehicles that touch; SUMO's longest trailer truck has 16.5 m

STRAYED = 4.0, 2.5  # m, m/s; the scene has changed if ego or BV is farther from its forecast
EGO_PAUSE_S = 2.0  # how long the ego must be on the road before an encounter
CALM_TIME_S = 2.0  # an encounter must not be dangerous by itself within this time
LOST = "The ego's client was lost or late."


class EncounterMonitor:
    """Looks for encounters in one session every half second."""

    def __init__(self, session: Session, road: RoadMap, settings: Settings, only: tuple[str, ...], warm_up: float):
        """Start to look.

        Args:
            session: The session.
            road: The road network.
            settings: The settings of the run.
            only: The ids of the vehicles that may be adversaries; empty allows all.
            warm_up: How long the ego must at least be on the road [s].
        """
        self._session, self._road, self._settings, self._only = session, road, settings, only
        self._since, session.heights = max(settings.history, EGO_PAUSE_S, warm_up), road.heights
        self._encounter = self._fresh()

    def until_encounter(self, end: float, *, trigger: float | None = None, quiet: float = 0.0) -> list[RankedVehicle]:
        """Step until an encounter begins.

        Args:
            end: The time to stop at [s].
            trigger: The time from which on the encounter begins, whatever the risk [s]; None detects it.
            quiet: How long from now on no encounter may begin [s].

        Returns:
            The possible adversaries, most dangerous first; empty at ``end`` or without traffic.

        Raises:
            ClientGone: The client did not come back in time.
        """
        session, every = self._session, self._settings.steps(LOOK_INTERVAL_S)
        from_here = session.now + quiet
        self._encounter = self._fresh()
        while session.now < end:
            session.hold()
            session.tick()
            ready = session.now >= from_here and session.ready(self._since)
            if not ready:
                self._encounter = self._fresh()
            elif trigger is not None:
                if session.now >= trigger - 1e-6:
                    return self._encounter.rank(session)
            elif session.steps % every == 0 and (ranking := self._encounter.look(session)):
                return ranking
            if session.steps % every == 0 and session.deserted():
                break
        return []

    def until(self, time: float) -> bool:
        """Step until a time.

        Args:
            time: The time [s].

        Returns:
            Whether the ego is on the road then and its client drives it.

        Raises:
            ClientGone: The client did not come (back) in time.
        """
        session = self._session
        while session.now < time - 1e-6:
            session.hold()
            try:
                session.tick()
            except EgoLost:
                return False
        return session.ready(0.0)

    def changed(self, tracks: Mapping[str, Track], bv: str, relation: str) -> str:
        """Say why the scene differs from the predicted one.

        Args:
            tracks: The forecast.
            bv: The id of the adversary.
            relation: Its relation to the ego at the trigger.

        Returns:
            The reason; empty if the scene is as predicted.
        """
        session = self._session
        raw = session.snapshot.raw
        assert session.ego is not None
        for name in (session.ego, bv):
            if name not in raw:
                return f"{name} is gone"
            away, faster = apart(tracks, session.state(name), session.now)
            if away > STRAYED[0] or faster > STRAYED[1]:
                return f"{name} is {away:.1f} m and {faster:.1f} m/s from its predicted position and speed"
        present = {c.id: c.relation for c in EncounterDetector(self._road, len(raw), (bv,)).rank(session)}
        now = present.get(bv, "out of reach")
        return "" if now == relation else f"{bv} is no longer {relation} but {now}"

    def _fresh(self) -> EncounterDetector:
        """Return a detector that has seen nothing."""
        settings = self._settings
        return EncounterDetector(self._road, settings.shortlist, self._only, settings.kind, odd=settings.odd)


@dataclass(frozen=True, slots=True)
class AttackScene:
    """An encounter as it was forecast at its trigger.

    Attributes:
        found: The encounter.
        ranking: The possible adversaries, most dangerous first.
        tracks: The vehicles near, over the last second and as forecast.
    """

    found: FoundEncounter
    ranking: Sequence[RankedVehicle]
    tracks: Mapping[str, Track]

    def relation(self, vehicle: str) -> str:
        """Return a vehicle's relation to the ego; empty if it is not in the ranking.

        Args:
            vehicle: The id of the vehicle.
        """
        return next((c.relation for c in self.ranking if c.id == vehicle), "")


def describe(
    session: Session, road: RoadMap, settings: Settings, ranking: Sequence[RankedVehicle], passed: Sequence[str]
) -> AttackScene | str:
    """Describe the encounter that begins now.

    Args:
        session: The session.
        road: The road network.
        settings: The settings of the run.
        ranking: The possible adversaries, most dangerous first.
        passed: The earlier encounters that were passed over, in words.

    Returns:
        The encounter, or a sentence that says why it is passed over.
    """

    def foresee(seconds: float) -> UnattackedMotion:
        return UnattackedMotion(traffic_forecast(road, session, seconds), (), dict(session.simulation.fleet.sizes))

    built = build_encounter(session, road, settings, ranking, foresee, checked=CALM_TIME_S, passed_over=passed)
    return built if isinstance(built, str) else AttackScene(built[0], tuple(ranking), built[1].tracks)


class LiveAttempts:
    """Runs attempts against a client.

    Attributes:
        session: The current session; None if the encounter did not come back.
        lost: Whether the client was lost in an attempt.
        prefixes: For each attempt, the seconds before the trigger.
    """

    displaces, repeats = False, False  # each attempt is driven by the client

    def __init__(
        self, session: Session, scene: AttackScene, road: RoadMap, settings: Settings, sandbox: Sandbox, events: Events,
        again: Callable[[], Session | None] | None = None,
    ) -> None:  # fmt: skip
        """Prepare attempts.

        Args:
            session: The session of the first attempt.
            scene: The encounter.
            road: The road network.
            settings: The settings of the run.
            sandbox: Runs planners.
            events: Receives what happens.
            again: Brings the same encounter back in a new session, for each attempt after the first; None keeps the
                session.
        """
        self.session: Session | None = session
        self.lost = False
        self.prefixes: list[Sequence[Snapshot]] = []
        self._scene, self._road, self._settings, self._sandbox = scene, road, settings, sandbox
        self._events, self._again = events, again
        self._count = 0

    def attempt(self, proposals: Sequence[Proposal]) -> Iterator[AttemptResult]:
        """Yield the results of attempts, in order. A candidate is driven when its result is requested.

        Args:
            proposals: The candidates.
        """
        for proposal in proposals:
            if self._count and self._again is not None:
                self.session = self._again()
            self._count += 1
            if self.session is None:
                nowhere = Driven("passed", "The encounter did not recur: the ego was elsewhere at that time.")
                self.prefixes.append(())
                yield AttemptResult(nowhere, None, self._scene.found.time)
            else:
                yield self._one(self.session, proposal)

    def references(
        self, proposal: Proposal, result: AttemptResult, known: Mapping[str, str], all_drivers: bool
    ) -> Preventability | None:
        """Return None: other drivers cannot repeat what a live client has driven."""
        return None

    def _one(self, session: Session, proposal: Proposal) -> AttemptResult:
        """Drive one attempt, judge it, and release the adversaries."""
        encounter, settings, bvs = self._scene.found, self._settings, proposal.bvs
        trigger = len(session.recording.snapshots) - settings.steps(session.now - encounter.time)
        self.prefixes.append(session.recording.snapshots[:trigger])
        start, verdict = session.now, None
        session.attended, session.adversaries = True, bvs
        edges = {bv: session.simulation.route(bv)[0] for bv in bvs if bv in session.snapshot.raw}
        try:
            while session.now < encounter.time + proposal.delay - 1e-6 and session.snapshot.raw.keys() >= set(bvs):
                session.tick()
            start = session.now
            driven = self._drive(session, proposal)
            verdict = verdict_of_attackers(session, encounter, settings, trigger, proposal, start, driven)
        except EgoLost:
            driven, self.lost = Driven("ego_lost", LOST), True
        finally:
            session.attended, session.adversaries = False, ()
        result = AttemptResult(
            driven,
            verdict,
            start,
            session.recording.snapshots[trigger:],
            dict(session.simulation.fleet.sizes),
        )
        hits = collided(session, bvs, with_ego=driven.ending == "contact")
        for bv in bvs:
            release_adversary(session, bv, edges.get(bv, ()), self._events, hit=hits.get(bv, ""))
        return result

    def _drive(self, session: Session, proposal: Proposal) -> Driven:
        """Wait for the start of the attack, and attack."""
        situation = self._situation(session, proposal.bvs)
        if situation is None or not situation.targets.keys() >= set(proposal.bvs):
            names = " or ".join([*proposal.bvs, "the ego"])
            return Driven("passed", f"{names} was gone when the attack was to begin.")
        self._events.tell(
            "attack", time=session.now, adversary=proposal.bv, intent=proposal.label, mode=proposal.planner.mode,
            **helpers(proposal),
        )  # fmt: skip
        settings, roads = self._settings, Roads({proposal.delay: situation})
        with ExitStack() as stack:
            members = {}
            for p in proposal.members:
                planner = stack.enter_context(
                    Sessions(self._sandbox, roads, [p], settings.seed, drivable=self._scene.found.drivable)
                )
                limits = settings.limits.of(situation.targets[p.bv].state)
                members[p.bv] = controller_of(situation, p, limits, partial(planner.answer, p))
            return attack(
                session, members, steps=settings.steps(settings.duration), replan=settings.steps(settings.replan)
            )

    def _situation(self, session: Session, bvs: Collection[str]) -> Situation | None:
        """Return the current situation of these adversaries; None if the ego or one of them is gone."""
        raw = session.snapshot.raw
        if session.ego is None or session.ego not in raw or not raw.keys() >= set(bvs):
            return None
        tracks = traffic_forecast(self._road, session, self._settings.duration)
        ranking = [c for c in self._scene.ranking if c.id in bvs]
        trigger = trigger_state(self._road, session, ranking)
        return build_situation(self._road, tracks, trigger, ranking, self._settings)


def collided(session: Session, bvs: Sequence[str], *, with_ego: bool) -> dict[str, str]:
    """Return what each adversary has hit: another adversary, another vehicle or the ego, if their boxes overlap now.

    Args:
        session: The session.
        bvs: The ids of the adversaries.
        with_ego: Whether to check the ego.
    """
    pairs = [(a, b) for a, b in combinations(bvs, 2) if apart_of(session, a, b) == 0.0]
    hits = {name: "another adversary" for pair in pairs for name in pair}
    for bv in bvs:
        if bv in session.snapshot.raw and bv not in hits:
            others = session.near(session.state(bv), REACH_OF_A_VEHICLE_M)
            if any(apart_of(session, bv, other) == 0.0 for other in others if other not in (*bvs, session.ego)):
                hits[bv] = "another vehicle"
    if with_ego and session.ego is not None:
        hits |= {bv: "the ego" for bv in bvs if apart_of(session, session.ego, bv) == 0.0}
    return hits


def release_adversary(session: Session, vehicle: str, edges: Sequence[str], events: Events, *, hit: str = "") -> None:
    """Give an adversary back to SUMO on its old route; remove it if it has hit something or is off the road.

    A vehicle that is released where no lane is leaves the simulation anyway, without an arrival (measured).

    Args:
        session: The session.
        vehicle: The id of the adversary.
        edges: Its old route.
        events: Receives what happens.
        hit: What it has hit; empty for nothing.
    """
    raw = session.snapshot.raw.get(vehicle)
    if raw is None:
        return
    if hit or raw[4] == "":
        session.remove(vehicle)
        how = f"removed: it has hit {hit}" if hit else "removed: it was off the road"
    else:
        session.simulation.moved.release(vehicle)
        session.simulation.set_speed(vehicle, None)
        Stage(session.simulation).direct(vehicle, tuple(edges))
        how = "driven on by SUMO"
    events.tell("released", time=session.now, vehicle=vehicle, how=how)
