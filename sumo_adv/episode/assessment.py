"""Run attempts for the front, and turn their results into attempts with a diagnosis.

Planners run in the sandbox and answer the questions of the engine's forks. If an attack was requested in words, each
attempt is compared with the request: by rules and, if a model plays the analyzer, by the model's reading of the motion.
An attempt that does not fit has ``Verdict.misfits``. It meets no goal (``Goal.reached``), so the search continues.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from sumo_adv.agents.agents import Agents, Bought
from sumo_adv.asked import Asked, Event
from sumo_adv.config import Settings
from sumo_adv.datatypes import (
    Attempt,
    Diagnosis,
    Floats,
    Level,
    Limits,
    ObservedMotion,
    Preventability,
    Proposal,
    Track,
    Verdict,
)
from sumo_adv.episode.engine import EpisodeCalls, EpisodeEngine, PlannerQuestion
from sumo_adv.episode.rules_broken import RED, YELLOW, light_at_line
from sumo_adv.episode.scenario_naming import scenario_of
from sumo_adv.episode.task import AttemptResult, FoundEncounter
from sumo_adv.episode.verdict import sight_from
from sumo_adv.geometry import Frame, Path, wrap
from sumo_adv.goal import Goal
from sumo_adv.llm.asking import MeteredModel
from sumo_adv.metrics.reference import REFERENCE_DRIVERS
from sumo_adv.metrics.verdict import with_answers
from sumo_adv.planners.answers import Answer
from sumo_adv.planners.sandbox import Sandbox
from sumo_adv.planners.sessions import Roads, Sessions
from sumo_adv.scenario_names import columns_of, is_one_of
from sumo_adv.search.intents import labelled_by_motion
from sumo_adv.search.sampling import kind_of
from sumo_adv.situation import Situation
from sumo_adv.words.fit import compare_attackers, misfits
from sumo_adv.words.motion import DescribedMotion, Scene, observe, words_of
from sumo_adv.words.request import Reading, read_motion

# -- running attempts -----------------------------------------------------------------------------------------------


class Attempts(Protocol):
    """Runs attempts. A caller uses a result only if the attempts before it did not succeed.

    Attributes:
        displaces: Whether the ego can be placed where it would be if it arrived differently (``Proposal.arrival``).
        repeats: Whether the encounter can be attempted as often as needed, so that neighbours of a success can be
            tried.
    """

    displaces: bool
    repeats: bool

    def attempt(self, proposals: Sequence[Proposal]) -> Iterable[AttemptResult]:
        """Return the results of attempts.

        Args:
            proposals: The candidates to attempt.

        Returns:
            The results, in the order of the proposals.
        """

    def references(
        self, proposal: Proposal, result: AttemptResult, known: Mapping[str, str], all_drivers: bool
    ) -> Preventability | None:
        """Return which reference drivers avoid the collision of an attempt, kinematically and in the loop.

        Args:
            proposal: The candidate that was attempted.
            result: The result of the attempt.
            known: Answers of reference drivers that have already driven in the loop. They do not drive again.
            all_drivers: Whether all reference drivers drive in the loop (``EpisodeCalls.references``).

        Returns:
            The answers; None if there are none.
        """


class AttemptRunner:
    """Runs attempts on the engine. Each attempt gets a fresh sandbox session for each planner that is not trusted.

    Attempts run when their results are requested, as many at a time as the engine can run. Thus, if the caller stops
    at a success, no further batch runs.
    """

    def __init__(
        self, engine: EpisodeEngine, sandbox: Sandbox, found: FoundEncounter, seed: int, *, displaces: bool = True
    ) -> None:  # fmt: skip
        """Use an open engine that has found the encounter.

        Args:
            engine: Simulates the attempts.
            sandbox: Runs the planners.
            found: The encounter.
            seed: The seed of the planners' sessions.
            displaces: Whether the ego can arrive differently; False if a log moves it.
        """
        self._engine, self._sandbox, self._found, self._seed = engine, sandbox, found, seed
        self.displaces, self.repeats = displaces, True

    def attempt(self, proposals: Sequence[Proposal]) -> Iterator[AttemptResult]:
        for k in range(0, len(proposals), self._engine.at_once):
            some = list(proposals[k : k + self._engine.at_once])
            with self._answering(some) as reply:
                results = self._engine.call_answering(reply, EpisodeCalls.attempts, some)
            yield from results

    def references(
        self, proposal: Proposal, result: AttemptResult, known: Mapping[str, str], all_drivers: bool
    ) -> Preventability | None:
        with self._answering([proposal] * len(REFERENCE_DRIVERS)) as reply:
            return self._engine.call_answering(reply, EpisodeCalls.references, proposal, result, known, all_drivers)

    @contextmanager
    def _answering(self, proposals: Sequence[Proposal]) -> Iterator[Callable[[PlannerQuestion], Answer | str]]:
        """Provide what answers questions to planners; ``proposals`` are indexed by ``PlannerQuestion.index``."""
        opened: dict[tuple[int, int], Sessions] = {}
        roads = Roads(self._found.situations)

        def answer(question: PlannerQuestion) -> Answer | str:
            adversary, key = proposals[question.index].members[question.member], (question.index, question.member)
            if key not in opened:
                session = Sessions(self._sandbox, roads, [adversary], self._seed, drivable=self._found.drivable)
                opened[key] = session.__enter__()
            return opened[key].answer(adversary, question.observation)

        try:
            yield answer
        finally:
            for sessions in opened.values():
                sessions.__exit__(None, None, None)


def runner_of(engine: EpisodeEngine, sandbox: Sandbox, found: FoundEncounter, settings: Settings) -> AttemptRunner:
    """Return the runner for the attempts of an encounter.

    Args:
        engine: Simulates the attempts.
        sandbox: Runs the planners.
        found: The encounter.
        settings: The run's settings. An ego that a log moves cannot arrive differently.
    """
    return AttemptRunner(engine, sandbox, found, settings.seed, displaces=settings.ego != "replay")


# -- diagnosis ------------------------------------------------------------------------------------------------------

SAME_PLACE_DISTANCE_M = 2.0  # m; centres of two tracks that are nearer are at the same place
BRAKING_REACTION_M_S2 = 1.5  # m/s2; harder braking of the ego counts as a reaction
LIMIT_REACHED_SHARE = 0.97  # share of a limit that counts as reached
NEXT_POSITION_SEARCH_M = 25.0  # m along the ego's path within which its next position is searched


def diagnose(
    result: AttemptResult, ego: str, bv: str, ego_path: Path, limits: Limits, step_length: float
) -> Diagnosis | None:
    """Diagnose an attempt at the moment when the centres of the ego and the BV are nearest to each other.

    Args:
        result: The result of the attempt.
        ego: The ego's id.
        bv: The adversary's id.
        ego_path: The path of the unattacked ego.
        limits: The limits of the adversary's motion.
        step_length: The step of the simulation [s].

    Returns:
        The diagnosis; None if the ego or the BV has fewer than two states after the takeover.
    """
    tracks = result.tracks(step_length, ego, bv)
    if ego not in tracks or bv not in tracks:
        return None
    first, last = result.start, min(tracks[ego].time[-1], tracks[bv].time[-1])
    a, b = tracks[ego].between(first, last), tracks[bv].between(first, last)
    count = min(len(a.time), len(b.time))
    if count < 2:
        return None
    i = int(np.argmin(np.hypot(a.x[:count] - b.x[:count], a.y[:count] - b.y[:count])))
    braking = np.flatnonzero(a.acceleration < -BRAKING_REACTION_M_S2)
    return Diagnosis(
        time=round(float(a.time[i]) - first, 2), ego_frame=_seen(a, b, i), bv_frame=_seen(b, a, i),
        ego_speed=round(float(a.speed[i]), 2), bv_speed=round(float(b.speed[i]), 2), early=_early(a, b),
        ego_reaction=round(float(a.time[braking[0]]) - first, 2) if len(braking) else None,
        ego_braking=round(max(0.0, -float(a.acceleration.min())), 2), ego_shift=_shift(a, ego_path),
        bound=_bound(b, limits, step_length),
    )  # fmt: skip


def _seen(one: Track, other: Track, i: int) -> tuple[float, float]:
    """Return the place of another track's centre in the frame of a track at step ``i`` [m]."""
    frame = Frame(float(one.x[i]), float(one.y[i]), float(one.heading[i]))
    x, y, _ = frame.to_local(float(other.x[i]), float(other.y[i]), 0.0)
    return round(x, 2), round(y, 2)


