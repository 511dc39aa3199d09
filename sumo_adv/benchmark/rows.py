"""Provide opponents by name: ``random``, ``oracle``, those with files of their own, and a user's ``module:Class``.

``random`` draws from the behaviour library. ``oracle`` simulates all of it.
"""

from __future__ import annotations

import random
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sumo_adv.benchmark.nouns import MIN_TTC_CAP_S, Cell, Encounter, Opponent, counts
from sumo_adv.benchmark.resampling import Resampling
from sumo_adv.benchmark.transformer import Transformer
from sumo_adv.datatypes import Attempt, Planner, PrescribedMotion, Proposal, acceleration_of
from sumo_adv.drivers.registry import in_one_line, make_object
from sumo_adv.errors import PlannerResultError, PlannerRuntimeError, UsageError
from sumo_adv.search.sampling import EMERGENCY_BRAKING_LABEL, AttackTemplate, templates_of
from sumo_adv.situation import Situation


class RandomIntent:
    """Any vehicle, intent, mode and start that apply, with parameter values drawn within their bounds.

    Idea: This row uses the library's planners without any choice. Each attempt draws one of all ways to attack
    uniformly, and then each parameter of its planner uniformly within its author's bounds. Nothing is predicted, and
    nothing is learnt from earlier attempts. The gain of a method over this row is the value of choosing.

    Limits: An intent with many modes, or one that applies to many vehicles, is drawn more often.

    Citation: The usual control of search-based testing (Arcuri and Briand 2011, "Adaptive random testing: an illusion
    of effectiveness?", ISSTA), here over the paper's behaviour library.
    """

    name = "random"

    def __init__(self) -> None:
        self._families: list[AttackTemplate] = []
        self._draw = random.Random(0)

    def begin(self, encounter: Encounter) -> None:
        self._families = templates_of(encounter.situations, encounter.library)
        self._draw = random.Random(encounter.seed)

    def propose(self, tried: Sequence[Attempt]) -> Proposal | None:
        if not self._families:
            return None
        return replace(self._draw.choice(self._families).proposal(self._draw), by=self.name)


BEHAVIOUR_LABELS = (
    "Aggressive Cut-in",
    "Close Car-following",
    "Emergency Braking",
    "Intersection Rush-through Go-straight",
    "Intersection Rush-through Turn Left",
    "Opposite Direction Intrusion",
    "Straight Lane Shift",
)
"""The paper's seven behaviours, as the shipped library labels them."""

MAX_ORACLE_SIMULATIONS = 60  # simulations of each encounter
ORACLE_BRAKING_M_S2 = (-8.0, -6.5, -5.0)
CRITERIA = ("collision", "valid")
TIE_SHARE, TIE_TTC_S = 0.05, 0.2  # differences of shares and mean min TTC up to these are a tie
HALVINGS = 20

Labels = Mapping[str, tuple[str, ...]]
Groups = Mapping[str, Sequence[Mapping[str, Any]]]


class Oracle:
    """All intents, modes and starts are simulated, which shows afterwards which was the most dangerous.

    Idea: Every family (vehicle, intent, mode, delay) is driven against the real ego with its author's parameter values.
    The rest of the ``MAX_ORACLE_SIMULATIONS`` simulations goes to the intents that had the fewest, with sampled values,
    so that shares are similarly precise. Emergency braking is driven at -5, -6.5 and -8 m/s2 in turn. The oracle does
    not stop at a success. ``oracle_labels`` derives the label that an analyzer should have answered. ``split_half`` is
    how well one half of the simulations predicts the other half, which shows how certain a label from half as many
    simulations is.

    Limits: The oracle has more simulations than the other rows have attempts, so it is a bound and not a competitor.
    With tens of simulations, a share is known to about 0.1. The oracle knows only the library's behaviours.
    """

    name = "oracle"
    exhaustive = True

    def __init__(self) -> None:
        self._plans: list[Proposal] = []

    def begin(self, encounter: Encounter) -> None:
        ways = templates_of(encounter.situations, encounter.library)
        self._plans = [replace(p, by=self.name) for p in _plans(ways, random.Random(encounter.seed))]

    def propose(self, tried: Sequence[Attempt]) -> Proposal | None:
        return self._plans[len(tried)] if len(tried) < len(self._plans) else None


def _plans(ways: Sequence[AttackTemplate], draw: random.Random) -> list[Proposal]:
    """Return ``MAX_ORACLE_SIMULATIONS`` proposals: all templates once, by alternating labels, then the rarest label."""
    by_label: dict[str, list[AttackTemplate]] = defaultdict(list)
    for way in ways:
        by_label[way.entry.label].append(way)
    endless = {label: _endless(label, templates, draw) for label, templates in by_label.items()}
    count: Counter[str] = Counter()
    plans: list[Proposal] = []
    while by_label and len(plans) < MAX_ORACLE_SIMULATIONS:
        first = [label for label, templates in by_label.items() if count[label] < len(templates)]
        label = min(first or by_label, key=lambda name: count[name])
        plans.append(next(endless[label]))
        count[label] += 1
    return plans


