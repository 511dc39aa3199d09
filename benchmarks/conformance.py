"""Whether the drivers that the program predicts with do what SUMO's drivers do, on random scenes by situation.

    python benchmarks/conformance.py [--encounters N] [--plans N] [--kind NAME ...] [--perturb]

In each encounter SUMO drives the ego against motions of the adversary that are given in advance, and the prediction
drives it against the same motions. Printed of each situation and driver: the scenes, and the median, the 90 % quantile
and the maximum over them of the largest error along the path [m], sideways [m] and of the speed [m/s] within a scene.
Where the ego gives way, the share of scenes in which both wait or both go is bounded, too. Then single scenes follow
that depend on one constant (``CHOSEN``). Status 1 if a bound of ``conformance_scenes.py`` is broken.
Left out are scenes in which SUMO's ego changes lanes, which no prediction does, and what comes after a contact.

``--perturb`` also changes each constant by 20 %, down and up, one at a time, and prints a table: the constant, its
file, and for either change the situations and single scenes where a bound then breaks. ``benchmarks/README.md`` has
the table as it was last made.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from conformance_scenes import ADVERSARY, CHOSEN, KINDS, Plan

from sumo_adv.benchmark.nouns import course_proposal
from sumo_adv.config import load_settings
from sumo_adv.datatypes import Bools, Floats, ObservedMotion, PrescribedMotion
from sumo_adv.drivers.prediction import PredictedEgos
from sumo_adv.episode.assessment import observed_motion
from sumo_adv.episode.task import FoundEncounter, make_task
from sumo_adv.episode.worker import Worker
from sumo_adv.planners.adversary_batch import AdversaryBatch
from sumo_adv.planners.trajectory import Batch, Motion, pose, start
from sumo_adv.simulation.engine import Engine, in_forks
from sumo_adv.situation import Situation

SECONDS = 8.0  # of an attack
PROFILE = 3.0  # s that the unattacked ego is known for beyond that
CHANGES_LANE = 1.0  # m off the middle of its lane: no driver moves so far over to make room
AT_ONCE = 2  # encounters
CAREFUL = ("following", "cut_in", "crossing")  # situations that the careful driver is compared in, too
QUANTILES = (0.5, 0.9, 1.0)
SHARE = 0.2  # of a constant
WAITS = 2.0  # m/s: an ego that is slower before the junction waits
BEFORE = 0.5  # m past the line up to which a front counts as before the junction


@dataclass(frozen=True, slots=True)
class Driven:
    """What SUMO's ego did in one encounter: ``seen[k]`` against the adversary on ``plans[k]``, drawn as number
    ``numbers[k]``."""

    situation: Situation
    numbers: tuple[int, ...]
    plans: tuple[Plan, ...]
    seen: tuple[ObservedMotion, ...]


class Attacks:
    """The adversary's motions by plan: as SUMO gets them (``courses``), and the egos predicted for them."""

    def __init__(self, situation: Situation, plans: Sequence[Plan]) -> None:
        n, target, dt = len(plans), situation.targets[ADVERSARY], situation.dt
        self._ground = AdversaryBatch([situation] * n, [ADVERSARY] * n)
        self._ground.rows.row = self._ground.rows.row + np.array([p.way for p in plans])
        self._width = np.full(n, target.state.width)
        time = np.arange(round(SECONDS / dt) + 1) * dt
        v = np.stack([p.speeds(target.state.speed, time) for p in plans])
        d = np.stack([p.offsets(target.offset, speeds, time) for p, speeds in zip(plans, v, strict=True)])
        s, slope, a = (np.full(n, q) for q in (target.station, np.sin(target.turn), target.state.acceleration))
        self._motions: list[Motion] = [start(Batch, s, d[:, 0], slope, v[:, 0], a)]
        for k in range(1, len(time)):
            aside, speed = (d[:, k] - d[:, k - 1]) / dt, v[:, k]
            slope = np.where(speed > 0.01, aside / np.maximum(speed, 0.01), slope)
            bend = self._ground.rows.at(s)[3]
            s = s + dt * np.sqrt(np.maximum(speed**2 - aside**2, 0.0)) / np.maximum(1.0 - bend * d[:, k], 0.2)
            self._motions.append(start(Batch, s, d[:, k], slope, speed, (speed - v[:, k - 1]) / dt))

    def courses(self) -> list[PrescribedMotion]:
        """One a plan, from the step after the takeover on."""
        poses = np.array([(*pose(Batch, m, self._ground.rows), m.v) for m in self._motions[1:]])
        return [PrescribedMotion(*np.ascontiguousarray(poses[:, :, k].T)) for k in range(poses.shape[2])]

    def predicted(self) -> Floats:
        """Station, offset, speed of the predicted egos by step, ``(3, n, steps)``."""
        ground, states = self._ground, []
        egos = PredictedEgos(ground.scenes, ground.names, ground.length, self._width)
        for k, motion in enumerate(self._motions):
            states.append((egos.s, egos.d, egos.v))
            egos.step(k * ground.scenes.dt, ground.relative(motion), motion.v, ground.at_junction(motion))
        return np.array(states).transpose(1, 2, 0)


