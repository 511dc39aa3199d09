"""Proposals scored by prediction: numpy rollouts of the planners' own answers, judged by the verdicts' own functions.

Score, lower is better (ALGORITHM, "How it was built"): a feasible collision that is not rear-end scores by who could
have avoided it; no hit, an infeasible one, a third party hit first and a rear-end follow.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sumo_adv.config import Settings
from sumo_adv.datatypes import Bools, Boxes, Floats, Planner, Proposal, acceleration_at
from sumo_adv.errors import PlannerLimitError, SandboxError
from sumo_adv.geometry import wrap_all
from sumo_adv.metrics.avoidance import avoidance
from sumo_adv.metrics.boxes import gap, on_grid, overlaps
from sumo_adv.metrics.criticality import ttc
from sumo_adv.metrics.hazard import hazard_index
from sumo_adv.planning.follow import off_road
from sumo_adv.planning.ground import road_of
from sumo_adv.planning.predict import Answer, Rollouts, Told, predict, world_endpoint
from sumo_adv.planning.sandbox import Call, Sandbox
from sumo_adv.situation import Situation
from sumo_adv.world.network import Drivable

NONE, MISS, OFF_ROAD, THIRD, REAR, FAILED = 1.2, 1.5, 3.0, 4.0, 5.0, 9.0
DELAYS = (0.6, 0.8, 1.0)  # s after the hazard shows at which a manoeuvre begins
LEAST_STEPS = 3
TOGETHER = 12  # planners with a sandbox session open at once
TRAJECTORY_SECONDS = 20.0  # s all calls of one planner's own trajectory() may take in the predictions of one batch


class Foresight:
    """Predicts and scores proposals; ``seconds`` and ``count`` say what that has cost so far."""

    def __init__(self, sandbox: Sandbox, settings: Settings, drivable: Drivable, situations: Mapping[float, Situation]):
        self._sandbox = sandbox
        self._settings = settings
        self._drivable = drivable
        self._situations = situations
        self.seconds, self.count = 0.0, 0
        self.failures: dict[str, str] = {}  # planner hash -> sentence

    def score(self, proposals: Sequence[Proposal]) -> list[Proposal]:
        """The same proposals with ``score`` and ``predicted`` filled in."""
        began = time.perf_counter()
        scored: dict[int, Proposal] = {}
        for delay, hashes in _batches(proposals):
            rows = [k for k, p in enumerate(proposals) if p.delay == delay and p.planner.hash in hashes]
            for k, p in zip(rows, self._together(delay, [proposals[k] for k in rows]), strict=True):
                scored[k] = p
        self.seconds += time.perf_counter() - began
        self.count += len(proposals)
        return [scored[k] for k in range(len(proposals))]

    def _together(self, delay: float, proposals: list[Proposal]) -> list[Proposal]:
        situation, settings = self._situations[delay], self._settings
        planners = [p.planner for p in proposals]
        with Sessions(
            self._sandbox, situation, planners, settings.seed, self.failures, drivable=self._drivable
        ) as sessions:
            rollouts = predict(
                situation, proposals, lambda rows, told: sessions.ask(proposals, rows, told),
                limits=settings.limits.limits(), steps=settings.steps(settings.duration),
                replan=settings.steps(settings.replan),
            )  # fmt: skip
            self.failures |= sessions.failures
        results = judge_all(situation, proposals, rollouts, self._drivable)
        failed = {p.planner.hash for p in proposals} & set(self.failures)
        return [
            replace(p, score=FAILED, predicted={"failed": self.failures[p.planner.hash]})
            if p.planner.hash in failed
            else replace(p, score=r["score"], predicted=r)
            for p, r in zip(proposals, results, strict=True)
        ]


def _batches(proposals: Sequence[Proposal]) -> list[tuple[float, set[str]]]:
    """What is predicted together: one delay, and at most ``TOGETHER`` planners, each in a session of its own."""
    found = []
    for delay in sorted({p.delay for p in proposals}):
        hashes = list(dict.fromkeys(p.planner.hash for p in proposals if p.delay == delay))
        found += [(delay, set(hashes[k : k + TOGETHER])) for k in range(0, len(hashes), TOGETHER)]
    return found


class Sessions:
    """One sandbox session for each planner of a batch."""

    def __init__(
        self,
        sandbox: Sandbox,
        situation: Situation,
        planners: Sequence[Planner],
        seed: int,
        failed: Mapping[str, str] | None = None,
        *,
        drivable: Drivable | None = None,
    ) -> None:
        self._situation, self._drivable = situation, drivable
        self._spent: dict[str, float] = {}  # planner hash -> s in its trajectory()
        self._roads = {n: road_of(situation, n) for n in situation.targets}
        self._sandbox, self._seed = sandbox, seed
        self._open: dict[str, Any] = {}
        self.failures: dict[str, str] = dict(failed or {})  # planner hash -> sentence; those are not asked again
        self._planners = {p.hash: p for p in planners if p.hash not in self.failures}

    def __enter__(self) -> Sessions:
        for name, planner in self._planners.items():
            try:
                self._open[name] = self._sandbox.session(planner, self._roads, seed=self._seed).__enter__()
            except SandboxError as error:
                self.failures[name] = str(error)
        return self

    def __exit__(self, *_: object) -> None:
        for session in self._open.values():
            session.__exit__(None, None, None)

    def one(self, proposal: Proposal, told: Told) -> Answer:
        """The answer to one question. Raises SandboxError."""
        name = proposal.planner.hash
        if name in self.failures:
            raise SandboxError(self.failures[name])
        end: dict[str, float] = self._open[name].endpoint(*self._call(proposal, told))
        return self._answer(proposal, told, end)

    def _call(self, proposal: Proposal, told: Told) -> Call:
        acceleration = acceleration_at(proposal.acceleration, told[0]["time"])
        return proposal.bv, *told, proposal.parameters, acceleration, self._situation.horizon

    def _answer(self, proposal: Proposal, told: Told, end: dict[str, float]) -> Answer:
        """An endpoint in the world, with the planner's own trajectory to it if it defines one and it is on the road."""
        situation, session = self._situation, self._open[proposal.planner.hash]
        endpoint = world_endpoint(situation, end)
        if not session.has_trajectory:
            return Answer(endpoint)
        own = session.trajectory(proposal.bv, told[0], end, situation.dt)
        states = np.array([(*situation.frame.to_world(x, y, h), v) for x, y, h, v in own])
        bv = situation.targets[proposal.bv].state
        if self._drivable is not None:
            leaves = off_road(states, bv.length, bv.width, situation.dt, self._drivable)
            if leaves is not None:
                what = f"trajectory() leaves the road {leaves:.1f} s later, and the built-in one was driven"
                return Answer(endpoint, None, what)
        return Answer(endpoint, states)

    def ask(self, proposals: Sequence[Proposal], rows: Sequence[int], told: Sequence[Told]) -> list[Answer | None]:
        """Answers for the proposals ``rows``; None where the planner failed."""
        answers: list[Answer | None] = [None] * len(rows)
        for name, session in self._open.items():
            mine = [k for k in rows if proposals[k].planner.hash == name]
            if not mine or name in self.failures:
                continue
            try:
                found = session.endpoints([self._call(proposals[k], told[k]) for k in mine])
            except SandboxError as error:
                self.failures[name] = str(error)
                continue
            for k, answer in zip(mine, found, strict=True):
                try:
                    if isinstance(answer, SandboxError):
                        raise answer
                    answers[k] = self._timed(proposals[k], told[k], answer)
                except SandboxError as error:
                    self.failures.setdefault(name, str(error))
        return answers

    def _timed(self, proposal: Proposal, told: Told, end: dict[str, float]) -> Answer:
        """``_answer`` within what all predictions of a batch may take. Raises SandboxError."""
        name = proposal.planner.hash
        if self._spent.get(name, 0.0) > TRAJECTORY_SECONDS:
            who = f"Planner {proposal.label}/{proposal.planner.mode}"
            raise PlannerLimitError(f"{who}: trajectory() is too slow for predictions: make it faster.")
        began = time.perf_counter()
        answer = self._answer(proposal, told, end)
        self._spent[name] = self._spent.get(name, 0.0) + time.perf_counter() - began
        return answer


