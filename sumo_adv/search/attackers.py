"""Further attackers: each has an intent, a planner, parameters and a start of its own, as the collider has.

If the scene names several attackers, each candidate has all of them: it is drawn for one of them, its collider, and
completed by an attack of each other one. One that only plays a part is never the collider.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from random import Random

from sumo_adv.asked import Attacker
from sumo_adv.datatypes import MAX_WAIT_S, Duty, Proposal
from sumo_adv.memory.records import canonical
from sumo_adv.road_users import is_unprotected
from sumo_adv.search.intents import FREE_MOTION
from sumo_adv.search.sampling import AttackTemplate

AT_ONCE_SHARE = 0.5  # of the attackers that are drawn; they begin with the collider, the others later
BY_DEFAULT_SHARE = 0.5  # of the attackers that are drawn; they have the default parameters of their planners


def attack_of(template: AttackTemplate, random: Random, duty: Duty = Duty.ATTACK) -> Proposal:
    """Draw the part of an attacker that is not the collider.

    Args:
        template: How it attacks.
        random: The random generator.
        duty: Whether it attacks, or only plays its part.
    """
    wait = 0.0 if random.random() < AT_ONCE_SHARE else round(random.uniform(0.0, MAX_WAIT_S), 2)
    numbers = None if random.random() < BY_DEFAULT_SHARE else random
    return replace(template.proposal(numbers), duty=duty, wait=wait)


class Attackers:
    """The vehicles that may attack, each with its templates, and those that attack in each candidate.

    Attributes:
        names: The ids of the vehicles that attack in each candidate; empty for one collider.
    """

    def __init__(self, attackers: Sequence[Attacker], random: Random) -> None:
        """Know the attackers of the scene and their intents.

        Args:
            attackers: The vehicles that attack in each candidate.
            random: The random generator.
        """
        self._intents = {each.id: frozenset(map(canonical, each.intents)) for each in attackers}
        self._duties = {each.id: Duty.ATTACK if each.attacks else Duty.PLAY for each in attackers}
        self._random = random
        self._templates: Mapping[tuple[float, str], Sequence[AttackTemplate]] = {}
        self.names = tuple(self._intents)

    def usable(self, templates: Sequence[AttackTemplate]) -> list[AttackTemplate]:
        """Return the templates from which colliders are drawn, and draw further attackers from them from now on.

        Args:
            templates: All templates.

        Returns:
            The same templates. If the scene names attackers, only theirs with their intents, at starts at which all
            of them can attack, and none of those that only play a part.
        """
        kept = [t for t in templates if self._may_draw(t)]
        by_start: dict[tuple[float, str], list[AttackTemplate]] = {}
        for t in kept:
            by_start.setdefault((t.delay, t.target.state.id), []).append(t)
        self._templates = by_start
        return [
            t for t in kept
            if self._duties.get(t.target.state.id) is not Duty.PLAY
            and all((t.delay, name) in by_start for name in self.names)
        ]  # fmt: skip

    def lacking(self, p: Proposal) -> list[Proposal]:
        """Draw an attack of each attacker of the scene that a candidate lacks.

        Args:
            p: The candidate.
        """
        missing = [name for name in self.names if name not in p.bvs]
        return [
            attack_of(self._random.choice(self._templates[p.delay, name]), self._random, self._duties[name])
            for name in missing
        ]

    def others(self, p: Proposal) -> list[AttackTemplate]:
        """Return the templates with which further vehicles can attack along with a candidate.

        Free motions are left out, because they are named by the contact of a collider, and so are pedestrians and
        cyclists.

        Args:
            p: The candidate.
        """
        return [
            t for (delay, name), own in self._templates.items() if delay == p.delay and name not in p.bvs
            for t in own if t.entry.label != FREE_MOTION and not is_unprotected(t.target.state)
        ]  # fmt: skip

    def _may_draw(self, t: AttackTemplate) -> bool:
        """Return whether a vehicle may attack with an intent."""
        intents = self._intents.get(t.target.state.id)
        return not self.names or (intents is not None and (not intents or canonical(t.entry.label) in intents))