def _endless(label: str, ways: Sequence[AttackTemplate], draw: random.Random) -> Iterator[Proposal]:
    """Yield a label's templates with their authors' values, and then repeatedly with sampled values."""
    turn = 0
    while True:
        for k, way in enumerate(ways):
            proposal = way.proposal(None if turn == 0 else draw)
            if label == EMERGENCY_BRAKING_LABEL:
                proposal = replace(proposal, acceleration=ORACLE_BRAKING_M_S2[(turn + k) % len(ORACLE_BRAKING_M_S2)])
            yield proposal
        turn += 1


# -- what the cell of an oracle says ------------------------------------------------------------------------------


def oracle_labels(cell: Cell) -> dict[str, tuple[str, ...]]:
    """Return the most dangerous labels of an oracle's cell, by criterion; more than one is a tie.

    For ``collision``, the share of candidates with a feasible collision that is not rear-end counts first; for
    ``valid``, the share with a valid collision. Among ties, the mean of the minimum TTC counts, where an infeasible or
    rear-end motion has ``MIN_TTC_CAP_S``.

    Args:
        cell: The oracle's cell.

    Returns:
        The labels by criterion; empty without simulations.
    """
    return {criterion: _most_dangerous(_groups(cell), criterion) for criterion in CRITERIA}


def split_half(cell: Cell) -> dict[str, float | None]:
    """Measure the agreement of random halves of each label's candidates.

    It is the chance that a label drawn from one half's tie is in the other half's tie, over ``HALVINGS`` splits in both
    directions.

    Args:
        cell: The oracle's cell.

    Returns:
        The agreement in [0, 1] by criterion; None if there are fewer than two labels.
    """
    groups, draw = _groups(cell), random.Random(0)
    if len(groups) < 2:
        return dict.fromkeys(CRITERIA)
    total = dict.fromkeys(CRITERIA, 0.0)
    for _ in range(HALVINGS):
        halves: tuple[dict[str, Any], dict[str, Any]] = {}, {}
        for label, members in groups.items():
            mixed = draw.sample(members, len(members))
            middle = (len(mixed) + draw.randrange(2)) // 2  # an odd member goes to either half
            halves[0][label], halves[1][label] = mixed[:middle], mixed[middle:]
        for criterion in CRITERIA:
            first, second = (set(_most_dangerous(half, criterion)) for half in halves)
            both = len(first & second)
            total[criterion] += (both / len(first) + both / len(second)) / 2 if first and second else 0.0
    return {criterion: total[criterion] / HALVINGS for criterion in CRITERIA}


def _groups(cell: Cell) -> dict[str, list[Mapping[str, Any]]]:
    """Group the attempts of a cell by intent."""
    groups: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
    for attempt in cell["attempts"]:
        groups[attempt["intent"]].append(attempt)
    return dict(sorted(groups.items()))


def _most_dangerous(groups: Groups, criterion: str) -> tuple[str, ...]:
    """Return the labels with the highest share of success and, among these, the lowest mean of the minimum TTC."""
    attempted = {label: members for label, members in groups.items() if members}
    if not attempted:
        return ()
    share = {n: sum(succeeds(a, criterion) for a in members) / len(members) for n, members in attempted.items()}
    near = [n for n in attempted if share[n] >= max(share.values()) - TIE_SHARE]
    mean = {n: sum(_time(a) for a in attempted[n]) / len(attempted[n]) for n in near}
    return tuple(n for n in near if mean[n] <= min(mean.values()) + TIE_TTC_S)


def succeeds(attempt: Mapping[str, Any], criterion: str) -> bool:
    """Return whether a simulation counts: a valid collision, or one that is feasible and not rear-end, by criterion."""
    return bool(attempt["valid"]) if criterion == "valid" else bool(attempt["collided"]) and counts(attempt)


def _time(attempt: Mapping[str, Any]) -> float:
    """Return the capped minimum TTC [s] of an attempt."""
    least = attempt["min_ttc"]
    return min(float(least), MIN_TTC_CAP_S) if least is not None and counts(attempt) else MIN_TTC_CAP_S


ARRAYS = ("x", "y", "heading", "speed")