Job = tuple[str, str, int, Sequence[int]]
"""Situation, driver, seed, numbers of the plans in the order in which they are drawn."""
Scenes = Mapping[str, Sequence[Driven]]
"""By situation, or by single scene."""


def drive(slots: Sequence[Connection], kind: str, driver: str, seed: int, numbers: Sequence[int]) -> Driven | None:
    """One encounter in SUMO, in a process that holds no simulation; None if it failed."""
    definition, draw = KINDS[kind], np.random.default_rng([seed, *kind.encode()])
    settings = load_settings(
        None, ego=driver, seed=seed, duration=SECONDS, delays=(0.0, PROFILE), critical_ttc=0.01, fork=False
    )  # fmt: skip
    with tempfile.TemporaryDirectory(prefix="sumo_adv-") as name:
        worker = Worker(slots)
        worker.open(make_task(definition.start(draw).source(Path(name)), settings, Path(name)))
        encounter = worker.seek()
        if not isinstance(encounter, FoundEncounter):
            return None
        delay = min(encounter.situations)
        situation = encounter.situations[delay]
        target = situation.targets[ADVERSARY]
        drawn = [definition.plan(draw, situation, target) for _ in range(max(numbers) + 1)]
        plans = [drawn[k] for k in numbers]
        courses = Attacks(situation, plans).courses()
        results = worker.attempts([course_proposal("conformance", ADVERSARY, delay, c) for c in courses])
    seen = [observed_motion(r, encounter, delay, settings) for r in results]
    kept = [(k, p, s) for k, p, s in zip(numbers, plans, seen, strict=True) if s is not None and not _changes_lane(s)]
    return Driven(situation, *zip(*kept, strict=True)) if kept else None


def _changes_lane(seen: ObservedMotion) -> bool:
    return bool(np.abs(seen.d[: seen.seen]).max() > CHANGES_LANE)


def body(slots: list[Connection]) -> dict[str, Callable[..., Any]]:
    """The engine's commands."""

    def scenes(jobs: Sequence[Job]) -> list[Driven | None]:
        return in_forks([partial(drive, slots, *job) for job in jobs])

    return {"scenes": scenes}


def run(engine: Engine, jobs: Sequence[Job]) -> list[Driven]:
    """The encounters of the jobs that came to something."""
    driven: list[Driven | None] = []
    for first in range(0, len(jobs), AT_ONCE):
        driven += engine.request("scenes", jobs[first : first + AT_ONCE])
    return [encounter for encounter in driven if encounter is not None]


def errors(driven: Sequence[Driven]) -> Floats:
    """Each scene's largest error along the path [m], sideways [m] and of the speed [m/s], ``(3, scenes)``."""
    largest = [np.empty((3, 0))]
    for encounter in driven:
        predicted = Attacks(encounter.situation, encounter.plans).predicted()
        for k, seen in enumerate(encounter.seen):
            count = min(seen.seen, predicted.shape[2])
            real = np.stack([seen.s, seen.d, seen.v])[:, :count]
            largest.append(np.abs(predicted[:, k, :count] - real).max(axis=1, keepdims=True))
    return np.concatenate(largest, axis=1)


def waits(driven: Sequence[Driven]) -> Bools:
    """Whether the predicted ego and SUMO's wait before the junction, ``(2, scenes)``."""
    waiting = [np.empty((2, 0), bool)]
    for encounter in driven:
        predicted, road = Attacks(encounter.situation, encounter.plans).predicted(), encounter.situation.road
        half = encounter.situation.ego.length / 2
        line = road.bay if np.isfinite(road.bay) else road.junction
        for k, seen in enumerate(encounter.seen):
            count = min(seen.seen, predicted.shape[2])
            s, v = (np.stack([predicted[q, k, :count], real[:count]]) for q, real in ((0, seen.s), (2, seen.v)))
            waiting.append((np.where(s + half < line + BEFORE, v, np.inf).min(axis=1) < WAITS)[:, None])
    return np.concatenate(waiting, axis=1)


def quantiles(of: Floats) -> Floats:
    """Median, 90 % quantile and maximum of each error, ``(3, 3)``."""
    return np.array(np.quantile(of, QUANTILES, axis=1).T)


UNITS = ("m along the path", "m sideways", "m/s")


