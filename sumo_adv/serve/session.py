"""One simulation that a client shares with the server: it is stepped, paced and recorded, and always has an ego.

The server is SUMO's first client, the gate is the second, and there is no third. In a step, the server has its turn,
then the ego's client, and then SUMO moves. While one of the two waits (the server for the client, or the client for a
decision of the server), simulated time stands, unless ``real_time`` is set.
"""

from __future__ import annotations

import math
import socket
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from sumo_adv.drivers import Action, ExternalEgo
from sumo_adv.episode.drive import Drive
from sumo_adv.errors import SimulationError
from sumo_adv.geometry import Pose
from sumo_adv.serve import OnLoss, Options
from sumo_adv.serve.events import Events
from sumo_adv.serve.gate import SHARED_SUMO_TIMEOUT_S, STOP_POLL_PERIOD_S, Gate
from sumo_adv.serve.policy import OUR_PREFIX
from sumo_adv.serve.seat import Stepper
from sumo_adv.serve.sumo_process import StrangerError, SumoProcess
from sumo_adv.simulation.inputs import EgoRoute
from sumo_adv.simulation.remote import Remote
from sumo_adv.simulation.simulation_spec import SimulationSpec
from sumo_adv.simulation.sumo_states import Snapshot, pose_of

if TYPE_CHECKING:
    from traci.connection import Connection


OUR_ORDER = 1
MAX_SUMO_STARTS = 5  # maximum number of starts of SUMO if other programs connect to its port first
KEPT_STATES_S = 15.0  # how long states are kept while nothing happens
STAND_IN_BRAKING_M_S2 = 4.5
CLIENT_GRACE_S = 10.0  # how long the simulation continues without its client; with ``real_time`` it never waits
MIN_SPEED_CORRECTION_M_S, MAX_CREDIBLE_SPEED_M_S = (
    1.0,
    80.0,
)  # SUMO's speed is corrected if it differs by the first or more; a speed above the second is a jump


def shared_sumo(
    arguments: Sequence[str], gate: Gate, *, own: Collection[str], kept: Collection[str], events: Events,
    private: bool = True,
) -> tuple[SumoProcess, Connection]:  # fmt: skip
    """Start SUMO, and connect the gate and the server to it.

    Args:
        arguments: The arguments of SUMO.
        gate: The gate.
        own: The vehicles that the client may set.
        kept: Those of them that it neither adds nor removes.
        events: Receives what happens.
        private: Whether only this program connects to SUMO (``SumoProcess``).

    Returns:
        SUMO, and the server's connection to it.

    Raises:
        SimulationError: SUMO does not start, or other programs always connect first.
        UsageError: SUMO is not installed.
    """
    for tries in range(1, MAX_SUMO_STARTS + 1):
        sumo = SumoProcess(arguments, private=private)
        try:
            gate.attach(sumo, own=own, kept=kept)
            return sumo, connect(sumo)
        except StrangerError as error:
            gate.detach(keep=True)
            sumo.close()
            events.tell("stranger", tries=tries, sentence=f"{error} SUMO is restarted.")
        except BaseException:
            gate.detach()
            sumo.close()
            raise
    raise SimulationError(
        f"Another program connected to SUMO's port first, {MAX_SUMO_STARTS} times in a row: end it, or run this in a "
        "container."
    )


def connect(sumo: SumoProcess) -> Connection:
    """Make the server's own connection, the first in order.

    Args:
        sumo: The running SUMO.

    Raises:
        StrangerError: Another program connected to SUMO first.
        SimulationError: SUMO does not accept the connection.
    """
    import traci

    try:
        with socket.create_server(("127.0.0.1", 0)) as nobody:  # traci connects by itself and accepts no socket
            connection = traci.connect(nobody.getsockname()[1], numRetries=0, host="127.0.0.1")
        connection._socket.close()
        connection._socket = sumo.dial(SHARED_SUMO_TIMEOUT_S)
        connection._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setOrder(OUR_ORDER)
    except (traci.TraCIException, traci.FatalTraCIError, OSError) as error:
        raise SimulationError(f"SUMO did not take our connection ({sumo.last_error or error}).") from error
    return connection


class EgoLost(Exception):
    """The client is gone or late, and it was needed."""


class ClientGone(Exception):
    """The client did not come (back) in time."""


@dataclass(frozen=True, slots=True)
class EgoPlan:
    """The vehicle under test.

    Attributes:
        id: Its id.
        type: Its vehicle type.
        next_route: Returns the route of the next departure. None if the demand has the vehicle, or if the client adds
            it.
        warm_up: How long the traffic runs before it departs [s].
        added: Whether the client adds the vehicle and moves it as it likes.
    """

    id: str
    type: str
    next_route: Callable[[], EgoRoute] | None = None
    warm_up: float = 0.0
    added: bool = False


