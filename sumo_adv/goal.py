"""What an attempt must come to for an episode to have succeeded: a level, a severity, or a near miss."""

from __future__ import annotations

from dataclasses import dataclass

from sumo_adv.datatypes import Level, Verdict


@dataclass(frozen=True, slots=True)
class Goal:
    """What is wanted of an attempt.

    level: it must be reached. min_delta_v: the least delta-v of the ego [m/s]; above 0 only a collision will do.
    ttc: a band [s]. The attempt must then be a near miss: no collision, and its min TTC lies in the band.
    """

    level: Level = Level.SERIOUS
    min_delta_v: float = 0.0
    ttc: tuple[float, float] | None = None

    def reached(self, verdict: Verdict) -> Level:
        """How far an attempt came towards the goal; at least ``level`` if it met the goal, and only then.

        A near miss in the band counts as the highest level, any other attempt then as none. A collision below
        ``min_delta_v`` counts as critical. An attempt with misfits stays below ``level``.
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
        """Whether the attempt succeeded. An infeasible motion and a rear-end never do."""
        least = Level.COLLISION if self.min_delta_v > 0 else Level.NONE
        return not verdict.misfits and self.reached(verdict) >= max(self.level, least)

    @property
    def hard(self) -> str:
        """The wanted delta-v in words; empty if there is none."""
        return f" with a delta-v of {self.min_delta_v:g} m/s or more" if self.min_delta_v > 0 else ""

    def attack(self, level: Level) -> str:
        """An attack that meets the goal, in words; ``level``: the named level."""
        if self.ttc is not None:
            return f"near miss with a min TTC of {self.ttc[0]:g} to {self.ttc[1]:g} s"
        return f"{level} attack{self.hard}"

    def __str__(self) -> str:
        """The goal in words."""
        return self.attack(self.level) if self.ttc is not None else f"{self.level}{self.hard}"
