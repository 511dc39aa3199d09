"""What an ego controller sees and what it may answer.

The engine calls ``act`` once a step, before the step is taken; the answer says how the ego moves *during* that step,
that is from ``time`` to ``time + dt``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

from sumo_adv.datatypes import VehicleState


@dataclass(frozen=True, slots=True)
class Road:
    """What the engine knows of the road at the ego, for controllers that say ``needs_road``.

    limit: the fastest it may go there [m/s]. sides: centres of the lanes beside its own that lead the same way, as
    offsets from its own [m, left positive], for the next ``until`` metres. width: of its lane [m]. advised: the speed
    [m/s] that SUMO's driver would have had after the last step, for lights, right of way and whoever is ahead, at most
    what the ego was asked for in it; None before the ego drove itself, and where it stands at a line. held: SUMO's
    rules let it not go on from that line now. leaves: its route ends in these metres, and SUMO is to take it out.
    """

    limit: float
    sides: tuple[float, ...] = ()
    until: float = 0.0
    width: float = 3.2
    advised: float | None = None
    held: bool = False
    leaves: bool = False


@dataclass(frozen=True, slots=True)
class Observation:
    """What the ego's driver sees at ``time`` [s]; the step to come lasts ``dt`` [s].

    ``others``: vehicles within 120 m, box centres in the world frame. ``lane_heading`` [rad] of the ego's own lane and
    ``lane_offset`` [m, left positive] from its centre, and ``path``, the centreline [m] of its lane and route from
    where it is (or some metres before) to at least 60 m ahead, are None where the engine does not know them; so is
    ``road``, unless the controller needs it.
    """

    time: float
    dt: float
    ego: VehicleState
    others: Sequence[VehicleState]
    lane_heading: float | None = None
    lane_offset: float | None = None
    path: Sequence[tuple[float, float]] | None = None
    road: Road | None = None


@dataclass(frozen=True, slots=True)
class Steer:
    """Pedals and wheel: ``acceleration`` [m/s2], ``steering`` [rad], the front wheels' angle, left positive."""

    acceleration: float
    steering: float


@dataclass(frozen=True, slots=True)
class LaneSpeed:
    """SUMO keeps the lane: go to ``lane`` (index from the right; None = stay), be at ``speed`` [m/s] after the step.

    SUMO goes slower than asked where it must (safe distance, red light). The ego can brake harder than the vType's
    ``decel``, up to its ``emergencyDecel``; so does SUMO for what it holds for safe, as long as a speed is asked for.
    """

    lane: int | None
    speed: float


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the box centre [m] is after this step, its heading [rad] and its speed [m/s]."""

    x: float
    y: float
    heading: float
    speed: float


Action: TypeAlias = Steer | LaneSpeed | Pose | None
"""What ``act`` returns; None leaves this step to SUMO."""


class EgoController(Protocol):
    """The driver under test.

    ``sumo_type``: vType attributes with which SUMO drives where the controller does not. ``needs_observation`` False:
    ``act`` is never called. ``forkable`` True: it holds no thread, socket or device, so ``os.fork`` copies it whole.
    """

    @property
    def name(self) -> str:
        """What the reports call it."""
        ...

    @property
    def forkable(self) -> bool:
        """Whether a forked process may go on with it."""
        ...

    @property
    def sumo_type(self) -> Mapping[str, str]:
        """vType attributes, as SUMO spells them."""
        ...

    @property
    def needs_observation(self) -> bool:
        """Whether ``act`` is to be called."""
        ...

    def reset(self, seed: int) -> None:
        """Forget everything; a run begins."""
        ...

    def act(self, observation: Observation) -> Action:
        """What to do in the step that begins at ``observation.time``."""
        ...
