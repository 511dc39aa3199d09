"""Evolutionary search without predictions: candidates are tried against the real driver, and the best ones are varied.

Generation 0 consists of the candidates that were handed in (from memory, analyzer or forecast), the default parameters
of the planners, and uniform samples. Later candidates are variations of an elite, the best attempt of its cell. A cell
is a vehicle, intent, mode and side of the ego (MAP-Elites; Mouret and Clune 2015, "Illuminating search spaces by
mapping elites"). An elite is rated by the weighted mean badness of the attempts near it, so that an isolated good
attempt ranks below a plateau of good ones (implicit averaging; Branke 1998, "Creating robust solutions by means of
evolutionary algorithms"). The step size of a cell grows when a variation improves on its parent and shrinks when it
does not (one-fifth success rule; Rechenberg 1973). Some later candidates are sampled from scratch. If several
adversaries are allowed, some candidates gain or lose a support (``supports``).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sumo_adv.datatypes import AS_FOUND, MAX_WAIT_S, Duty, Level, Proposal, Verdict
from sumo_adv.goal import Goal
from sumo_adv.search.sampling import (
    EMERGENCY_BRAKING_LABEL,
    EMERGENCY_BRAKING_RANGE_M_S2,
    AttackTemplate,
    Sampler,
    originals,
    varied,
    varied_in_one,
)
from sumo_adv.search.settings import FULL_WARNING_S, MAX_COUNTED_DISTANCE_M, MAX_COUNTED_TTC_S, EvolutionSettings
from sumo_adv.search.supports import Supports

MAX_COUNTED_DELTA_V_M_S = 10.0  # larger values are capped to this
START_SCALE_S, BRAKING_SCALE_M_S2 = 3.0, 8.0  # differences that count like the whole range of a parameter


def badness(verdict: Verdict, goal: Goal) -> float:
    """Rate how far an attempt is from the goal; lower is better.

    The level that the attempt reached counts first, then its margin to the next level. If the goal is a near miss, the
    distance of the minimum TTC from the middle of the wanted band counts instead.

    Args:
        verdict: The verdict on the attempt.
        goal: What the attempt was meant to achieve.

    Returns:
        The badness [-].
    """
    if goal.ttc is not None:
        return _off_band(verdict, goal.ttc)
    gap = _gap(verdict.min_distance, verdict.min_ttc)
    if not verdict.counts:
        return 6.0 + gap
    if not verdict.collided:
        return 5.0 - float(verdict.level) + gap
    delta_v, level = verdict.delta_v or 0.0, goal.reached(verdict)
    if verdict.misfits:  # of several attackers, all are to come near the ego
        return 4.0 + gap + max((_gap(a.min_distance, a.min_ttc) for a in verdict.attackers[1:]), default=0.0)
    if level < verdict.level:  # the collision is milder than wanted
        return 4.0 - min(delta_v / goal.min_delta_v, 1.0) / 2
    hard, human = min(delta_v / MAX_COUNTED_DELTA_V_M_S, 1.0), float(bool(verdict.humanlike))
    overlap, warning = verdict.overlap or 0.0, min(_warning(verdict) / FULL_WARNING_S, 1.0)
    if level < Level.STRICT:
        return 5.0 - float(level) - 0.5 * warning - 0.2 * human - 0.1 * overlap - 0.1 * hard
    return 5.0 - float(level) - 0.1 * warning - 0.2 * human - 0.1 * overlap - 0.5 * hard


def _gap(distance: float, ttc: float) -> float:
    """Rate how near a vehicle came by its minimum distance [m] and TTC [s]: 0 is a contact, 1 is far away."""
    near, soon = min(distance, MAX_COUNTED_DISTANCE_M), min(ttc, MAX_COUNTED_TTC_S)
    return (near / MAX_COUNTED_DISTANCE_M + soon / MAX_COUNTED_TTC_S) / 2


def _off_band(verdict: Verdict, band: tuple[float, float]) -> float:
    """Measure the distance of the minimum TTC from the band's middle [s]; penalise contacts and what does not count."""
    distance, ttc = min(verdict.min_distance, MAX_COUNTED_DISTANCE_M), min(verdict.min_ttc, MAX_COUNTED_TTC_S)
    off = abs(ttc - sum(band) / 2) + distance / MAX_COUNTED_DISTANCE_M
    return off + (2.0 * MAX_COUNTED_TTC_S if not verdict.counts else MAX_COUNTED_TTC_S if verdict.collided else 0.0)