def _early(ego: Track, bv: Track) -> float | None:
    """Return the time by which the BV preceded the ego at a place that both visited [s]; None without such a place.

    Of several such pairs of states, the pair with the smallest difference in time counts.
    """
    apart = np.hypot(ego.x[:, None] - bv.x[None, :], ego.y[:, None] - bv.y[None, :])
    i, j = np.nonzero(apart < SAME_PLACE_DISTANCE_M)
    if not len(i):
        return None
    between = ego.time[i] - bv.time[j]
    return round(float(between[np.argmin(np.abs(between))]), 2)


def _shift(ego: Track, path: Path) -> float:
    """Return the largest change of the ego's offset from its path [m]."""
    offsets = np.array([offset for _, offset in followed(path, ego.x, ego.y)])
    return round(float(np.max(np.abs(offsets - offsets[0]))), 2)


def followed(path: Path, x: Floats, y: Floats, reach: float = NEXT_POSITION_SEARCH_M) -> list[tuple[float, float]]:
    """Project successive places onto a path.

    Args:
        path: The path.
        x: The x of the places [m], in the order in which they were visited.
        y: Their y [m].
        reach: The maximum distance along the path between successive places [m]. The search for the first place begins
            at the beginning of the path.

    Returns:
        The station and the offset of each place [m].
    """
    places, station = list[tuple[float, float]](), 0.0
    for at in zip(x.tolist(), y.tolist(), strict=True):
        station, offset = path.project(*at, near=station, reach=reach)
        places.append((station, offset))
    return places


