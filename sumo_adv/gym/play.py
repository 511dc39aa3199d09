"""An episode of an environment in the engine's process: the steps that the front requests, from the trigger on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sumo_adv.datatypes import Limits, Proposal, VehicleState, Verdict
from sumo_adv.drivers import Action, LaneSpeed, Observation
from sumo_adv.episode.attempt import (
    AdversaryController,
    Command,
    Driven,
    OngoingAttempt,
    PlannedAdversary,
    apart_of,
    controller_of,
)
from sumo_adv.episode.open_encounter import OpenEncounter
from sumo_adv.episode.verdict import unattacked, verdict_on
from sumo_adv.geometry import Pose, stations
from sumo_adv.gym.actions import controlled, ego_action, endpoint
from sumo_adv.gym.picture import draw_picture
from sumo_adv.gym.rewards import Transition
from sumo_adv.gym.views import SIGHT_M, AgentView, AgentWatch, Viewing, ViewOfAdversary, view_of_ego
from sumo_adv.planners.answers import Answer, AskOne, PlannerObservation
from sumo_adv.planners.sessions import ask_trusted
from sumo_adv.situation import Target

Numbers = NDArray[Any]
DRAW_REQUEST = "draw"  # the message with which the front requests a picture
ENDED_BY_CONTACT, ENDED_BY_THIRD_PARTY, ENDED_OFF_ROAD = "contact", "third_party", "off_road"
CONTACT_SEARCH_RADIUS_M = 25.0  # between centres; vehicles farther apart do not touch, not even long ones
STEERED = "controls"  # the actions with which an ego may leave its lane
FOLLOWER_GAP_M = 30.0  # a vehicle that is at most this far behind follows the ego
TERMINATED = frozenset({ENDED_BY_CONTACT, ENDED_BY_THIRD_PARTY, ENDED_OFF_ROAD})


@dataclass(frozen=True, slots=True)
class AgentStep:
    """An episode after a step.

    Attributes:
        time: The simulated time [s].
        views: What each agent observes, by agent.
        transition: The step.
    """

    time: float
    views: Mapping[str, AgentView]
    transition: Transition


@dataclass(frozen=True, slots=True)
class Play:
    """One episode. The engine calls it before it forks.

    Attributes:
        viewing: What observations hold.
        every: The number of simulation steps in a step of the environment.
        ego: The kind of the ego's actions; None if no agent drives it.
        adversary: The kind of the adversary's actions; None if no agent drives it.
        proposal: The attack of an episode without an adversary agent; None if there is none.
        bv: The id of the adversary; None without an attack.
        delay: The time from the trigger to the attack [s].
    """

    viewing: Viewing
    every: int
    ego: str | None = None
    adversary: str | None = None
    proposal: Proposal | None = None
    bv: str | None = None
    delay: float = 0.0

    def __call__(self, here: OpenEncounter, dialogue: Connection, ask_front: AskOne) -> Callable[[], None]:
        """Return a function that makes the steps that the front requests, until it sends None.

        The planner's text is read here already.

        Args:
            here: The encounter.
            dialogue: The connection to the front.
            ask_front: Has the front ask a planner.
        """
        ask = None
        if self.proposal is not None:
            ask = ask_trusted(self.proposal, here.found.situations[self.delay], ask_front)
        return partial(self._talk, here, dialogue, ask)

    def _talk(self, here: OpenEncounter, dialogue: Connection, ask: AskOne | None) -> None:
        """Make the steps that the front requests."""
        playing = Playing(self, here, ask)
        dialogue.send(playing.moment())
        while (message := dialogue.recv()) is not None:
            dialogue.send(playing.picture() if message == DRAW_REQUEST else playing.step(message))


class Playing:
    """An episode in progress."""

    def __init__(self, play: Play, here: OpenEncounter, ask: AskOne | None) -> None:
        """Start at the trigger.

        Args:
            play: The episode.
            here: The encounter.
            ask: Asks the planner of the attack; None without one.
        """
        assert here.drive.ego is not None
        self._ask = ask
        self._play, self._here, self._drive = play, here, here.drive
        self._ego, self._dt = here.drive.ego, here.settings.step_length
        self._waits = here.settings.steps(play.delay)  # steps until the attack begins
        self._left = here.drive.within(self._waits + here.settings.steps(here.settings.duration))
        self._attempt: OngoingAttempt | None = None
        self._start = here.drive.now
        self._me = here.drive.state(self._ego)  # its current or last state
        self._pace, self._driven, self._behind = RealTimePace(here), 0.0, 0.0
        self._watch = AgentWatch() if play.viewing.danger and play.ego is not None else None
        self._every_step = play.ego == STEERED or self._watch is not None
        self._seen = self._look() if self._every_step else None
        self._actions: Mapping[str, Numbers] = {}
        self._ending = ""
        self._touched: str | None = None
        self._off_road: str | None = None
        self._view = None if play.adversary is None else ViewOfAdversary(self._target(), play.viewing.vehicles)
        self._views: dict[str, AgentView] = {}
        self._apart = self._distance()
        self._transition = Transition(
            0.0, self._me, self._me, self._there(play.bv), self._limit(), self._apart, self._apart, None, None
        )  # fmt: skip

    def _target(self) -> Target:
        """Return the adversary at the start of the attack."""
        assert self._play.bv is not None
        return self._here.found.situations[self._play.delay].targets[self._play.bv]

    def _look(self) -> Observation:
        """Return what the ego's driver sees."""
        seen = self._drive.observation()
        if self._watch is not None:
            self._watch.step(seen)
        return seen

    # -- requests of the front ----------------------------------------------------------------------------------

    def step(self, actions: Mapping[str, Numbers]) -> AgentStep:
        """Make one step of the environment: ``every`` steps of the simulation, fewer if the episode ends before.

        Args:
            actions: The action of each agent.
        """
        self._actions, before, apart, began = actions, self._me, self._apart, self._drive.now
        behind = self._behind
        for _ in range(self._play.every):
            if self._ending:
                break
            self._advance()
        self._apart = self._distance()
        verdict = self._verdict() if self._ending and self._attempt is not None else None
        unattacked, speed = self._pace.at(self._drive.now)
        self._behind = max(unattacked - self._driven, 0.0)
        self._transition = Transition(
            self._drive.now - began, self._there(self._ego), before, self._there(self._play.bv), self._limit(),
            self._apart, apart, self._touched, self._off_road, self._ending, verdict, self._behind, behind, speed,
            self._play.bv is not None, self._followed(), self._delta_v(verdict),
        )  # fmt: skip
        return self.moment()

    def moment(self) -> AgentStep:
        """Return the current moment. A vehicle that is gone keeps its last view."""
        ego, bv = self._there(self._ego), self._there(self._play.bv)
        if self._play.ego is not None and ego is not None:
            seen = self._drive.observation() if self._seen is None else self._seen
            self._views["ego"] = view_of_ego(seen, self._play.viewing.vehicles, self._watch)
        if self._view is not None and bv is not None and ego is not None:
            near = self._drive.near(bv, SIGHT_M)
            others = [self._drive.state(name) for name in near if name != self._ego]
            self._views["adversary"] = self._view(bv, ego, others)
        return AgentStep(self._drive.now, dict(self._views), self._transition)

    def picture(self) -> NDArray[np.uint8]:
        """Return a picture of the road and the vehicles around the ego, from above."""
        return draw_picture(self._here.road, self._drive, self._ego, self._play.bv, self._me)

    # -- a step of the simulation -------------------------------------------------------------------------------

    def _advance(self) -> None:
        """Make one step of the simulation."""
        if self._play.bv is None or self._waits > 0:
            self._waits -= 1
            self._drive.tick(None, self._ego_action())
        else:
            self._attack()
        self._left -= 1
        if self._ego in self._drive.snapshot.raw:
            me = self._drive.state(self._ego)
            self._driven += math.hypot(me.x - self._me.x, me.y - self._me.y)
            self._me = me
            if self._every_step:  # keeps the route of an ego that leaves its lane, and the watched state
                self._seen = self._look()
        self._end()

    def _attack(self) -> None:
        """Make one step of the attack."""
        bv, settings = self._play.bv, self._here.settings
        assert bv is not None
        if self._attempt is None:
            self._start = self._drive.now
            replan = self._play.every if self._play.proposal is None else settings.steps(settings.replan)
            controllers = {bv: self._controller()}
            self._attempt = OngoingAttempt(self._drive, controllers, steps=max(self._left, 1), replan=replan)
        poses: dict[str, Pose] = {}
        me = self._there(bv)
        if self._play.adversary == "controls" and me is not None:
            fastest = self._target().fastest
            poses[bv] = controlled(self._actions["adversary"], me, self._limits(), fastest, self._dt)
        self._attempt.step(Command(poses, self._ego_action()))

    def _limits(self) -> Limits:
        """Return the limits of the adversary, which depend on its kind of road user."""
        return self._here.settings.limits.of(self._target().state)

    def _controller(self) -> AdversaryController | None:
        """Return what drives the adversary; None if the agent's controls do."""
        play, here = self._play, self._here
        situation, limits = here.found.situations[play.delay], self._limits()
        if play.proposal is not None and self._ask is not None:
            return controller_of(situation, play.proposal, limits, self._ask)
        assert play.bv is not None
        return PlannedAdversary(situation, play.bv, limits, self._endpoint) if play.adversary == "endpoint" else None

    def _endpoint(self, observation: PlannerObservation) -> Answer:
        """Return the endpoint that the agent chose."""
        assert self._view is not None and self._play.bv is not None
        me = self._drive.state(self._play.bv)
        station, _ = self._view.way.project(me.x, me.y, near=self._view.station)
        return Answer(endpoint(self._actions["adversary"], self._view.way, station, self._target().fastest))

    def _ego_action(self) -> Action:
        """Return the ego's action; a lane that does not exist is ignored."""
        if self._play.ego is None or self._ego not in self._drive.snapshot.raw:
            return None
        me = self._drive.state(self._ego)
        action = ego_action(self._play.ego, self._actions["ego"], me, self._limit(), self._dt)
        if isinstance(action, LaneSpeed) and action.lane is not None:
            edge = me.lane.rpartition("_")[0]
            if f"{edge}_{action.lane}" not in self._here.road.lanes:
                return LaneSpeed(None, action.speed)
        return action

    def _end(self) -> None:
        """Record how the episode has ended, if it has."""
        driven = None if self._attempt is None else self._attempt.state.driven
        ego, bv = self._there(self._ego), self._there(self._play.bv)
        self._touched = self._touching(ego)
        led = ((self._play.ego, ego), (self._play.adversary, bv))
        agents = [v for kind, v in led if kind is not None and v is not None]
        off = [v for v in agents if self._is_off_road(v)]
        if self._touched is not None:
            self._ending = ENDED_BY_CONTACT
        elif self._play.adversary is not None and bv is not None and self._touching(bv) is not None:
            self._ending = ENDED_BY_THIRD_PARTY
        elif off:
            self._ending, self._off_road = ENDED_OFF_ROAD, off[0].id
        elif driven is not None:
            self._ending = driven.ending
        elif ego is None:
            self._ending = "ego_left"
        elif self._left <= 0:
            self._ending = "time_limit"

    def _is_off_road(self, v: VehicleState) -> bool:
        """Return whether the centre is off the road or, where the road's area is unknown, in no lane."""
        encounter = self._here.found
        x, y, radius = encounter.area
        if math.hypot(v.x - x, v.y - y) > radius:
            return v.lane == ""
        return not encounter.drivable(np.array([v.x]), np.array([v.y]))[0]

    def _touching(self, me: VehicleState | None) -> str | None:
        """Return a vehicle that ``me`` touches."""
        near = () if me is None else self._drive.near(me, CONTACT_SEARCH_RADIUS_M)
        return next((name for name in near if me is not None and apart_of(self._drive, me.id, name) == 0.0), None)

    # -- facts --------------------------------------------------------------------------------------------------

    def _there(self, name: str | None) -> VehicleState | None:
        """Return the state of a vehicle; None if it is gone."""
        return self._drive.state(name) if name is not None and name in self._drive.snapshot.raw else None

    def _distance(self) -> float:
        """Return the distance of ego and adversary [m]."""
        if self._attempt is not None and self._play.bv is not None:
            return self._attempt.state.apart[self._play.bv]
        ego, bv = self._there(self._ego), self._there(self._play.bv)
        return math.inf if ego is None or bv is None else math.hypot(ego.x - bv.x, ego.y - bv.y)

    def _limit(self) -> float:
        """Return the speed limit at the ego [m/s]."""
        if self._ego not in self._drive.snapshot.raw:
            return self._transition.limit
        return self._drive.simulation.limit(self._ego)

    def _followed(self) -> bool:
        """Return whether a vehicle in the ego's lane is close behind it."""
        me = self._there(self._ego)
        if me is None or not me.lane:
            return False
        near = (self._drive.state(name) for name in self._drive.near(me, FOLLOWER_GAP_M))
        ahead = math.cos(me.heading), math.sin(me.heading)
        return any(v.lane == me.lane and (v.x - me.x) * ahead[0] + (v.y - me.y) * ahead[1] < 0 for v in near)

    def _delta_v(self, verdict: Verdict | None) -> float:
        """Return the ego's delta-v by the contact [m/s].

        If the other vehicle is not the adversary, it is that of two equal masses that stick together.
        """
        touched = self._there(self._touched)
        if touched is None:
            return 0.0
        if verdict is not None and verdict.delta_v is not None and self._touched == self._play.bv:
            return verdict.delta_v
        me = self._me
        x = me.speed * math.cos(me.heading) - touched.speed * math.cos(touched.heading)
        y = me.speed * math.sin(me.heading) - touched.speed * math.sin(touched.heading)
        return math.hypot(x, y) / 2

    def _verdict(self) -> Verdict | None:
        """Return the verdict on the attack, as on any attempt."""
        here = self._here
        assert self._attempt is not None and self._play.bv is not None
        driven = self._attempt.state.driven or Driven("time_limit")
        return verdict_on(
            self._drive, here.found, here.settings, here.trigger_step, (self._play.bv,), self._start, driven
        )  # fmt: skip


class RealTimePace:
    """How far and how fast the ego drives in the encounter without an attack. After the recording ends, it keeps its
    speed.
    """

    def __init__(self, here: OpenEncounter) -> None:
        """Read the unattacked motion of an encounter.

        Args:
            here: The encounter.
        """
        me, track = here.drive.state(here.found.ego), unattacked(here.found, here.settings)
        self._time, self._speed, x, y = (np.array([v]) for v in (here.drive.now, me.speed, me.x, me.y))
        if track is not None:  # otherwise the motion was only forecast
            self._time, self._speed = np.append(self._time, track.time), np.append(self._speed, track.speed)
            x, y = np.append(x, track.x), np.append(y, track.y)
        self._driven = stations(x, y)

    def at(self, time: float) -> tuple[float, float]:
        """Return the distance driven since the trigger [m] and the speed [m/s].

        Args:
            time: The time [s].
        """
        speed = float(np.interp(time, self._time, self._speed))
        beyond = max(time - float(self._time[-1]), 0.0) * speed
        return float(np.interp(time, self._time, self._driven)) + beyond, speed
