"""Campaigns in rounds until a clock ends them; inputs that bring new failures get more of the rounds.

A round is a campaign of some inputs with the next seeds, in a folder of its own (``rounds/0001``). Which inputs a round
has follows from the rounds before: each input is drawn as often as it is likely to bring a distinct failure (Thompson
sampling; Thompson 1933). ``hunt.json`` remembers the rounds and the time that was used, so the same command goes on.
"""

from __future__ import annotations

import csv
import io
import json
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from random import Random
from typing import Any, Protocol

from sumo_adv.campaigns.campaign import Orders, Summary
from sumo_adv.campaigns.plan import Plan
from sumo_adv.campaigns.results import failed, read_csv, read_row
from sumo_adv.datatypes import Level
from sumo_adv.errors import UsageError
from sumo_adv.files import sentences, write_text
from sumo_adv.hunting.failures import COLUMNS, Failure, distinct, failure_of, table
from sumo_adv.parsing import parse_json
from sumo_adv.report.outcome import ATTACKS

SCHEMA = 1
STATE, RESULTS, FAILURES, ROUNDS = "hunt.json", "results.csv", "failures", "rounds"
EACH = 3  # episodes of a round for each worker
LONGEST = 20.0  # s of attempts in an encounter at most: a second simulation tells more than a longer search
KINDS = 3  # kinds of attacks that are looked for in an encounter, then the next one comes
SHARE = 0.1  # of the time that is left: the most that an encounter may take
SHORTEST = 3.0  # s


class RunCampaign(Protocol):
    """Runs what is missing of a plan."""

    def __call__(self, plan: Plan, orders: Orders) -> Summary:
        """The outcome. Raises SumoAdvError."""
        ...


@dataclass(frozen=True, slots=True)
class HuntProgress:
    """How far a hunt is. newest: the newest distinct failure, None where the last round brought none."""

    seconds_left: float
    encounters: int
    attempts: int
    attempts_per_second: float
    found: Sequence[Failure]
    newest: Failure | None

    def count(self, level: Level) -> int:
        """Distinct failures of this level or a higher one."""
        return sum(f.level >= level for f in self.found)


@dataclass(frozen=True, slots=True)
class Found:
    """What a hunt came to. ended: ``time``, ``distinct`` or ``stopped`` (Ctrl-C)."""

    folder: Path
    failures: Sequence[Failure]
    encounters: int
    attempts: int
    seconds: float
    ended: str