def _bound(bv: Track, limits: Limits, dt: float) -> tuple[str, ...]:
    """Name the limits that the BV's motion reached. The first step is left out, because SUMO drove it."""
    if len(bv.time) < 4:
        return ()
    a = bv.acceleration[1:]
    turn: Floats = wrap(np.diff(bv.heading)) / dt
    most = {
        "braking": -float(a.min()) / limits.braking, "acceleration": float(a.max()) / limits.acceleration,
        "lateral": float(np.abs(turn * bv.speed[1:]).max()) / limits.lateral,
        "jerk": float(np.abs(np.diff(a)).max()) / dt / limits.jerk,
    }  # fmt: skip
    return tuple(name for name, share in most.items() if math.isfinite(share) and share >= LIMIT_REACHED_SHARE)


# -- what was asked for ---------------------------------------------------------------------------------------------

MAX_READINGS = 2  # maximum number of attempts of an encounter that a model reads
Reader = Callable[[str], Reading]
"""A reader reads a motion in words and returns whether it fits the request. It raises ModelError if it fails."""


@dataclass
class Fitting:
    """Compares the attempts of one encounter with the request.

    Attributes:
        asked: The request, as rules compare it.
        attackers: What is requested of each of several attackers, by id.
        found: The encounter.
        settings: The run's settings.
        reader: Reads the motion if the rules find no misfit; None if no model does.
        readings: The reader's answers, by the index of the attempt.
    """

    asked: Asked
    attackers: Mapping[str, Asked]
    found: FoundEncounter
    settings: Settings
    reader: Reader | None = None
    readings: dict[int, Reading] = field(default_factory=dict, init=False)

    def judged(self, attempt: Attempt, result: AttemptResult, goal: Goal, *, read: bool = True) -> Attempt:
        """Return an attempt with its differences from the request as misfits.

        An attempt below the level ``critical`` that does not meet the goal is returned unchanged. The reader reads only
        motions that meet the goal and in which the rules find no misfit, at most ``MAX_READINGS`` in an encounter.

        Args:
            attempt: The attempt.
            result: Its result.
            goal: What an attempt must reach.
            read: Whether the reader may be used.

        Raises:
            ModelError: The reader gave no usable answer.
        """
        if attempt.verdict.level < Level.CRITICAL and not goal.met(attempt.verdict):
            return attempt
        motions = motions_of(attempt, result, self.found, self.settings, tuple(self.attackers))
        lacks: tuple[str, ...] = ("The adversary or the ego was gone at once.",)
        if motions:
            lacks = misfits(compare_attackers(self.asked, self.attackers, motions, attempt.proposal.bv))
        may_read = read and not lacks and goal.met(attempt.verdict) and len(self.readings) < MAX_READINGS
        if may_read and self.reader is not None:
            reading = self.readings[attempt.index] = self.reader(words_of(list(motions.values())))
            lacks = () if reading.fits else (reading.lacks,)
        lacks = tuple(dict.fromkeys((*attempt.verdict.misfits, *lacks)))
        return replace(attempt, verdict=replace(attempt.verdict, misfits=lacks))


