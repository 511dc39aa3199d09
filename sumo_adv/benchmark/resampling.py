"""Resampling: kinematic motions, weighted by their likelihood and their chance to hit the ego's predicted rollouts.

Idea: For every vehicle of the shortlist, ``MOTIONS_PER_DELAY`` motions along its ways are drawn. A motion has two
target speeds, one after the other, and two moves to another offset (the vehicle's lane, a lane beside it, or a little
off), whose beginnings and durations are drawn, too. All motions keep the limits of an adversary. The ego has
``FUTURES`` predicted rollouts: its driver's model answering to that very motion, unattacked, at constant speed, braking
gently, and braking firmly. A motion's score is its prior times the chance that it collides over the futures, discounted
by ``CONFIDENCE_PER_SECOND`` for each second. The prior prefers small accelerations and staying in lane, and punishes
leaving the road or hitting others. The motion with the best score is tried, then the best of those not tried yet. After
each attempt, futures that predicted another result lose weight. This is the closed loop of CAT, in which the ego's real
rollouts replace its predictions.

Limits: The proposals come from a kinematic family and a hand-made prior, while CAT has a learnt predictor (DenseTNT on
Waymo data). The motion is fixed at the takeover and never reacts to the ego. Only collisions that are not rear-end
count, which CAT does not require. Whether they are avoidable does not count.

Citation: Zhang, Peng, Li and Zhou 2023, "CAT: Closed-loop Adversarial Training for Safe End-to-End Driving", CoRL, PMLR
229:2357-2372. From it come the factors of the probability: prior, ego's rollout and collision.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sumo_adv.benchmark.nouns import Encounter, course_proposal
from sumo_adv.datatypes import Attempt, Bools, Boxes, Floats, Limits, PrescribedMotion, Proposal
from sumo_adv.drivers.prediction import PredictedEgos
from sumo_adv.geometry import wrap
from sumo_adv.metrics.boxes import on_grid, pick, touching
from sumo_adv.metrics.contact import SAME_DIRECTION
from sumo_adv.metrics.gates import off_road
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.trajectory import Batch, Motion, PathEndpoint, advance, pose, steer
from sumo_adv.situation import Situation, Target

Places = NDArray[np.intp]

MOTIONS_PER_DELAY = 256  # motions of each vehicle and delay
FUTURES = {"model": 0.4, "unattacked": 0.3, "constant": 0.1, "gentle": 0.1, "firm": 0.1}
RESPONSE_BRAKING_M_S2 = {"gentle": 2.0, "firm": 5.0}
RESPONSE_DELAY_S = 1.5
CONFIDENCE_PER_SECOND = 0.96  # factor per second, because later collisions are predicted less well
FORETOLD_LIKELIHOOD, NOT_FORETOLD_LIKELIHOOD = (
    0.8,
    0.3,
)  # likelihood of a result under a future that predicted it, or another result
ACCELERATION_STD_M_S2 = 1.5  # standard deviation of usual accelerations
MEAN_ACCELERATIONS_M_S2 = (-4.0, 2.0)  # mean accelerations are drawn from this range
MAX_STRAY_M = 1.3  # half the moves end off the lane's middle, by at most this
LANE_MOVE_ODDS, STRAY_ODDS = 0.3, 0.5  # prior odds of a move to another lane, and of a move that ends off the middle
ROAD_SLACK_M = 0.2
UNLIKELY_FACTOR = 1e-3  # prior factor of a motion that leaves the road or hits a third vehicle


@dataclass(frozen=True, slots=True)
class Drawn:
    """The motions of all vehicles at one delay.

    Attributes:
        delay: The delay after the trigger [s].
        names: The vehicle of each motion.
        poses: x [m], y [m], heading [rad] and speed [m/s] from the takeover on, ``(4, n, steps)``.
        prior: The prior of each motion ``(n,)``.
        hits: The chance of a collision that counts, 0 or discounted, ``(futures, n)``.
    """

    delay: float
    names: Sequence[str]
    poses: Floats
    prior: Floats
    hits: Floats


class Resampling:
    """The row ``resampling``; see the module."""

    name = "resampling"

    def __init__(self) -> None:
        self._drawn: list[Drawn] = []
        self._places: list[tuple[int, int]] = []  # delay's index and motion of each attempt

    def begin(self, encounter: Encounter) -> None:
        rng = np.random.default_rng(encounter.seed)
        self._drawn = [draw(encounter, delay, rng) for delay in sorted(encounter.situations)]
        self._places = []

    def propose(self, tried: Sequence[Attempt]) -> Proposal | None:
        weights = self._weights(tried)
        best: tuple[float, int, int] | None = None
        for i, some in enumerate(self._drawn):
            score = some.prior * (weights @ some.hits) + 1e-9 * some.prior
            score[[k for j, k in self._places if j == i]] = -1.0
            k = int(np.argmax(score))
            if score[k] >= 0.0 and (best is None or score[k] > best[0]):
                best = float(score[k]), i, k
        if best is None:
            return None
        self._places.append(best[1:])
        some, k = self._drawn[best[1]], best[2]
        x, y, heading, speed = (np.ascontiguousarray(column[k, 1:]) for column in some.poses)
        return course_proposal(self.name, some.names[k], some.delay, PrescribedMotion(x, y, heading, speed))

    def _weights(self, tried: Sequence[Attempt]) -> Floats:
        """Return the weights of the futures, from the results of the attempts."""
        weights = np.array(list(FUTURES.values()))
        for attempt, (i, k) in zip(tried, self._places, strict=False):
            predicted = self._drawn[i].hits[:, k] > 0.0
            counts = attempt.verdict.collided and not attempt.verdict.rear_end
            weights = weights * np.where(predicted == counts, FORETOLD_LIKELIHOOD, NOT_FORETOLD_LIKELIHOOD)
        return np.asarray(weights / weights.sum())


# -- drawing ------------------------------------------------------------------------------------------------------


def draw(encounter: Encounter, delay: float, rng: np.random.Generator) -> Drawn:
    """Draw ``MOTIONS_PER_DELAY`` motions of each target at a delay.

    Args:
        encounter: The encounter.
        delay: The delay after the trigger [s].
        rng: The random generator.

    Returns:
        The motions, with their priors and what they hit.
    """
    situation, settings = encounter.situations[delay], encounter.settings
    targets = situation.target_list()
    names = [t.state.id for t in targets for _ in range(MOTIONS_PER_DELAY)]
    plan = _plans(targets, rng)
    ground = AdversaryBatch([situation] * len(names), names)
    ground.rows.row = ground.rows.row + plan.way
    steps, dt, limits = settings.steps(settings.duration), situation.dt, settings.limits.limits()
    width = np.array([t.state.width for t in ground.targets])
    motion, egos = ground.begin(), PredictedEgos(ground.scenes, ground.length, width)
    poses, model = np.empty((4, len(names), steps)), np.empty((4, len(names), steps))
    for k in range(steps):
        poses[:, :, k] = (*pose(Batch, motion, ground.rows), motion.v)
        model[:, :, k] = egos.pose()
        egos.step(k * dt, ground.relative(motion), motion.v, ground.at_junction(motion))
        motion = _forward(ground, motion, plan, k * dt, limits, dt)
    x, y, heading, speed = poses
    adversary = Boxes(x, y, heading, speed, ground.length[:, None], width[:, None])
    last, hits = _hits(situation, adversary, _futures(situation, model))
    odd = _off_road(encounter, adversary, last) | _third_party(situation, names, adversary, last)
    return Drawn(delay, names, poses, plan.prior * np.where(odd, UNLIKELY_FACTOR, 1.0), hits)


@dataclass(frozen=True, slots=True)
class _Plan:
    """The random parameters of ``n`` motions.

    Attributes:
        way: The index of the way ``(n,)``.
        offsets: The offsets to which the two moves go ``(2, n)`` [m].
        begins: When the two moves begin ``(2, n)`` [s].
        lasts: How long the two moves last ``(2, n)`` [s].
        speeds: The two target speeds ``(2, n)`` [m/s].
        spans: How long each target speed is approached ``(2, n)`` [s].
        prior: The prior ``(n,)``.
    """

    way: Places
    offsets: Floats
    begins: Floats
    lasts: Floats
    speeds: Floats
    spans: Floats
    prior: Floats


def _plans(targets: Sequence[Target], rng: np.random.Generator) -> _Plan:
    """Draw the parameters of all targets' motions."""
    way = np.concatenate([rng.integers(len(t.ways), size=MOTIONS_PER_DELAY) for t in targets])
    v = np.repeat([t.state.speed for t in targets], MOTIONS_PER_DELAY)
    n = len(v)
    lanes = [np.array([0.0, *(offset for offset, _ in t.sides)]) for t in targets]
    lane = np.concatenate([rng.choice(some, (2, MOTIONS_PER_DELAY)) for some in lanes], axis=1)
    stray = rng.uniform(-MAX_STRAY_M, MAX_STRAY_M, (2, n)) * (rng.random((2, n)) < 0.5)
    first = rng.uniform(0.0, 5.0, n)
    begins = np.array([first, first + rng.uniform(2.0, 6.0, n)])
    spans = rng.uniform(1.5, 6.0, (2, n))
    means = rng.uniform(*MEAN_ACCELERATIONS_M_S2, (2, n))
    slower = np.maximum(v + means[0] * spans[0], 0.0)
    speeds = np.array([slower, np.maximum(slower + means[1] * spans[1], 0.0)])
    moved = np.diff(lane, axis=0, prepend=0.0) != 0.0
    odds = np.where(moved, LANE_MOVE_ODDS, 1.0) * np.where(stray != 0.0, STRAY_ODDS, 1.0)
    prior = np.exp(-0.5 * np.square(means / ACCELERATION_STD_M_S2).sum(axis=0)) * odds.prod(axis=0)
    return _Plan(way, lane + stray, begins, rng.uniform(2.5, 6.5, (2, n)), speeds, spans, prior)