def judge_all(
    situation: Situation, proposals: Sequence[Proposal], rollouts: Rollouts, drivable: Drivable
) -> list[dict[str, Any]]:
    """For each rollout: hit, min TTC, who could avoid it, s from the hazard to the contact, and the score."""
    n, steps = rollouts.ego[0].shape
    lengths = np.array([[situation.targets[p.bv].state.length] for p in proposals])
    widths = np.array([[situation.targets[p.bv].state.width] for p in proposals])
    ego = Boxes(*rollouts.ego, situation.ego.length, situation.ego.width)
    adversary = Boxes(*rollouts.adversary, lengths, widths)
    contact = _first(_touching(ego, adversary))
    hit = contact < steps
    last = np.minimum(contact, steps - 1)
    third = _third_party(situation, proposals, adversary, last)
    off_road = _off_road(adversary, last, drivable)
    rear = hit & _rear(ego, adversary, last)
    least, nearest = _least(ego, adversary, last)
    good = np.flatnonzero(hit & ~third & ~off_road & ~rear & (contact >= LEAST_STEPS))
    score = np.where(hit, NONE, MISS + 0.3 * np.minimum(least, 10.0) + 0.1 * np.minimum(nearest, 30.0))
    score = np.where(off_road, OFF_ROAD, score)
    score = np.where(third, THIRD, np.where(rear, REAR, score))
    careful, manoeuvre, hazard = np.zeros(n, bool), np.zeros((n, len(DELAYS)), bool), np.array(last)
    if len(good):
        careful[good], manoeuvre[good], hazard[good] = _avoidable(situation, ego, adversary, good, last[good], drivable)
        score[good] = _score(careful[good], manoeuvre[good])
    return [
        {
            "score": float(score[k]), "hit": bool(hit[k]), "min_ttc": 0.0 if hit[k] else float(least[k]),
            "gap": float(nearest[k]), "careful": bool(careful[k]), "manoeuvre": bool(manoeuvre[k, 1]),
            "rear": bool(rear[k]), "third_party": bool(third[k]), "off_road": bool(off_road[k]),
            "time": float(last[k] * situation.dt), "warning": float((last[k] - hazard[k]) * situation.dt),
        }
        for k in range(n)
    ]  # fmt: skip