class Hunt:
    """One hunt in its folder. ``plan``: all inputs, egos and settings; its seeds are not used, but for the first one.

    Raises UsageError: the folder holds another hunt.
    """

    def __init__(self, plan: Plan, orders: Orders, campaign: RunCampaign, minutes: float, most: int | None) -> None:
        """minutes: of the whole hunt, also over several calls. most: distinct failures that end it sooner."""
        self._plan, self._orders, self._campaign = plan, orders, campaign
        self._limit, self._most, self.folder = minutes * 60.0, most, orders.out
        self._inputs = {i.content: i for i in plan.inputs if not i.error}
        if not self._inputs:
            why = next((i.error for i in plan.inputs), "there is no input")
            raise UsageError(f"No input of the hunt can be run: {why}")
        self._state = self._read()
        self._rows: list[list[Mapping[str, Any]]] = []  # of each round
        self._more: list[dict[str, list[Failure]]] = []  # of each round, by id: attacks of further kinds
        self._input_of: dict[str, str] = {}  # by id of an episode, the content of its input

    def run(self, tell: Callable[[HuntProgress], None]) -> Found:
        """Go on until the time is used up or enough was found. What a round found is kept when the next one begins."""
        ended, before = "time", 0
        for k in range(len(self._state["rounds"])):  # finished ones are read, an interrupted one is completed
            if self._round(k).stopped:
                ended = "stopped"
                break
        while ended == "time" and not self._enough() and self._left() > 0:
            self._state["rounds"].append(self._next())
            self._write()
            began = time.perf_counter()
            summary = self._round(len(self._state["rounds"]) - 1)
            self._state["seconds"] += time.perf_counter() - began
            self._write()
            found = self.found()
            newest = self._newest(found) if len(found) > before else None
            before = len(found)
            tell(self._progress(found, newest))
            if summary.stopped:
                ended = "stopped"
        if ended == "time" and self._enough():
            ended = "distinct"
        found = self._collected()
        progress = self._progress(found, None)
        return Found(self.folder, found, progress.encounters, progress.attempts, self._state["seconds"], ended)

    def found(self) -> list[Failure]:
        """The distinct failures so far, most serious first."""
        return distinct(f for k, rows in enumerate(self._rows) for f in self._failures(k, rows))

    # -- rounds -------------------------------------------------------------------------------------------------

    def _round(self, k: int) -> Summary:
        """Run what is missing of a round, and write the table of all rounds."""
        order = self._state["rounds"][k]
        inputs = [self._inputs[content] for content in order["inputs"] if content in self._inputs]
        bounds = {"seconds": order["seconds"], "total_seconds": 2 * order["seconds"], "diverse": KINDS}
        plan = replace(
            self._plan, inputs=inputs, seeds=tuple(order["seeds"]),
            variants=[{**variant, **bounds} for variant in self._plan.variants],
        )  # fmt: skip
        self._input_of |= {job.id: job.input.content for job in plan.jobs}
        summary = self._campaign(plan, replace(self._orders, out=self._folder_of(k)))
        self._rows[k:] = [list(summary.rows)]
        self._more[k:] = [_further(self._runs_of(k), summary.rows)]
        self._write_table(self.found())
        return summary

    def _next(self) -> dict[str, Any]:
        """The inputs and seeds of the next round."""
        k, random = len(self._state["rounds"]), Random(f"{self._plan.seeds[0]}-{len(self._state['rounds'])}")
        size = EACH * self._orders.pace.workers
        tries, wins = self._tally()
        drawn = {c: random.betavariate(1 + wins.get(c, 0), 1 + tries.get(c, 0) - wins.get(c, 0)) for c in self._inputs}
        chosen = sorted(drawn, key=lambda c: -drawn[c])[:size]
        fewer = max(1, size // len(chosen))
        first = self._plan.seeds[0] + sum(len(r["seeds"]) for r in self._state["rounds"][:k])
        seconds = round(min(LONGEST, max(SHORTEST, SHARE * self._left())), 1)
        return {"inputs": chosen, "seeds": [first + j for j in range(fewer)], "seconds": seconds}

    def _tally(self) -> tuple[dict[str, int], dict[str, int]]:
        """By input the episodes, and those that were the first of a cell."""
        tries, wins, cells = dict[str, int](), dict[str, int](), set[Any]()
        for k, rows in enumerate(self._rows):
            for row in rows:
                content = self._input_of[str(row["id"])]
                own = {f.cell for f in self._failures(k, [row])}
                tries[content], wins[content] = tries.get(content, 0) + 1, wins.get(content, 0) + bool(own - cells)
                cells |= own
        return tries, wins

    def _failures(self, k: int, rows: Sequence[Mapping[str, Any]]) -> list[Failure]:
        first = [f for row in rows if (f := failure_of(row, self._runs_of(k))) is not None]
        return first + [f for row in rows for f in self._more[k].get(str(row["id"]), ())]

    def _newest(self, found: Sequence[Failure]) -> Failure | None:
        runs = self._runs_of(len(self._rows) - 1)
        return next((f for f in found if runs in f.run.parents), None)

    def _enough(self) -> bool:
        return self._most is not None and len(self.found()) >= self._most

    def _left(self) -> float:
        return max(self._limit - float(self._state["seconds"]), 0.0)

    def _progress(self, found: Sequence[Failure], newest: Failure | None) -> HuntProgress:
        rows = [row for each in self._rows for row in each if not failed(row)]
        attempts = sum(int(row["attempts"] or 0) for row in rows)
        pace = attempts / max(float(self._state["seconds"]), 1e-3)
        return HuntProgress(self._left(), len(rows), attempts, pace, found, newest)

    # -- files --------------------------------------------------------------------------------------------------

    def _folder_of(self, k: int) -> Path:
        return self.folder / ROUNDS / f"{k + 1:04d}"

    def _runs_of(self, k: int) -> Path:
        return self._folder_of(k) / "runs"

    def _read(self) -> dict[str, Any]:
        told = {**self._plan.as_dict(), "seeds": [self._plan.seeds[0]]}
        file = self.folder / STATE
        if not file.is_file():
            if self.folder.is_dir() and any(self.folder.iterdir()):
                raise UsageError(f"{self.folder} is not empty and holds no hunt: give another --out.")
            return {"schema": SCHEMA, "plan": told, "seconds": 0.0, "rounds": []}
        with sentences(self.folder):
            state: dict[str, Any] = parse_json(file.read_text(encoding="utf-8"))
        if state.get("schema") != SCHEMA or state.get("plan") != json.loads(json.dumps(told)):
            raise UsageError(
                f"{self.folder} holds a hunt with other inputs, egos or settings: say the same, or give another --out."
            )
        return state

    def _write(self) -> None:
        with sentences(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            write_text(self.folder / STATE, json.dumps(self._state, indent=1) + "\n")

    def _write_table(self, found: Sequence[Failure]) -> None:
        text = io.StringIO()
        writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(table(found, self.folder))
        with sentences(self.folder):
            write_text(self.folder / RESULTS, text.getvalue())

    def _collected(self) -> list[Failure]:
        """Copies of the representatives' folders in ``failures/``, best first, and the table that names them."""
        target = self.folder / FAILURES
        found = []
        with sentences(self.folder):
            for k, failure in enumerate(self.found()):
                copy = target / f"{k + 1:03d}-{failure.level}-{_slug(failure.cell.intent)}"
                kept = {p.name for p in target.glob(f"{k + 1:03d}-*")} if target.is_dir() else set()
                for name in kept:
                    shutil.rmtree(target / name)
                shutil.copytree(failure.run, copy)
                found.append(replace(failure, run=copy))
        self._write_table(found)
        return found


def _further(runs: Path, rows: Sequence[Mapping[str, Any]]) -> dict[str, list[Failure]]:
    """By id of an episode, its attacks of further kinds; their folders lie in that of the run."""
    more: dict[str, list[Failure]] = {}
    for row in rows:
        for folder in sorted((runs / str(row["id"]) / ATTACKS).glob("*")):
            attack = read_row(folder)
            failure = None if attack is None else failure_of({**attack, "id": folder.name}, folder.parent)
            if failure is not None:
                more.setdefault(str(row["id"]), []).append(failure)
    return more


def _slug(words: str) -> str:
    return "-".join("".join(c if c.isalnum() else " " for c in words.lower()).split())


def read_table(folder: Path) -> dict[str, list[Any]]:
    """``results.csv`` of a hunt, columns by name. Raises UsageError: it is none, or damaged."""
    if not (folder / STATE).is_file():
        raise UsageError(f"{folder} is not the folder of a hunt: it has no {STATE}.")
    return read_csv(folder / RESULTS)
