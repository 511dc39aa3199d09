"""Define the jobs of a bench, the program's own rows, and the memory bank that each row has.

A job is rows of one encounter that share a simulation, or the next encounter of a row that learns. The program's own
rows are:

    raw                        the unattacked run
    expert                     the whole library, updated between encounters; the expert plays all parts (LLM-A)
    llm-f                      a bank of Close Car-following and Emergency Braking, no learning (the paper's LLM-F)
    llm-a:MODEL, llm-f:MODEL   the same with a language model in all parts
    expert+tuner=off           any setting of ``run`` changed; several: ``expert+learn=off+replan=12``
    expert+shift=-1.5          the trigger this many seconds later (negative: earlier)

All other rows are opponents (``rows.py``).
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sumo_adv.benchmark.nouns import GROUPS, RAW, SuiteCase
from sumo_adv.config import Settings, load_settings
from sumo_adv.errors import UsageError
from sumo_adv.memory.bank import MemoryBank

if TYPE_CHECKING:
    from sumo_adv.episode.run import Run
    from sumo_adv.simulation.inputs import RunInput

FIXED_LIBRARY = ("Close Car-following", "Emergency Braking")
OWN_METHODS = ("expert", "llm-a", "llm-f")
GIVEN_ELSEWHERE = (
    "ego", "ego_id", "ego_parameters", "seed", "until", "attempts", "memory", "trigger", "ttc", "critical_ttc",
    "min_delta_v", "limits", "duration",
    "step_length", "density", "background", "begin", "end", "search", "history", "shortlist", "adversary",
)  # fmt: skip
"""The settings that no row changes: who is attacked, where, with what budget, and how it is judged."""

ABLATIONS: Mapping[str, str] = {
    "expert": "everything",
    "expert+learn=off": "no memory: nothing is learnt from earlier encounters",
    "expert+tuner=off+learn=off": "no tuner: only the authors' parameter values",
    "expert+replan=60+learn=off": "no replanning: one endpoint per attempt",
    "expert+forecast=constant+learn=off": "the ego predicted by constant velocity",
    "expert+shift=-1.5+learn=off": "the trigger 1.5 s early",
    "expert+shift=1.5+learn=off": "the trigger 1.5 s late",
}
"""For each row, what is left out. Each row is compared with ``REFERENCE``."""
REFERENCE = "expert+learn=off"
ANALYZER_SAMPLES = (1, 3, 5)
GROWING = ("", "+learn=off", "+recall=scene")  # a row that learns, its reference, and recall by scene


def sampled(model: str) -> dict[str, str]:
    """Return the rows that ask a model's analyzer a different number of times, with a description of each."""
    return {
        f"llm-a:{model}+samples={k}+learn=off": f"{model}, the analyzer sampled {k} times" for k in ANALYZER_SAMPLES
    }


@dataclass(frozen=True, slots=True)
class Method:
    """A row that is the program itself.

    Attributes:
        name: The name of the row.
        settings: The settings that differ from the table's.
        fixed: Whether the bank has only the two intents of ``FIXED_LIBRARY``.
        learns: Whether the row learns from encounter to encounter.
        shift: How much later the trigger is [s].
    """

    name: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    fixed: bool = False  # the bank has two intents
    learns: bool = False
    shift: float = 0.0

    @property
    def key(self) -> str:
        """What methods must have in common to share one simulation."""
        return json.dumps([dict(self.settings), self.shift], sort_keys=True)


def method_of(row: str) -> Method | None:
    """Parse the name of a row.

    Args:
        row: The name.

    Returns:
        The method; None if the row is not the program's own.

    Raises:
        UsageError: A setting does not exist, or a table gives it for all rows.
    """
    base, *changes = row.split("+")
    kind, _, model = base.partition(":")
    if kind not in (*OWN_METHODS, RAW) or (model and kind not in ("llm-a", "llm-f")):
        return None
    if kind == RAW:
        if changes:
            raise UsageError(f"The row '{row}' has no settings to change; give '{kind}' alone.")
        return Method(row)
    if kind == "llm-a" and not model:
        raise UsageError("The row llm-a needs a model: give llm-a:NAME, or the row 'expert' without a model.")
    settings: dict[str, Any] = {"llm": model} if model else {}
    shift = 0.0
    for change in changes:
        name, equals, value = change.partition("=")
        if not equals or (name != "shift" and name not in Settings.model_fields):
            raise UsageError(f"The row '{row}' changes '{name}', which is not a setting; give expert+NAME=VALUE.")
        if name in GIVEN_ELSEWHERE:
            raise UsageError(
                f"The row '{row}' changes '{name}', which is the same for all rows of a table; leave it out."
            )
        if name == "llm":
            raise UsageError(f"The row '{row}' changes 'llm'; give llm-a:NAME or llm-f:NAME for a row with a model.")
        if name == "shift":
            shift = _number(row, value)
        else:
            settings[name] = value
    load_settings(None, **settings)  # raises for bad values
    learns = settings.pop("learn", "off" if kind == "llm-f" else "on") == "on"
    if learns and kind == "llm-f":
        raise UsageError(f"The row '{row}' learns, but the bank of llm-f stays fixed; use llm-a or expert.")
    return Method(row, settings, kind == "llm-f", learns, shift)