class UserRow:
    """A user's generator. Its errors become one sentence that names it."""

    def __init__(self, spec: str) -> None:
        """Create the generator.

        Args:
            spec: ``module:Class``, found on ``sys.path`` or in the current folder.

        Raises:
            UsageError: The generator cannot be created.
        """
        self._generator = make_object("generator", spec, {}, {"begin": "begin(encounter)", "propose": "propose(tried)"})
        self.name = spec
        self._situations: Mapping[float, Situation] = {}

    def begin(self, encounter: Encounter) -> None:
        """Begin with a copy of the encounter, so that other rows do not see changes.

        Args:
            encounter: The encounter.

        Raises:
            PlannerRuntimeError: The user's code failed.
        """
        self._situations = encounter.situations
        try:
            self._generator.begin(replace(encounter, situations=deepcopy(dict(encounter.situations))))
        except Exception as error:  # user code
            raise PlannerRuntimeError(f"The generator {self.name!r} failed in begin: {in_one_line(error)}.") from error

    def propose(self, tried: Sequence[Attempt]) -> Proposal | None:
        """Return the generator's next attack.

        Args:
            tried: The attempts so far.

        Returns:
            The attack, or None if nothing is left to try.

        Raises:
            PlannerRuntimeError: The user's code failed.
            PlannerResultError: The answer cannot be driven.
        """
        try:
            answer = self._generator.propose(tried)
        except Exception as error:  # user code
            reason = in_one_line(error)
            raise PlannerRuntimeError(f"The generator {self.name!r} failed in propose: {reason}.") from error
        if answer is None:
            return None
        try:
            return _checked(answer, self._situations, self.name)
        except ValueError as error:
            raise PlannerResultError(f"The generator {self.name!r} returned {error}.") from error
        except (TypeError, AttributeError) as error:
            fault = f"a Proposal with a field of a wrong type ({in_one_line(error)})"
            raise PlannerResultError(f"The generator {self.name!r} returned {fault}.") from error


def _checked(answer: object, situations: Mapping[float, Situation], name: str) -> Proposal:
    """Return the proposal, marked as the generator's. Raise ValueError that says what is wrong with the answer."""
    if not isinstance(answer, Proposal):
        raise ValueError(f"{type(answer).__name__}; propose must return a Proposal or None")
    if answer.delay not in situations:
        delays = ", ".join(f"{d:g}" for d in sorted(situations))
        raise ValueError(f"the delay {answer.delay!r}, which the encounter does not have; use one of {delays}")
    targets = situations[answer.delay].targets
    if answer.bv not in targets:
        raise ValueError(f"the vehicle {answer.bv!r}; use one of the encounter's targets, {', '.join(targets)}")
    if answer.course is not None:
        return replace(answer, by=name, course=_course(answer.course))
    if not isinstance(answer.planner, Planner) or not answer.planner.text:
        raise ValueError("a Proposal with neither a course nor a planner's source text; give one of them")
    numbers = answer.parameters.values()
    if not all(isinstance(n, int | float) and np.isfinite(n) for n in numbers):
        raise ValueError("parameters that are not all finite numbers")
    try:
        acceleration_of(answer.acceleration)
    except ValueError as error:
        raise ValueError(f"an acceleration that cannot be used ({str(error).rstrip('.')})") from error
    return replace(answer, by=name)


def _course(course: object) -> PrescribedMotion:
    """Return the course as arrays of floats. Raise ValueError if it is none."""
    if not isinstance(course, PrescribedMotion):
        raise ValueError(f"a course that is {type(course).__name__}; it must be a PrescribedMotion")
    try:
        arrays = [np.array(getattr(course, name), float) for name in ARRAYS]
    except (TypeError, ValueError) as error:
        raise ValueError("a course whose x, y, heading and speed are not all arrays of numbers") from error
    shape = arrays[0].shape
    if len(shape) != 1 or not shape[0] or any(a.shape != shape for a in arrays):
        raise ValueError("a course whose x, y, heading and speed are not arrays (n,) of one length, 1 or more")
    if not all(np.isfinite(a).all() for a in arrays):
        raise ValueError("a course with numbers that are not finite")
    if (arrays[3] < 0).any():
        raise ValueError("a course with negative speeds; a vehicle drives forwards along its heading")
    x, y, heading, speed = arrays
    return PrescribedMotion(x, y, heading, speed)


ROWS: Mapping[str, Callable[[], Opponent]] = {
    "random": RandomIntent, "oracle": Oracle, "resampling": Resampling, "transformer": Transformer,
}  # fmt: skip
WEIGHTS = "transformer:"


def make_row(text: str) -> Opponent:
    """Create an opponent.

    Args:
        text: A name in ``ROWS``, ``transformer:FILE`` or ``module:Class``.

    Returns:
        The opponent.

    Raises:
        UsageError: There is no such opponent.
    """
    if text in ROWS:
        return ROWS[text]()
    if text.startswith(WEIGHTS):
        return Transformer(Path(text.removeprefix(WEIGHTS)))
    if ":" in text:
        return UserRow(text)
    raise UsageError(f"There is no row '{text}'; use {', '.join(ROWS)}, transformer:FILE or module:Class.")
