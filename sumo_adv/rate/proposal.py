"""How often drivers err, how dangerous an error would be, and with which probability errors begin in the runs.

Each run keeps its likelihood. The rates are those that ``docs/rate.md`` derives, each with its source. The danger of an
error is extrapolated from the present states alone. The other vehicle drives straight on, modified by the error. The
ego goes straight on, once at its speed and once braking. This only needs to sort errors: whether an error ends in a
collision is learnt from pilot runs, for each level of danger.

The model P starts an error of kind k with its probability p. The raised proposal R starts it with r >= p. r depends on
how dangerous the error would be, and thus only on the past. R returns to p for the rest of a run as soon as an error
has begun, or when it has spent ``ERROR_BUDGET``.

Before a run, a coin is tossed: with probability ``MODEL_SHARE`` the whole run is drawn from P, otherwise from R. Its
weight is that of the mixture, whichever side the coin fell on (the balance heuristic, Veach and Guibas 1995; Hesterberg
1995):

    w = P / (a P + (1 - a) R) = 1 / (a + (1 - a) R/P)  <=  1/a = 10

A mixture in each decision would only bound the weight of each decision by 10, and the weight of a run by 10 to the
power of the number of decisions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Boxes, Floats, Ints
from sumo_adv.metrics.boxes import separation
from sumo_adv.simulation.human_errors import (
    DRIFT_DISTANCE_M,
    ERROR_SIDES,
    LATE_BRAKING_M_S2,
    LATE_REACTION_S,
    ErrorKind,
)

ERROR_KINDS = tuple(ErrorKind)
DECISION_INTERVAL_S = 1.0  # between two decisions of a driver
ERRING_DISTANCE_M = 100.0  # drivers err only within this distance of the ego
ERRORS_PER_HOUR = {
    ErrorKind.INATTENTION: 0.14,
    ErrorKind.LATE_BRAKING: 0.07,
    ErrorKind.CHANGE_LEFT: 0.005,
    ErrorKind.CHANGE_RIGHT: 0.005,
    ErrorKind.DRIFT_LEFT: 0.025,
    ErrorKind.DRIFT_RIGHT: 0.025,
    ErrorKind.PRIORITY: 0.1,
    ErrorKind.RED_LIGHT: 0.1,
}
"""The errors that a driver begins per hour in which the error is possible (``HumanErrors.possible``)."""
LOOK_AHEAD_TIMES_S = np.arange(0.25, 6.01, 0.25)
DANGER_GAP_M = 1.5  # between the boxes; smaller gaps are dangerous
ASSUMED_EGO_REACTION_S, ASSUMED_EGO_BRAKING_M_S2 = 1.0, 4.5
SUMO_LANE_CHANGE_SPEED_M_S, LANE_CHANGE_DISTANCE_M = 1.0, 3.2  # SUMO's
GO_SPEED_M_S, GO_ACCELERATION_M_S2 = 8.0, 2.0  # for a driver that enters a junction at low speed
MODEL_SHARE = 0.1  # of the runs; these are drawn from the model
MAX_WEIGHT = 1.0 / MODEL_SHARE
ERROR_BUDGET = 3.0  # sum of -log(1 - r) that a run may spend; 5 % (exp -3) of the runs spend it without an error
EXPECTED_ERRORS_PER_RUN = 1.5  # that the proposal would begin if it did not stop after the first
MAX_ERROR_PROBABILITY = 0.5  # of one decision
DANGER_LEVEL_COUNT = 4
# guessed share of errors that end in a collision, by level of danger
PRIOR_COLLISION_SHARES = np.array([0.002, 0.02, 0.1, 0.3])
PRIOR_ERROR_COUNT = 1.0  # the guess weighs as much as this number of errors
PILOT_PROBABILITIES = np.array([0.01, 0.05, 0.05, 0.1])  # of an error in pilot runs, by level of danger


def chances(factor: float) -> Floats:
    """Return the probability that a driver begins each error in one decision, ``(kinds,)``.

    Args:
        factor: The factor of all rates.
    """
    return np.array([ERRORS_PER_HOUR[kind] for kind in ERROR_KINDS]) * factor * DECISION_INTERVAL_S / 3600.0


def danger_levels(ego: Boxes, others: Boxes) -> Ints:
    """Return the level of danger of each kind of error, ``(vehicles, kinds)``.

    Level 0: nothing comes near. Level 1: less than 1.5 m apart. Level 2: contact if the ego does not brake. Level 3:
    contact even if the ego brakes.

    Args:
        ego: The ego, as 0-d arrays.
        others: The other vehicles, ``(vehicles,)``.
    """
    speed = np.asarray(others.speed, float)[:, None, None]
    along, left = _motions(speed)
    c, s = np.cos(others.heading)[:, None, None], np.sin(others.heading)[:, None, None]
    length, width = (np.asarray(v, float).reshape(-1, 1, 1) for v in (others.length, others.width))
    x, y = others.x[:, None, None] + along * c - left * s, others.y[:, None, None] + along * s + left * c
    z = np.asarray(others.z)[:, None, None] if np.ndim(others.z) else others.z
    moved = Boxes(x, y, np.broadcast_to(others.heading[:, None, None], x.shape), speed, length, width, z)
    pace = np.asarray(ego.speed, float)
    ways = (pace * LOOK_AHEAD_TIMES_S, _braked(pace, ASSUMED_EGO_REACTION_S, ASSUMED_EGO_BRAKING_M_S2))
    keeps, brakes = (separation(_straight(ego, way), moved).min(axis=-1) for way in ways)
    return (np.asarray(keeps < DANGER_GAP_M, np.intp) + (keeps <= 0.0) + ((keeps <= 0.0) & (brakes <= 0.0))).astype(
        np.intp
    )


def _braked(speed: Floats, reaction: float, hardest: float) -> Floats:
    """Return how far a vehicle goes that brakes after its reaction time [m], at ``LOOK_AHEAD_TIMES_S``."""
    braking = np.clip(LOOK_AHEAD_TIMES_S - reaction, 0.0, speed / hardest)
    return np.asarray(speed * (np.minimum(LOOK_AHEAD_TIMES_S, reaction) + braking) - hardest * braking**2 / 2)


def _straight(ego: Boxes, distance: Floats) -> Boxes:
    """Move the ego straight ahead by these distances [m]."""
    x, y = ego.x + distance * np.cos(ego.heading), ego.y + distance * np.sin(ego.heading)
    return Boxes(x, y, np.asarray(ego.heading), ego.speed, ego.length, ego.width, ego.z)


def _motions(speed: Floats) -> tuple[Floats, Floats]:
    """Return how far vehicles go along their heading and to the left of it [m], each ``(vehicles, kinds, times)``."""
    along = np.repeat(speed * LOOK_AHEAD_TIMES_S, len(ERROR_KINDS), axis=1)
    left = np.zeros_like(along)
    begun = np.minimum(speed[:, 0], GO_SPEED_M_S)
    gaining = np.minimum(LOOK_AHEAD_TIMES_S, (GO_SPEED_M_S - begun) / GO_ACCELERATION_M_S2)
    gone = (
        begun * gaining
        + GO_ACCELERATION_M_S2 * gaining**2 / 2
        + np.maximum(speed[:, 0], GO_SPEED_M_S) * (LOOK_AHEAD_TIMES_S - gaining)
    )
    for k, kind in enumerate(ERROR_KINDS):
        if kind is ErrorKind.LATE_BRAKING:
            along[:, k] = _braked(speed[:, 0], LATE_REACTION_S, LATE_BRAKING_M_S2)
        elif kind in (ErrorKind.PRIORITY, ErrorKind.RED_LIGHT):
            along[:, k] = gone
        elif kind in ERROR_SIDES:
            wide = DRIFT_DISTANCE_M if kind in (ErrorKind.DRIFT_LEFT, ErrorKind.DRIFT_RIGHT) else LANE_CHANGE_DISTANCE_M
            left[:, k] = ERROR_SIDES[kind] * np.minimum(SUMO_LANE_CHANGE_SPEED_M_S * LOOK_AHEAD_TIMES_S, wide)
    return along, left


@dataclass(frozen=True)
class ErrorProposal:
    """The probabilities with which errors are begun.

    Attributes:
        starts: The probability of each kind of error at each level of danger, ``(kinds, levels)``.
    """

    starts: Floats

    def raised(self, model: Floats, danger: Ints) -> Floats:
        """Return the raised probabilities of errors, ``(vehicles, kinds)``.

        A probability of 0 in the model stays 0. Others are never lower than the model's.

        Args:
            model: The model's probabilities, ``(vehicles, kinds)``.
            danger: The levels of danger, ``(vehicles, kinds)``.
        """
        proposed = self.starts[np.arange(model.shape[1]), danger]
        raised = np.where(model > 0.0, np.maximum(proposed, model), 0.0)
        total = raised.sum(axis=1, keepdims=True)
        return np.where(
            total > MAX_ERROR_PROBABILITY,
            np.maximum(raised * MAX_ERROR_PROBABILITY / np.maximum(total, MAX_ERROR_PROBABILITY), model),
            raised,
        )


def pilot_proposal(kinds: int) -> ErrorProposal:
    """Return the proposal of the pilot runs, which depends on the level of danger only.

    Args:
        kinds: The number of kinds of errors.
    """
    return ErrorProposal(np.tile(PILOT_PROBABILITIES, (kinds, 1)))


@dataclass(frozen=True)
class Counts:
    """The counts of pilot runs, by kind of error and level of danger, ``(kinds, levels)``.

    Attributes:
        chances: The number of decisions in which the error was possible.
        starts: The number of those in which the proposal began it.
        crashes: The number of those that ended in a collision.
    """

    chances: Floats
    starts: Floats
    crashes: Floats


def learnt(counts: Sequence[Counts], model: Floats) -> ErrorProposal:
    """Learn the proposal from pilot runs.

    Consider a sum of rare events with probabilities p c, where p is that of the error and c the chance that it ends in
    a collision. For a given number of errors, its estimate has the least variance if errors are drawn in proportion to
    p sqrt(c). c is estimated for each kind and level. The guess ``PRIOR_COLLISION_SHARES`` weighs as much as
    ``PRIOR_ERROR_COUNT`` errors.

    Args:
        counts: The counts of each pilot run.
        model: The model's probabilities, ``(kinds,)``.
    """
    tried, begun, ended = (
        np.sum([getattr(c, name) for c in counts], axis=0) for name in ("chances", "starts", "crashes")
    )
    collides = (ended + PRIOR_ERROR_COUNT * PRIOR_COLLISION_SHARES) / (begun + PRIOR_ERROR_COUNT)
    worth = model[:, None] * np.sqrt(collides)
    in_a_run = float((tried * worth).sum()) / len(counts)
    return ErrorProposal(
        np.minimum(worth * EXPECTED_ERRORS_PER_RUN / in_a_run, MAX_ERROR_PROBABILITY) if in_a_run > 0.0 else worth
    )


class Decisions:
    """Draws the errors of one run, and keeps its likelihood ratio.

    Attributes:
        raising: Whether probabilities are still raised, so that ``next`` needs the levels of danger.
    """

    def __init__(self, draw: np.random.Generator, proposal: ErrorProposal | None, *, pilot: bool = False) -> None:
        """Toss the coin between model and proposal.

        Args:
            draw: The random generator.
            proposal: The raised proposal; None draws everything from the model, with weight 1.
            pilot: Whether the run only has to try many errors. Such a run is never drawn from the model, and raises
                probabilities to its end.
        """
        self._draw, self._proposal, self._pilot = draw, proposal, pilot
        self._from_model = proposal is None or (draw.random() < MODEL_SHARE and not pilot)
        self._spent = 0.0
        self._log_ratio = 0.0  # log R/P of the draws so far
        self.raising = proposal is not None

    @property
    def weight(self) -> float:
        """The likelihood ratio of the model to the mixture, for the draws so far."""
        if self._proposal is None:
            return 1.0
        return 1.0 / (MODEL_SHARE + (1.0 - MODEL_SHARE) * math.exp(min(self._log_ratio, 700.0)))

    def next(self, model: Floats, danger: Ints | None = None) -> Ints:
        """Draw the error that each vehicle begins.

        Args:
            model: The model's probabilities, ``(vehicles, kinds)``.
            danger: The levels of danger, ``(vehicles, kinds)``; needed while ``raising``.

        Returns:
            The index of the kind of error, or -1, ``(vehicles,)``.
        """
        used = model
        if self.raising:
            assert self._proposal is not None and danger is not None
            used = self._proposal.raised(model, danger)
            cost = -float(np.log1p(-used.sum(axis=1)).sum())
            if self._spent + cost > ERROR_BUDGET and not self._pilot:
                self.raising, used = False, model
            self._spent += cost
        begun = self._drawn(model if self._from_model else used)
        if self.raising:
            rows, kinds = np.flatnonzero(begun >= 0), begun[begun >= 0]
            free = begun < 0
            none = np.log1p(-used.sum(axis=1)) - np.log1p(-model.sum(axis=1))
            self._log_ratio += float(none[free].sum() + np.log(used[rows, kinds] / model[rows, kinds]).sum())
            self.raising = self._pilot or not len(rows)
        return begun

    def _drawn(self, chances: Floats) -> Ints:
        """Draw from each row's probabilities: a kind, or -1 with the remaining probability."""
        up_to = np.cumsum(chances, axis=1)
        thrown = self._draw.random(len(chances))
        kind = (thrown[:, None] >= up_to).sum(axis=1)
        return np.where(kind < chances.shape[1], kind, -1).astype(np.intp)