def _forward(ground: AdversaryBatch, motion: Motion, plan: _Plan, elapsed: float, limits: Limits, dt: float) -> Motion:
    """Advance all motions by one step according to their plans."""
    later, moved, again = elapsed >= plan.spans[0], elapsed >= plan.begins[0], elapsed >= plan.begins[1]
    v = np.where(later, plan.speeds[1], plan.speeds[0])
    time = np.maximum(np.where(later, plan.spans[0] + plan.spans[1], plan.spans[0]) - elapsed, 1.0)
    offset = np.where(again, plan.offsets[1], np.where(moved, plan.offsets[0], motion.target))
    goal = PathEndpoint(motion.s + (motion.v + v) / 2 * time, offset, v, time)
    sideways = goal._replace(time=np.where(again, plan.lasts[1], plan.lasts[0]))
    motion = steer(Batch, motion, sideways, ground.rows.at(motion.s)[3])
    return advance(Batch, motion, goal, ground.rows, limits, ground.cap, dt, True)  # CAT has no human bounds


# -- weighing -----------------------------------------------------------------------------------------------------


def _futures(situation: Situation, model: Floats) -> list[Floats]:
    """Return the ego's x, y, heading and speed by future: ``(4, n, steps)``, or ``(4, 1, steps)`` if all share it."""
    time = np.arange(model.shape[2]) * situation.dt
    s0, v0 = float(situation.baseline.s[0]), float(situation.ego.speed)
    last = len(situation.baseline.s) - 1
    k = np.minimum(np.arange(len(time)), last)
    over = np.maximum(np.arange(len(time)) - last, 0) * situation.dt
    unattacked = situation.baseline.s[k] + over * situation.baseline.v[-1]
    lines = [(unattacked, situation.baseline.v[k]), (s0 + v0 * time, v0 + 0.0 * time)]
    for brake in RESPONSE_BRAKING_M_S2.values():
        since = np.clip(time - RESPONSE_DELAY_S, 0.0, v0 / brake)
        lines.append((s0 + v0 * np.minimum(time, RESPONSE_DELAY_S + since) - brake * since**2 / 2, v0 - brake * since))
    return [model, *(np.stack([*situation.baseline.path.at(s), v])[:, None, :] for s, v in lines)]


