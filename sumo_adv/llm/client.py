"""The only HTTP of the project: chat completions and embeddings of any OpenAI-compatible server.

A question has a deadline over all its retries, kept by a clock of our own: servers that drip or hang are cut off.
429, 5xx and broken connections are tried again after a random wait that doubles, at least what ``Retry-After`` says.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from email.utils import parsedate_to_datetime
from functools import partial
from typing import Any, NoReturn, Protocol, TypeVar
from urllib.parse import urlsplit

import httpx
import numpy as np

from sumo_adv import __version__
from sumo_adv.config_model import ModelSettings
from sumo_adv.datatypes import Floats
from sumo_adv.errors import BudgetError, ModelError
from sumo_adv.llm import wire
from sumo_adv.llm.chat import ChatModel, ChatReply, ChatRequest
from sumo_adv.llm.ledger import Counted, Ledger
from sumo_adv.llm.presets import MODES, Server, find_server
from sumo_adv.llm.recording import Replay
from sumo_adv.llm.threads import start

REPLAY = "replay:"
LARGEST = 2_000_000  # bytes of an answer
FIRST_WAIT = 0.5  # s, before the first retry
LONGEST_WAIT = 8.0  # s, unless the server asks for more
AGAIN = (408, 429)  # and 5xx
UNSUPPORTED = (400, 422)  # how servers refuse a response_format
HERE = ("localhost", "127.0.0.1", "::1")
T = TypeVar("T")


class Clock(Protocol):
    """Time [s] for waits and deadlines."""

    def now(self) -> float:
        """A time that only grows."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait."""
        ...


class SystemClock:
    """The real one."""

    now = staticmethod(time.monotonic)
    sleep = staticmethod(time.sleep)


def connect(
    name: str,
    settings: ModelSettings,
    ledger: Ledger,
    *,
    clock: Clock | None = None,
    environment: Mapping[str, str] = os.environ,
) -> ChatModel:
    """The model of that name, its questions counted in ``ledger``: one of a preset, one of the server at the settings'
    base URL, or ``replay:FILE``. Asks nothing yet. Raises UsageError."""
    if name.startswith(REPLAY):
        return Counted(Replay.open(name.removeprefix(REPLAY)), ledger)
    server = find_server(name, settings, environment)
    return Counted(HttpModel(name, server, settings, ledger, clock or SystemClock()), ledger)


def connect_embedder(
    name: str, settings: ModelSettings, *, clock: Clock | None = None, environment: Mapping[str, str] = os.environ
) -> HttpEmbedder:
    """The embedding model of that name, found like a chat model. Raises UsageError."""
    return HttpEmbedder(name, find_server(name, settings, environment), settings, clock or SystemClock())


class HttpModel:
    """A chat model behind HTTP. What the server understands of answer shapes is remembered."""

    def __init__(self, name: str, server: Server, settings: ModelSettings, ledger: Ledger, clock: Clock) -> None:
        self.name = name
        self._server = server
        self._settings = settings
        self._ledger = ledger
        self._modes = MODES[MODES.index(server.mode) :]
        self._door = _Door(name, server, settings, clock)

    def complete(self, request: ChatRequest) -> ChatReply:
        """The answer; with a shape by json_schema, after a 400 by json_object, then in text. Raises ModelError, and
        BudgetError if the run's time ends during the question."""
        with self._door.question(self._ledger.seconds_left()) as question:
            modes = self._modes if request.shape is not None else MODES[-1:]
            for mode in modes:
                body = wire.chat_body(request, self._server.model, mode, self._settings.llm_temperature)

                read = partial(wire.read_reply, request=request, mode=mode)
                reply = question.post("/chat/completions", body, read, or_none=mode != modes[-1])
                if reply is not None:
                    if request.shape is not None:
                        self._modes = MODES[MODES.index(mode) :]
                    return replace(reply, seconds=question.seconds(), retries=question.retries)
        raise AssertionError("the last mode answers or raises")


