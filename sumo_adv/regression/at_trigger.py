"""How the ego and the adversary stand to each other when a kept attack begins; whether another ego arrives otherwise.

An attack is a set of numbers that fit one situation. An ego that is slower or nearer meets another one, so the numbers
are moved with it, as in a film at another scale and speed: lengths in proportion to the gap, speeds to the ego's speed,
and times and accelerations as these two ask for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from sumo_adv.datatypes import Boxes, Proposal, VehicleState
from sumo_adv.geometry import Frame
from sumo_adv.metrics.boxes import gap

OTHER_SPEED_SHARE, OTHER_GAP_SHARE = 0.15, 0.30  # shares of the kept values from which on the ego arrives otherwise
MIN_SPEED_DIFFERENCE_M_S, MIN_GAP_DIFFERENCE_M = 0.5, 2.0  # smaller differences are none, however small the kept values
MAX_SCALE = 3.0  # factor by which lengths and speeds are scaled at most


@dataclass(frozen=True, slots=True)
class AtTrigger:
    """The two when the adversary is taken over.

    Attributes:
        ego_speed: Speed of the ego [m/s].
        gap: Distance between the two boxes [m].
        x: The adversary's centre ahead of the ego's [m].
        y: The same to the left [m].
        heading: The adversary's heading against the ego's [rad].
        adversary_speed: Speed of the adversary [m/s].
    """

    ego_speed: float
    gap: float
    x: float
    y: float
    heading: float
    adversary_speed: float

    @classmethod
    def of(cls, ego: VehicleState, adversary: VehicleState) -> AtTrigger:
        """From the states of both at the same time."""
        here = Frame(ego.x, ego.y, ego.heading).to_local(adversary.x, adversary.y, adversary.heading)
        numbers = (ego.speed, float(gap(_box(ego), _box(adversary))), *here, adversary.speed)
        return cls(*(round(float(number), 3) for number in numbers))

    def as_data(self) -> dict[str, float]:
        """The numbers by name."""
        return asdict(self)

    def difference(self, arrived: AtTrigger) -> str:
        """How an ego ``arrived`` otherwise than in this situation, in words; empty if it did not."""
        said = []
        if _differs(self.ego_speed, arrived.ego_speed, OTHER_SPEED_SHARE, MIN_SPEED_DIFFERENCE_M_S):
            said.append(f"at {arrived.ego_speed:.1f} m/s instead of {self.ego_speed:.1f} m/s")
        if _differs(self.gap, arrived.gap, OTHER_GAP_SHARE, MIN_GAP_DIFFERENCE_M):
            said.append(f"{arrived.gap:.1f} m instead of {self.gap:.1f} m from the adversary")
        return " and ".join(said)

    def moved(self, proposal: Proposal, arrived: AtTrigger) -> Proposal:
        """A candidate of this situation with the numbers that do the same where an ego ``arrived`` otherwise, within
        their bounds; so are those of its supports."""
        length = _ratio(arrived.gap, self.gap, MIN_GAP_DIFFERENCE_M)
        speed = _ratio(arrived.ego_speed, self.ego_speed, MIN_SPEED_DIFFERENCE_M_S)
        factors = {"m": length, "m/s": speed, "s": length / speed, "m/s2": speed**2 / length, "1/s": speed / length}
        return _scaled(proposal, factors)


def _box(state: VehicleState) -> Boxes:
    x, y, heading, speed = (np.asarray(v, float) for v in (state.x, state.y, state.heading, state.speed))
    return Boxes(x, y, heading, speed, state.length, state.width)


def _differs(kept: float, now: float, share: float, least: float) -> bool:
    return abs(now - kept) > max(share * kept, least)


def _ratio(now: float, kept: float, least: float) -> float:
    return float(np.clip(max(now, least) / max(kept, least), 1.0 / MAX_SCALE, MAX_SCALE))


def _scaled(p: Proposal, factors: Mapping[str, float]) -> Proposal:
    """The candidate with each parameter times the factor of its unit."""
    numbers = {
        q.name: round(float(np.clip(p.parameters.get(q.name, q.default) * factors.get(q.unit, 1.0), q.low, q.high)), 4)
        for q in p.planner.parameters
    }
    supports = tuple(_scaled(support, factors) for support in p.supports)
    return replace(p.unscored(), parameters=numbers, supports=supports)
