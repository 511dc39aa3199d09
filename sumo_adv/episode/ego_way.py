"""Follow the ego along its way: how far it has come, which of its moves are due, and how far it can see.

Where SUMO drives the ego, SUMO carries out the moves. Another driver reads them in its observation, as a demand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

from sumo_adv.ego_way import CHANGES, TURNS, EgoMove, SightStretch
from sumo_adv.errors import UsageError
from sumo_adv.metrics.reference.sight import SightLimits, limit_at
from sumo_adv.simulation.network import NetworkLane, RoadMap

if TYPE_CHECKING:
    from sumo_adv.episode.drive import Drive

ATTACK_LEAD_S = 4.0  # s before the attacked move from which on an encounter may begin, at the present speed
MIN_LEAD_SPEED_M_S = 2.0  # m/s; a slower ego is as near to its move as at this speed
SLOWING_M_S2 = 2.0  # m/s2; how the ego slows down for a move
STANDING_M_S = 0.1  # m/s; a slower ego stands
STOP_ROOM_M = 1.0  # m; an ego that stands no farther before its place has stopped there
SPEED_TOLERANCE_M_S = 0.1  # m/s; an ego that is so near to a speed has it


@dataclass(slots=True)
class _Stage:
    """How far one move has come.

    Attributes:
        move: The move.
        place: Where it happens [m]; None until a time decides.
        began: When it began [s]; None before.
        speed: The ego's speed then [m/s].
        until: When a stop is over [s]; inf before the ego stands.
        done: Whether it is over.
    """

    move: EgoMove
    place: float | None
    began: float | None = None
    speed: float = 0.0
    until: float = math.inf
    done: bool = False


@dataclass(slots=True)
class EgoWay:
    """Follows one ego in a simulation that was just loaded.

    Attributes:
        road: The map.
        moves: The ego's own moves.
        stretches: The stretches of its way from which it sees less far.
        come: How far its front has come since its departure [m].
        wanted_lane: SUMO's index of the lane to change to now; None without a change.
        wanted_speed: The speed that its moves demand now, at most [m/s]; None without one.
    """

    road: RoadMap
    moves: Sequence[EgoMove]
    stretches: tuple[SightStretch, ...]
    come: float = 0.0
    wanted_lane: int | None = None
    wanted_speed: float | None = None
    _stages: list[_Stage] = field(default_factory=list)
    _time: float = -math.inf  # of the last look [s]
    _front: tuple[float, float] = (0.0, 0.0)
    _target: str = ""  # the lane that the ego changes to
    _slowing: float | None = None  # the speed of now while the ego slows down for a move, or stands [m/s]
    _top: float | None = None  # the speed that a move set for good [m/s]
    _told: tuple[float | None, float | None] = (None, None)  # what SUMO was told last of the two
    _holds_lane: bool = False  # whether SUMO was told to change lanes only for moves and for the route

    @property
    def sight(self) -> float:
        """How far the ego sees along its way now [m]; inf without a limit."""
        return limit_at(self.stretches, self.come)

    def limits(self, drive: Drive) -> SightLimits | None:
        """Return how far the ego sees along its way, from where it is now; None without a limit.

        Args:
            drive: The simulation with the ego.
        """
        self.look(drive)
        return SightLimits(self.stretches, self._time, self.come) if self.stretches else None

    def look(self, drive: Drive) -> None:
        """Note where the ego is now, and which moves are due. The ego must be on the road.

        Args:
            drive: The simulation with the ego.

        Raises:
            UsageError: A move or a stretch does not fit the ego's route.
        """
        if drive.now == self._time or drive.ego is None:
            return
        x, y, _, speed, lane = drive.snapshot.raw[drive.ego]
        if math.isinf(self._time):
            self._begin(drive)
        else:
            self.come += math.dist(self._front, (x, y))
        self._front, self._time = (x, y), drive.now
        self._slowing = None
        for stage in self._stages:
            self._advance(stage, speed)
        speeds = [value for value in (self._slowing, self._top) if value is not None]
        self.wanted_speed = min(speeds, default=None)
        self.wanted_lane = self._wanted_lane(self.road.lanes.get(lane), drive.kind(drive.ego))

    def awaits_move(self, drive: Drive) -> bool:
        """Return whether the attacked move is still too far away for an encounter.

        Args:
            drive: The simulation with the ego.
        """
        self.look(drive)
        stage = next((each for each in self._stages if each.move.attacked), None)
        if stage is None:
            return False
        if stage.move.time is not None:
            return drive.now < stage.move.time - ATTACK_LEAD_S - 1e-6
        assert stage.place is not None and drive.ego is not None
        lead = ATTACK_LEAD_S * max(drive.snapshot.raw[drive.ego][3], MIN_LEAD_SPEED_M_S)
        return self.come < stage.place - lead

    @property
    def missed(self) -> str:
        """A sentence on the attacked move, for runs without an encounter, after a space; empty without such a move."""
        move = next((each for each in self.moves if each.attacked), None)
        if move is None:
            return ""
        return f" No encounter begins more than {ATTACK_LEAD_S:g} s before the ego's move {move.words}."

    def carry_out(self, drive: Drive, asked: float | None = None) -> None:
        """Let SUMO carry out what is due in the step that begins now.

        Args:
            drive: The simulation with the ego.
            asked: The speed that the ego's driver has asked of SUMO for this step [m/s]; None without one.
        """
        assert drive.ego is not None
        simulation, ego = drive.simulation, drive.ego
        if not self._holds_lane and any(move.does in CHANGES for move in self.moves):
            simulation.hold_lane(ego)
            self._holds_lane = True
        if self.wanted_lane is not None:
            simulation.change_lane(ego, self.wanted_lane)
        slowing, top = self._told
        if self._slowing is not None:
            simulation.cap_speed(ego, self._slowing if asked is None else min(self._slowing, asked))
        elif slowing is not None and asked is None:
            simulation.cap_speed(ego, None)
        if self._top is not None and self._top != top and self._slowing is None:
            simulation.set_top_speed(ego, self._top)
            top = self._top
        self._told = self._slowing, top

    def _begin(self, drive: Drive) -> None:
        """Find the places of all moves on the ego's route, and check them."""
        assert drive.ego is not None
        fronts = [s.raw[drive.ego][:2] for s in drive.recording.snapshots if drive.ego in s.raw]
        self.come = sum(math.dist(a, b) for a, b in pairwise(fronts))
        lanes = self._lanes(drive)
        self._stages = [_Stage(move, self._place(k, move, lanes)) for k, move in enumerate(self.moves, start=1)]
        end = lanes[-1][2]
        for stretch in self.stretches:
            if stretch.begin >= end:
                raise UsageError(f"The stretch of sight from {stretch.begin:g} m begins behind the end of the ego's "
                                 f"way, which is {end:.0f} m long.")  # fmt: skip

    def _lanes(self, drive: Drive) -> list[tuple[NetworkLane, float, float]]:
        """Return the lanes of the ego's way with the places where they begin and end [m]."""
        assert drive.ego is not None
        name, road = drive.snapshot.raw[drive.ego][4], self.road
        station = road.lanes[name].station_of(drive.simulation.lane_position(drive.ego))
        ahead = drive.simulation.ahead(drive.ego)
        reach = 2.0 * sum(road.lanes[road.edges[edge][0]].length for edge in ahead if edge in road.edges)
        begin, lanes = self.come - station, []
        for each in road.chain(name, station, reach, ahead, drive.kind(drive.ego)):
            lane = road.lanes[each]
            lanes.append((lane, begin, begin + lane.length))
            begin += lane.length
        return lanes

    def _place(self, k: int, move: EgoMove, lanes: Sequence[tuple[NetworkLane, float, float]]) -> float | None:
        """Return the place of the ``k``-th move [m]; None if a time decides. Raise UsageError if there is none."""
        if move.does in TURNS:
            outside = [each for each in lanes if not each[0].internal]
            for (lane, _, end), (after, *_) in pairwise(outside):
                row = (self.road.lanes[name] for name in self.road.edges[lane.edge])
                if any(c.to == after.id and c.movement == TURNS[move.does] for each in row for c in each.connections):
                    return end
            raise UsageError(f"The ego's route makes no turn for its move {k}, {move.does}: give another route.")
        if move.at is None:
            return None
        end = lanes[-1][2]
        if move.at >= end:
            raise UsageError(f"The ego's move {k}, {move.words}, is behind the end of its way ({end:.0f} m).")
        if move.does in CHANGES:
            edge = next(lane.edge for lane, _, until in lanes if until > move.at and not lane.internal)
            if len([name for name in self.road.edges[edge] if self.road.lanes[name].carriageway]) < 2:
                raise UsageError(
                    f"The ego's move {k}, {move.words}, needs a second lane, which '{edge}' does not have."
                )
        return move.at

    def _advance(self, stage: _Stage, speed: float) -> None:
        """Begin, continue or end one move."""
        move = stage.move
        if stage.done or move.does in TURNS or not self._due(stage, speed):
            return
        if stage.began is None:
            stage.began, stage.speed = self._time, speed
            if stage.place is None:
                stage.place = self.come + speed**2 / (2.0 * SLOWING_M_S2)
            if move.does == "speed":  # it ends the one before
                for other in self._stages:
                    other.done |= other is not stage and other.move.does == "speed" and other.began is not None
        if move.does == "stop":
            self._stop(stage, speed)
        elif move.does == "speed":
            assert move.speed is not None
            slowing = stage.speed - SLOWING_M_S2 * (self._time - stage.began)
            if speed > move.speed + SPEED_TOLERANCE_M_S:
                self._slow_to(max(slowing, move.speed))
            else:
                stage.done, self._top = True, move.speed

    def _due(self, stage: _Stage, speed: float) -> bool:
        """Return whether a move has begun, or begins now."""
        if stage.began is not None:
            return True
        if stage.move.time is not None:
            return self._time >= stage.move.time - 1e-6
        assert stage.place is not None
        room = speed**2 / (2.0 * SLOWING_M_S2) if stage.move.does == "stop" else 0.0
        return self.come >= stage.place - room

    def _stop(self, stage: _Stage, speed: float) -> None:
        """Come to a stop at the place of the move, stand there, and drive on."""
        assert stage.place is not None and stage.move.seconds is not None
        room = stage.place - self.come
        if speed < STANDING_M_S and room < STOP_ROOM_M:
            stage.until = min(stage.until, self._time + stage.move.seconds)
        if self._time >= stage.until - 1e-6:
            stage.done = True
        else:
            self._slow_to(math.sqrt(2.0 * SLOWING_M_S2 * max(room, 0.0)) if math.isinf(stage.until) else 0.0)

    def _slow_to(self, speed: float) -> None:
        self._slowing = speed if self._slowing is None else min(self._slowing, speed)

    def _wanted_lane(self, lane: NetworkLane | None, vclass: str) -> int | None:
        """Return SUMO's index of the lane to change to; None if no change is due, or no such lane is there."""
        if lane is None or lane.internal:
            return None
        changes = (s for s in self._stages if s.move.does in CHANGES and s.began is not None and not s.done)
        for stage in changes:
            if lane.id == self._target:
                stage.done, self._target = True, ""
                continue
            if not self._target or self.road.lanes[self._target].edge != lane.edge:
                self._target = self._beside(lane, CHANGES[stage.move.does], vclass)
            return _index(self._target) if self._target else None
        return None

    def _beside(self, lane: NetworkLane, side: str, vclass: str) -> str:
        """Return the next lane on a side that a vehicle may use; empty if there is none."""
        step = 1 if (side == "left") == (self.road.hand > 0) else -1
        name = f"{lane.edge}_{_index(lane.id) + step}"
        return name if name in self.road.lanes and self.road.lanes[name].allows(vclass) else ""


def _index(lane: str) -> int:
    """Return SUMO's index of a lane."""
    return int(lane.rpartition("_")[2])
