"""What a person sees while a run goes on, and at its end. In pipes: plain lines; with --json: nothing."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, Self

import typer

from sumo_adv.cli.shown import Shown
from sumo_adv.datatypes import Attempt


class Reporter(Protocol):
    """Told what happens."""

    def tell(self, what: str, value: Any) -> None:
        """``encounter``, ``intents`` or ``attempt``."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class Silent(Shown):
    """Says nothing."""

    def tell(self, what: str, value: Any) -> None:
        """Nothing."""


class Lines(Silent):
    """One line an event."""

    def tell(self, what: str, value: Any) -> None:
        """Print it."""
        text = line(what, value)
        if text:
            typer.echo(text)


class Live(Silent):
    """Lines above a spinner, in a terminal."""

    def __init__(self) -> None:
        from rich.console import Console

        self._console = Console(highlight=False)
        self._display = self._console.status("Looking for an encounter ...")

    def tell(self, what: str, value: Any) -> None:
        """Print it, and say what comes next."""
        text = line(what, value)
        if text:
            self._console.print(text, markup=False)
        following = {"encounter": "Predicting ...", "intents": "Attacking ...", "attempt": "Attacking ..."}
        self._display.update(following.get(what, ""))


def make_reporter(*, quiet: bool) -> Reporter:
    """Silent with --json, live in a terminal, lines in a pipe."""
    if quiet:
        return Silent()
    return Live() if sys.stdout.isatty() else Lines()


def line(what: str, value: Any) -> str:
    """An event in words."""
    if what == "encounter":
        near = ", ".join(f"{i} ({r})" for i, r, _ in value.ranking)
        passed = f" after passing over {len(value.passed_over)}" if value.passed_over else ""
        return f"Encounter at {value.time:.1f} s{passed}: ego {value.ego}; near it {near}"
    if what == "intents":
        top = value[0]
        return f"Most dangerous: {top.bv} — {top.label} (risk {top.risk}; {top.reason})"
    return _attempt(value) if what == "attempt" else ""


def _attempt(a: Attempt) -> str:
    v, p = a.verdict, a.proposal
    what = "collision" if v.collided else (f"min TTC {v.min_ttc:.2f} s" if v.min_ttc < 100 else "no conflict")
    if v.collided and v.avoidable:
        what += f" ({'avoidable by ' if v.avoidable != 'unavoidable' else ''}{v.avoidable.replace('_', ' ')})"
    gates = f", not feasible: {', '.join(v.failed_gates)}" if v.failed_gates else ""
    rear = ", rear-end" if v.rear_end else ""
    return f"  attempt {a.index + 1:2d} [{p.by}] {p.bv}: {p.label}/{p.planner.mode}, {what}{rear}{gates}"


def summary(result: Mapping[str, Any], folder: Path) -> str:
    """The outcome in a few lines."""
    lines = [f"Ending: {result['ending']}. {result['reason']}"]
    raw, best = result["raw"], result["outcome"]
    if best is not None and raw is not None:
        before = "collision" if raw["collided"] else _seconds(raw["min_ttc"])
        after = "collision" if best["collided"] else _seconds(best["min_ttc"])
        verdict = {True: "valid", False: f"not valid: {_why(best)}", None: "no collision"}[best["valid"]]
        intent = result["intent"]
        lines.append(f"{intent['label']} by {intent['bv']}: min TTC {before} unattacked, {after} attacked ({verdict}).")
    lines.append(result["agents"]["note"])
    if result["encounter"] is not None and not result["forked"]:
        lines.append("Attempts were loaded and repeated, not forked: slower, the same result.")
    lines.append(f"Files: {folder}")
    return "\n".join(lines)


def _why(verdict: Mapping[str, Any]) -> str:
    """What keeps a collision from being valid."""
    reasons = [g.replace("_", " ") for g in verdict["failed_gates"]]
    reasons += ["rear-end"] if verdict["rear_end"] else []
    return ", ".join(reasons) or str(verdict["avoidable"]).replace("_", " ")


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.2f} s"