def _hits(situation: Situation, adversary: Boxes, futures: Sequence[Floats]) -> tuple[Places, Floats]:
    """Find the contacts of motions and futures.

    Return the step until which each motion matters (the first contact under any future or, without one, the end), and
    its chance of a collision that counts under each future.
    """
    n, steps = adversary.x.shape
    last, chance = np.full(n, steps - 1), np.zeros((len(futures), n))
    for f, future in enumerate(futures):
        ego = _spread(future, (n, steps), situation.ego.length, situation.ego.width)
        touches = touching(ego, adversary)
        hit, first = touches.any(axis=1), touches.argmax(axis=1)
        counts = hit & (first > 2) & (first <= situation.left) & ~_from_behind(ego, adversary, first)
        chance[f] = np.where(counts, CONFIDENCE_PER_SECOND ** (first * situation.dt), 0.0)
        last = np.where(hit, np.minimum(last, first), last)
    return last, chance


def _spread(columns: Sequence[Floats] | Floats, shape: tuple[int, int], length: float, width: float) -> Boxes:
    """Broadcast the columns of a motion to boxes."""
    x, y, heading, speed = (np.broadcast_to(column, shape) for column in columns)
    return Boxes(x, y, heading, speed, length, width)


def _from_behind(ego: Boxes, adversary: Boxes, at: Places) -> Bools:
    """Return whether, one step before ``at``, the adversary was a whole length behind the ego in its direction."""
    k = (np.arange(len(at)), np.maximum(at - 1, 0))
    a, b = pick(ego, k), pick(adversary, k)
    ahead = np.cos(a.heading) * (b.x - a.x) + np.sin(a.heading) * (b.y - a.y)
    alike = np.abs(wrap(b.heading - a.heading)) < SAME_DIRECTION
    return np.asarray(alike & (ahead < ROAD_SLACK_M - (np.asarray(a.length) + b.length) / 2))


def _off_road(encounter: Encounter, adversary: Boxes, last: Places) -> Bools:
    """Return whether a corner leaves the road up to step ``last``; every fourth step is checked."""
    k = np.arange(adversary.x.shape[1])
    judged = (k % 4 == 0) & (k <= last[:, None])
    return np.asarray(off_road(adversary, judged, encounter.drivable).any(axis=1))


def _third_party(situation: Situation, names: Sequence[str], adversary: Boxes, last: Places) -> Bools:
    """Return whether the motion touches another vehicle's unattacked motion up to step ``last``."""
    n, steps = adversary.x.shape
    touched, ids = np.zeros(n, bool), np.array(names)
    before = np.arange(steps)[None, :] <= last[:, None]
    time = np.asarray(situation.time + np.arange(steps) * situation.dt, float)
    for track in situation.traffic.others:
        b = on_grid([track], time)
        boxes = _spread((b.x, b.y, b.heading, b.speed), (n, steps), track.length, track.width)
        touched |= (touching(boxes, adversary) & before).any(axis=1) & (ids != track.id)
    return touched