def growing_banks(rows: Sequence[str]) -> list[str]:
    """Return a sentence for each row that changes its bank from encounter to encounter."""
    return [
        f"The bank of the row {row} grows from encounter to encounter, so the row's figures depend on their order; "
        "with learn=off the bank stays fixed."
        for row in rows
        if (method := method_of(row)) is not None and method.learns
    ]


def _number(row: str, value: str) -> float:
    try:
        seconds = float(value)
    except ValueError:
        seconds = math.nan
    if not math.isfinite(seconds):
        raise UsageError(f"The row '{row}' has shift={value}, which is not a number of seconds.")
    return seconds


# -- jobs


FILE_SIGNS = re.compile(r"[^A-Za-z0-9._=+-]+")
KINDS_SHOWN = 2  # kinds of each group that are drawn as examples


@dataclass(frozen=True, slots=True)
class BenchParts:
    """The functions that load, run and write.

    All of them can be imported by name, because they are sent to other processes.

    Attributes:
        load: Loads an input from its path and the id of a record.
        open_agents: Opens the agents of a row.
        full_outcome: Returns the content of ``outcome.json``.
        keep_run: Writes the folder of a run, with the exchanges with a model.
        draw_example: Draws the encounter without and with the attack.
    """

    load: Callable[[Path, str | None], RunInput]
    open_agents: Callable[..., AbstractContextManager[Any]]
    full_outcome: Callable[[Run], dict[str, Any]]  # what outcome.json holds
    keep_run: Callable[[Path, Run, Path | None], None]  # the folder of a run, with the model's exchanges
    draw_example: Callable[[Path, Run], None]  # a picture of the encounter without and with the attack


@dataclass(frozen=True, slots=True)
class BenchSetup:
    """What every process of a bench needs.

    Attributes:
        folder: The bench's folder.
        suite: The name of the suite.
        bank: The memory bank, which is only read.
        settings: The settings of all rows, as data.
        parts: The functions that load, run and write.
        keep_runs: Whether the folders of runs are kept.
        examples: The cases of which each row's attack is drawn.
    """

    folder: Path
    suite: str
    bank: Path
    settings: Mapping[str, Any]
    parts: BenchParts
    keep_runs: bool = False
    examples: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class BenchJob:
    """Rows of one encounter.

    Attributes:
        case: The encounter.
        ego: The ego's driver.
        seed: The seed.
        rows: The rows.
        settings: The settings that differ from the table's.
        shift: How much later the trigger is [s].
        place: The position of the case in the suite if the row learns, because its bank is the one that the previous
            encounter left; otherwise None.
    """

    case: SuiteCase
    ego: str
    seed: int
    rows: tuple[str, ...]
    settings: Mapping[str, Any] = field(default_factory=dict)
    shift: float = 0.0
    place: int | None = None

    @property
    def id(self) -> str:
        """The job in words."""
        return f"{self.ego} {self.case.name} {' '.join(self.rows)}"


def cell_path(folder: Path, ego: str, case: str, row: str) -> Path:
    """Return the file of a cell."""
    return folder / "cells" / slug(ego) / slug(case) / f"{slug(row)}.json"


def example_path(folder: Path, ego: str, case: str, row: str) -> Path:
    """Return the file of the picture of an attack in the bench's folder."""
    return folder / "figures" / f"example-{slug(ego)}-{slug(row)}-{slug(case)}.png"


def examples_of(cases: Sequence[SuiteCase]) -> frozenset[str]:
    """Select the cases that are drawn: for each group, the first case of each of its first ``KINDS_SHOWN`` kinds."""
    names: list[str] = []
    for group in GROUPS:
        first: dict[str, str] = {}
        for case in cases:
            if case.group == group:
                first.setdefault(case.kind, case.name)
        names += list(first.values())[:KINDS_SHOWN]
    return frozenset(names)


