"""The modifier's changes in one encounter: which attempt it is asked about, and what is tried next.

It is asked about the best attempt that it has not been asked about. A chain of changes has at most ``modifications``
links, and it is asked no more after two changes in a row that brought nothing, or once it says that nothing can work.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sumo_adv.agents.agents import Agents
from sumo_adv.agents.modifier import Change, Instead
from sumo_adv.agents.scene_text import Aliases
from sumo_adv.agents.ways import begin_of, way_of
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Intent, LibraryEntry, Planner, Proposal
from sumo_adv.episode.assessment import rank
from sumo_adv.episode.attempt_report import report_of, scene_of
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.search.fixed_order import chosen
from sumo_adv.search.templates import AttackTemplate

IN_VAIN = 2  # changes in a row that bring nothing
Key = tuple[str, float, tuple[tuple[str, float], ...]]
Tried = Sequence[tuple[Attempt, AttemptResult]]


def key_of(p: Proposal) -> Key:
    """What identifies a link in a chain of changes: the planner (hash), the start [s] and the numbers."""
    return p.planner.hash, p.delay, tuple(sorted(p.parameters.items()))


class Repairs:
    """The questions to the modifier, and its changes as candidates."""

    def __init__(
        self, agents: Agents, found: FoundEncounter, library: Sequence[LibraryEntry],
        templates: Sequence[AttackTemplate], settings: Settings,
    ) -> None:  # fmt: skip
        self._agents, self._found, self._library = agents, found, library
        self._templates, self._settings = templates, settings
        self._depth: dict[Key, int] = {}  # how many changes led to a candidate
        self._asked: set[Key] = set()
        self._before: tuple[float, float] | None = None  # rank of the best attempt at the last change
        self._in_vain = 0
        self.versions: dict[str, Planner] = {}  # texts that it wrote, by hash

    def made(self, p: Proposal) -> bool:
        """Whether a candidate is as the modifier gave it."""
        return self._depth.get(key_of(p), 0) > 0

    def next(self, tried: Tried, only: str | None = None) -> list[Proposal]:
        """The candidate to which the modifier changes an attempt, or none. ``only``: attempts of this planner (hash).

        Raises ModelError.
        """
        ordered = sorted((a for a, _ in tried), key=lambda a: (rank(a.verdict), a.verdict.min_distance))
        if not ordered or self._in_vain_by(rank(ordered[0].verdict)) >= IN_VAIN:
            return []
        attempt = next((a for a in ordered if self._may_change(a.proposal, only)), None)
        if attempt is None:
            return []
        self._asked.add(key_of(attempt.proposal))
        change = self._ask(attempt, tried)
        if change is None:
            return []
        self._before = rank(ordered[0].verdict)
        return self._as_candidates(change, attempt.proposal)

    def _may_change(self, p: Proposal, only: str | None) -> bool:
        key = key_of(p)
        if key in self._asked or only not in (None, p.planner.hash) or p.by == "memory":
            return False
        return self._depth.get(key, 0) < self._settings.modifications

    def _in_vain_by(self, best: tuple[float, float]) -> int:
        """How many changes in a row brought nothing, now that the best attempt has this rank."""
        if self._before is not None:
            self._in_vain = 0 if best < self._before else self._in_vain + 1
            self._before = None
        return self._in_vain

    def _ask(self, attempt: Attempt, tried: Tried) -> Change | None:
        p, encounter = attempt.proposal, self._found
        own = [(a, r) for a, r in tried if a.proposal.planner.hash == p.planner.hash and a.proposal.bv == p.bv]
        own.sort(key=lambda each: (each[0] is not attempt, rank(each[0].verdict)))
        reports = [report_of(a, r, encounter, self._settings) for a, r in own]
        entry = next(e for e in self._library if e.label == p.label)
        scene = scene_of(p.bv, entry, [a for a, _ in tried], encounter, self._library)
        return self._agents.modify(p.planner, reports, scene)

    def _as_candidates(self, change: Change, p: Proposal) -> list[Proposal]:
        if change.instead is not None:
            candidates = self._instead(change.instead)
        elif change.planner is not None:
            numbers = change.planner.defaults() | change.parameters
            delay = p.delay if change.begin is None else begin_of(change.begin, self._found.situations, p.bv)
            candidates = [replace(p.unscored(), planner=change.planner, parameters=numbers, delay=delay)]
            if change.planner.hash != p.planner.hash:
                self.versions[change.planner.hash] = change.planner
        else:  # nothing can work here
            self._before, self._in_vain = None, IN_VAIN
            return []
        for candidate in candidates:
            self._depth[key_of(candidate)] = self._depth.get(key_of(p), 0) + 1
        return [replace(c, by=self._agents.player("modifier")) for c in candidates]

    def _instead(self, instead: Instead) -> list[Proposal]:
        bv = Aliases.of(self._found.first).bvs[instead.bv]
        intent = Intent(bv, instead.label, "", "high", 0.0, ways=(way_of(instead, self._found.situations, bv),))
        return chosen(intent, self._templates)
