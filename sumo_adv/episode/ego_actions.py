"""With what the ego's driver answered, and how often SUMO did not do what it asked for."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from sumo_adv.drivers import Action, LaneSpeed

SLOWER = 0.05  # m/s below what was asked for: more than rounding, less than any braking


@dataclass(frozen=True, slots=True)
class EgoActions:
    """counts: how often each kind of answer came, from the takeover of the ego on; ``None`` is counted as ``SUMO``.
    limited: after how many ``LaneSpeed`` SUMO's safe speed was lower than the speed that was asked for."""

    counts: Mapping[str, int]
    limited: int


class ActionCount:
    """Counts the answers of one driver."""

    def __init__(self) -> None:
        self._counts: Counter[str] = Counter()
        self._limited = 0
        self._expected: float | None = None

    def answered(self, action: Action, reachable: float) -> None:
        """``reachable``: the highest speed [m/s] that the ego can have after the step, without other vehicles."""
        self._counts["SUMO" if action is None else type(action).__name__] += 1
        self._expected = min(action.speed, reachable) if isinstance(action, LaneSpeed) else None

    def stepped(self, speed: float) -> None:
        """``speed``: the ego's after the step [m/s]."""
        if self._expected is not None and speed < self._expected - SLOWER:
            self._limited += 1
        self._expected = None

    def total(self) -> EgoActions:
        """The counts so far."""
        return EgoActions(dict(sorted(self._counts.items())), self._limited)