def reader_of(agents: Agents, words: str) -> Reader | None:
    """Return the model that plays the analyzer, as a reader of motions.

    Args:
        agents: The models of the run.
        words: The request in words.

    Returns:
        The reader; None if no model plays the analyzer, or if the request is empty.
    """
    if not agents.by_model("analyzer") or not words:
        return None
    metered = MeteredModel(agents.models["analyzer"], agents.ledger)

    def read(motion: str) -> Reading:
        reading = read_motion(metered, agents.prompts, motion, words)
        agents.bought.append(Bought("reader", "it fits" if reading.fits else "it does not fit"))
        return reading

    return read


def motions_of(
    attempt: Attempt, result: AttemptResult, found: FoundEncounter, settings: Settings, attackers: Sequence[str] = ()
) -> dict[str, DescribedMotion]:
    """Describe what happened in an attempt, from the takeover of the adversaries to the contact.

    Args:
        attempt: The attempt.
        result: Its result.
        found: The encounter.
        settings: The run's settings.
        attackers: The ids of several attackers; empty for the collider alone.

    Returns:
        The motion of each attacker by id, without those that were gone at once or are no target of their situation.
        Each is described at least as long as that of the collider. Empty if the ego or the collider was gone at once.
    """
    collider = attempt.proposal.bv
    first = _motion_of(collider, attempt, result, found, settings)
    if first is None:
        return {}
    until = float(first.time[-1])
    made = {
        name: first if name == collider else _motion_of(name, attempt, result, found, settings, until)
        for name in attackers or (collider,)
    }
    return {name: motion for name, motion in made.items() if motion is not None}


def _motion_of(
    bv: str, attempt: Attempt, result: AttemptResult, found: FoundEncounter, settings: Settings, until: float = 0.0
) -> DescribedMotion | None:
    """Describe what one attacker did, at least until ``until`` [s after the start of the attack].

    Return None if it or the ego was gone at once, or if it is no target.
    """
    p, start, end = attempt.proposal, result.start, attempt.verdict.contact_time
    situation = found.situations.get(p.delay)
    target = None if situation is None else situation.targets.get(bv)
    if situation is None or target is None:
        return None
    last = math.inf if end is None else end
    cut = {name: t.between(start, last) for name, t in result.tracks(settings.step_length).items()}
    if found.ego not in cut or bv not in cut:
        return None
    others = [t for name, t in cut.items() if name not in (found.ego, bv)]
    first = found.first.targets.get(bv, target)
    return observe(
        Scene(
            cut[found.ego], cut[bv], others, situation.baseline.path, first.relation, first.hidden,
            attempt.verdict.contact_side if attempt.verdict.collided and bv == p.bv else None, start,
            _runs_light(bv, situation, result, float(cut[bv].time[0]) if len(cut[bv].time) else start),
            sight_from(found, settings, start), until, situation.frame.hand,
        )
    )  # fmt: skip


def _runs_light(bv: str, situation: Situation, result: AttemptResult, begun: float) -> tuple[float, Event] | None:
    """Return when the adversary passes its stop line on yellow or red [s], and the event; None if it does not."""
    passed = light_at_line(bv, situation.traffic.signals.get(bv, ()), [s for s in result.snapshots if s.time >= begun])
    if passed is None or passed.letter not in RED + YELLOW:
        return None
    return passed.time, Event.RUNS_RED if passed.letter in RED else Event.RUNS_YELLOW


# -- from a result to an attempt ------------------------------------------------------------------------------------

NO_MOTION_VERDICT = Verdict(float("inf"), float("inf"), False, False, False, False, failed_gates=("no_motion",))


