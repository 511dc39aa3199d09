"""A search that predicts nothing: candidates are drawn, tried against the real driver, and the best ones are varied.

Generation 0 has the candidates that were handed in (memory, analyzer, forecast), the planners' own numbers and
uniform draws. Later candidates vary an elite: the best attempt of its cell, which is a vehicle, intent, mode and side
of the ego (MAP-Elites; Mouret and Clune 2015, "Illuminating search spaces by mapping elites"). What an elite is worth
is the mean over the attempts near it, so that a needle is worth less than a plateau (implicit averaging; Branke 1998,
"Creating robust solutions by means of evolutionary algorithms"). The step of a cell grows where a variation improves
it and shrinks where none does (the one-fifth rule; Rechenberg 1973). Some are drawn anew. Where several adversaries are
allowed, a part of the candidates gets or loses a support (``supports``).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sumo_adv.datatypes import AS_FOUND, Duty, Level, Proposal, Verdict
from sumo_adv.goal import Goal
from sumo_adv.search.sampling import (
    EMERGENCY_BRAKING_LABEL,
    EMERGENCY_BRAKING_RANGE_M_S2,
    AttackTemplate,
    Sampler,
    originals,
    varied,
)
from sumo_adv.search.settings import FULL_WARNING_S, MAX_COUNTED_DISTANCE_M, MAX_COUNTED_TTC_S, EvolutionSettings
from sumo_adv.search.supports import Supports

MAX_COUNTED_DELTA_V_M_S = 10.0  # more counts as this
START_SCALE_S, BRAKING_SCALE_M_S2 = 3.0, 8.0  # differences that count as the whole range of a number


def badness(verdict: Verdict, goal: Goal) -> float:
    """How far an attempt is from the goal, lower is better: the level it reached, then the margin to the next one."""
    if goal.ttc is not None:
        return _off_band(verdict, goal.ttc)
    distance, ttc = min(verdict.min_distance, MAX_COUNTED_DISTANCE_M), min(verdict.min_ttc, MAX_COUNTED_TTC_S)
    gap = (distance / MAX_COUNTED_DISTANCE_M + ttc / MAX_COUNTED_TTC_S) / 2
    if not verdict.counts:
        return 6.0 + gap
    if not verdict.collided:
        return 5.0 - float(verdict.level) + gap
    delta_v, level = verdict.delta_v or 0.0, goal.reached(verdict)
    if verdict.misfits:
        return 4.0 + gap
    if level < verdict.level:  # too mild a collision
        return 4.0 - min(delta_v / goal.min_delta_v, 1.0) / 2
    hard, human = min(delta_v / MAX_COUNTED_DELTA_V_M_S, 1.0), float(bool(verdict.humanlike))
    overlap, warning = verdict.overlap or 0.0, min(_warning(verdict) / FULL_WARNING_S, 1.0)
    if level < Level.STRICT:
        return 5.0 - float(level) - 0.5 * warning - 0.2 * human - 0.1 * overlap - 0.1 * hard
    return 5.0 - float(level) - 0.1 * warning - 0.2 * human - 0.1 * overlap - 0.5 * hard


def _off_band(verdict: Verdict, band: tuple[float, float]) -> float:
    """Distance of the least TTC from the middle of a band [s]; a contact and what does not count are worse."""
    distance, ttc = min(verdict.min_distance, MAX_COUNTED_DISTANCE_M), min(verdict.min_ttc, MAX_COUNTED_TTC_S)
    off = abs(ttc - sum(band) / 2) + distance / MAX_COUNTED_DISTANCE_M
    return off + (2.0 * MAX_COUNTED_TTC_S if not verdict.counts else MAX_COUNTED_TTC_S if verdict.collided else 0.0)


def _warning(verdict: Verdict) -> float:
    """Seconds from the alarm of ``cc_human`` to the contact; 0 if a reference driver could not have known."""
    p = verdict.preventability
    if p is None or verdict.contact_time is None or "cc_human" not in p.alarms:
        return 0.0
    return max(verdict.contact_time - p.alarms["cc_human"], 0.0)


class _Tries:
    """The attempts of one family: where they stand among its numbers, and how far they were from the goal."""

    def __init__(self) -> None:
        self._places: list[tuple[float, ...]] = []
        self._badness: list[float] = []

    def note(self, tried: Proposal, worth: float) -> None:
        """Take note of an attempt; ``worth``: its badness."""
        self._places.append(_place(tried))
        self._badness.append(worth)

    def near(self, tried: Proposal, reach: float) -> float:
        """The mean badness of the attempts near one; the weight of each falls with its distance (Gaussian, standard
        deviation ``reach``)."""
        place = _place(tried)
        same = [k for k, other in enumerate(self._places) if len(other) == len(place)]
        apart = np.array([self._places[k] for k in same]) - np.array(place)
        weights = np.exp(-0.5 * (apart**2).mean(axis=1) / reach**2)
        return float(weights @ np.array([self._badness[k] for k in same]) / weights.sum())


def _place(p: Proposal) -> tuple[float, ...]:
    """The numbers of a candidate as shares of their ranges; its start and its braking as shares of ``WHOLE_*``."""
    numbers = [
        (p.parameters.get(q.name, q.default) - q.low) / (q.high - q.low)
        for each in p.members
        for q in each.planner.parameters
        if q.high > q.low
    ]
    braking = p.acceleration if isinstance(p.acceleration, float) else 0.0
    return (*numbers, p.delay / START_SCALE_S, braking / BRAKING_SCALE_M_S2)


@dataclass(slots=True)
class _Elite:
    """The best attempt of a cell. own: its badness; worth: the mean over the attempts near it. step: standard deviation
    of its variations, as a share of a parameter's range. escape: what a support had to do in it."""

    proposal: Proposal
    own: float
    worth: float
    step: float
    escape: Sequence[Duty]


