"""What a person sees of a bench: a bar in a terminal, a line now and then in a pipe, nothing with --json."""

from __future__ import annotations

import sys
import time
from typing import Any

import typer

from sumo_adv.benchmark.jobs import Job
from sumo_adv.cli.shown import Shown

EVERY = 30.0  # s between lines where there is no terminal


class Quiet(Shown):
    """Says nothing."""

    def begin(self, total: int, before: int) -> None:
        """Nothing."""

    def finished(self, job: Job) -> None:
        """Nothing."""


class Lines(Quiet):
    """How far it is, every half a minute."""

    def begin(self, total: int, before: int) -> None:
        """How much there is to do."""
        self._total, self._done, self._told = total, before, time.monotonic()
        typer.echo(f"{total} cells, {before} of them there.", err=True)

    def finished(self, job: Job) -> None:
        """Perhaps a line."""
        self._done += len(job.rows)
        if time.monotonic() - self._told > EVERY:
            self._told = time.monotonic()
            typer.echo(f"{self._done} of {self._total} cells.", err=True)


class Bar(Quiet):
    """A bar with time left."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._display = Progress(
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
            console=Console(stderr=True, highlight=False),
        )  # fmt: skip
        self._task: Any = None

    def begin(self, total: int, before: int) -> None:
        """Set the bar up."""
        self._task = self._display.add_task("cells", total=total, completed=before)

    def finished(self, job: Job) -> None:
        """On by the rows of the job."""
        self._display.update(self._task, advance=len(job.rows), description=job.case.name)


def make_watcher(*, quiet: bool) -> Quiet:
    """As fits where the output goes."""
    if quiet:
        return Quiet()
    return Bar() if sys.stderr.isatty() else Lines()
