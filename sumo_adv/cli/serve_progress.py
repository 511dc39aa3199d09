"""What a person sees of a server: a line for what matters, and in a terminal a line that lives below them."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

import typer

from sumo_adv.cli.shown import Shown

Event = Mapping[str, Any]


class Quiet(Shown):
    """Says nothing."""

    def __call__(self, event: Event) -> None:
        """Nothing."""


class Lines(Quiet):
    """A line for what matters, for pipes."""

    def __call__(self, event: Event) -> None:
        """Print it."""
        text = line(event)
        if text:
            typer.echo(text)
            sys.stdout.flush()


class Live(Quiet):
    """The same lines above a line of the present state."""

    def __init__(self) -> None:
        from rich.console import Console

        self._console = Console(highlight=False)
        self._display = self._console.status("Starting ...")
        self._counts = [0, 0, 0]
        self._doing = "Starting"

    def __call__(self, event: Event) -> None:
        """Print it, and say what goes on now."""
        text = line(event)
        if text:
            self._console.print(text, markup=False)
        if event["event"] == "outcome":
            for k, name in enumerate(("number", "critical", "collided")):
                self._counts[k] = event["number"] if name == "number" else self._counts[k] + bool(event[name])
        self._doing = now(event) or self._doing
        done, critical, collided = self._counts
        self._display.update(f"{self._doing} ({done} encounters, {critical} critical, {collided} collisions)")


def make_terminal(*, quiet: bool) -> Quiet:
    """Silent with --json, live in a terminal, lines in a pipe."""
    if quiet:
        return Quiet()
    return Live() if sys.stdout.isatty() else Lines()


def now(event: Event) -> str:
    """What goes on after an event; empty if as before."""
    kind, time = event["event"], event.get("time")
    if kind == "client":
        return "The client drives" if event["state"] == "connected" else "Waiting for a client"
    at = "" if time is None else f"{time:.1f} s: "
    doing = {
        "listening": "Waiting for a client", "encounter": f"{at}deciding", "attack": f"{at}attacking",
        "passed_over": f"{at}watching", "dropped": f"{at}watching", "released": f"{at}watching",
        "ego": f"{at}watching", "again": "The same encounter again",
    }  # fmt: skip
    return doing.get(kind, "")


def line(event: Event) -> str:
    """An event in words; empty for those that only programs want."""
    kind = event["event"]
    if kind == "listening":
        opens = f"\n{event['opens']}" if event["opens"] else ""
        added = f"\nThe demand has no vehicle '{event['ego']}': the program is to add it." if event["added"] else ""
        return f"Waiting at {event['host']}:{event['port']} for the program that drives '{event['ego']}'.{added}{opens}"
    if kind == "status_page":
        return f"Status: http://127.0.0.1:{event['port']}/status"
    if kind == "client":
        return "" if event["state"] == "restarted" or event["again"] else str(event["sentence"])
    if kind == "encounter":
        near = ", ".join(f"{c['id']} ({c['relation']})" for c in event["ranking"])
        return f"Encounter {event['number']} at {event['time']:.1f} s: near {event['ego']} are {near}"
    if kind in ("passed_over", "dropped"):
        return f"  {kind.replace('_', ' ')}: {event['reason']}" if kind == "dropped" else ""
    if kind == "attempt":
        return _attempt(event)
    return _outcome(event) if kind == "outcome" else ""


def _attempt(event: Event) -> str:
    outcome = "collision" if event["collided"] else "no conflict"
    if not event["collided"] and event["min_ttc"] is not None:
        outcome = f"min TTC {event['min_ttc']:.2f} s"
    lost = ", the client was lost" if event["ending"] == "ego_lost" else ""
    who = f"{event['adversary']}: {event['intent']}/{event['mode']}"
    helped = "".join(f" + {q['id']}: {q['intent']}" for q in event.get("supports", ()))
    return f"  attempt {event['index'] + 1:2d} [{event['by']}] {who}{helped}, {outcome}{lost}"


def _outcome(event: Event) -> str:
    return f"  {event['ending']}: {event['folder']}"
