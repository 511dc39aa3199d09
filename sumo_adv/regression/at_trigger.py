"""The positions and speeds of ego and adversary when a kept attack begins, and whether another ego arrives differently.

The numbers of an attack fit one situation. An ego that is slower or nearer meets another situation, so the numbers are
adapted to it, as in a film at another scale and speed. Lengths are scaled by the ratio of the gaps, and speeds by the
ratio of the ego's speeds. The factors of times and accelerations follow from these two.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from sumo_adv.datatypes import Boxes, Proposal, VehicleState
from sumo_adv.geometry import Frame
from sumo_adv.metrics.boxes import gap

OTHER_SPEED_SHARE, OTHER_GAP_SHARE = 0.15, 0.30  # of the kept values; above these, arrivals differ
MIN_SPEED_DIFFERENCE_M_S, MIN_GAP_DIFFERENCE_M = 0.5, 2.0  # never count smaller differences
MAX_SCALE = 3.0  # maximum factor by which lengths and speeds are scaled


@dataclass(frozen=True, slots=True)
class AtTrigger:
    """The ego and the adversary when the adversary is taken over.

    Attributes:
        ego_speed: The ego's speed [m/s].
        gap: The distance between the two boxes [m].
        x: How far the adversary's centre is ahead of the ego's [m].
        y: How far the adversary's centre is to the left of the ego's [m].
        heading: The adversary's heading relative to the ego's [rad].
        adversary_speed: The adversary's speed [m/s].
    """

    ego_speed: float
    gap: float
    x: float
    y: float
    heading: float
    adversary_speed: float

    @classmethod
    def of(cls, ego: VehicleState, adversary: VehicleState) -> AtTrigger:
        """Compare the states of both at the same time.

        Args:
            ego: The ego's state.
            adversary: The adversary's state.
        """
        here = Frame(ego.x, ego.y, ego.heading).to_local(adversary.x, adversary.y, adversary.heading)
        numbers = (ego.speed, float(gap(_box(ego), _box(adversary))), *here, adversary.speed)
        return cls(*(round(float(number), 3) for number in numbers))

    def as_data(self) -> dict[str, float]:
        """Return the numbers by name."""
        return asdict(self)

    def difference(self, arrived: AtTrigger) -> str:
        """Say how an ego arrives differently from this situation.

        Args:
            arrived: The situation that the ego arrived in.

        Returns:
            The difference in words; empty if there is none.
        """
        said = []
        if _differs(self.ego_speed, arrived.ego_speed, OTHER_SPEED_SHARE, MIN_SPEED_DIFFERENCE_M_S):
            said.append(f"at {arrived.ego_speed:.1f} m/s instead of {self.ego_speed:.1f} m/s")
        if _differs(self.gap, arrived.gap, OTHER_GAP_SHARE, MIN_GAP_DIFFERENCE_M):
            said.append(f"{arrived.gap:.1f} m instead of {self.gap:.1f} m from the adversary")
        return " and ".join(said)

    def moved(self, proposal: Proposal, arrived: AtTrigger) -> Proposal:
        """Adapt a candidate of this situation to another one.

        Args:
            proposal: The candidate.
            arrived: The situation that the ego arrived in.

        Returns:
            The candidate, and its supports, with parameters that are scaled by their units and kept within their
            bounds.
        """
        length = _ratio(arrived.gap, self.gap, MIN_GAP_DIFFERENCE_M)
        speed = _ratio(arrived.ego_speed, self.ego_speed, MIN_SPEED_DIFFERENCE_M_S)
        factors = {"m": length, "m/s": speed, "s": length / speed, "m/s2": speed**2 / length, "1/s": speed / length}
        return _scaled(proposal, factors)


def _box(state: VehicleState) -> Boxes:
    """Return the box of a state."""
    x, y, heading, speed = (np.asarray(v, float) for v in (state.x, state.y, state.heading, state.speed))
    return Boxes(x, y, heading, speed, state.length, state.width)


def _differs(kept: float, now: float, share: float, least: float) -> bool:
    """Return whether two values differ by more than a share of the kept value, and by more than ``least``."""
    return abs(now - kept) > max(share * kept, least)


def _ratio(now: float, kept: float, least: float) -> float:
    """Return the ratio of two values, neither below ``least``, limited to ``MAX_SCALE``."""
    return float(np.clip(max(now, least) / max(kept, least), 1.0 / MAX_SCALE, MAX_SCALE))


def _scaled(p: Proposal, factors: Mapping[str, float]) -> Proposal:
    """Multiply each parameter of a candidate by the factor of its unit."""
    numbers = {
        q.name: round(float(np.clip(p.parameters.get(q.name, q.default) * factors.get(q.unit, 1.0), q.low, q.high)), 4)
        for q in p.planner.parameters
    }
    supports = tuple(_scaled(support, factors) for support in p.supports)
    return replace(p.unscored(), parameters=numbers, supports=supports)