@dataclass(slots=True)
class SessionPace:
    """Keeps simulated time in step with the clock.

    Attributes:
        step: The step length [s].
        slips: How often simulated time was more than a second late.
    """

    step: float
    slips: int = 0
    _next: float | None = None

    def wait(self) -> None:
        """Wait until the next step is due."""
        now = time.monotonic()
        due = now if self._next is None else self._next
        if due > now:
            time.sleep(due - now)
        elif now - due > 1.0:
            self.slips += 1
            due = now
        self._next = due + self.step


class Session(Drive):
    """A drive in which a client drives the ego.

    Attributes:
        attended: Whether the client is needed, so that its loss raises EgoLost.
        adversaries: The ids of the vehicles that an attempt moves.
        away: Whether the client is absent or late.
        away_since: Since when the client has been away [s].
        steps: The number of steps so far.
        present_since: Since when the ego has been on the road [s]; None if it is not.
        pace: Keeps simulated time in step with the clock; None without ``real_time``.
    """

    def __init__(
        self, spec: SimulationSpec, gate: Gate, options: Options, ego: EgoPlan, events: Events,
        check: Callable[[], None],
    ) -> None:  # fmt: skip
        """Start SUMO behind the gate.

        Args:
            spec: The simulation.
            gate: The gate.
            options: The options of the server.
            ego: The vehicle under test.
            events: Receives what happens.
            check: Called every step; it may raise.

        Raises:
            SimulationError: SUMO does not start.
            UsageError: SUMO is not installed.
        """
        self._gate, self._options, self._plan, self._events, self._check = gate, options, ego, events, check
        kept = () if ego.added else (ego.id,)
        self._sumo, connection = shared_sumo(spec.arguments(), gate, own=(ego.id,), kept=kept, events=events)
        try:
            super().__init__(spec, ExternalEgo(), spec.seed, Remote(connection))
        except BaseException:
            gate.detach()
            self._sumo.close()
            raise
        if ego.added:
            self.simulation.unrouted = frozenset({ego.id})
        self.attended = False
        self.adversaries: Sequence[str] = ()
        self.away = True
        self.away_since = spec.begin
        self.steps = 0
        self.present_since: float | None = None
        self.pace = SessionPace(spec.step_length) if options.real_time else None
        self._again: tuple[EgoRoute, str] | None = None  # route and type of an ego of the demand
        self._departures, self._pending = 0, ego.next_route is None
        self._first = spec.begin + ego.warm_up
        self._owners: tuple[object, ...] = ()
        events.tell("simulation", state="started", time=spec.begin, seed=spec.seed, network=spec.network.name)

    # -- stepping -----------------------------------------------------------------------------------------------

    def tick(self, poses: Mapping[str, Pose] | None = None, ego: Action = None) -> Snapshot:
        """Make one step of all vehicles.

        Args:
            poses: The poses of vehicles that are moved.
            ego: The ego's action.

        Raises:
            EgoLost: The client did not make this step, and ``attended`` is set.
            SimulationError: SUMO ended.
        """
        self._check()
        if self.pace is not None:
            self.pace.wait()
        self._depart()
        if self.away:
            self._stand_in()
        snapshot = self._with_true_speed(super().tick(poses, ego))
        self.steps += 1
        self._look_for_ego(snapshot)
        if not self.attended:
            self._forget()
        self._look_for_client()
        return snapshot

    def hold(self) -> None:
        """Wait between encounters for a client that has been away for a while.

        Raises:
            ClientGone: The client does not come within ``patience``.
        """
        if self._gate.connected or (
            self.steps and (self.pace is not None or self.now - self.away_since < CLIENT_GRACE_S)
        ):
            return
        patience = self._options.patience
        until = None if patience is None else time.monotonic() + patience
        while not self._gate.wait_connected(STOP_POLL_PERIOD_S):
            self._check()
            if until is not None and time.monotonic() > until:
                raise ClientGone
        if self.pace is not None:
            self.pace = SessionPace(self.spec.step_length)

    def ready(self, since: float) -> bool:
        """Return whether an encounter may begin: the ego has been on the road long enough, and its client drives it.

        Args:
            since: How long the ego must have been on the road [s].
        """
        return self.present_since is not None and not self.away and self.now - self.present_since >= since

    def close(self, *, clean: bool = True) -> None:
        """End SUMO.

        Args:
            clean: Whether the client's call is answered before its connection is closed. If not, SUMO is killed at
                once.
        """
        self._gate.detach()
        assert self.simulation.remote is not None
        self.simulation.remote.close() if clean else self.simulation.remote.drop()
        self._sumo.close(2.0 if clean else 0.0)
        self._events.tell(
            "simulation", state="ended", time=self.now, seed=self.spec.seed, steps=self.steps,
            client_steps=self._gate.client_steps,
        )  # fmt: skip

    def deserted(self) -> bool:
        """Return whether no vehicle except the ego is on the road or still expected."""
        return self.simulation.expected() <= (self.present_since is not None or self._pending)

    def remove(self, vehicle: str) -> None:
        """Remove a vehicle, and end the client's subscription to it; otherwise every later step of SUMO would fail.

        Args:
            vehicle: The id of the vehicle.
        """
        for end in (self.simulation.api.vehicle.unsubscribe, self.simulation.api.vehicle.remove):
            with suppress(*self.simulation.errors):
                end(vehicle)

    @property
    def spec(self) -> SimulationSpec:
        """The simulation."""
        return self.simulation.spec

    # -- the ego ------------------------------------------------------------------------------------------------

    def _depart(self) -> None:
        """Insert the ego if it is neither on the road nor about to be."""
        if self.present_since is not None or self._pending or self.now < self._first:
            return
        route, kind = (self._plan.next_route(), self._plan.type) if self._plan.next_route else self._again or (None, "")
        if route is None:
            return
        depart = {
            "depart": repr(max(route.depart, self.now)), "departLane": str(route.lane),
            "departPos": str(route.position), "departSpeed": str(route.speed),
        }  # fmt: skip
        name = f"{OUR_PREFIX}{self._plan.id}.route.{self._departures}"
        self.simulation.add(self._plan.id, route.edges, kind, depart, route=name)
        self._departures, self._pending = self._departures + 1, True

    def _with_true_speed(self, snapshot: Snapshot) -> Snapshot:
        """Correct the ego's speed by the distance that it moved in the step.

        SUMO's speed of a vehicle that its client moves by ``moveToXY`` alone is wrong (measured).
        """
        snapshots, name = self.recording.snapshots, self._plan.id
        if len(snapshots) < 2 or name not in snapshot.raw or name not in snapshots[-2].raw:
            return snapshot
        raw, length = snapshot.raw[name], self.simulation.fleet.sizes[name][0]
        (x, y, _), (x_before, y_before, _) = pose_of(raw, length), pose_of(snapshots[-2].raw[name], length)
        went = math.hypot(x - x_before, y - y_before) / self.spec.step_length
        if abs(went - raw[3]) < MIN_SPEED_CORRECTION_M_S or went > MAX_CREDIBLE_SPEED_M_S:
            return snapshot
        snapshots[-1] = replace(snapshot, raw={**snapshot.raw, name: (*raw[:3], went, raw[4])})
        return snapshots[-1]

    def _look_for_ego(self, snapshot: Snapshot) -> None:
        """Notice that the ego has departed or left."""
        name = self._plan.id
        if name in snapshot.raw and self.present_since is None:
            self.present_since, self._pending = self.now, False
            self.take_over(name)
            if self._plan.next_route is None and self._again is None and not self._plan.added:
                kind = str(self.simulation.api.vehicle.getTypeID(name))
                self._again = EgoRoute(self.simulation.route(name)[0], 0.0), kind
            self._events.tell("ego", state="departed", id=name, time=self.now)
        elif name not in snapshot.raw and self.present_since is not None:
            self.present_since = None
            self._events.tell("ego", state="left", id=name, time=self.now)
        self._tell_owners(snapshot)

    def _tell_owners(self, snapshot: Snapshot) -> None:
        """Report who drives which vehicles, if that has changed."""
        here = self.present_since is not None
        client = (self._plan.id,) if here and not self.away else ()
        ours = tuple(name for name in self.adversaries if name in snapshot.raw)
        if (client, ours) != self._owners:
            self._owners = (client, ours)
            others = len(snapshot.raw) - len(client) - len(ours)
            self._events.tell("owners", time=self.now, client=list(client), adversary=list(ours), sumo=others)

    # -- the client ---------------------------------------------------------------------------------------------

    def _look_for_client(self) -> None:
        """Notice that the client has come or gone."""
        away = self._gate.stepped_by is not Stepper.CLIENT
        if away == self.away:
            return
        self.away = away
        if away:
            self.away_since = self.now
            if self._options.on_loss is OnLoss.SUMO and self.present_since is not None:
                self.simulation.set_speed(self._plan.id, None)
            if self.attended or self._options.on_loss is OnLoss.END:
                raise EgoLost
        elif self._options.on_loss is OnLoss.BRAKE and self.present_since is not None:
            self.simulation.set_speed(self._plan.id, None)

    def _stand_in(self) -> None:
        """Brake the ego of an absent client, if ``on_loss`` is brake."""
        if self.steps and self._options.on_loss is OnLoss.BRAKE and self.present_since is not None:
            speed = self.snapshot.raw[self._plan.id][3] - STAND_IN_BRAKING_M_S2 * self.spec.step_length
            self.simulation.set_speed(self._plan.id, speed)

    # -- memory -------------------------------------------------------------------------------------------------

    def _forget(self) -> None:
        """Keep only the last seconds, and the sizes of the vehicles in them."""
        kept = round(KEPT_STATES_S / self.spec.step_length)
        if len(self.recording.snapshots) >= 2 * kept:
            self.recording.forget(kept)
            self.simulation.fleet.forget({name for s in self.recording.snapshots for name in s.raw})
