"""What an ego controller gets, and what it may answer.

Before each step of the simulation, ``act`` gets an ``Observation``. Its answer says how the ego moves during that step,
from ``time`` to ``time + dt``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

from sumo_adv.datatypes import DriverModel, VehicleState
from sumo_adv.drivers.road import Road
from sumo_adv.geometry import Pose


@dataclass(frozen=True, slots=True)
class Observation:
    """What the driver sees at ``time`` [s, of the simulation]; the step to come lasts ``dt`` [s].

    others: vehicles within 120 m, box centres in the world frame; in a run each is a ``Vehicle``. lane_heading: of the
    ego's lane at the ego [rad]. lane_offset: of the ego's centre from the lane's centre [m, left positive]. path:
    points [m] on the centreline of the ego's lane and route, from the ego (or a few metres before) to at least 60 m
    ahead. road: the map at the ego. These four are None where they are not known, as off the road. ``road`` and each
    ``Vehicle`` must be read in the ``act`` that got them: later an attribute that was not read yet is refused.
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
    """Pedals and wheel: ``acceleration`` [m/s2]; ``steering``: angle of the front wheels [rad, left positive]."""

    acceleration: float
    steering: float


@dataclass(frozen=True, slots=True)
class LaneSpeed:
    """SUMO keeps the lane. ``lane``: the lane to change to (SUMO's index: from the right, in left-hand traffic from the
    left; None = stay); ``speed``: after the step [m/s].

    SUMO goes slower than asked where its rules demand it (safe distance, red light). The ego can brake harder than its
    vType's ``decel``, up to ``emergencyDecel``. While a speed is asked for, SUMO's own rules may use
    ``emergencyDecel``, too.
    """

    lane: int | None
    speed: float


Action: TypeAlias = Steer | LaneSpeed | Pose | None
"""What ``act`` returns: the ego's motion, or its ``Pose`` after the step. None leaves this step to SUMO."""


class EgoController(Protocol):
    """The driver under test.

    A driver may also have ``wishes`` (see ``wishes.py``) and ``model_of`` (see the function ``model_of``).
    """

    @property
    def name(self) -> str:
        """What reports call it."""
        ...

    @property
    def forkable(self) -> bool:
        """Whether ``os.fork`` copies it whole, because it holds no thread, socket or device."""
        ...

    @property
    def sumo_type(self) -> Mapping[str, str]:
        """vType attributes, as SUMO spells them. SUMO drives with them where the controller does not."""
        ...

    @property
    def needs_observation(self) -> bool:
        """If False, ``act`` is never called."""
        ...

    def reset(self, seed: int) -> None:
        """Forget everything; a run begins."""
        ...

    def act(self, observation: Observation) -> Action:
        """The action for the step that begins at ``observation.time``."""
        ...


def model_of(driver: Any, numbers: DriverModel) -> DriverModel:
    """How a driver is predicted: its own ``model_of(numbers)``, or ``numbers`` if it has no such method.

    ``numbers``: an unknown driver with the ego's car-following numbers in SUMO (``Simulation.model``).
    """
    own = getattr(driver, "model_of", None)
    return numbers if own is None else own(numbers)
