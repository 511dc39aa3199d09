"""What is run at once: rows of one encounter that share a simulation, or the next encounter of a row that learns."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sumo_adv.benchmark.methods import Method, method_of
from sumo_adv.benchmark.nouns import GROUPS, Case

if TYPE_CHECKING:
    from sumo_adv.episode.episode import Episode
    from sumo_adv.simulation.inputs import RunInput

FILE_SIGNS = re.compile(r"[^A-Za-z0-9._=+-]+")
KINDS_SHOWN = 2  # of each group, as examples


@dataclass(frozen=True, slots=True)
class Parts:
    """What the command line composes, all importable by name, because they go to other processes."""

    load: Callable[[Path, str | None], RunInput]
    open_agents: Callable[..., AbstractContextManager[Any]]
    full_outcome: Callable[[Episode], dict[str, Any]]  # what outcome.json holds
    keep_run: Callable[[Path, Episode, Path | None], None]  # the folder of a run, with the model's exchanges
    draw_example: Callable[[Path, Episode], None]  # a picture of the encounter without and with the attack


@dataclass(frozen=True, slots=True)
class Setup:
    """What every process of a bench needs. ``bank``: the library, only read; ``settings``: of all rows, as data;
    ``examples``: cases of which each row's attack is drawn."""

    folder: Path
    suite: str
    bank: Path
    settings: Mapping[str, Any]
    parts: Parts
    keep_runs: bool = False
    examples: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Job:
    """Rows of one encounter. ``place``: of the case in the suite, for a row that learns: its bank is what the
    encounter before left."""

    case: Case
    ego: str
    seed: int
    rows: tuple[str, ...]
    settings: Mapping[str, Any] = field(default_factory=dict)
    shift: float = 0.0
    place: int | None = None


def cell_path(folder: Path, ego: str, case: str, row: str) -> Path:
    """Where a cell lies in the bench's folder."""
    return folder / "cells" / slug(ego) / slug(case) / f"{slug(row)}.json"


def example_path(folder: Path, ego: str, case: str, row: str) -> Path:
    """Where the picture of an attack lies in the bench's folder."""
    return folder / "figures" / f"example-{slug(ego)}-{slug(row)}-{slug(case)}.png"


def examples_of(cases: Sequence[Case]) -> frozenset[str]:
    """The cases that are drawn: of each group the first of each of its first ``KINDS_SHOWN`` kinds."""
    names: list[str] = []
    for group in GROUPS:
        first: dict[str, str] = {}
        for case in cases:
            if case.group == group:
                first.setdefault(case.kind, case.name)
        names += list(first.values())[:KINDS_SHOWN]
    return frozenset(names)


def slug(text: str) -> str:
    """A name for a file; what had to be changed is told apart by a few digits of its hash."""
    plain = FILE_SIGNS.sub("-", text).strip("-.")
    return plain if plain == text else f"{plain}-{hashlib.sha256(text.encode()).hexdigest()[:6]}"


def make_jobs(
    cases: Sequence[Case], egos: Sequence[str], rows: Sequence[str], seed: int
) -> tuple[list[Job], list[list[Job]]]:
    """Jobs that depend on nothing, and chains of jobs to be done one after another."""
    free: list[Job] = []
    chains: list[list[Job]] = []
    methods = {row: method_of(row) for row in rows}
    shared: dict[str, list[str]] = {}
    for row, method in methods.items():
        if method is None or not method.learns:
            shared.setdefault(Method(row).key if method is None else method.key, []).append(row)
    for ego in egos:
        for together in shared.values():
            first = methods[together[0]] or Method(together[0])
            free += [Job(c, ego, seed, tuple(together), first.settings, first.shift) for c in cases]
        for row, method in methods.items():
            if method is not None and method.learns:
                chain = [Job(c, ego, seed, (row,), method.settings, method.shift, k) for k, c in enumerate(cases)]
                chains.append(chain)
    return free, chains