class HttpEmbedder:
    """An embedding model behind HTTP."""

    BATCH = 128  # texts a request

    def __init__(self, name: str, server: Server, settings: ModelSettings, clock: Clock) -> None:
        self.name = name
        self._server = server
        self._door = _Door(name, server, settings, clock)

    def embed(self, texts: Sequence[str]) -> Floats:
        """A vector a text, shape (n, d). Raises ModelError."""
        rows: list[list[float]] = []
        for at in range(0, len(texts), self.BATCH):
            part = list(texts[at : at + self.BATCH])
            body = {"model": self._server.model, "input": part, "encoding_format": "float"}
            with self._door.question(None) as question:
                rows += question.post("/embeddings", body, partial(wire.read_vectors, count=len(part))) or []
        return np.asarray(rows, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class _Answer:
    status: int
    headers: Mapping[str, str]
    body: bytes


class _TooLarge(Exception):
    pass


class _Encoded(Exception):
    """The server compressed its answer, although it was asked not to."""


class _Door:
    """One server: its address, its key, and how many may ask at once."""

    def __init__(self, name: str, server: Server, settings: ModelSettings, clock: Clock) -> None:
        self.name = name
        self.settings = settings
        self.clock = clock
        self.base_url = server.base_url
        self.host = urlsplit(server.base_url).netloc
        self.trust = urlsplit(server.base_url).hostname not in HERE  # proxies are not for servers on this machine
        self.jitter = random.Random()
        self.slots = threading.BoundedSemaphore(settings.llm_concurrency)
        self.answered = False
        self._key = server.key.get_secret_value() if server.key is not None else None

    def question(self, left: float | None) -> _Question:
        """A question with ``left`` [s] of the run's time."""
        return _Question(self, left)

    def send(self, path: str, body: bytes, seconds: float) -> _Answer:
        """POST and read all within ``seconds``. Raises TimeoutError, httpx.HTTPError, _TooLarge, _Encoded."""
        answer = start(lambda: asyncio.run(asyncio.wait_for(self._exchange(path, body), seconds))).result()
        if self._key is None:
            return answer
        return _Answer(answer.status, answer.headers, answer.body.replace(self._key.encode(), b"***"))

    async def _exchange(self, path: str, body: bytes) -> _Answer:
        headers = {
            "Content-Type": "application/json", "User-Agent": f"sumo-adv/{__version__}", "Accept-Encoding": "identity",
        }  # fmt: skip
        if self._key is not None:
            headers["Authorization"] = f"Bearer {self._key}"
        timeout = httpx.Timeout(self.settings.llm_read_timeout, connect=self.settings.llm_connect_timeout)
        async with (
            httpx.AsyncClient(timeout=timeout, trust_env=self.trust) as client,
            client.stream("POST", self.base_url + path, content=body, headers=headers) as response,
        ):
            encoding = response.headers.get("content-encoding", "identity").strip().lower()
            if encoding not in ("", "identity"):  # 2 kB may hold 3 GB: nothing is unpacked
                raise _Encoded(encoding)
            parts, size = [], 0
            async for part in response.aiter_raw(65536):
                parts.append(part)
                size += len(part)
                if size > LARGEST:
                    raise _TooLarge
            return _Answer(response.status_code, dict(response.headers), b"".join(parts))


class _Question:
    """One question to a server with all its retries; a context manager that holds one of the server's slots."""

    def __init__(self, door: _Door, left: float | None) -> None:
        self._door = door
        allowed = door.settings.llm_question_seconds
        self._of_budget = left is not None and left < allowed
        self._allowed = allowed if left is None else min(allowed, left)
        self.retries = 0

    def __enter__(self) -> _Question:
        self._door.slots.acquire()
        self._began = self._door.clock.now()
        return self

    def __exit__(self, *_: object) -> None:
        self._door.slots.release()

    def seconds(self) -> float:
        """Since the question began, to the ms."""
        return round(self._door.clock.now() - self._began, 3)

    def post(
        self, path: str, body: Mapping[str, Any], read: Callable[[Mapping[str, Any]], T], *, or_none: bool = False
    ) -> T | None:
        """What ``read`` makes of the answer; None for a 400 if ``or_none``. Raises ModelError, BudgetError."""
        raw = json.dumps(body).encode()
        for turn in range(self._door.settings.llm_retries + 1):
            fault, wait = self._try(path, raw)
            if isinstance(fault, _Answer):
                if fault.status in UNSUPPORTED and or_none:
                    self.retries += 1
                    return None
                if fault.status != 200:
                    self._refuse(fault)
                try:
                    value = wire.read_json(fault.body)
                except wire.WrongShape as error:
                    fault, wait = f"sent an answer that cannot be read ({error})", 0.0
                else:
                    try:
                        return read(value)
                    except wire.WrongShape as error:
                        self._fail(f"gave no usable answer: {error}")
            last = turn == self._door.settings.llm_retries
            self._wait(turn, wait, fault, last)
        raise AssertionError("the last turn answers or raises")

    def _try(self, path: str, raw: bytes) -> tuple[_Answer | str, float]:
        """An answer, or why there is none and how long to wait at least [s] before the next try."""
        left = self._allowed - (self._door.clock.now() - self._began)
        if left <= 0:
            self._late()
        try:
            answer = self._door.send(path, raw, left)
        except TimeoutError:
            self._late()
        except _TooLarge:
            self._fail(f"sent an answer of more than {LARGEST // 1_000_000} MB, which is refused")
        except _Encoded as error:
            self._fail(
                f"sent an answer with Content-Encoding {wire.plain(str(error))}, which is refused; "
                "turn compression off there"
            )
        except httpx.ConnectError as error:
            if not self._door.answered:
                self._fail(f"cannot be reached ({_reason(error)}); is it running, and is SUMO_ADV_LLM_BASE_URL right?")
            return f"cannot be reached any more ({_reason(error)})", 0.0
        except httpx.TimeoutException:
            return "did not go on within the connect or read timeout", 0.0
        except httpx.HTTPError as error:
            return f"broke the connection ({_reason(error)})", 0.0
        except (httpx.InvalidURL, httpx.StreamError) as error:
            self._fail(f"cannot be asked ({_reason(error)})")
        self._door.answered = True
        if answer.status in AGAIN or answer.status >= 500:
            return f"answered with status {answer.status}{_words(answer)}", _retry_after(answer.headers)
        return answer, 0.0

    def _wait(self, turn: int, wait: float, fault: str | _Answer, last: bool) -> None:
        if last:
            tried = "" if self.retries == 0 else f", also after {self.retries} retries"
            self._fail(f"{fault}{tried}")
        backoff = min(LONGEST_WAIT, FIRST_WAIT * 2**turn) * self._door.jitter.uniform(0.5, 1.0)
        wait = max(wait, backoff)
        if self._door.clock.now() - self._began + wait >= self._allowed:
            self._fail(f"{fault}, and asks for {wait:.0f} s of patience; a question has {self._allowed:g} s")
        self._door.clock.sleep(wait)
        self.retries += 1

    def _refuse(self, answer: _Answer) -> NoReturn:
        what = {
            401: "does not accept the key; set SUMO_ADV_LLM_API_KEY",
            402: "wants to be paid first",
            403: "does not let this key use the model; set SUMO_ADV_LLM_API_KEY, or choose another model",
            404: f"does not know this model or address; check the name '{self._door.name}' and SUMO_ADV_LLM_BASE_URL",
        }.get(answer.status, "does not take the question")
        if 300 <= answer.status < 400:
            what = "sends us elsewhere; set SUMO_ADV_LLM_BASE_URL to the address it moved to"
        self._fail(f"{what} (status {answer.status}{_words(answer)})")

    def _late(self) -> NoReturn:
        if self._of_budget:
            raise BudgetError(
                f"The time that a run may spend on language models ended during a question to {self._door.host}.",
                retries=self.retries, seconds=self.seconds(),
            )  # fmt: skip
        self._fail(f"did not answer within {self._allowed:g} s, the limit for one question (llm_question_seconds)")

    def _fail(self, what: str) -> NoReturn:
        message = f"The server {self._door.host} of model {self._door.name} {what}"
        raise ModelError(message.rstrip(".") + ".", retries=self.retries, seconds=self.seconds())


def _reason(error: Exception) -> str:
    return wire.plain(str(error)) or type(error).__name__


def _words(answer: _Answer) -> str:
    """What the server says about its status, with a colon before."""
    try:
        said = wire.plain(wire.error_words(wire.read_json(answer.body)))
    except wire.WrongShape:
        said = wire.plain(answer.body[:1000].decode("utf-8", "replace"))
    return f": {said.rstrip('.')}" if said else ""


def _retry_after(headers: Mapping[str, str]) -> float:
    """Seconds of a Retry-After header, given as such or as a date; 0 without one."""
    given = headers.get("retry-after", "").strip()
    try:
        return max(0.0, float(given)) if given and given[0].isdigit() else max(0.0, _until(given))
    except (ValueError, TypeError, OverflowError):
        return 0.0


def _until(date: str) -> float:
    return parsedate_to_datetime(date).timestamp() - time.time() if date else 0.0
