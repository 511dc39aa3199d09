"""Where errors are drawn: the proposal raises the rates of errors that look dangerous; each run keeps its likelihood.

The model P starts an error of kind k with its probability p. The raised proposal R starts it with r >= p, which depends
on how dangerous the error would be (``danger.py``), so on the past alone. It goes back to p for the rest of a run as
soon as an error has begun, or when it has spent ``BUDGET``.

Before a run, a coin is tossed: with probability ``MODEL_SHARE`` the whole run is drawn from P, else from R. Its weight
is that of the mixture, whichever side the coin fell (the balance heuristic, Veach and Guibas 1995; Hesterberg 1995):

    w = P / (a P + (1 - a) R) = 1 / (a + (1 - a) R/P)  <=  1/a = 10

A mixture in each decision would only bound the weight of each decision by 10, and that of a run by 10 to the power of
their number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sumo_adv.datatypes import Floats, Ints

MODEL_SHARE = 0.1  # of the runs that are drawn from the model
MOST_WEIGHT = 1.0 / MODEL_SHARE
BUDGET = 3.0  # the sum of -log(1 - r) that is spent in a run: without an error it leaves 5 % (exp -3) of runs
STARTS = 1.5  # errors that the proposal would begin in a run if it did not stop after the first
MOST = 0.5  # the highest probability of an error in one decision
LEVELS = 4  # of danger
PRIOR = np.array([0.002, 0.02, 0.1, 0.3])  # guess of the share of errors that end in a collision, by level of danger
PRIOR_STARTS = 1.0  # errors that the guess weighs as much as
PILOT = np.array([0.01, 0.05, 0.05, 0.1])  # probabilities in the pilot runs, by level of danger


@dataclass(frozen=True)
class Proposal:
    """``starts`` ``(kinds, levels)``: the probability with which an error of a level of danger is begun."""

    starts: Floats

    def raised(self, model: Floats, danger: Ints) -> Floats:
        """The probabilities of errors ``(vehicles, kinds)``, from those of the model and the levels of danger.

        Where the model has 0, it stays 0; elsewhere it is never less than the model's.
        """
        proposed = self.starts[np.arange(model.shape[1]), danger]
        raised = np.where(model > 0.0, np.maximum(proposed, model), 0.0)
        total = raised.sum(axis=1, keepdims=True)
        return np.where(total > MOST, np.maximum(raised * MOST / np.maximum(total, MOST), model), raised)


def pilot_proposal(kinds: int) -> Proposal:
    """The proposal of the pilot runs: by the level of danger alone."""
    return Proposal(np.tile(PILOT, (kinds, 1)))


@dataclass(frozen=True)
class Counts:
    """What pilot runs saw, by kind of error and level of danger ``(kinds, levels)``.

    chances: decisions in which the error was possible; starts: those in which the proposal began it; crashes: how many
    of these ended in a collision.
    """

    chances: Floats
    starts: Floats
    crashes: Floats


def learnt(counts: Sequence[Counts], model: Floats) -> Proposal:
    """The proposal from pilot runs, for the model's probabilities ``(kinds,)``.

    A sum of rare events with probabilities p c (p: of the error, c: that it ends in a collision) is estimated with the
    least variance, at a given number of errors, if errors are drawn in proportion to p sqrt(c). c is estimated for each
    kind and level, the guess ``PRIOR`` weighing as much as ``PRIOR_STARTS`` errors.
    """
    tried, begun, ended = (
        np.sum([getattr(c, name) for c in counts], axis=0) for name in ("chances", "starts", "crashes")
    )
    collides = (ended + PRIOR_STARTS * PRIOR) / (begun + PRIOR_STARTS)
    worth = model[:, None] * np.sqrt(collides)
    in_a_run = float((tried * worth).sum()) / len(counts)
    return Proposal(np.minimum(worth * STARTS / in_a_run, MOST) if in_a_run > 0.0 else worth)


class Decisions:
    """Draws the errors of one run, and keeps its likelihood ratio."""

    def __init__(self, draw: np.random.Generator, proposal: Proposal | None, *, pilot: bool = False) -> None:
        """``proposal`` None: all is drawn from the model, with weight 1. pilot: the run only has to try many errors: it
        is never drawn from the model, and raises them to its end."""
        self._draw, self._proposal, self._pilot = draw, proposal, pilot
        self._from_model = proposal is None or (draw.random() < MODEL_SHARE and not pilot)
        self._spent = 0.0
        self._log_ratio = 0.0  # log R/P of what was drawn
        self.raising = proposal is not None

    @property
    def weight(self) -> float:
        """The likelihood ratio of the model to the mixture, for what was drawn so far."""
        if self._proposal is None:
            return 1.0
        return 1.0 / (MODEL_SHARE + (1.0 - MODEL_SHARE) * math.exp(min(self._log_ratio, 700.0)))

    def next(self, model: Floats, danger: Ints | None = None) -> Ints:
        """For each vehicle the kind of error that it begins, or -1 ``(vehicles,)``.

        model: the model's probabilities ``(vehicles, kinds)``; danger: the levels of danger, needed while ``raising``.
        """
        used = model
        if self.raising:
            assert self._proposal is not None and danger is not None
            used = self._proposal.raised(model, danger)
            cost = -float(np.log1p(-used.sum(axis=1)).sum())
            if self._spent + cost > BUDGET and not self._pilot:
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
        """One draw from each row's probabilities: a kind, or -1 with the rest of the probability."""
        up_to = np.cumsum(chances, axis=1)
        thrown = self._draw.random(len(chances))
        kind = (thrown[:, None] >= up_to).sum(axis=1)
        return np.where(kind < chances.shape[1], kind, -1).astype(np.intp)
