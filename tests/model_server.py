"""A real HTTP server on loopback that speaks chat completions, with scripted answers and faults."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Self

from sumo_adv.config import ModelSettings
from sumo_adv.llm.transport import Clock

KEY = "sk-tests-0123456789"


@dataclass(frozen=True)
class Asked:
    """A request as the server got it."""

    path: str
    headers: Mapping[str, str]
    body: Mapping[str, Any]

    @property
    def mode(self) -> str:
        """json_schema, json_object or text."""
        return str(self.body.get("response_format", {}).get("type", "text"))

    @property
    def messages(self) -> list[tuple[str, str]]:
        """(role, content) pairs."""
        return [(m["role"], m["content"]) for m in self.body["messages"]]

    @property
    def system(self) -> str:
        """The first message's content."""
        return self.messages[0][1]

    @property
    def last(self) -> str:
        """The last message's content."""
        return self.messages[-1][1]


@dataclass(frozen=True)
class Say:
    """An answer in words: 200 and a completion. An object as ``text`` is sent as its JSON; ``more`` are further keys of
    the message."""

    text: str | Mapping[str, Any]
    reasoning: str | None = None
    reasoning_key: str = "reasoning_content"
    finish: str | None = "stop"
    more: Mapping[str, Any] = field(default_factory=dict)
    usage: Mapping[str, Any] | None = field(
        default_factory=lambda: {"prompt_tokens": 100, "completion_tokens": 10, "prompt_cache_hit_tokens": 40}
    )

    def body(self) -> dict[str, Any]:
        """The completion."""
        content = self.text if isinstance(self.text, str) else json.dumps(self.text)
        message: dict[str, Any] = {"role": "assistant", "content": content, **self.more}
        if self.reasoning is not None:
            message[self.reasoning_key] = self.reasoning
        usage = {} if self.usage is None else {"usage": dict(self.usage)}
        return {"id": "1", "choices": [{"index": 0, "message": message, "finish_reason": self.finish}], **usage}


@dataclass(frozen=True)
class Raw:
    """Any status, headers and body."""

    status: int = 200
    body: bytes = b""
    headers: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Cut:
    """A connection that breaks in the middle of the body."""


@dataclass(frozen=True)
class Drop:
    """A connection that the server ends without a word."""


@dataclass(frozen=True)
class Drip:
    """A byte every ``every`` seconds that never ends; in the headers already, or in the body."""

    every: float = 0.02
    in_headers: bool = False


@dataclass(frozen=True)
class Hang:
    """Nothing at all."""


@dataclass(frozen=True)
class Large:
    """An answer of ``size`` bytes."""

    size: int = 10_000_000


def status(code: int, message: str = "", **headers: str) -> Raw:
    """An error as such servers send it; ``Retry_After="2"`` gives that header."""
    body = json.dumps({"error": {"message": message, "type": "test"}}).encode()
    return Raw(code, body, {name.replace("_", "-"): value for name, value in headers.items()})


def no_schema(answer: Answer, refused: Sequence[str] = ("json_schema",)) -> Callable[[Asked], Answer]:
    """A server that answers 400 to these response formats, and else ``answer``."""

    def script(request: Asked) -> Answer:
        return status(400, f"response_format {request.mode} is unavailable") if request.mode in refused else answer

    return script


Answer = str | Mapping[str, Any] | Say | Raw | Cut | Drop | Drip | Hang | Large
Script = Sequence[Answer] | Callable[[Asked], Answer]