def slug(text: str) -> str:
    """Convert a text to a file name; if characters are replaced, digits of its hash keep the name distinct."""
    plain = FILE_SIGNS.sub("-", text).strip("-.")
    return plain if plain == text else f"{plain}-{hashlib.sha256(text.encode()).hexdigest()[:6]}"


def make_jobs(
    cases: Sequence[SuiteCase], egos: Sequence[str], rows: Sequence[str], seed: int
) -> tuple[list[BenchJob], list[list[BenchJob]]]:
    """Make the jobs of a table.

    Args:
        cases: The encounters.
        egos: The ego drivers.
        rows: The rows.
        seed: The seed.

    Returns:
        Jobs that depend on nothing, and chains of jobs that are done one after another.
    """
    free: list[BenchJob] = []
    chains: list[list[BenchJob]] = []
    methods = {row: method_of(row) or Method(row) for row in rows}
    shared: dict[str, list[str]] = {}
    for row, method in methods.items():
        if not method.learns:
            shared.setdefault(method.key, []).append(row)
    for ego in egos:
        for together in shared.values():
            first = methods[together[0]]
            free += [BenchJob(c, ego, seed, tuple(together), first.settings, first.shift) for c in cases]
        for row, method in methods.items():
            if method.learns:
                chains.append(
                    [BenchJob(c, ego, seed, (row,), method.settings, method.shift, k) for k, c in enumerate(cases)]
                )
    return free, chains


# -- the bank of a row


def bank_of(
    method: Method, job: BenchJob, setup: BenchSetup, library: MemoryBank, scratch: Path
) -> AbstractContextManager[MemoryBank]:
    """Open the bank for a row's attack on one encounter.

    Args:
        method: The row.
        job: The job.
        setup: The setup.
        library: The bank of rows that do not learn.
        scratch: A folder for temporary files.

    Returns:
        The bank, as a context manager.

    Raises:
        BankError: The bank cannot be read or copied.
        UsageError: The bank lacks an intent of LLM-F.
    """
    if method.learns:
        return _growing(job, setup)
    return _fixed(setup.bank, scratch) if method.fixed else nullcontext(library)


@contextmanager
def _fixed(library: Path, scratch: Path) -> Iterator[MemoryBank]:
    """Yield a copy of the bank in which all intents but LLM-F's two are retired."""
    copy = scratch / "fixed.sqlite"
    if not copy.exists():
        shutil.copyfile(library, copy)
        with MemoryBank.open(copy) as bank:
            missing = set(FIXED_LIBRARY) - {i.label for i in bank.intents()}
            if missing:
                raise UsageError(f"The memory bank has no intent '{sorted(missing)[0]}', so there is no row llm-f.")
            for intent in bank.intents():
                if intent.label not in FIXED_LIBRARY:
                    bank.retire(intent.label)
    with MemoryBank.open(copy, read_only=True) as bank:
        yield bank


@contextmanager
def _growing(job: BenchJob, setup: BenchSetup) -> Iterator[MemoryBank]:
    """Yield the bank as previous encounters left it; what this encounter teaches is kept for the next one.

    ``K.sqlite`` is the bank before encounter K. It stays until encounter K has its cell, so that an interrupted
    encounter is repeated from the same bank. A case that broke, or that has no encounter, leaves no bank; the next one
    uses the newest bank.
    """
    place = job.place or 0
    folder = _folder(job, setup)
    folder.mkdir(parents=True, exist_ok=True)
    before = folder / f"{known_place(job, setup)}.sqlite"
    if place == 0 or not before.exists():
        shutil.copyfile(setup.bank, before)
    for leftover in folder.iterdir():  # from finished encounters or an interrupted one
        if leftover != before:
            leftover.unlink()
    part, after = folder / f"{place + 1}.part", folder / f"{place + 1}.sqlite"
    shutil.copyfile(before, part)
    with MemoryBank.open(part) as bank:
        yield bank
    part.replace(after)


def known_place(job: BenchJob, setup: BenchSetup) -> int:
    """Return the position, at most the job's, from which a learning row can continue: the newest with a bank, or 0."""
    places = (int(file.stem) for file in _folder(job, setup).glob("*.sqlite"))
    return max((k for k in places if k <= (job.place or 0)), default=0)


def _folder(job: BenchJob, setup: BenchSetup) -> Path:
    """Return the folder of a learning row's banks."""
    return setup.folder / "banks" / slug(job.ego) / slug(job.rows[0])
