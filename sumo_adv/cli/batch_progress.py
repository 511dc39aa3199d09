"""What a person sees of a batch: a bar in a terminal, little in a pipe or in CI, nothing with --json."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from typing import Any

import typer

from sumo_adv.campaigns.nouns import Job, Row
from sumo_adv.campaigns.results import failed
from sumo_adv.cli.shown import Shown


class Quiet(Shown):
    """Says only what went wrong, at once, on stderr."""

    def begin(self, total: int, before: Sequence[Row]) -> None:
        """Nothing."""

    def finished(self, job: Job, row: Row) -> None:
        """A line for a failure."""
        if failed(row):
            typer.echo(f"sumo-adv: {job.words} failed: {row['failure']}", err=True)

    def stopping(self, now: bool) -> None:
        """What Ctrl-C does."""
        typer.echo(stopping_words(now), err=True)


class Bar(Quiet):
    """A bar with rate, time left and counts."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._display = Progress(
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(), TextColumn("{task.fields[counts]}"), console=Console(stderr=True, highlight=False),
        )  # fmt: skip
        self._task: Any = None
        self._critical = self._failed = self._ran = 0

    def begin(self, total: int, before: Sequence[Row]) -> None:
        """The bar, as far as it was before."""
        self._critical = sum(bool(r["critical"]) for r in before)
        self._failed = sum(map(failed, before))
        self._task = self._display.add_task("Episodes", total=total, completed=len(before), rate="", counts="")
        self._show(0)

    def finished(self, job: Job, row: Row) -> None:
        """One step."""
        self._critical += bool(row["critical"])
        self._failed += failed(row)
        self._ran += 1
        if failed(row):
            self._display.console.print(f"{job.words} failed: {row['failure']}", markup=False)
        self._show(1)

    def _show(self, advance: int) -> None:
        seconds = self._display.tasks[0].elapsed or 0.0
        rate = f"{60 * self._ran / seconds:.1f}/min" if self._ran and seconds else ""
        counts = f"{self._critical} critical, {self._failed} failed"
        self._display.update(self._task, advance=advance, rate=rate, counts=counts)

    def stopping(self, now: bool) -> None:
        """What Ctrl-C does."""
        self._display.console.print(stopping_words(now), markup=False)


def stopping_words(now: bool) -> str:
    """What follows a Ctrl-C."""
    if now:
        return "Stopping now."
    return "Finishing the episodes that run; Ctrl-C again stops them. Say the same command again to go on."


def make_watcher() -> Quiet:
    """A bar in a terminal that is not a build server's."""
    return Bar() if sys.stderr.isatty() and not os.environ.get("CI") else Quiet()
