"""Run batches in rounds until a clock ends them, and give more rounds to inputs that bring new failures.

A round is a batch of some inputs with the next seeds, in a folder of its own (``rounds/0001``). The earlier rounds
decide which inputs a round has: an input is chosen with the probability that it brings a distinct failure (Thompson
sampling; Thompson 1933). ``hunt.json`` holds the rounds, the time that each took and the number of failures that were
known at its end, so the same command continues the hunt.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from random import Random
from statistics import median
from typing import Any

from sumo_adv.campaigns.campaign import Orders, Summary
from sumo_adv.campaigns.local import Stop
from sumo_adv.campaigns.plan import CampaignPlan
from sumo_adv.campaigns.results import is_failed
from sumo_adv.datatypes import Level
from sumo_adv.drivers.timing import DriverTime, read_driver_time, total_time
from sumo_adv.episode.run import seconds_by_part
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.files import refuse_links, sentences, write_text
from sumo_adv.goal import Goal
from sumo_adv.hunting.choice import Shown, drawn_to_cover, drawn_to_fail
from sumo_adv.hunting.failures import FAILURE_COLUMNS, Failure, FailureCell, distinct, failure_of, table
from sumo_adv.hunting.rounds import FAILURE_LEVELS, cells_of, folder_of, further, outcomes_of
from sumo_adv.metrics.species import Discovery, discovery
from sumo_adv.parsing import read_object
from sumo_adv.report.index import HUNT
from sumo_adv.report.scenario_table import ScenarioRow, Tally, scenario_rows, tallies_of, write_scenarios
from sumo_adv.report.staging import RESULTS_FILE
from sumo_adv.report.tables import csv_text, plain_row
from sumo_adv.scenario_names import is_one_of, wanted

HUNT_SCHEMA = 1
FAILURES_FOLDER = "failures"
MAX_EPISODES_PER_WORKER = 3
"""Episodes of a round for each worker at most; the first round has one."""
ROUND_S = 60.0  # s: how long a round should take
MIN_ATTEMPTS = 12  # attempts that an encounter should have time for, whatever one of them costs
FAILED_EPISODES = 3  # that end the hunt if no episode succeeds; fewer if there are fewer inputs
LINE_INTERVAL_S = 10.0  # s between two reports of progress, unless there is a new failure
MAX_ENCOUNTER_S = 20.0  # s of attempts in an encounter at most: a second simulation tells more than a longer search
MIN_ENCOUNTER_S = 3.0
MAX_MEDIAN_TIMES = 3.0  # an encounter may take this many times the median time to the first success
KINDS_PER_ENCOUNTER = 3
"""Kinds of attacks that are looked for in an encounter once fresh encounters brought nothing new."""
MAX_TIME_SHARE = 0.1
"""Share of the time that is left that the attempts in an encounter may take, if finding it does not take longer."""
FAILURE_GOAL = Goal(Level.VALID)
"""What a failure comes to at least, if no level is asked for."""
RunCampaign = Callable[[CampaignPlan, Orders, Callable[[Mapping[str, Any]], None]], Summary]
"""Runs the missing episodes of a plan, and calls a function with the row of each one. Raises SumoAdvError."""


def count_failures(found: Sequence[Failure], level: Level) -> int:
    """Count the failures of this level or a higher one, without near-touches."""
    return sum(f.level >= level and not f.near_touch for f in found)


@dataclass(frozen=True, slots=True)
class HuntProgress:
    """How far a hunt is.

    Attributes:
        seconds_left: The time that is left [s].
        episodes: The number of finished episodes.
        attempts: The number of attempts in them.
        attempts_per_second: Attempts per second of the hunt.
        found: The distinct failures, most serious first.
        newest: The newest distinct failure; None if there is none since the last report.
        lost: The number of attempts and episodes that broke, such as with a driver that hangs.
        left: Estimates of what is left.
        driver_time: How long the driver's answers took.
        episode_seconds: The time of all episodes [s].
    """

    seconds_left: float
    episodes: int
    attempts: int
    attempts_per_second: float
    found: Sequence[Failure]
    newest: Failure | None
    lost: int
    left: Discovery
    driver_time: DriverTime
    episode_seconds: float

    def count(self, level: Level) -> int:
        """Distinct failures of this level or a higher one, without near-touches."""
        return count_failures(self.found, level)


@dataclass(frozen=True, slots=True)
class Found:
    """The result of a hunt.

    Attributes:
        folder: The folder of the hunt.
        failures: The distinct failures, most serious first.
        episodes: The number of finished episodes.
        attempts: The number of attempts in them.
        seconds: The time of the hunt, over all its calls [s].
        ended: ``time``, ``distinct`` or ``stopped`` (Ctrl-C).
        left: Estimates of what is left.
        lost: A sentence for each attempt and each episode that broke.
        scenarios: What was met of each named scenario.
        driver_time: How long the driver's answers took.
        episode_seconds: The time of all episodes [s].
        spent: What the workers spent their time on, by part [s].
    """

    folder: Path
    failures: Sequence[Failure]
    episodes: int
    attempts: int
    seconds: float
    ended: str
    left: Discovery
    lost: Sequence[str] = ()
    scenarios: Sequence[ScenarioRow] = ()
    driver_time: DriverTime = field(default_factory=DriverTime)
    episode_seconds: float = 0.0
    spent: Mapping[str, float] = field(default_factory=dict)


class Hunt:
    """One hunt in its folder."""

    def __init__(
        self, plan: CampaignPlan, orders: Orders, campaign: RunCampaign, minutes: float, most: int | None,
        goal: Goal = FAILURE_GOAL, *, cover: bool = False, longest: float | None = None,
    ) -> None:  # fmt: skip
        """Prepare a hunt, or go on with the one in its folder.

        Args:
            plan: All inputs, egos and settings. Of its seeds, only the first one is used.
            orders: How the rounds are run.
            campaign: Runs a round.
            minutes: The time of the whole hunt, also over several calls.
            most: The number of distinct failures that ends the hunt sooner; None for no such end.
            goal: The least that counts as a failure.
            cover: Give time to the named scenarios that were met least, not to inputs that bring new failures.
            longest: The most time for attempts in an encounter [s]; None lets the cost of an attempt decide.

        Raises:
            UsageError: No input can be run, or the folder holds another hunt.
        """
        self._goal, self._cover, self._longest = goal, cover, longest
        self._only = wanted(plan.variants[0].get("scenario") or ())  # what failures must show
        self._plan, self._orders, self._campaign = plan, orders, campaign
        self._limit, self._most, self.folder = minutes * 60.0, most, orders.out
        self._inputs = {i.content: i for i in plan.inputs if not i.error}
        if not self._inputs:
            why = next((i.error for i in plan.inputs), "there is no input")
            raise UsageError(f"No input of the hunt can be run: {why}")
        self._state = self._read()
        self._rows: list[list[Mapping[str, Any]]] = []  # of each round
        self._more: list[dict[str, list[Failure]]] = []  # of each round, by id: attacks of further kinds
        self._lost: list[list[str]] = []  # of each round, why attempts and episodes broke
        self._firsts: list[list[float]] = []  # of each round, s to the first success of an encounter
        self._tallies: list[dict[str, list[Tally]]] = []  # of each round, by id: scenarios of each encounter
        self._times: list[list[tuple[DriverTime, float]]] = []  # of each round, of its episodes
        self._parts: list[list[Mapping[str, float]]] = []  # of each round, s of each part of its episodes
        self._told: tuple[frozenset[FailureCell], float] = (frozenset(), -math.inf)  # failures, and when
        self._input_of: dict[str, str] = {}  # by id of an episode, the content of its input

    def run(self, tell: Callable[[HuntProgress], None]) -> Found:
        """Run rounds until the time is used up or enough was found.

        Raises SumoAdvError: no episode can be run, none was, or the disk is full.
        """
        rounds = range(len(self._state["rounds"]))  # finished ones are read, an interrupted one is completed
        ended = "stopped" if any(self._round(k, tell).interrupted for k in rounds) else "time"
        self._remember()
        while ended == "time" and not self._enough() and self._left() > 0:
            self._state["rounds"].append(self._next())
            self._write()
            if self._round(len(self._state["rounds"]) - 1, tell).interrupted:
                ended = "stopped"
            self._remember()
        if self._enough():
            ended = "distinct"
        elif self._left() <= 0:
            ended = "time"
        found = self._collected()
        progress, lost = self._progress(found, None), [why for each in self._lost for why in each]
        return Found(
            self.folder, found, progress.episodes, progress.attempts, self._seconds(), ended, self.left(), lost,
            self.scenarios(), progress.driver_time, progress.episode_seconds, self._spent(),
        )  # fmt: skip

    def found(self) -> list[Failure]:
        """Return the distinct failures so far, most serious first."""
        return distinct(f for k, rows in enumerate(self._rows) for f in self._failures(k, rows))

    def left(self) -> Discovery:
        """Estimate from the episodes so far what is left to find."""
        rows = [(k, row) for k, each in enumerate(self._rows) for row in each if not is_failed(row)]
        return discovery([cells_of(self._failures(k, [row])) for k, row in rows])

    def scenarios(self) -> list[ScenarioRow]:
        """Count for each named scenario what was met so far."""
        return scenario_rows(tally for each in self._tallies for own in each.values() for tally in own)

    # -- rounds -------------------------------------------------------------------------------------------------

    def _round(self, k: int, tell: Callable[[HuntProgress], None]) -> Summary:
        """Run what is missing of a round, and take note of all its episodes."""
        order = self._state["rounds"][k]
        inputs = [self._inputs[content] for content in order["inputs"] if content in self._inputs]
        seconds, kinds = order["seconds"], order.get("kinds", KINDS_PER_ENCOUNTER)
        bounds = {"seconds": seconds, "total_seconds": 2 * seconds, "diverse": kinds}
        plan = replace(
            self._plan, inputs=inputs, seeds=tuple(order["seeds"]),
            variants=[{**variant, **bounds} for variant in self._plan.variants],
        )  # fmt: skip
        self._input_of |= {job.id: job.input.content for job in plan.jobs}
        began, before = time.perf_counter(), order.get("took", 0.0)
        self._begin(k)

        def finished(row: Mapping[str, Any]) -> None:
            order["took"] = before + time.perf_counter() - began
            self._add(k, [row])
            self._say(tell)
            stop.drain |= self._enough() or self._left() <= 0

        stop = Stop(drain=self._left() <= 0)
        pace = replace(self._orders.pace, until=time.time() + self._left())
        summary = self._campaign(plan, replace(self._orders, out=self._folder_of(k), pace=pace, stop=stop), finished)
        if summary.ran or summary.stopped:
            order["took"] = before + time.perf_counter() - began
        self._begin(k)
        self._add(k, summary.rows)
        every = [row for each in self._rows for row in each]
        if len(every) >= min(len(self._inputs), FAILED_EPISODES) and all(map(is_failed, every)):
            many = f"All {len(every)} episodes" if len(every) > 1 else "The only episode"
            raise SumoAdvError(f"{many} of the hunt failed, the first one because: {every[0]['failure']}")
        return summary

    def _begin(self, k: int) -> None:
        """Forget what is known of the episodes of a round."""
        for each in (self._rows, self._lost, self._firsts, self._times, self._parts):
            each[k:] = [[]]
        self._more[k:], self._tallies[k:] = [{}], [{}]

    def _add(self, k: int, rows: Sequence[Mapping[str, Any]]) -> None:
        """Take note of finished episodes of a round."""
        outcomes = outcomes_of(self._runs_of(k), rows)
        timings = [outcome["timing"] or {} for outcome in outcomes.values()]
        self._rows[k] += rows
        self._more[k] |= further(self._runs_of(k), rows)
        self._tallies[k] |= {name: tallies_of(outcome) for name, outcome in outcomes.items()}
        self._times[k] += map(_times_of, outcomes.values())
        self._lost[k] += _lost(rows, outcomes)
        self._firsts[k] += [t["first_success"] for t in timings if t.get("first_success") is not None]
        self._parts[k] += [{part: s for part, s in t.items() if part != "first_success"} for t in timings]

    def _say(self, tell: Callable[[HuntProgress], None]) -> None:
        """Report the progress if there is a new failure, or if the last report is old."""
        found, (known, then), now = self.found(), self._told, time.perf_counter()
        newest = next((f for f in found if f.cell not in known), None)
        if newest is not None or now - then >= LINE_INTERVAL_S:
            self._told = frozenset(f.cell for f in found), now
            tell(self._progress(found, newest))

    def _spent(self) -> dict[str, float]:
        """Return how long the workers spent on each part [s].

        ``between`` is the rest of their time: they start, or they wait for the last episode of a round.
        """
        spent = seconds_by_part(*(parts for each in self._parts for parts in each))
        total = spent.pop("total", 0.0)
        return {**spent, "between": max(self._seconds() * self._orders.pace.workers - total, 0.0)}

    def _remember(self) -> list[Failure]:
        """Write down the distinct failures after the newest round."""
        found = self.found()
        if self._rows:
            self._state["rounds"][len(self._rows) - 1]["found"] = {
                str(level): count_failures(found, level) for level in FAILURE_LEVELS
            }
            self._state["rounds"][len(self._rows) - 1]["left"] = self.left().as_data()
        self._write(found)
        return found

    def _next(self) -> dict[str, Any]:
        """Choose the inputs and seeds of the next round."""
        rounds, seed = self._state["rounds"], self._plan.seeds[0]
        random = Random(f"{seed}-{len(rounds)}")
        workers, rows = self._orders.pace.workers, sum(map(len, self._rows))
        lasts = self._seconds() * workers / rows if rows else 0.0  # s, an episode
        time_for = round(min(self._left(), ROUND_S) / lasts) if lasts else 1
        size = workers * max(1, min(MAX_EPISODES_PER_WORKER, time_for))
        if self._cover:
            drawn = drawn_to_cover(self._inputs, self._shown(), random)
        else:
            drawn = drawn_to_fail(self._inputs, *self._tally(), random)
        chosen = sorted(drawn, key=lambda c: -drawn[c])[:size]
        first = seed + sum(len(r["seeds"]) for r in rounds)
        seeds = list(range(first, first + max(1, size // len(chosen))))
        return {"inputs": chosen, "seeds": seeds, "seconds": self._each(), "kinds": self._kinds()}

    def _each(self) -> float:
        """Return how long an encounter may be attacked [s]."""
        firsts = [s for each in self._firsts for s in each]
        attempt, rest = self._costs()
        longest = self._longest if self._longest is not None else max(MAX_ENCOUNTER_S, MIN_ATTEMPTS * attempt)
        longest = min(longest, MAX_MEDIAN_TIMES * median(firsts)) if firsts else longest
        return round(max(MIN_ENCOUNTER_S, min(longest, max(MAX_TIME_SHARE * self._left(), rest))), 1)

    def _costs(self) -> tuple[float, float]:
        """Return how long an attempt takes, and everything else in an episode [s]; 0 before the first one."""
        parts = [each for every in self._parts for each in every]
        spent, attempts = seconds_by_part(*parts), sum(int(row["attempts"] or 0) for rows in self._rows for row in rows)
        attacking = spent.get("attempts", 0.0)
        return attacking / max(attempts, 1), (spent.get("total", 0.0) - attacking) / max(len(parts), 1)

    def _kinds(self) -> int:
        """Return how many kinds of attacks an encounter is searched for.

        As long as the rounds bring new failures, a fresh encounter is the quicker way to the next one.
        """
        if self._cover:
            return KINDS_PER_ENCOUNTER
        known = [r.get("found") for r in self._state["rounds"]]
        return KINDS_PER_ENCOUNTER if known and known[-1] == (known[-2] if len(known) > 1 else None) else 1

    def _tally(self) -> tuple[Counter[str], Counter[str]]:
        """Count for each input its episodes, and those that brought a new cell."""
        tries, wins, cells = Counter[str](), Counter[str](), set[Any]()
        for k, rows in enumerate(self._rows):
            for row in rows:
                content = self._input_of[str(row["id"])]
                own = {f.cell for f in self._failures(k, [row])}
                tries[content] += 1
                wins[content] += bool(own - cells)
                cells |= own
        return tries, wins

    def _shown(self) -> Iterator[Shown]:
        """Yield each episode with the named scenarios that it shows."""
        for rows, tallies in zip(self._rows, self._tallies, strict=True):
            for row in rows:
                own = {name for tally in tallies.get(str(row["id"]), ()) for name in tally}
                yield self._input_of[str(row["id"])], own

    def _failures(self, k: int, rows: Sequence[Mapping[str, Any]]) -> list[Failure]:
        first = [f for row in rows if (f := failure_of(row, self._runs_of(k))) is not None]
        every = first + [f for row in rows for f in self._more[k].get(str(row["id"]), ())]
        some = [f for f in every if f.level >= self._goal.level and f.delta_v >= self._goal.min_delta_v]
        return [f for f in some if not self._only or is_one_of(asdict(f), self._only)]

    def _enough(self) -> bool:
        return self._most is not None and count_failures(self.found(), Level.VALID) >= self._most

    def _seconds(self) -> float:
        return sum(float(r.get("took", 0.0)) for r in self._state["rounds"])

    def _left(self) -> float:
        return max(self._limit - self._seconds(), 0.0)

    def _progress(self, found: Sequence[Failure], newest: Failure | None) -> HuntProgress:
        rows = [row for each in self._rows for row in each if not is_failed(row)]
        attempts = sum(int(row["attempts"] or 0) for row in rows)
        pace = attempts / max(self._seconds(), 1e-3)
        return HuntProgress(
            self._left(), len(rows), attempts, pace, found, newest, sum(map(len, self._lost)), self.left(),
            total_time(took for each in self._times for took, _ in each),
            sum(seconds for each in self._times for _, seconds in each),
        )  # fmt: skip

    # -- files --------------------------------------------------------------------------------------------------

    def _folder_of(self, k: int) -> Path:
        return folder_of(self.folder, k)

    def _runs_of(self, k: int) -> Path:
        return self._folder_of(k) / "runs"

    def _read(self) -> dict[str, Any]:
        told = {**self._plan.as_dict(), "seeds": [self._plan.seeds[0]]}
        refuse_links(self.folder)
        file = self.folder / HUNT
        if not file.is_file():
            parts = f".{Path(HUNT).stem}."  # of a state that was being written when the program was killed
            if self.folder.is_dir() and any(not p.name.startswith(parts) for p in self.folder.iterdir()):
                raise UsageError(f"{self.folder} is not empty and holds no hunt: give another --out.")
            return {"schema": HUNT_SCHEMA, "plan": told, "rounds": []}
        state = read_object(file, "The state of the hunt")
        if state.get("schema") != HUNT_SCHEMA or state.get("plan") != json.loads(json.dumps(told)):
            raise UsageError(
                f"{self.folder} holds a hunt with other inputs, egos or settings: give the same ones, or another --out."
            )
        return state

    def _write(self, found: Sequence[Failure] | None = None) -> None:
        """Write the state and, if they are given, the distinct failures."""
        with sentences(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            write_text(self.folder / HUNT, json.dumps(self._state, indent=1) + "\n")
            if found is not None:
                write_text(
                    self.folder / RESULTS_FILE, csv_text(FAILURE_COLUMNS, map(plain_row, table(found, self.folder)))
                )
                write_scenarios(self.folder, self.scenarios())

    def _collected(self) -> list[Failure]:
        """Copy the folders of the distinct failures into ``failures/``, most serious first, and write their table."""
        target = self.folder / FAILURES_FOLDER
        found = []
        with sentences(self.folder):
            if target.is_dir():
                shutil.rmtree(target)
            for k, failure in enumerate(self.found()):
                copy = target / f"{k + 1:03d}-{failure.level}-{_slug(failure.cell.intent)}"
                _copy(failure.run, copy)
                found.append(replace(failure, run=copy))
        self._write(found)
        return found


def _lost(rows: Sequence[Mapping[str, Any]], outcomes: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Collect why episodes failed, and why attempts of the others broke."""
    broke = [each for o in outcomes.values() for each in o["attempts"] if each["ending"] == "crashed"]
    return [str(row["failure"]) for row in rows if is_failed(row)] + [str(each["message"]) for each in broke]


def _times_of(outcome: Mapping[str, Any]) -> tuple[DriverTime, float]:
    """Return how long the driver's answers took in an episode, and how long the episode took [s]."""
    took = read_driver_time(outcome.get("driver_time"))
    return took or DriverTime(), float((outcome["timing"] or {}).get("total") or 0.0)


def _copy(path: Path, target: Path) -> None:
    """Copy a folder; its files become hard links, which take no space, if the file system has them."""
    target.mkdir(parents=True)
    for file in sorted(path.iterdir()):
        if file.is_dir():
            _copy(file, target / file.name)
            continue
        try:
            os.link(file, target / file.name)
        except OSError:
            shutil.copyfile(file, target / file.name)


def _slug(words: str) -> str:
    return "-".join("".join(c if c.isalnum() else " " for c in words.lower()).split())