def _touching(a: Boxes, b: Boxes) -> Bools:
    near = np.hypot(a.x - b.x, a.y - b.y) < _half_diagonal(a) + _half_diagonal(b)
    touching = np.zeros(near.shape, bool)
    k = np.nonzero(near)
    if len(k[0]):
        touching[k] = overlaps(_pick(a, k), _pick(b, k))
    return touching


def _half_diagonal(b: Boxes) -> Floats:
    return np.hypot(np.asarray(b.length, float), np.asarray(b.width, float)) / 2


def _pick(b: Boxes, k: Any) -> Boxes:
    size = [np.broadcast_to(np.asarray(v, float), b.x.shape)[k] for v in (b.length, b.width)]
    return Boxes(b.x[k], b.y[k], b.heading[k], b.speed[k], *size)


def _first(holds: Bools) -> Any:
    return np.where(holds.any(axis=1), holds.argmax(axis=1), holds.shape[1])


def _score(careful: Bools, manoeuvre: Bools) -> Floats:
    early, middle, late = manoeuvre.T
    by = np.where(late, 0.1, np.where(middle, 0.2, np.where(early, 0.6, NONE)))
    return np.where(careful, np.where(late, 0.0, 0.06), by)


def _rear(ego: Boxes, adversary: Boxes, at: Any) -> Bools:
    """The adversary behind, going the same way, in line and faster at the contact."""
    k = (np.arange(len(at)), at)
    a, b = _pick(ego, k), _pick(adversary, k)
    turned = np.abs(wrap_all(b.heading - a.heading))
    c, s = np.cos(a.heading), np.sin(a.heading)
    ahead = c * (b.x - a.x) + s * (b.y - a.y)
    left = -s * (b.x - a.x) + c * (b.y - a.y)
    overlap = (np.asarray(a.length) + np.asarray(b.length)) / 2
    in_line = np.abs(left) < 0.8 * (np.asarray(a.width) + np.asarray(b.width)) / 2
    return np.asarray((turned < np.pi / 4) & (ahead < -0.75 * overlap) & in_line & (b.speed > a.speed))