def _warning(verdict: Verdict) -> float:
    """Return the time from the alarm of ``cc_human`` to the contact [s]; 0 if it could not have known the danger."""
    p = verdict.preventability
    if p is None or verdict.contact_time is None or "cc_human" not in p.alarms:
        return 0.0
    return max(verdict.contact_time - p.alarms["cc_human"], 0.0)


class _Tries:
    """The attempts of one family: their positions in parameter space, and their badness."""

    def __init__(self) -> None:
        self._places: list[tuple[float, ...]] = []
        self._badness: list[float] = []

    def note(self, tried: Proposal, worth: float) -> None:
        """Record an attempt and its badness.

        Args:
            tried: The candidate that was attempted.
            worth: Its badness [-].
        """
        self._places.append(_place(tried))
        self._badness.append(worth)

    def near(self, tried: Proposal, reach: float) -> float:
        """Average the badness of the attempts near a candidate.

        Args:
            tried: The candidate, which must have been recorded.
            reach: The standard deviation of the Gaussian weights, as a share of the parameters' ranges.

        Returns:
            The weighted mean badness of the attempts with as many parameters [-].
        """
        place = _place(tried)
        same = [k for k, other in enumerate(self._places) if len(other) == len(place)]
        apart = np.array([self._places[k] for k in same]) - np.array(place)
        weights = np.exp(-0.5 * (apart**2).mean(axis=1) / reach**2)
        return float(weights @ np.array([self._badness[k] for k in same]) / weights.sum())


def _place(p: Proposal) -> tuple[float, ...]:
    """Return the parameters and the waits of attackers as shares of their ranges; start and braking as shares of
    ``START_SCALE_S`` and ``BRAKING_SCALE_M_S2``.
    """
    numbers = [
        (p.parameters.get(q.name, q.default) - q.low) / (q.high - q.low)
        for each in p.members
        for q in each.planner.parameters
        if q.high > q.low
    ]
    braking = p.acceleration if isinstance(p.acceleration, float) else 0.0
    waits = [each.wait / MAX_WAIT_S for each in p.supports if each.duty in (Duty.ATTACK, Duty.PLAY)]
    return (*numbers, p.delay / START_SCALE_S, braking / BRAKING_SCALE_M_S2, *waits)


@dataclass(slots=True)
class _Elite:
    """The best attempt of a cell.

    Attributes:
        proposal: The candidate that was attempted.
        own: Its own badness [-].
        worth: The weighted mean badness of the attempts near it [-].
        step: The standard deviation of its variations, as a share of a parameter's range.
        escape: Duties of a support that would have countered the ego's escape; empty if unknown.
    """

    proposal: Proposal
    own: float
    worth: float
    step: float
    escape: Sequence[Duty]