def attempt_of(
    index: int, phase: str, proposal: Proposal, result: AttemptResult, found: FoundEncounter, settings: Settings
) -> Attempt:
    """Make an attempt from its result. An attempt whose planner failed is not feasible.

    Of several attackers, the one that the verdict is on becomes the collider.

    Args:
        index: The index of the attempt in its encounter.
        phase: The phase of the run that made the attempt.
        proposal: The candidate that was attempted.
        result: The result.
        found: The encounter.
        settings: The run's settings.
    """
    verdict = result.verdict or NO_MOTION_VERDICT
    if verdict.attackers:
        proposal = proposal.led_by(verdict.attackers[0].id)
    if result.driven.ending == "planner_failed":
        failed = (*verdict.failed_gates, "planner_failed")
        verdict = replace(verdict, feasible=False, failed_gates=failed, level=Level.NONE)
    path = found.situations[proposal.delay].baseline.path
    target = found.situations[proposal.delay].targets.get(proposal.bv)
    limits = settings.limits.limits() if target is None else settings.limits.of(target.state)
    diagnosis = diagnose(result, found.ego, proposal.bv, path, limits, settings.step_length)
    kind = ""
    if target is not None:
        proposal = labelled_by_motion(proposal, target, verdict)
        kind = kind_of(proposal.label, target.relation, verdict.contact_side)
    scenario = scenario_of(proposal, verdict, result, found, settings)
    if settings.scenario and not is_one_of(columns_of(scenario), settings.scenario_names):
        shown = "nothing that has a name" if scenario is None else scenario.motion
        misfit = f"It shows {shown}, not {' or '.join(settings.scenario)}."
        verdict = replace(verdict, misfits=(*verdict.misfits, misfit))
    return Attempt(
        index, phase, proposal, result.start, verdict, result.driven.ending, result.driven.message, diagnosis, kind,
        scenario,
    )  # fmt: skip


def observed_motion(
    result: AttemptResult, found: FoundEncounter, delay: float, settings: Settings
) -> ObservedMotion | None:
    """Return the ego's motion from the takeover on.

    Args:
        result: The result of the attempt.
        found: The encounter.
        delay: The start of the attempt, as time after the trigger [s].
        settings: The run's settings.

    Returns:
        The motion over ``settings.duration``. After the end of the attempt, the speed is constant. None if the ego was
        gone at once.
    """
    situation, dt = found.situations[delay], settings.step_length
    whole = result.tracks(dt, found.ego).get(found.ego)
    track = None if whole is None else whole.between(result.start, math.inf)
    if track is None or len(track.time) < 2:
        return None
    missing = range(round((float(track.time[0]) - result.start) / dt))  # nothing is recorded at the trigger itself
    places = [(float(situation.baseline.s[k]), 0.0) for k in missing]
    speeds = np.concatenate([situation.baseline.v[: len(missing)], track.speed])
    places += followed(situation.baseline.path, track.x, track.y)
    steps = settings.steps(settings.duration)
    over = np.maximum(np.arange(steps + 1) - (len(places) - 1), 0) * dt
    k = np.minimum(np.arange(steps + 1), len(places) - 1)
    stations, offsets = np.array(places)[k].T
    return ObservedMotion(stations + over * float(speeds[-1]), offsets, speeds[k], len(places))


def checked(attempt: Attempt, result: AttemptResult, runner: Attempts, goal: Goal, best: Level) -> Attempt:
    """Confirm an attempt in the loop if it claims a level.

    An attempt claims a level if its verdict is at least ``valid`` and meets the goal or exceeds the best level so far.

    Args:
        attempt: The attempt.
        result: Its result.
        runner: Runs the reference drivers.
        goal: What an attempt must reach.
        best: The highest level of the attempts so far.

    Returns:
        The attempt, with the answers of the reference drivers if it claims a level.
    """
    claims = attempt.verdict.level >= Level.VALID and (goal.met(attempt.verdict) or attempt.verdict.level > best)
    return confirmed(attempt, result, runner) if claims else attempt


def confirmed(attempt: Attempt, result: AttemptResult, runner: Attempts, *, all_drivers: bool = False) -> Attempt:
    """Add the answers of reference drivers in the loop to the verdict on an attempt.

    The attempt is returned unchanged if it is below the level ``collision``, if reference drivers were never asked, or
    if they were asked in the loop before and not all drivers are wanted now.

    Args:
        attempt: The attempt.
        result: Its result.
        runner: Runs the reference drivers.
        all_drivers: Whether drivers also answer on which the level does not depend.
    """
    verdict, prevention = attempt.verdict, attempt.verdict.preventability
    if verdict.level < Level.COLLISION or prevention is None or (prevention.in_loop and not all_drivers):
        return attempt
    answer = runner.references(attempt.proposal, result, prevention.in_loop, all_drivers)
    return attempt if answer is None else replace(attempt, verdict=with_answers(verdict, answer))