def _least(ego: Boxes, adversary: Boxes, last: Any) -> tuple[Floats, Floats]:
    """Least TTC [s] and least box distance [m] up to the contact, every third step."""
    steps = np.arange(0, ego.x.shape[1], 3)
    pick = (np.arange(len(last))[:, None], steps[None, :])
    a, b = _pick(ego, pick), _pick(adversary, pick)
    before = steps[None, :] <= last[:, None]
    centres = np.where(before, np.hypot(a.x - b.x, a.y - b.y), np.inf)
    at = (np.arange(len(last)), centres.argmin(axis=1))
    return np.where(before, ttc(a, b), np.inf).min(axis=1), np.asarray(gap(_pick(a, at), _pick(b, at)))


def _third_party(situation: Situation, proposals: Sequence[Proposal], adversary: Boxes, last: Any) -> Bools:
    """Whether the adversary touches a vehicle in its unattacked motion before the ego."""
    tracks = situation.others
    found = np.zeros(len(proposals), bool)
    if not tracks:
        return found
    steps = adversary.x.shape[1]
    grid = on_grid(tracks, np.asarray(situation.time + np.arange(steps) * situation.dt, float))
    names = np.array([t.id for t in tracks])
    for k, proposal in enumerate(proposals):
        until = slice(0, int(last[k]) + 1)
        apart = np.hypot(grid.x[:, until] - adversary.x[k, until], grid.y[:, until] - adversary.y[k, until])
        near = apart < _half_diagonal(grid) + _half_diagonal(adversary)[k]
        near &= (names != proposal.bv)[:, None]
        i, j = np.nonzero(near)
        if len(i):
            rows = np.full(len(i), k)
            found[k] = bool(overlaps(_pick(grid, (i, j)), _pick(adversary, (rows, j))).any())
    return found


def _off_road(adversary: Boxes, last: Any, drivable: Drivable) -> Bools:
    """Whether a corner (0.15 m within the box) leaves the carriageway, every fourth step."""
    steps = np.arange(0, adversary.x.shape[1], 4)
    x, y, h = adversary.x[:, steps], adversary.y[:, steps], adversary.heading[:, steps]
    out = np.zeros(x.shape, bool)
    for along in (-0.5, 0.5):
        for aside in (-0.5, 0.5):
            a = along * (np.asarray(adversary.length) - 0.3)
            b = aside * (np.asarray(adversary.width) - 0.3)
            out |= ~drivable(x + a * np.cos(h) - b * np.sin(h), y + a * np.sin(h) + b * np.cos(h))
    return np.asarray((out & (steps[None, :] <= last[:, None])).any(axis=1))


def _avoidable(
    situation: Situation, ego: Boxes, adversary: Boxes, good: Any, last: Any, drivable: Drivable
) -> tuple[Bools, Bools, Any]:
    a, b = _rows(ego, good), _rows(adversary, good)
    start = np.zeros(len(good), np.intp)
    hazard, _ = hazard_index(a, b, start, last, situation.dt, lane_half_width=situation.lane_width / 2)
    found = avoidance(a, b, hazard, situation.dt, delays=DELAYS, on_road=drivable)
    return found["careful"], found["manoeuvre"], hazard


def _rows(b: Boxes, rows: Any) -> Boxes:
    size = [v if np.ndim(v) == 0 else np.asarray(v)[rows] for v in (b.length, b.width)]
    return Boxes(b.x[rows], b.y[rows], b.heading[rows], b.speed[rows], *size)
