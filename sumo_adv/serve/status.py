"""A small HTTP server on the loopback interface that says how the server is: ``/health`` and ``/status``, as JSON."""

from __future__ import annotations

import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from sumo_adv.errors import UsageError
from sumo_adv.files import json_text

LOOPBACK = "127.0.0.1"


class StatusPage:
    """Answers in threads of its own until it is closed; a context manager."""

    def __init__(self, port: int, report: Callable[[], dict[str, Any]]) -> None:
        """Listen on ``port`` (0 = any free one). Raises UsageError if it is taken."""
        try:
            self._server = ThreadingHTTPServer((LOOPBACK, port), _handler(report))
        except (OSError, OverflowError) as error:
            raise UsageError(f"The status port {port} cannot be opened ({error}); give another.") from error
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="status", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop answering."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def __enter__(self) -> StatusPage:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _handler(report: Callable[[], dict[str, Any]]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = 5.0  # s for a whole request

        def do_GET(self) -> None:
            """``/health`` and ``/status``."""
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
