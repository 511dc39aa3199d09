"""The intent oracle: all intents, modes and moments simulated, to know afterwards which was the most dangerous.

Idea: every family (vehicle, intent, mode, delay) is driven against the real ego with its author's numbers; what
is left of ``MOST`` simulations goes, with drawn numbers, to the intents that had fewest, so that shares are of like
precision. Emergency braking is driven at -5, -6.5 and -8 m/s2 in turn. It does not stop at a success.
``oracle_labels`` reads from that the label an analyzer should have answered: the largest share of collisions that count
(feasible and not rear-end, or valid), then the least mean of min TTC, ties as sets. ``split_half`` is how well one half
of the simulations answers for the other: how certain a label of half as many is.
Limits: it has more simulations than the other rows have attempts, so it is a bound, not a competitor; with tens of
simulations a share is known to about 0.1; it knows of nothing but the library's behaviours.
"""

from __future__ import annotations

import random
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from sumo_adv.benchmark.nouns import Cell, Encounter, counts
from sumo_adv.datatypes import Attempt, Proposal
from sumo_adv.search.sampling import BRAKING_LABEL, AttackTemplate, templates_of

MOST = 60  # simulations an encounter
BRAKING = (-8.0, -6.5, -5.0)  # m/s2
CRITERIA = ("collision", "valid")
CAP = 10.0  # s: a min TTC above, or of a motion that does not count, is this
SAME_SHARE, SAME_TTC = 0.05, 0.2  # shares and mean min TTC [s] that differ by no more are a tie
SPLITS = 20

Labels = Mapping[str, tuple[str, ...]]
Groups = Mapping[str, Sequence[Mapping[str, Any]]]


class Oracle:
    """Everything that applies, within ``MOST`` simulations."""

    name = "oracle"
    exhaustive = True

    def __init__(self) -> None:
        self._plans: list[Proposal] = []

    def begin(self, encounter: Encounter) -> None:
        """Lay down all simulations."""
        ways = templates_of(encounter.situations, encounter.library)
        self._plans = [replace(p, by=self.name) for p in _plans(ways, random.Random(encounter.seed))]

    def propose(self, tried: Sequence[Attempt]) -> Proposal | None:
        """The next one laid down."""
        return self._plans[len(tried)] if len(tried) < len(self._plans) else None


def _plans(ways: Sequence[AttackTemplate], draw: random.Random) -> list[Proposal]:
    """At most ``MOST`` proposals: all templates once, in turn by label; then the label with the fewest so far."""
    by_label: dict[str, list[AttackTemplate]] = defaultdict(list)
    for way in ways:
        by_label[way.entry.label].append(way)
    endless = {label: _endless(label, templates, draw) for label, templates in by_label.items()}
    count: Counter[str] = Counter()
    plans: list[Proposal] = []
    while by_label and len(plans) < MOST:
        first = [label for label, templates in by_label.items() if count[label] < len(templates)]
        label = min(first or by_label, key=lambda name: count[name])
        plans.append(next(endless[label]))
        count[label] += 1
    return plans


def _endless(label: str, ways: Sequence[AttackTemplate], draw: random.Random) -> Iterator[Proposal]:
    """A label's templates with their authors' numbers, then again and again with drawn ones."""
    turn = 0
    while True:
        for k, way in enumerate(ways):
            proposal = way.proposal(None if turn == 0 else draw)
            if label == BRAKING_LABEL:
                proposal = replace(proposal, acceleration=BRAKING[(turn + k) % len(BRAKING)])
            yield proposal
        turn += 1


# -- what the cell of an oracle says ------------------------------------------------------------------------------


def oracle_labels(cell: Cell) -> dict[str, tuple[str, ...]]:
    """The most dangerous labels of an oracle's cell, by collisions and by valid collisions; more than one is a tie.

    ``collision``: share of candidates with a feasible collision that is not rear-end; ``valid``: with a valid one. Then
    the mean of min TTC, where an infeasible or rear-end motion counts as ``CAP``. Empty without simulations.
    """
    return {criterion: _most_dangerous(_groups(cell), criterion) for criterion in CRITERIA}


def split_half(cell: Cell, seed: int = 0) -> dict[str, float | None]:
    """Agreement in [0, 1] of random halves of each label's candidates, by criterion; None without two labels.

    It is the chance that a label drawn from one half's tie set is in the other's, over ``SPLITS`` splits both ways.
    """
    groups, draw = _groups(cell), random.Random(seed)
    if len(groups) < 2:
        return dict.fromkeys(CRITERIA)
    total = dict.fromkeys(CRITERIA, 0.0)
    for _ in range(SPLITS):
        halves: tuple[dict[str, Any], dict[str, Any]] = {}, {}
        for label, members in groups.items():
            mixed = draw.sample(members, len(members))
            middle = (len(mixed) + draw.randrange(2)) // 2  # the odd one goes to either side
            halves[0][label], halves[1][label] = mixed[:middle], mixed[middle:]
        for criterion in CRITERIA:
            first, second = (set(_most_dangerous(half, criterion)) for half in halves)
            both = len(first & second)
            total[criterion] += (both / len(first) + both / len(second)) / 2 if first and second else 0.0
    return {criterion: total[criterion] / SPLITS for criterion in CRITERIA}


def _groups(cell: Cell) -> dict[str, list[Mapping[str, Any]]]:
    groups: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
    for attempt in cell["attempts"]:
        groups[attempt["intent"]].append(attempt)
    return dict(sorted(groups.items()))


def _most_dangerous(groups: Groups, criterion: str) -> tuple[str, ...]:
    attempted = {label: members for label, members in groups.items() if members}
    if not attempted:
        return ()
    share = {n: sum(succeeds(a, criterion) for a in members) / len(members) for n, members in attempted.items()}
    near = [n for n in attempted if share[n] >= max(share.values()) - SAME_SHARE]
    mean = {n: sum(_time(a) for a in attempted[n]) / len(attempted[n]) for n in near}
    return tuple(n for n in near if mean[n] <= min(mean.values()) + SAME_TTC)


def succeeds(attempt: Mapping[str, Any], criterion: str) -> bool:
    """Whether a simulation counts: a valid collision, or a feasible one, but no rear-end."""
    return bool(attempt["valid"]) if criterion == "valid" else bool(attempt["collided"]) and counts(attempt)


def _time(attempt: Mapping[str, Any]) -> float:
    least = attempt["min_ttc"]
    return min(float(least), CAP) if least is not None and counts(attempt) else CAP
