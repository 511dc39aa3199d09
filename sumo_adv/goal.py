"""Define what an attempt must reach for an episode to succeed: a level, a severity, or a near miss."""

from __future__ import annotations

from dataclasses import dataclass

from sumo_adv.datatypes import Level, Verdict


@dataclass(frozen=True, slots=True)
class Goal:
    """The goal of an attempt.

    Attributes:
        level: The level that the attempt must reach.
        min_delta_v: The smallest delta-v of the ego [m/s]. Above 0, only a collision succeeds.
        ttc: A band [s]. If it is given, the attempt must be a near miss: no collision, and a minimum TTC in the band.
    """

    level: Level = Level.SERIOUS
    min_delta_v: float = 0.0
    ttc: tuple[float, float] | None = None

    def reached(self, verdict: Verdict) -> Level:
        """Rate how far an attempt came towards the goal.

        A near miss in the band counts as the highest level. With a band, any other attempt counts as none. A collision
        below ``min_delta_v`` counts as critical. An attempt with misfits stays below ``level``.

        Args:
            verdict: The verdict on the attempt.

        Returns:
            The level. It is ``level`` or higher if and only if the attempt met the goal.
        """
        if verdict.misfits:
            return min(verdict.level, Level(max(self.level - 1, 0)))
        if self.ttc is not None:
            low, high = self.ttc
            inside = verdict.counts and not verdict.collided and low <= verdict.min_ttc <= high
            return Level.SERIOUS if inside else Level.NONE
        if self.min_delta_v > 0 and (verdict.delta_v or 0.0) < self.min_delta_v:
            return min(verdict.level, Level.CRITICAL)
        return verdict.level

    def met(self, verdict: Verdict) -> bool:
        """Return whether the attempt succeeded. Infeasible motions and rear-ends never do."""
        least = Level.COLLISION if self.min_delta_v > 0 else Level.NONE
        return not verdict.misfits and self.reached(verdict) >= max(self.level, least)

    @property
    def hard(self) -> str:
        """The wanted delta-v in words; empty if none is wanted."""
        return f" with a delta-v of {self.min_delta_v:g} m/s or more" if self.min_delta_v > 0 else ""

    def attack(self, level: Level) -> str:
        """Describe an attack that meets the goal.

        Args:
            level: The level to name.
        """
        if self.ttc is not None:
            return f"near miss with a min TTC of {self.ttc[0]:g} to {self.ttc[1]:g} s"
        return f"{level} attack{self.hard}"

    def __str__(self) -> str:
        """Return the goal in words."""
        return self.attack(self.level) if self.ttc is not None else f"{self.level}{self.hard}"
