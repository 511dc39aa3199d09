"""What happens while a server runs, for those that listen: the terminal, a file of JSON lines, the status page."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from sumo_adv.datatypes import Proposal
from sumo_adv.errors import UsageError
from sumo_adv.files import json_text

Event = Mapping[str, Any]
Listener = Callable[[Event], None]
KEPT = 200  # outcomes that the status page lists


def helpers(p: Proposal) -> dict[str, Any]:
    """What the event of an attack with supports has besides."""
    return {"composition": p.composition, "supports": [q.as_adversary() for q in p.supports]} if p.supports else {}


class Events:
    """Gives each event to every listener in turn; may be told from any thread.

    An event has ``event`` (its kind), ``clock`` [s since 1970] and what its kind says; ``time`` is simulated [s].
    """

    def __init__(self, *listeners: Listener) -> None:
        self._listeners = listeners
        self._lock = threading.RLock()

    def tell(self, kind: str, **facts: Any) -> None:
        """One event."""
        event = {"event": kind, "clock": round(time.time(), 3), **facts}
        with self._lock:
            for listener in self._listeners:
                listener(event)


class EventFile:
    """A JSON object a line, each written at once."""

    def __init__(self, path: Path) -> None:
        """Begin the file. Raises UsageError if it cannot be written."""
        try:
            self._file = path.open("w", encoding="utf-8")
        except OSError as error:
            raise UsageError(f"The events file {path} cannot be written ({error.strerror}); give another.") from error

    def __call__(self, event: Event) -> None:
        """Write one event; after a failure (a full disk) nothing more is written."""
        try:
            if not self._file.closed:
                self._file.write(json_text(event))
                self._file.flush()
        except OSError:
            self.close()

    def close(self) -> None:
        """End the file."""
        try:
            self._file.close()
        except OSError:
            return  # its last line could not be written


class Status:
    """The state of a server as its events tell it, for the status page."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._began = time.time()
        self._now: dict[str, Any] = {
            "health": "starting", "time": None, "client": "away", "ego": None, "owners": None, "encounter": None,
            "simulations": 0, "dropped": 0, "passed_over": 0, "refused": 0, "encounters": 0, "critical": 0,
            "collisions": 0,
        }  # fmt: skip
        self._outcomes: deque[Event] = deque(maxlen=KEPT)

    def __call__(self, event: Event) -> None:
        """Take an event in."""
        with self._lock:
            if event.get("time") is not None:
                self._now["time"] = event["time"]
            handler = getattr(self, f"_on_{event['event']}", None)
            if handler is not None:
                handler(event)

    def report(self) -> dict[str, Any]:
        """All of it."""
        with self._lock:
            return {**self._now, "uptime": round(time.time() - self._began, 1), "outcomes": list(self._outcomes)}

    def _on_listening(self, event: Event) -> None:
        self._now |= {"health": "ok", "ego": event["ego"], "address": f"{event['host']}:{event['port']}"}

    def _on_client(self, event: Event) -> None:
        if event["state"] == "refused":
            self._now["refused"] += 1
        elif event["state"] != "restarted":
            self._now["client"] = event["state"]

    def _on_simulation(self, event: Event) -> None:
        self._now["simulations"] += event["state"] == "started"

    def _on_owners(self, event: Event) -> None:
        self._now["owners"] = {k: event[k] for k in ("client", "adversary", "sumo")}

    def _on_encounter(self, event: Event) -> None:
        self._now["encounter"] = {k: event[k] for k in ("number", "time", "ranking")}

    def _on_passed_over(self, event: Event) -> None:
        self._now["passed_over"] += 1
        self._now["encounter"] = None

    def _on_dropped(self, event: Event) -> None:
        self._now["dropped"] += 1
        self._now["encounter"] = None

    def _on_released(self, event: Event) -> None:
        self._now["encounter"] = None

    def _on_outcome(self, event: Event) -> None:
        self._now["encounters"] += 1
        self._now["critical"] += bool(event["critical"])
        self._now["collisions"] += bool(event["collided"])
        self._outcomes.append({k: v for k, v in event.items() if k != "event"})

    def _on_stopped(self, event: Event) -> None:
        self._now["health"] = "stopped"
