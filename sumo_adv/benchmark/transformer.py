"""Transformer: the futures that a trained motion predictor gives the background vehicle, the most dangerous first.

Idea: A network in the manner of HiVT (``sumo_adv/transformer``) predicts six futures (modes) of every vehicle of the
shortlist at every delay. Each mode is a candidate, and so are ``DRAWS_PER_MODE`` samples of its Laplace distribution. A
sample is off its mode by the same share of the scale at all steps. The project's f_traj makes each candidate feasible:
the vehicle follows the prediction along its way, within the limits of any adversary. The ego is predicted by its
driver's model, which answers to that very motion. Candidates that collide and are not ruled out (rear-end, off the
road, third parties) come first, with the likelier ones before the others. Then come those with the lowest minimum TTC
and distance. The most dangerous candidate of each mode is tried before any second one.

Limits: The network predicts how vehicles do drive, and a likely future is seldom dangerous. It has seen only SUMO's
drivers. The motion is fixed at the takeover and never reacts to the ego.

Citation: Zhou, Ye, Wang, Wu and Lu 2022, "HiVT: Hierarchical Vector Transformer for Multi-Agent Motion Prediction",
CVPR, pp. 8823-8833, for the predictor. Mei, Nie, Sun and Tian, "Seeking to Collide", section IV-C, for taking the most
dangerous of its candidates.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sumo_adv.benchmark.nouns import Encounter, course_proposal
from sumo_adv.datatypes import Attempt, Endpoint, Floats, Level, Planner, Prediction, PrescribedMotion, Proposal
from sumo_adv.planners.answers import Answer
from sumo_adv.search.rollouts import predict
from sumo_adv.search.scoring import judge_all, touch_of
from sumo_adv.search.settings import ScoreSettings
from sumo_adv.simulation.network import read_network
from sumo_adv.situation import Situation
from sumo_adv.transformer.model import SHIPPED_WEIGHTS, Predicted, TransformerPredictor
from sumo_adv.transformer.scene import FUTURE_COUNT, POSITION_STEP_S, agents_of, segments_of

DRAWS_PER_MODE = 3  # samples of each mode
MAX_DRAW_SCALE = 2.0  # samples are cut at this multiple of the scale
STANDING_STEP_M = 0.05  # with less motion in a step, a vehicle keeps its heading


class Transformer:
    """The row ``transformer``; see the module."""

    def __init__(self, weights: Path = SHIPPED_WEIGHTS) -> None:
        """Load the predictor.

        Args:
            weights: The file of the network's weights.

        Raises:
            UsageError: The file holds no weights.
        """
        self.name = "transformer" if weights == SHIPPED_WEIGHTS else f"transformer:{weights}"
        self._predictor = TransformerPredictor(weights)
        self._proposals: list[Proposal] = []

    def begin(self, encounter: Encounter) -> None:
        segments = segments_of(read_network(encounter.network))
        rng = np.random.default_rng(encounter.seed)
        drawn: list[_Drawn] = []
        for delay, situation in sorted(encounter.situations.items()):
            names, agents = agents_of(situation)
            predicted = self._predictor.predict(agents, segments)
            drawn += [
                draw
                for k, name in enumerate(names)
                if name in situation.targets
                for draw in _draws(delay, situation, name, predicted, k, rng)
            ]
        self._proposals = _ordered(encounter, drawn, self.name)

    def propose(self, tried: Sequence[Attempt]) -> Proposal | None:
        return self._proposals[len(tried)] if len(tried) < len(self._proposals) else None


@dataclass(frozen=True, slots=True)
class _Drawn:
    """A future of one vehicle.

    Attributes:
        delay: The delay after the trigger [s].
        bv: The vehicle.
        mode: The index of the mode.
        likelihood: The probability of the mode, times the density of the sample relative to that of the mode itself.
        states: x [m], y [m], heading [rad] and speed [m/s] at each step after the takeover, ``(n, 4)``.
    """

    delay: float
    bv: str
    mode: int
    likelihood: float
    states: Floats


def _draws(
    delay: float, situation: Situation, bv: str, predicted: Predicted, k: int, rng: np.random.Generator
) -> Iterator[_Drawn]:
    """Yield the futures of vehicle ``k`` of a prediction: each mode and its samples."""
    state = situation.targets[bv].state
    c, s = np.cos(state.heading), np.sin(state.heading)
    to_world = np.array([[c, s], [-s, c]])
    for mode, (place, scale) in enumerate(zip(predicted.place[k], predicted.scale[k], strict=True)):
        for draw in range(1 + DRAWS_PER_MODE):
            off = np.clip(rng.laplace(size=2), -MAX_DRAW_SCALE, MAX_DRAW_SCALE) if draw else np.zeros(2)
            states = _states(place + (off * scale) @ to_world, situation, bv)
            yield _Drawn(delay, bv, mode, float(predicted.probability[k, mode] * np.exp(-np.abs(off).sum())), states)


def _states(place: Floats, situation: Situation, bv: str) -> Floats:
    """Convert positions ``POSITION_STEP_S`` apart to states at the situation's steps, which the follower needs."""
    state = situation.targets[bv].state
    points = np.vstack([[state.x, state.y], place])
    time = situation.dt * np.arange(1, round(FUTURE_COUNT * POSITION_STEP_S / situation.dt) + 1)
    x, y = (np.interp(time, POSITION_STEP_S * np.arange(FUTURE_COUNT + 1), points[:, column]) for column in range(2))
    dx, dy = np.diff(x, prepend=state.x), np.diff(y, prepend=state.y)
    moved = np.hypot(dx, dy)
    heading, last = np.empty(len(x)), state.heading
    for k in range(len(x)):
        last = heading[k] = np.arctan2(dy[k], dx[k]) if moved[k] > STANDING_STEP_M else last
    return np.column_stack([x, y, heading, moved / situation.dt])