def broken(kind: str, of: Floats) -> list[str]:
    """What is wrong with the errors of a situation; each sentence names the rules that it exercises."""
    sentences = []
    for name, measured, bounds in zip(UNITS, quantiles(of), KINDS[kind].bounds, strict=True):
        for quantile, error, bound in zip(("median", "90 %", "maximum"), measured, bounds, strict=True):
            if error > bound:
                sentences.append(
                    f"{kind}: the {quantile} of the error is {error:.3f} {name}, more than {bound:g}. SUMO and the "
                    f"prediction differ in {KINDS[kind].rules}."
                )
    return sentences


def undecided(kind: str, predicted: Bools, real: Bools) -> list[str]:
    """What is wrong with the decisions to wait of a situation, ``(scenes,)`` each."""
    definition, differences = KINDS[kind], []
    agree, missed = float(np.mean(predicted == real)), float(np.mean(real & ~predicted))
    if agree < definition.agree:
        differences.append(f"in {agree:.0%} of the scenes, less than {definition.agree:.0%}, both egos wait or both go")
    if missed > definition.missed:
        differences.append(f"in {missed:.0%} of the scenes, more than {definition.missed:.0%}, only SUMO's ego waits")
    return [
        f"{kind}: {difference}. SUMO and the prediction differ in {definition.rules}." for difference in differences
    ]


def faults(kind: str, driven: Sequence[Driven]) -> list[str]:
    """What is wrong with the prediction in the scenes of a situation."""
    of = errors(driven)
    if not KINDS[kind].agree:
        return broken(kind, of)
    predicted, real = waits(driven)
    return undecided(kind, predicted, real) + broken(kind, of[:, predicted == real])


def chosen_job(name: str) -> Job:
    """The job of a single scene."""
    scene = CHOSEN[name]
    return scene.kind, scene.driver, scene.seed, (scene.plan,)


def chosen_faults(name: str, driven: Sequence[Driven]) -> list[str]:
    """What is wrong with the prediction in a single scene."""
    scene = CHOSEN[name]
    if not driven:
        return [f"{name}: SUMO gave no comparable run of this scene."]
    return [
        f"{name}: the error is {error:.3f} {unit}, more than {bound:g}. SUMO and the prediction differ in "
        f"{', '.join(scene.constants)}, {KINDS[scene.kind].rules}."
        for unit, error, bound in zip(UNITS, errors(driven)[:, 0], scene.bounds, strict=True)
        if error > bound
    ]


# -- constants that are wrong -------------------------------------------------------------------------------------

COPIED = {
    "drivers.car_following": ("AMPLIFIED",),
    "drivers.prediction": ("OVER", "TURNED", "BACK"),
    "drivers.lateral_gap": ("SUBLANE", "GAP", "LATERAL_SPEED", "LATERAL_ACCELERATION"),
    "drivers.leaders": ("JAM",),
    "drivers.junctions": ("AHEAD", "SEES", "STOPS_BEFORE"),
    "planners.adversary_batch": ("SUMO_TURN_COST", "SUMO_LOYALTY", "JOINED"),
}
"""The constants that copy SUMO, from its source or measured in it, by module. Two more are not
changed here: ``NUMERICAL`` of ``car_following.py``, a millimetre, and ``HALTING`` of ``junctions.py``, which only
keeps a divisor from zero."""
OWN = {
    "drivers.prediction": ("ACROSS", "SAME_WAY"),
    "drivers.leaders": ("HELD_UP", "ALONG", "BRAKES", "LATE", "NOTICED"),
    "drivers.junctions": ("FOE_ACCELERATION", "FOE_SPEED", "CLEARANCE", "LONGEST"),
    "planners.adversary_batch": ("AFTER",),
}
"""Other constants of the same modules, which SUMO's source does not have. Angles stand for the lanes by which SUMO
knows which way a vehicle drives. Tolerances say from when on an ego counts as disturbed or held up.
``FOE_ACCELERATION`` and ``FOE_SPEED`` stand for what SUMO knows of the other vehicle and of its road. ``CLEARANCE``,
``LONGEST`` and ``AFTER`` stand for the end of a junction, which the prediction does not know."""
WHERE = {
    "drivers.car_following": ("following", "cut_in"),
    "drivers.prediction": ("cut_in", "beside", "left", "over_the_middle", "oncoming_intrusion"),
    "drivers.lateral_gap": ("beside",),
    "drivers.leaders": ("following", "left", "behind_another"),
    "drivers.junctions": ("crossing", "merging", "giving_way", "giving_way_idm", "gave_way"),
    "planners.adversary_batch": ("crossing", "merging", "giving_way", "gave_way"),
}
"""The situations in which the constants of a module matter."""
MODEL = ("acceleration", "deceleration", "tau", "min_gap", "hardest_braking")
"""Numbers of the driver model, which SUMO tells."""


