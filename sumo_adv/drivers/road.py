"""The road map that a driver sees: lanes, limits, stop lines and right of way near the ego.

All distances called *ahead* are metres along the ego's path from the centre of its box; its front bumper is half its
length nearer. Points are in the world frame [m].
"""

from __future__ import annotations

from dataclasses import dataclass

from sumo_adv.datatypes import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """One lane for cars. Equal only to itself.

    centre: ``(n, 2)`` in its direction of travel; width [m]; limit: the posted one [m/s].
    relation: ``route`` (the ego's path follows it), ``crossing`` (it crosses the path or joins it on a junction), else
    by its direction where it is nearest to the path: ``beside`` (within 45 degrees of the path's), ``oncoming`` (within
    45 degrees of the opposite) or ``crossing``.
    left, right: ids of the next lanes of the same edge, None if there is none. junction: it lies within a junction.
    """

    id: str
    centre: Floats
    width: float
    limit: float
    relation: str
    left: str | None = None
    right: str | None = None
    junction: bool = False

    @property
    def on_route(self) -> bool:
        """Whether the ego's path follows it."""
        return self.relation == "route"


@dataclass(frozen=True, slots=True)
class SpeedLimit:
    """A posted speed limit [m/s] that holds from ``ahead`` [m] on (negative: it holds already)."""

    ahead: float
    speed: float


@dataclass(frozen=True, slots=True)
class StopLine:
    """A line before or on a junction at which the ego's path has a traffic light, or has to give way.

    ahead: to the line [m]. signal: ``green``, ``yellow``, ``red``, or None if there is no light or it is off.
    sign: ``yield`` or ``stop`` where the ego has to give way while the light, if there is one, lets it go; else None.
    must_wait: the ego must not pass the line now (``docs/ego.md`` has the rule).
    """

    ahead: float
    signal: str | None = None
    sign: str | None = None
    must_wait: bool = False


@dataclass(frozen=True, slots=True)
class Conflict:
    """A place on a junction where the ego's path meets another lane.

    ahead [m]; lane: id of the other lane; x, y [m]; ego_yields: vehicles that come on it go first, by signs and lights
    now. joins: the other lane ends there in the lane that the ego enters, else it crosses.
    """

    ahead: float
    lane: str
    x: float
    y: float
    ego_yields: bool
    joins: bool


@dataclass(frozen=True)
class Road:
    """The road at the ego. In a run an attribute is worked out when it is first read in a step, and costs nothing else.

    limit: the fastest that the ego's SUMO type goes here [m/s]: the posted limit times ``speedFactor``, at most
    ``maxSpeed``. sides: centres of the lanes beside the ego's that lead the same way, as offsets from its lane
    [m, left positive], for the next ``until`` metres. width: of the ego's lane [m].
    leaves: the ego's route ends within a few metres, where SUMO will remove it.

    lanes: all lanes for cars within 120 m of the ego. edges: the boundary of the carriageway within 120 m, lines
    ``(n, 2)``. limits, stop_lines, conflicts: on the path within 120 m, nearest first. ``lanes`` and ``edges`` stay the
    same objects until the ego has gone 10 m or its route changes.

    advised: with ``needs_road`` and ``Steer`` alone: the speed [m/s] that SUMO's driver would have chosen in the last
    step, with regard to lights, right of way and leaders; at most the speed that the controller asked for. None while
    the ego stands at a line.
    """

    limit: float
    sides: tuple[float, ...] = ()
    until: float = 0.0
    width: float = 3.2
    advised: float | None = None
    leaves: bool = False
    lanes: tuple[Lane, ...] = ()
    edges: tuple[Floats, ...] = ()
    limits: tuple[SpeedLimit, ...] = ()
    stop_lines: tuple[StopLine, ...] = ()
    conflicts: tuple[Conflict, ...] = ()

    @property
    def must_wait(self) -> bool:
        """Whether the ego must not pass the next stop line now."""
        return bool(self.stop_lines) and self.stop_lines[0].must_wait