class ModelServer:
    """The server; use it in a ``with`` statement.

    ``script``: answers in order (then 500 "no more answers"), or a function of the request. ``models``: the answer to
    GET models. ``port``: 0 for a free one. ``asked`` holds what came, in order; ``most_at_once`` how many questions
    were open together.
    """

    def __init__(self, script: Script = (), models: Raw | None = None, port: int = 0) -> None:
        self.asked: list[Asked] = []
        self._models = models or status(404, "no list of models here")
        self.most_at_once = 0
        self._at_once = 0
        self._script = script
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._server = ThreadingHTTPServer(("127.0.0.1", port), self._handler())
        self._server.daemon_threads = True
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True)

    @property
    def base_url(self) -> str:
        """Where it listens."""
        return f"http://127.0.0.1:{self._server.server_port}/v1"

    def settings(self, **given: Any) -> ModelSettings:
        """Settings that lead here, with a key."""
        return ModelSettings(**{"llm_base_url": self.base_url, "llm_api_key": KEY, **given})

    def environment(self) -> dict[str, str]:
        """The same as environment variables, for the program in a process of its own."""
        return {"SUMO_ADV_LLM_BASE_URL": self.base_url, "SUMO_ADV_LLM_API_KEY": KEY}

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()

    def _answer(self, request: Asked) -> Answer:
        with self._lock:
            place = len(self.asked)
            self.asked.append(request)
            if not callable(self._script):
                return self._script[place] if place < len(self._script) else status(500, "no more answers")
        return self._script(request)

    def _enter(self, step: int) -> None:
        with self._lock:
            self._at_once += step
            self.most_at_once = max(self.most_at_once, self._at_once)

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        server = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                request = Asked(self.path, dict(self.headers.items()), body)
                server._enter(1)
                try:
                    if self.path == "/v1/chat/completions":
                        answer = server._answer(request)
                    else:
                        answer = status(404, f"no {self.path} here")
                finally:
                    server._enter(-1)
                try:
                    self._send(answer)
                except OSError:  # the other side has had enough
                    self.close_connection = True

            def do_GET(self) -> None:
                self._whole(server._models if self.path == "/v1/models" else status(404, f"no {self.path} here"))

            def _send(self, answer: Answer) -> None:
                if isinstance(answer, str | Mapping):
                    answer = Say(answer)
                if isinstance(answer, Say):
                    answer = Raw(200, json.dumps(answer.body()).encode())
                if isinstance(answer, Raw):
                    self._whole(answer)
                elif isinstance(answer, Cut):
                    self._begin(1000)
                    self.wfile.write(b'{"choices": [{"mess')
                    self.wfile.flush()
                    self.connection.shutdown(socket.SHUT_RDWR)
                    self.close_connection = True
                elif isinstance(answer, Drop):
                    self.connection.shutdown(socket.SHUT_RDWR)
                    self.close_connection = True
                elif isinstance(answer, Large):
                    self._begin(answer.size)
                    for _ in range(answer.size // 100_000):
                        self.wfile.write(b" " * 100_000)
                elif isinstance(answer, Drip):
                    self._drip(answer)
                else:
                    server._ending.wait()
                    self.close_connection = True

            def _whole(self, answer: Raw) -> None:
                self.send_response(answer.status)
                for name, value in answer.headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(answer.body)))
                self.end_headers()
                self.wfile.write(answer.body)

            def _begin(self, length: int) -> None:
                self.send_response(200)
                self.send_header("Content-Length", str(length))
                self.end_headers()

            def _drip(self, answer: Drip) -> None:
                if answer.in_headers:
                    self.wfile.write(b"HTTP/1.1 200 OK\r\nX-Slow: ")
                else:
                    self._begin(1_000_000)
                while not server._ending.wait(answer.every):
                    self.wfile.write(b"x")
                    self.wfile.flush()
                self.close_connection = True

            def log_message(self, format: str, *args: Any) -> None:
                pass

        return Handler


class StepClock(Clock):
    """A clock for retries: it stands still, and sleeping moves it on at once."""

    def __init__(self) -> None:
        self.time = 0.0
        self.slept: list[float] = []

    def now(self) -> float:
        """Seconds."""
        return self.time

    def sleep(self, seconds: float) -> None:
        """Note it, and go on."""
        self.slept.append(seconds)
        self.time += seconds