@contextmanager
def changed(home: str, name: str, factor: float) -> Iterator[None]:
    """A constant times a factor, in the module that has it and in those that import it."""
    value = getattr(sys.modules[f"sumo_adv.{home}"], name)
    modules = [m for n, m in sys.modules.items() if n.startswith("sumo_adv.") and getattr(m, name, None) is value]
    for module in modules:
        setattr(module, name, tuple(factor * v for v in value) if isinstance(value, tuple) else factor * value)
    try:
        yield
    finally:
        for module in modules:
            setattr(module, name, value)


def with_model(driven: Sequence[Driven], name: str, factor: float) -> list[Driven]:
    """The same scenes, predicted with a number of the driver model times a factor."""
    rescaled = []
    for encounter in driven:
        model = encounter.situation.baseline.model
        wrong = replace(model, **{name: factor * getattr(model, name)})
        rescaled.append(replace(encounter, situation=encounter.situation.driven_by(wrong)))
    return rescaled


def noticed(home: str, name: str, factor: float, kinds: Scenes, chosen: Scenes) -> Iterator[str]:
    """The single scenes and situations where a bound breaks once a constant is wrong, those of its own first."""
    with changed(home, name, factor):
        for scene, some in chosen.items():
            if name in CHOSEN[scene].constants and chosen_faults(scene, some):
                yield f'"{scene}"'
        for kind in WHERE[home]:
            if kind in kinds and faults(kind, kinds[kind]):
                yield kind


def perturbed(kinds: Scenes, chosen: Scenes) -> Iterator[str]:
    """The table's lines: constant, file, and what notices that it is too small and too large.

    Left out are situations and single scenes where a bound is broken by the right constants already.
    """
    kinds = {kind: some for kind, some in kinds.items() if not faults(kind, some)}
    chosen = {name: some for name, some in chosen.items() if not chosen_faults(name, some)}
    yield "| constant | file | -20 % noticed by | +20 % noticed by |\n|---|---|---|---|"
    for own, table in (("", COPIED), (" (own)", OWN)):
        for home, names in table.items():
            for name in names:
                by = [list(noticed(home, name, factor, kinds, chosen)) for factor in (1.0 - SHARE, 1.0 + SHARE)]
                yield _row(f"`{name}`{own}", f"{home.replace('.', '/')}.py", by)
    for name in MODEL:
        by = []
        for factor in (1.0 - SHARE, 1.0 + SHARE):
            wrong = {k: with_model(kinds[k], name, factor) for k in ("following", "cut_in") if k in kinds}
            by.append([kind for kind, some in wrong.items() if faults(kind, some)])
        yield _row(f"`{name}`", "told by SUMO", by)


def _row(name: str, file: str, by: Sequence[Sequence[str]]) -> str:
    return f"| {name} | {file} | {' | '.join(', '.join(names) or '-' for names in by)} |"


# -- the table ----------------------------------------------------------------------------------------------------


def line(kind: str, driver: str, of: Floats) -> str:
    """The errors of one situation against one driver."""
    spread = "  ".join("".join(f"{q:7.2f}" for q in row) for row in quantiles(of))
    return f"{kind:20s} {driver:8s} {of.shape[1]:6d}  {spread}"


def main() -> int:
    """Print the table; 1 if a bound is broken."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--encounters", type=int, default=6, help="of each situation and driver")
    parser.add_argument("--plans", type=int, default=6, help="motions of the adversary in each encounter")
    parser.add_argument("--kind", action="append", choices=[*KINDS], help="repeatable (default: all)")
    parser.add_argument("--perturb", action="store_true", help="also say which wrong constants are noticed, and where")
    given = parser.parse_args()
    heads = "  ".join(f"{name + ': median':>7s}   90 %    max" for name in ("m", "aside", "m/s"))
    print(f"{'situation':20s} {'driver':8s} scenes  {heads}")
    encounters: dict[str, list[Driven]] = {}
    wrong: list[str] = []
    with Engine(body) as engine:
        for kind in given.kind or KINDS:
            encounters[kind] = []
            for driver in (*KINDS[kind].drivers, "careful") if kind in CAREFUL else KINDS[kind].drivers:
                some = run(engine, [(kind, driver, seed, range(given.plans)) for seed in range(given.encounters)])
                if not some:
                    continue
                print(line(kind, driver, errors(some)), flush=True)
                encounters[kind] += some if driver in KINDS[kind].drivers else []
            wrong += faults(kind, encounters[kind])
        chosen = {name: run(engine, [chosen_job(name)]) for name in CHOSEN}
    for name, some in chosen.items():
        wrong += chosen_faults(name, some)
    if wrong:
        print("\n".join(wrong))
    if given.perturb:
        for row in perturbed(encounters, chosen):
            print(row, flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