class Evolution:
    """Proposes candidates and learns from the verdicts on their attempts.

    The same seed and verdicts give the same candidates.
    """

    def __init__(
        self, sampler: Sampler, goal: Goal, settings: EvolutionSettings, supports: Supports | None = None
    ) -> None:
        """Start without templates and elites.

        Args:
            sampler: Draws candidates. Its random generator also makes all other choices.
            goal: What an attempt is meant to achieve.
            settings: How candidates are drawn and varied.
            supports: Adds supports to variations and removes them; None if only one adversary is allowed.
        """
        self._supports = supports
        self._sampler, self._random = sampler, sampler.random
        self._goal, self._settings = goal, settings
        self._templates: list[AttackTemplate] = []
        self._waiting: list[Proposal] = []  # candidates of generation 0 that are still to be proposed
        self._elites: dict[tuple[str, ...], _Elite] = {}  # by cell
        self._families: dict[tuple[str, str, str], float] = {}  # lowest badness of a family's attempts
        self._tries: dict[tuple[str, str, str], _Tries] = {}
        self._parents: dict[int, tuple[str, ...]] = {}  # id of a proposed variation -> its parent's cell
        self._closed: set[str] = set()  # kinds of attack that are no longer searched for

    def __bool__(self) -> bool:
        """Return whether anything can be proposed."""
        return bool(self._templates or self._waiting or self._elites)

    @property
    def templates(self) -> Sequence[AttackTemplate]:
        """The templates that candidates are drawn from."""
        return self._templates

    def draw_from(self, templates: Sequence[AttackTemplate]) -> None:
        """Draw from these templates from now on.

        New templates are tried with the default parameters of their planners first, starting with the most dangerous
        vehicle, and then with uniform samples.

        Args:
            templates: All templates to draw from; they replace the previous ones.
        """
        known = {t.key for t in self._templates}
        fresh = [t for t in templates if t.key not in known]
        self._templates = list(templates)
        first = self._sampler.first(fresh, 0)  # default parameters only, no uniform samples
        drawn = self._sampler.uniform(originals(fresh), max(self._settings.first - len(first), 0))
        self._random.shuffle(drawn)
        drawn = [self._accompanied(p) for p in drawn]
        self._waiting += _by_turns(first, [t.target.state.id for t in fresh]) + drawn

    def add(self, proposals: Sequence[Proposal]) -> None:
        """Try these candidates next, before all others.

        Args:
            proposals: The candidates, in the order in which they are tried.
        """
        self._waiting[:0] = proposals

    def close(self, kind: Collection[str]) -> None:
        """Stop varying elites of these kinds of attack.

        Args:
            kind: The kinds, as given to ``observe``.
        """
        self._closed.update(kind)

    def propose(self, allowed: Collection[str] | None = None) -> Proposal | None:
        """Return the next candidate.

        Args:
            allowed: Labels and modes with attempts left, each as ``label/mode``; None allows all.

        Returns:
            The candidate, or None if there is nothing to draw from.
        """
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
        """Learn from an attempt.

        An attempt in which the ego arrived otherwise than in the encounter only counts in the average of the attempts
        near it. It becomes no elite and does not change a step size.

        Args:
            tried: The candidate that was attempted.
            verdict: The verdict on the attempt.
            kind: The kind of attack, which includes the side of the ego that was hit (``sampling.kind_of``).
            escape: Duties of a support that would have countered the ego's escape; empty if unknown.
        """
        settings = self._settings
        own = badness(verdict, self._goal) + settings.support * len(tried.supports)
        family = tried.family
        self._tries.setdefault(family, _Tries()).note(tried, own)
        for each in self._elites.values():
            if each.proposal.family == family:
                each.worth = self._worth(each.proposal, each.own)
        if tried.arrival != AS_FOUND:  # its verdict is not the one the candidate gets as the ego arrives here
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
        """Return the mean badness of the attempts near one, or its own badness if averaging is off."""
        reach, tries = self._settings.near, self._tries.get(tried.family)
        return own if not reach or tries is None else tries.near(tried, reach)

    def _drawn(self, templates: Sequence[AttackTemplate]) -> Proposal:
        """Sample the better of two random templates, by the best attempts of their families (untried: 0)."""
        pair = [self._random.choice(templates) for _ in range(2)]
        best = min(pair, key=lambda t: self._families.get((t.target.state.id, t.entry.label, t.planner.mode), 0.0))
        return self._accompanied(best.proposal(self._random))

    def _accompanied(self, p: Proposal, escape: Sequence[Duty] = ()) -> Proposal:
        """Add or remove a support with probability ``settings.accompany``; otherwise return the candidate unchanged."""
        if self._supports is None or self._random.random() >= self._settings.accompany:
            return p
        return self._supports.changed(p, escape)

    def _variation(self, elites: Sequence[_Elite]) -> Proposal:
        """Vary one of the best elites; the better its rank, the more likely it is chosen."""
        settings = self._settings
        ordered = sorted(elites, key=lambda e: e.worth)[: settings.parents]
        weights = [settings.pressure**k for k in range(len(ordered))]
        parent = self._random.choices(ordered, weights)[0]
        vary = varied if len(parent.proposal.attackers) == 1 else varied_in_one
        child = vary(parent.proposal, self._random, parent.step)
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
        """Replace the start with a random one of the candidate's vehicle; leave a candidate with supports as it is."""
        delays = sorted({t.delay for t in self._templates if t.target.state.id == p.bv})
        if p.supports or not delays:
            return p
        return replace(p, delay=self._random.choice(delays))


def _by_turns(proposals: Sequence[Proposal], vehicles: Sequence[str]) -> list[Proposal]:
    """Interleave the candidates: one of each vehicle in turn, in the order of ``vehicles``."""
    of = {name: [p for p in proposals if p.bv == name] for name in dict.fromkeys(vehicles)}
    longest = max((len(own) for own in of.values()), default=0)
    return [own[k] for k in range(longest) for own in of.values() if k < len(own)]
