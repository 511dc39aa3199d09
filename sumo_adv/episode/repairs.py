"""Choose which attempt of an encounter the modifier is asked about, and try its changes.

The modifier is asked about the best attempt that it has not been asked about yet. Attempts recalled from memory are
left out. A chain of changes has at most ``modifications`` links. The modifier is asked no more after two changes in a
row that did not improve the best attempt, or once it says that nothing can work.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sumo_adv.agents.agents import Agents
from sumo_adv.agents.feedback import AttemptReport, Row
from sumo_adv.agents.modifier import Change, Instead, RepairScene
from sumo_adv.agents.scene_text import Aliases, driver_words, scene_words
from sumo_adv.agents.ways import begin_of, starts_words, way_of
from sumo_adv.config import Settings
from sumo_adv.datatypes import Attempt, Intent, LibraryEntry, Planner, Proposal, Track
from sumo_adv.episode.assessment import followed
from sumo_adv.episode.order import rank
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.geometry import Frame, wrap
from sumo_adv.metrics.gates import explained_gates
from sumo_adv.search.intents import entry_of
from sumo_adv.search.ranking import chosen_candidates
from sumo_adv.search.sampling import AttackTemplate
from sumo_adv.situation import ReferencePath

# -- what the modifier is shown -------------------------------------------------------------------------------------

REPORT_ROW_INTERVAL_S = 0.5  # s between the rows of a report
NEXT_ON_WAY_SEARCH_M = 30.0  # m along a way within which a vehicle's next position is searched


def report_of(attempt: Attempt, result: AttemptResult, found: FoundEncounter, settings: Settings) -> AttemptReport:
    """Report an attempt to the modifier.

    Args:
        attempt: The attempt.
        result: The result of the attempt.
        found: The encounter.
        settings: The settings of the run.

    Returns:
        The report. It has neither rows nor gates if the ego or the adversary left at once.
    """
    tracks = result.tracks(settings.step_length)
    bv, begun = attempt.proposal.bv, attempt.proposal.delay - min(found.situations)
    if found.ego not in tracks or bv not in tracks:
        return AttemptReport(attempt, (), (), begun, 0.0)
    ego, adversary = tracks.pop(found.ego), tracks.pop(bv)
    end = float(min(ego.time[-1], adversary.time[-1]))
    contact = attempt.verdict.contact_time
    gates = explained_gates(
        adversary, list(tracks.values()), attempt.verdict.failed_gates, settings.limits.of(adversary), found.drivable,
        result.start, end if contact is None else contact,
    )  # fmt: skip
    target = found.situations[attempt.proposal.delay].targets.get(bv)
    driven = adversary.between(result.start, end)
    way = way_taken(driven, target.ways) if target is not None and target.ways else None
    rows = _rows(ego.between(result.start, end), driven, result.start, way)
    movement = "none" if way is None else way.movement
    return AttemptReport(attempt, rows, tuple(gates), begun, max(end - result.start, 0.0), movement)


def way_taken(track: Track, ways: Sequence[ReferencePath]) -> ReferencePath:
    """Find the way that a vehicle followed.

    Args:
        track: The motion of the vehicle.
        ways: The ways that it could take.

    Returns:
        The way with the smallest mean distance from the vehicle's centre; the first one of equals.
    """
    return min(ways, key=lambda way: sum(abs(d) for _, d in followed(way.path, track.x, track.y, NEXT_ON_WAY_SEARCH_M)))


def _rows(ego: Track, bv: Track, start: float, way: ReferencePath | None) -> tuple[Row, ...]:
    """Describe both vehicles every ``REPORT_ROW_INTERVAL_S`` and at the last common step."""
    count = min(len(ego.time), len(bv.time))
    if count < 2:
        return ()
    every = max(1, round(REPORT_ROW_INTERVAL_S / float(np.diff(ego.time).min())))
    steps = sorted({*range(0, count, every), count - 1})
    places = (
        [(0.0, 0.0)] * len(steps) if way is None else followed(way.path, bv.x[steps], bv.y[steps], NEXT_ON_WAY_SEARCH_M)
    )
    rows = list[Row]()
    for k, (_, offset) in zip(steps, places, strict=True):
        frame = Frame(float(ego.x[k]), float(ego.y[k]), float(ego.heading[k]))
        ahead, left, _ = frame.to_local(float(bv.x[k]), float(bv.y[k]), 0.0)
        heading = math.degrees(float(wrap(bv.heading[k] - ego.heading[k])))
        rows.append(
            Row(float(ego.time[k]) - start, ahead, left, heading, float(ego.speed[k]), float(bv.speed[k]), offset)
        )
    return tuple(rows)


def scene_of(
    bv: str, entry: LibraryEntry, attempts: Sequence[Attempt], found: FoundEncounter, library: Sequence[LibraryEntry]
) -> RepairScene:
    """Describe the encounter to the modifier.

    Args:
        bv: The id of the adversary.
        entry: The library entry of the planner that is to be changed.
        attempts: All attempts of the encounter so far.
        found: The encounter.
        library: The intents that may be tried instead.

    Returns:
        The description.
    """
    situation = found.first
    aliases = Aliases.of(situation)
    scene = scene_words(situation, aliases, aliases.by_id.get(bv, "BV1"))
    choices: Mapping[str, tuple[LibraryEntry, ...]] = {
        alias: tuple(e for e in library if set(e.applies) & set(situation.targets[name].applies()))
        for alias, name in aliases.bvs.items()
    }
    text = f"{scene}\nEGO's driver: {driver_words(situation)}"
    return RepairScene(entry, text, tuple(attempts), aliases.by_id, choices, starts_words(found.situations))


# -- its changes ----------------------------------------------------------------------------------------------------

MAX_CHANGES_IN_VAIN = 2  # changes in a row that do not improve the best attempt
Key = tuple[str, float, tuple[tuple[str, float], ...]]
Tried = Sequence[tuple[Attempt, AttemptResult]]


def key_of(p: Proposal) -> Key:
    """Identify a link in a chain of changes.

    Args:
        p: The candidate.

    Returns:
        The planner's hash, the start after the trigger [s] and the parameter values, sorted by name.
    """
    return p.planner.hash, p.delay, tuple(sorted(p.parameters.items()))


class Repairs:
    """Asks the modifier about attempts of one encounter, and turns its changes into candidates.

    Attributes:
        versions: Planners with a source that the modifier wrote, by hash.
    """

    def __init__(
        self, agents: Agents, found: FoundEncounter, library: Sequence[LibraryEntry],
        templates: Sequence[AttackTemplate], settings: Settings,
    ) -> None:  # fmt: skip
        """Start without changes.

        Args:
            agents: Asks the model that plays the modifier.
            found: The encounter.
            library: The intents that may be tried instead.
            templates: The templates of candidates with another intent.
            settings: The settings of the run.
        """
        self._agents, self._found, self._library = agents, found, library
        self._templates, self._settings = templates, settings
        self._depth: dict[Key, int] = {}  # how many changes led to a candidate
        self._asked: set[Key] = set()
        self._before: tuple[float, float] | None = None  # rank of the best attempt at the last change
        self._in_vain = 0
        self.versions: dict[str, Planner] = {}  # by hash

    def made(self, p: Proposal) -> bool:
        """Return whether the modifier made a candidate.

        Args:
            p: The candidate. It is recognised by its planner, start and parameter values.
        """
        return self._depth.get(key_of(p), 0) > 0

    def next(self, tried: Tried, only: str | None = None) -> list[Proposal]:
        """Ask the modifier about the best attempt that may still be changed.

        Args:
            tried: All attempts of the encounter with their results.
            only: The hash of the planner whose attempts may be changed; None allows all planners.

        Returns:
            The changed candidates; empty if the modifier is not asked, or if it has no change.

        Raises:
            ModelError: The model that plays the modifier failed, and ``fallback`` is not ``builtin``.
        """
        ordered = sorted((a for a, _ in tried), key=lambda a: (rank(a.verdict), a.verdict.min_distance))
        if not ordered or self._in_vain_by(rank(ordered[0].verdict)) >= MAX_CHANGES_IN_VAIN:
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
        """Count the changes in a row that did not improve the best attempt, which has the rank ``best`` now."""
        if self._before is not None:
            self._in_vain = 0 if best < self._before else self._in_vain + 1
            self._before = None
        return self._in_vain

    def _ask(self, attempt: Attempt, tried: Tried) -> Change | None:
        p, encounter = attempt.proposal, self._found
        own = [(a, r) for a, r in tried if a.proposal.planner.hash == p.planner.hash and a.proposal.bv == p.bv]
        own.sort(key=lambda each: (each[0] is not attempt, rank(each[0].verdict)))
        reports = [report_of(a, r, encounter, self._settings) for a, r in own]
        scene = scene_of(p.bv, entry_of(p, self._library), [a for a, _ in tried], encounter, self._library)
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
            self._before, self._in_vain = None, MAX_CHANGES_IN_VAIN
            return []
        for candidate in candidates:
            self._depth[key_of(candidate)] = self._depth.get(key_of(p), 0) + 1
        return [replace(c, by=self._agents.player("modifier")) for c in candidates]

    def _instead(self, instead: Instead) -> list[Proposal]:
        bv = Aliases.of(self._found.first).bvs[instead.bv]
        intent = Intent(bv, instead.label, "", "high", 0.0, ways=(way_of(instead, self._found.situations, bv),))
        return chosen_candidates(intent, self._templates)
