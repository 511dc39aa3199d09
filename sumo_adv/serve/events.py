"""Events of a running server, for its listeners: the terminal, a file of JSON lines, and the status page.

The status page is a small HTTP server on the loopback interface: ``/health`` and ``/status``, as JSON. The folders of
encounters are written in a separate thread, so that no simulation waits for a picture.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from sumo_adv.datatypes import Proposal
from sumo_adv.episode.run import Run
from sumo_adv.errors import SumoAdvError, UsageError, fault_sentence
from sumo_adv.files import json_text

Event = Mapping[str, Any]
Listener = Callable[[Event], None]
MAX_LISTED_OUTCOMES = 200  # maximum number of outcomes on the status page
LOOPBACK = "127.0.0.1"
HOSTS = (LOOPBACK, "localhost")
MAX_WAITING_ENCOUNTERS = 2  # more encounters that are not written yet make the simulation wait
WriteEncounter = Callable[[Run, int], Mapping[str, Any]]


def helpers(p: Proposal) -> dict[str, Any]:
    """Return the additional facts of the event of an attack with supports; none without supports.

    Args:
        p: The candidate.
    """
    return {"composition": p.composition, "supports": [q.as_adversary() for q in p.supports]} if p.supports else {}


class Events:
    """Passes each event to every listener in turn. It may be used from any thread.

    An event has ``event`` (its kind), ``clock`` [s since 1970] and the facts of its kind. ``time`` is simulated [s].
    """

    def __init__(self, *listeners: Listener) -> None:
        """Start with these listeners.

        Args:
            listeners: Called with each event.
        """
        self._listeners = listeners
        self._lock = threading.RLock()

    def tell(self, kind: str, **facts: Any) -> None:
        """Pass an event on.

        Args:
            kind: The kind of the event.
            facts: Its facts.
        """
        event = {"event": kind, "clock": round(time.time(), 3), **facts}
        with self._lock:
            for listener in self._listeners:
                listener(event)


class EventFile:
    """A file with one JSON object per line; each is written at once."""

    def __init__(self, path: Path) -> None:
        """Begin the file.

        Args:
            path: The path of the file.

        Raises:
            UsageError: The file cannot be written.
        """
        try:
            self._file = path.open("w", encoding="utf-8")
        except OSError as error:
            raise UsageError(f"The events file {path} cannot be written ({error.strerror}); give another.") from error

    def __call__(self, event: Event) -> None:
        """Write one event; after a failure (a full disk), write nothing more."""
        try:
            if not self._file.closed:
                self._file.write(json_text(event))
                self._file.flush()
        except OSError:
            self.close()

    def close(self) -> None:
        """Close the file."""
        with suppress(OSError):  # the last line could not be written
            self._file.close()


class Status:
    """The state of a server by its events, for the status page."""

    def __init__(self) -> None:
        """Start without events."""
        self._lock = threading.Lock()
        self._began = time.time()
        self._now: dict[str, Any] = {
            "health": "starting", "client": "away", "ego": None, "owners": None, "encounter": None,
            "simulations": 0, "dropped": 0, "passed_over": 0, "refused": 0, "encounters": 0, "critical": 0,
            "collisions": 0,
        }  # fmt: skip
        self._outcomes: deque[Event] = deque(maxlen=MAX_LISTED_OUTCOMES)

    def __call__(self, event: Event) -> None:
        """Update the state by an event."""
        with self._lock:
            handler = getattr(self, f"_on_{event['event']}", None)
            if handler is not None:
                handler(event)

    def report(self) -> dict[str, Any]:
        """Return the state."""
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

    def _on_released(self, event: Event) -> None:
        self._now["encounter"] = None
        if event["event"] in self._now:
            self._now[event["event"]] += 1

    _on_passed_over = _on_dropped = _on_released

    def _on_outcome(self, event: Event) -> None:
        self._now["encounters"] += 1
        self._now["critical"] += bool(event["critical"])
        self._now["collisions"] += bool(event["collided"])
        self._outcomes.append({k: v for k, v in event.items() if k != "event"})

    def _on_stopped(self, event: Event) -> None:
        self._now["health"] = "stopped"


class StatusPage:
    """Answers in its own threads until it is closed. Use it in a ``with`` statement."""

    def __init__(self, port: int, report: Callable[[], dict[str, Any]]) -> None:
        """Listen at a port.

        Args:
            port: The port; 0 takes any free one.
            report: Returns the state of the server.

        Raises:
            UsageError: The port is taken.
        """
        try:
            self._server = ThreadingHTTPServer((LOOPBACK, port), _handler(report))
        except (OSError, OverflowError) as error:
            raise UsageError(f"The status port {port} cannot be opened ({error}); give another.") from error
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="status", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop listening."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def __enter__(self) -> StatusPage:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _handler(report: Callable[[], dict[str, Any]]) -> type[BaseHTTPRequestHandler]:
    """Return the handler of requests."""

    class Handler(BaseHTTPRequestHandler):
        timeout = 5.0  # s for a whole request

        def do_GET(self) -> None:
            """``/health`` and ``/status``."""
            host = self.headers.get("Host", LOOPBACK).rpartition(":")
            if (host[0] or host[2]).lower() not in HOSTS:  # another site whose name was made to resolve to this machine
                self._answer(403, {"error": f"Ask for {LOOPBACK}: this page is for this machine alone."})
                return
            state = report()
            if self.path == "/health":
                self._answer(200 if state["health"] == "ok" else 503, {"status": state["health"]})
            elif self.path == "/status":
                self._answer(200, state)
            else:
                self._answer(404, {"error": "There is /health and /status."})

        def _answer(self, code: int, value: dict[str, Any]) -> None:
            body = json_text(value).encode()
            self.send_response(code)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *arguments: Any) -> None:
            """Requests are not logged."""

    return Handler


class ResultWriter:
    """Writes the folders of encounters in a separate thread.

    Attributes:
        critical: The number of critical encounters so far.
        collided: The number of encounters with a collision so far.
        written: The number of encounters written so far.
        failure: Why an encounter could not be written; None if all could.
    """

    def __init__(self, write: WriteEncounter, events: Events) -> None:
        """Start the thread.

        Args:
            write: Takes the run of an encounter and its number, and returns the content of ``outcome.json`` and its
                ``folder``.
            events: Receives the outcomes.
        """
        self._write, self._events = write, events
        self.critical = self.collided = self.written = 0
        self.failure: SumoAdvError | None = None
        self._tray: queue.Queue[tuple[Run, int] | None] = queue.Queue(MAX_WAITING_ENCOUNTERS)
        self._thread = threading.Thread(target=self._work, name="result writer", daemon=True)
        self._thread.start()

    def keep(self, run: Run, number: int) -> None:
        """Have an encounter written.

        Args:
            run: The run of the encounter.
            number: The number of the encounter.

        Raises:
            SumoAdvError: An earlier encounter could not be written.
        """
        if self.failure is not None:
            raise self.failure
        self._tray.put((run, number))

    def close(self) -> None:
        """Write what is left, and end the thread."""
        if self._thread.is_alive():
            self._tray.put(None)
            self._thread.join()

    def _work(self) -> None:
        """Write encounters until the end."""
        while (item := self._tray.get()) is not None:
            run, number = item
            if self.failure is None:
                try:
                    self._report(self._write(run, number), number)
                except SumoAdvError as error:
                    self.failure = error
                except Exception as error:  # a bug: the run ends with a sentence
                    self.failure = SumoAdvError(f"Encounter {number} could not be written. {fault_sentence(error)}")
            del item, run  # free the memory before waiting for the next one

    def _report(self, result: Mapping[str, Any], number: int) -> None:
        """Count an outcome, and pass it on as an event."""
        best, supports = result["outcome"] or {}, result["adversaries"][1:]
        critical = result["ending"] == "critical"
        self.written += 1
        self.critical += critical
        self.collided += bool(best.get("collided"))
        self._events.tell(
            "outcome", number=number, ending=result["ending"], reason=result["reason"], critical=critical,
            collided=bool(best.get("collided")), valid=best.get("valid"), min_ttc=best.get("min_ttc"),
            adversary=next((a["id"] for a in result["adversaries"]), None),
            intent=(result["intent"] or {}).get("label"), attempts=len(result["attempts"]),
            folder=str(result["folder"]), **({"supports": supports} if supports else {}),
        )  # fmt: skip
