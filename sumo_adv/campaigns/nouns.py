"""The nouns of a batch: an input, an episode to run, the functions that the command line composes, the outcome."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sumo_adv.simulation.inputs import RunInput

Row = Mapping[str, Any]
"""One line of ``results.csv``; see ``results.py``."""


class Learn(StrEnum):
    """When what episodes learn goes into the memory bank."""

    OFF = "off"
    AFTER = "after"  # at the end, in the plan's order
    DURING = "during"  # at once: then the rows depend on the order


@dataclass(frozen=True, slots=True)
class Input:
    """One input of a plan. ``name``: as people know it; ``source``: the path or the shipped name; ``record``: the id of
    a Waymo record; ``content``: SHA-256 of all its files; ``error``: why it cannot be run, '' if it can; ``notes``:
    sentences about what of it is not kept, or was converted."""

    name: str
    source: Path
    record: str | None
    content: str
    error: str = ""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Job:
    """One episode to run. ``id``: 16 hexadecimal digits of its content; ``variant``: place of its settings in the plan;
    ``ego`` None = as the input says."""

    id: str
    input: Input
    ego: str | None
    seed: int
    variant: int

    @property
    def words(self) -> str:
        """The episode for people."""
        return f"{self.input.name} {f'({self.ego}) ' if self.ego else ''}seed {self.seed}"


@dataclass(frozen=True, slots=True)
class Done:
    """The outcome of one try. ``again``: it failed in a way that another try may not; then nothing was kept, and
    ``text`` is a traceback or what its processes said."""

    id: str
    row: Row | None
    bytes: int = 0
    again: str = ""
    text: str = ""


@dataclass(frozen=True, slots=True)
class Parts:
    """What the command line composes, all importable by name, because they go to other processes."""

    load: Callable[[Path, str | None], RunInput]
    records: Callable[[Path], Iterator[tuple[str, str] | str]]  # of a file: id and content, or what is wrong with one
    open_agents: Callable[..., AbstractContextManager[Any]]
    staged: Callable[..., AbstractContextManager[Any]]
    write_run: Callable[..., dict[str, Any]]
    model_file: str


@dataclass(frozen=True, slots=True)
class Setup:
    """What every worker of a batch needs to know.

    runs: the folder of runs; bank: the snapshot, or with ``Learn.DURING`` the bank itself; variants: settings as data.
    """

    runs: Path
    bank: Path
    learn: Learn
    variants: Sequence[Mapping[str, Any]]
    figures: bool
    parts: Parts