def _ordered(encounter: Encounter, drawn: Sequence[_Drawn], name: str) -> list[Proposal]:
    """Return the proposals in order; each future is driven by f_traj and judged against the predicted ego."""
    if not drawn:
        return []
    settings, limits = encounter.settings, encounter.settings.limits.limits()
    planner = Planner(name, "prediction", "", (), name)
    proposals = [Proposal(draw.bv, name, planner, {}, 0.0, draw.delay, by=name) for draw in drawn]
    ends = [draw.states[-1].tolist() for draw in drawn]
    answers = [
        Answer(Endpoint(x, y, heading, speed, FUTURE_COUNT * POSITION_STEP_S), draw.states)
        for draw, (x, y, heading, speed) in zip(drawn, ends, strict=True)
    ]
    steps = settings.steps(settings.duration)
    rollouts = predict(
        encounter.situations, proposals, lambda rows, _: [a if k in rows else None for k, a in enumerate(answers)],
        limits=limits, steps=steps, replan=steps, touch=touch_of(encounter.situations, proposals),
    )  # fmt: skip
    judged = judge_all(encounter.situations, proposals, rollouts, encounter.drivable, limits, ScoreSettings())
    by_danger = sorted(range(len(drawn)), key=lambda k: _danger(judged[k][1], drawn[k]))
    before: Counter[tuple[float, str, int]] = Counter()
    order: list[tuple[bool, int, int]] = []
    for k in by_danger:
        draw = drawn[k]
        order.append((judged[k][1].level < Level.COLLISION, before[draw.delay, draw.bv, draw.mode], k))
        before[draw.delay, draw.bv, draw.mode] += 1
    order.sort(key=lambda placed: placed[:2])  # stable: the most dangerous of each mode comes before any second one
    return [
        course_proposal(
            name, drawn[k].bv, drawn[k].delay,
            PrescribedMotion(*(np.ascontiguousarray(column[k, 1:]) for column in rollouts.adversary)),
        )
        for _, _, k in order
    ]  # fmt: skip


def _danger(prediction: Prediction, draw: _Drawn) -> tuple[bool, bool, float, float, float]:
    """Return the sort key: the most dangerous first. Severity and the drivers that avoid a collision do not count."""
    misses = prediction.level < Level.COLLISION
    return misses, prediction.hopeless, prediction.min_ttc, prediction.gap * misses, -draw.likelihood