class Evolution:
    """Proposes candidates and learns from what they came to. The same seed and verdicts give the same candidates."""

    def __init__(
        self, sampler: Sampler, goal: Goal, settings: EvolutionSettings, supports: Supports | None = None
    ) -> None:
        """``supports``: gives variations supports; None where one adversary is all that is allowed."""
        self._supports = supports
        self._sampler, self._random = sampler, sampler.random
        self._goal, self._settings = goal, settings
        self._templates: list[AttackTemplate] = []
        self._waiting: list[Proposal] = []  # of generation 0
        self._elites: dict[tuple[str, ...], _Elite] = {}
        self._families: dict[tuple[str, str, str], float] = {}  # least badness of an attempt
        self._tries: dict[tuple[str, str, str], _Tries] = {}
        self._parents: dict[int, tuple[str, ...]] = {}  # id of a proposed variation -> its parent's cell
        self._closed: set[str] = set()  # kinds of attacks that are no longer looked for

    def __bool__(self) -> bool:
        """Whether anything can be proposed."""
        return bool(self._templates or self._waiting or self._elites)

    @property
    def templates(self) -> Sequence[AttackTemplate]:
        return self._templates

    def draw_from(self, templates: Sequence[AttackTemplate]) -> None:
        """From now on draw from these templates. Planners' own numbers of new ones are tried first, most dangerous
        vehicle first, then uniform draws."""
        known = {t.key for t in self._templates}
        fresh = [t for t in templates if t.key not in known]
        self._templates = list(templates)
        first = self._sampler.first(fresh, 0)  # no uniform ones
        drawn = self._sampler.uniform(originals(fresh), max(self._settings.first - len(first), 0))
        self._random.shuffle(drawn)
        drawn = [self._accompanied(p) for p in drawn]
        self._waiting += _by_turns(first, [t.target.state.id for t in fresh]) + drawn

    def add(self, proposals: Sequence[Proposal]) -> None:
        self._waiting[:0] = proposals

    def close(self, kind: Collection[str]) -> None:
        """No longer vary elites of these cells' kinds: see ``observe``."""
        self._closed.update(kind)

    def propose(self, allowed: Collection[str] | None = None) -> Proposal | None:
        """The next candidate, None if there is nothing to draw from. ``allowed``: labels and modes (``label/mode``)
        with attempts left, None for all."""
        while self._waiting:
            p = self._waiting.pop(0)
            if allowed is None or f"{p.label}/{p.planner.mode}" in allowed:
                return p
        templates = [t for t in self._templates if allowed is None or f"{t.entry.label}/{t.planner.mode}" in allowed]
        elites = [e for cell, e in self._elites.items() if cell[-1] not in self._closed]
        if templates and (not elites or self._random.random() < self._settings.anew):
            return self._drawn(templates)
        return self._variation(elites) if elites else None

    def observe(self, tried: Proposal, verdict: Verdict, kind: str, escape: Sequence[Duty] = ()) -> None:
        """Take note of an attempt; ``kind``: of attack, by the side of the ego that was hit; ``escape``: what a support
        had to do in it."""
        settings = self._settings
        own = badness(verdict, self._goal) + settings.support * len(tried.supports)
        family = tried.family
        self._tries.setdefault(family, _Tries()).note(tried, own)
        for each in self._elites.values():
            if each.proposal.family == family:
                each.worth = self._worth(each.proposal, each.own)
        if tried.arrival != AS_FOUND:  # what it came to is not what the candidate comes to here
            return
        worth = self._worth(tried, own)
        self._families[family] = min(worth, self._families.get(family, math.inf))
        side = verdict.contact_side or ("contact" if verdict.collided else "miss")
        cell = (*family, side, kind)
        elite, parent = self._elites.get(cell), self._elites.get(self._parents.pop(id(tried), ()))
        if parent is not None:
            better = worth < parent.worth
            factor = settings.grow if better else settings.shrink
            parent.step = min(max(parent.step * factor, settings.least_step), settings.most_step)
        if elite is None or worth < elite.worth:
            step = settings.step if parent is None else parent.step
            self._elites[cell] = _Elite(tried, own, worth, step, escape)

    def _worth(self, tried: Proposal, own: float) -> float:
        """What an attempt is worth, lower is better: the mean over the attempts near it; ``own``: its own badness."""
        reach, tries = self._settings.near, self._tries.get(tried.family)
        return own if not reach or tries is None else tries.near(tried, reach)

    def _drawn(self, templates: Sequence[AttackTemplate]) -> Proposal:
        """Uniform numbers for the better of two templates, by the best attempt of their families; an untried one is
        good."""
        pair = [self._random.choice(templates) for _ in range(2)]
        best = min(pair, key=lambda t: self._families.get((t.target.state.id, t.entry.label, t.planner.mode), 0.0))
        return self._accompanied(best.proposal(self._random))

    def _accompanied(self, p: Proposal, escape: Sequence[Duty] = ()) -> Proposal:
        """Now and then, the candidate with a support more or fewer."""
        if self._supports is None or self._random.random() >= self._settings.accompany:
            return p
        return self._supports.changed(p, escape)

    def _variation(self, elites: Sequence[_Elite]) -> Proposal:
        """Near one of the best elites: the better its rank, the likelier."""
        settings = self._settings
        ordered = sorted(elites, key=lambda e: e.worth)[: settings.parents]
        weights = [settings.pressure**k for k in range(len(ordered))]
        parent = self._random.choices(ordered, weights)[0]
        child = varied(parent.proposal, self._random, parent.step)
        if self._random.random() < settings.other_start:
            child = self._begun_elsewhen(child)
        child = self._accompanied(child, parent.escape)
        if child.label == EMERGENCY_BRAKING_LABEL and isinstance(child.acceleration, float):
            low, high = EMERGENCY_BRAKING_RANGE_M_S2
            braking = -child.acceleration + self._random.gauss(0.0, parent.step * (high - low))
            child = replace(child, acceleration=-min(max(braking, low), high))
        self._parents[id(child)] = next(cell for cell, e in self._elites.items() if e is parent)
        return child

    def _begun_elsewhen(self, p: Proposal) -> Proposal:
        """The candidate with another start at which all its vehicles can begin."""
        delays = sorted({t.delay for t in self._templates if t.target.state.id == p.bv})
        if p.supports or not delays:
            return p
        return replace(p, delay=self._random.choice(delays))


def _by_turns(proposals: Sequence[Proposal], vehicles: Sequence[str]) -> list[Proposal]:
    """One candidate of each vehicle in turn, in the order of the vehicles."""
    of = {name: [p for p in proposals if p.bv == name] for name in dict.fromkeys(vehicles)}
    longest = max((len(own) for own in of.values()), default=0)
    return [own[k] for k in range(longest) for own in of.values() if k < len(own)]
