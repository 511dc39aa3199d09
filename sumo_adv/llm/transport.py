"""HTTP requests to one model server: deadline, retries, and the messages of failures.

One deadline applies to a question with all its retries. This module's own clock enforces it, so a server that hangs or
sends one byte at a time is cut off as well. Temporary errors (``wire.py``) are retried ``llm_retries`` times after a
random wait. The wait doubles with each retry and is never shorter than the server's ``Retry-After``. If a server drops
connections, has gone away after it was reached, or is loading its model, the question is repeated until the deadline.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import random
import re
import threading
import time
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass
from email.utils import parsedate_to_datetime
from typing import Any, NoReturn, TypeVar
from urllib.parse import urlsplit

import httpx
from pydantic import SecretStr

from sumo_adv import __version__
from sumo_adv.config import ModelSettings
from sumo_adv.errors import BudgetError, ModelError
from sumo_adv.llm import wire
from sumo_adv.llm.chat import run_in_thread
from sumo_adv.llm.wire import TRY_LATER, ServerFault, fault_of

KEY_BLANK = "***"
MAX_BACKSLASHES = 8  # before one character; JSON in JSON in JSON has 7

Blanker = Callable[[str], str]
MAX_ANSWER_BYTES = 2_000_000
FIRST_RETRY_WAIT_S = 0.5  # wait before the first retry
NO_ADDRESS = re.compile(r"(?i)(unexpected|unknown|invalid|no such) (endpoint|url|route|path)")
"""The text of an error with status 200 from a server that does not know the address (LM Studio)."""
MAX_RETRY_WAIT_S = 8.0  # longest wait, unless the server asks for more
MAX_WAIT_DOUBLINGS = 4  # from FIRST_RETRY_WAIT_S to MAX_RETRY_WAIT_S
_DROPPED = re.compile(r"disconnected|closed connection")  # httpx's text if a server ends a connection
LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")  # reached without a proxy
T = TypeVar("T")


def blanker(key: str | None) -> Blanker:
    """Return a function that replaces the key in a text with ``KEY_BLANK``.

    The function finds the key in plain form, and with any of its characters escaped as in JSON, Python, URLs or HTML.
    Apply it before a text is cut, and again to every text that is decoded from it.

    Args:
        key: The key; if there is none, the function returns texts unchanged.
    """
    if not key:
        return lambda text: text
    spelt = re.compile(r"\x00*".join(map(_spellings, key)))
    return lambda text: spelt.sub(KEY_BLANK, text)


def _spellings(character: str) -> str:
    code = ord(character)
    numbers = rf"u0*{code:x}|u\{{0*{code:x}\}}|U0*{code:x}|x0*{code:x}|0*{code:o}"
    slashes = rf"\\{{0,{MAX_BACKSLASHES}}}"
    return (
        rf"(?:{slashes}{re.escape(character)}|\\{slashes}(?i:{numbers})"
        rf"|%(?i:{code:02x})|&#0*{code};|&#(?i:x0*{code:x});)"
    )


def decoded(body: bytes) -> str:
    """Decode a body in UTF-8, UTF-16 or UTF-32, which are detected as in JSON. Invalid bytes are replaced."""
    return body.decode(json.detect_encoding(body), "replace")


class Clock:
    """The computer's clock, for waits and deadlines [s]."""

    def now(self) -> float:
        """Return the time of a monotonic clock [s]."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait for some seconds."""
        time.sleep(seconds)


@dataclass(frozen=True, slots=True)
class _Response:
    """A server's answer, with the key blanked out in its body."""

    status: int
    headers: Mapping[str, str]
    body: str


@dataclass(frozen=True, slots=True)
class _Failure:
    """A failed try that may be repeated.

    Attributes:
        reason: Why it failed.
        wait: The shortest wait before the next try [s].
        advice: What the user can do.
        until_deadline: Whether it is repeated until the deadline, regardless of the number of tries.
    """

    reason: str
    wait: float = 0.0
    advice: str = TRY_LATER
    until_deadline: bool = False


class _TooLarge(Exception):
    pass


class _Compressed(Exception):
    """The server compressed its answer, although the request forbids that."""


class ServerConnection:
    """One server: its address, its key, and the limit on questions that are open at the same time."""

    def __init__(self, model: str, base_url: str, key: SecretStr | None, settings: ModelSettings, clock: Clock) -> None:
        """Prepare the connection without sending anything.

        Args:
            model: The name of the model in messages.
            base_url: The server's address.
            key: The key, or None.
            settings: The settings.
            clock: The clock for waits and deadlines.
        """
        self.model = model
        self.settings = settings
        self.clock = clock
        self.host = urlsplit(base_url).netloc
        self.jitter = random.Random()
        self.slots = threading.BoundedSemaphore(settings.llm_concurrency)
        self.was_reached = False
        self._base_url = base_url
        versioned = re.search(r"/v\d", urlsplit(base_url).path) is not None
        longer = f"set SUMO_ADV_LLM_BASE_URL to {base_url}/v1, where most servers answer"
        self.address_advice = "" if versioned else longer
        """Advice for an address that answers no questions and has no version; empty if the address has one."""
        self._use_proxy = urlsplit(base_url).hostname not in LOCAL_HOSTS
        self._key = key.get_secret_value() if key is not None else None
        self.blank = blanker(self._key)  # apply it to every text of the server before it is cut, shown or kept

    def send(self, body: bytes, seconds: float) -> _Response:
        """POST a question and read the whole answer, with the key blanked out.

        Args:
            body: The body of the request.
            seconds: The time for the whole exchange [s].

        Raises:
            ModelError: A proxy or certificate of the environment cannot be used.
            TimeoutError: The exchange took longer.
            httpx.HTTPError: The exchange failed.
            _TooLarge: The answer is too large.
            _Compressed: The answer is compressed.
        """
        return self._within(seconds, self._exchange("POST", "chat/completions", body))

    def models(self, seconds: float) -> tuple[int, Mapping[str, Any] | None]:
        """GET the list of models.

        Args:
            seconds: The time for the whole exchange [s].

        Returns:
            The status, and the JSON object of the answer or None if it is not one.

        Raises:
            ModelError: The server gives no usable answer in time.
        """
        try:
            answer = self._within(seconds, self._exchange("GET", "models", None))
        except (TimeoutError, httpx.TimeoutException) as error:
            raise ModelError(f"{self.host} did not answer GET models within {seconds:g} s.") from error
        except (httpx.HTTPError, httpx.InvalidURL, httpx.StreamError, _TooLarge, _Compressed) as error:
            why = self.quoted(str(error)) or type(error).__name__
            raise ModelError(f"{self.host} gave no usable answer to GET models ({why}).") from error
        return answer.status, wire.read_body(answer.body)[0]

    def _within(self, seconds: float, exchange: Coroutine[Any, Any, _Response]) -> _Response:
        return run_in_thread(lambda: asyncio.run(asyncio.wait_for(exchange, seconds))).result()

    async def _exchange(self, method: str, path: str, body: bytes | None) -> _Response:
        headers = {
            "Content-Type": "application/json", "User-Agent": f"sumo-adv/{__version__}", "Accept-Encoding": "identity",
        }  # fmt: skip
        if self._key is not None:
            headers["Authorization"] = f"Bearer {self._key}"
        timeout = httpx.Timeout(self.settings.llm_read_timeout, connect=self.settings.llm_connect_timeout)
        async with (
            self._client(timeout) as client,
            client.stream(method, f"{self._base_url}/{path}", content=body, headers=headers) as response,
        ):
            encoding = response.headers.get("content-encoding", "identity").strip().lower()
            if encoding not in ("", "identity"):  # 2 kB may unpack to 3 GB
                raise _Compressed(encoding)
            parts, size = [], 0
            async for part in response.aiter_raw(65536):
                parts.append(part)
                size += len(part)
                if size > MAX_ANSWER_BYTES:
                    raise _TooLarge
            return _Response(response.status_code, dict(response.headers), self.blank(decoded(b"".join(parts))))

    def _client(self, timeout: httpx.Timeout) -> httpx.AsyncClient:
        """Open a client. Raise ModelError if a proxy or certificate of the environment cannot be used."""
        try:
            return httpx.AsyncClient(timeout=timeout, trust_env=self._use_proxy)
        except (ImportError, ValueError, OSError, httpx.InvalidURL) as error:  # no socksio, no such scheme or file
            why = self.quoted(str(error)).rstrip(".") or type(error).__name__
            raise ModelError(
                f"The proxy or certificate setting of this machine cannot be used ({why}); correct or unset ALL_PROXY, "
                "HTTPS_PROXY, HTTP_PROXY or SSL_CERT_FILE."
            ) from error

    def quoted(self, text: str) -> str:
        """Shorten a text of the server for a message, and blank out the key."""
        return wire.quoted_reply(self.blank(text))


class Question:
    """One question to a server with all its retries. It is a context manager that holds one of the server's slots.

    Attributes:
        retries: The number of retries so far.
    """

    def __init__(self, server: ServerConnection, seconds_left: float | None) -> None:
        """Set the time of the question.

        Args:
            server: The server.
            seconds_left: The run's remaining time for models [s], or None if there is no limit.
        """
        self._server = server
        allowed = server.settings.llm_question_seconds
        self._limited_by_budget = seconds_left is not None and seconds_left < allowed
        self._allowed = allowed if seconds_left is None else min(allowed, seconds_left)
        self.retries = 0

    def __enter__(self) -> Question:
        self._server.slots.acquire()
        self._began = self._server.clock.now()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.slots.release()

    def seconds(self) -> float:
        """Return the time since the question began [s], rounded to ms."""
        return round(self._server.clock.now() - self._began, 3)

    def post(
        self, body: Mapping[str, Any], read: Callable[[Mapping[str, Any]], T], *, none_if_rejected: bool = False
    ) -> T | None:
        """Send a question until it is answered.

        Args:
            body: The body of the request.
            read: Reads the answer. It raises InvalidAnswer if the answer is unusable.
            none_if_rejected: Whether to return None if the server may have refused a field of the body.

        Returns:
            The result of ``read``, or None.

        Raises:
            ModelError: The server gives no usable answer.
            BudgetError: The run's time for models has ended.
        """
        raw, counted = json.dumps(body).encode(), 0
        for number in itertools.count():
            result = self._try(raw)
            if isinstance(result, _Response):
                value, unreadable = wire.read_body(result.body)
                fault = fault_of(result.status, value)
                if fault is not None:
                    if none_if_rejected and (fault.of_a_field or wire.refuses_the_form(result.body)):
                        self.retries += 1
                        return None
                    result = self._failure(fault, result)
                elif value is None:
                    advice = self._server.address_advice or TRY_LATER
                    result = _Failure(f"sent an answer that cannot be read ({unreadable})", advice=advice)
                else:
                    try:
                        return read(value)
                    except wire.InvalidAnswer as error:
                        self._fail(f"gave no usable answer: {error}")
            self._wait(number, counted, result)
            counted += not result.until_deadline
        raise AssertionError("the last try answers or raises")

    def _try(self, raw: bytes) -> _Response | _Failure:
        """Send the question once. Raise ModelError for a failure that a retry cannot change."""
        left = self._allowed - (self._server.clock.now() - self._began)
        if left <= 0:
            self._fail_for_time()
        try:
            answer = self._server.send(raw, left)
        except TimeoutError:
            self._fail_for_time()
        except _TooLarge:
            self._fail(
                f"sent an answer of more than {MAX_ANSWER_BYTES // 1_000_000} MB, which is refused; "
                "check SUMO_ADV_LLM_BASE_URL"
            )
        except _Compressed as error:
            self._fail(
                f"sent an answer with Content-Encoding {self._server.quoted(str(error))}, which is refused; "
                "turn compression off there"
            )
        except httpx.ConnectError as error:
            if not self._server.was_reached:
                self._fail(f"cannot be reached ({self._reason(error)}); start it, or correct SUMO_ADV_LLM_BASE_URL")
            return _Failure(f"cannot be reached any more ({self._reason(error)})", until_deadline=True)
        except httpx.TimeoutException:
            return _Failure("sent nothing within the connect or read timeout")
        except httpx.HTTPError as error:
            dropped = isinstance(error, httpx.NetworkError) or _DROPPED.search(str(error)) is not None
            self._server.was_reached |= dropped
            return _Failure(f"broke the connection ({self._reason(error)})", until_deadline=dropped)
        except (httpx.InvalidURL, httpx.StreamError) as error:
            self._fail(f"cannot be asked ({self._reason(error)}); correct SUMO_ADV_LLM_BASE_URL")
        self._server.was_reached = True
        return answer

    def _wait(self, number: int, counted: int, failure: _Failure) -> None:
        """Wait before the next try. Raise ModelError after the last try, or if the deadline would pass.

        Args:
            number: The number of tries before this one.
            counted: How many of them count against the maximum.
            failure: The failure of this try.
        """
        if counted == self._server.settings.llm_retries and not failure.until_deadline:
            retried = "" if self.retries == 0 else f", also after {self.retries} retries"
            self._fail(f"{failure.reason}{retried}; {failure.advice}")
        doubled = FIRST_RETRY_WAIT_S * 2 ** min(number, MAX_WAIT_DOUBLINGS)
        backoff = min(MAX_RETRY_WAIT_S, doubled) * self._server.jitter.uniform(0.5, 1.0)
        wait = max(failure.wait, backoff)
        if self._server.clock.now() - self._began + wait >= self._allowed:
            self._fail(
                f"{failure.reason}, and the next try would be {wait:.0f} s later, but a question may take only "
                f"{self._allowed:g} s; raise llm_question_seconds"
            )
        self._server.clock.sleep(wait)
        self.retries += 1

    def _failure(self, fault: ServerFault, answer: _Response) -> _Failure:
        """Make the failure after which to retry. Raise ModelError for a fault that a retry cannot change."""
        said = self._server_text(answer)
        no_address = (answer.status in (404, 405) and "model" not in said.lower()) or NO_ADDRESS.search(said)
        if no_address and (advice := self._server.address_advice):
            self._fail(f"answers no questions at this address (status {answer.status}{said}); {advice}")
        reason = f"{fault.says} (status {answer.status}{said})"
        advice = fault.advice.format(model=self._server.model)
        if not fault.retried:
            self._fail(f"{reason}; {advice}")
        return _Failure(reason, _retry_after(answer.headers), advice, fault.passes)

    def _fail_for_time(self) -> NoReturn:
        if self._limited_by_budget:
            raise BudgetError(
                f"The run's time for language models ended during a question to {self._server.host}; "
                "raise llm_max_seconds for more.",
                retries=self.retries, seconds=self.seconds(),
            )  # fmt: skip
        self._fail(f"did not answer within {self._allowed:g} s; raise llm_question_seconds for a slow model")

    def _reason(self, error: Exception) -> str:
        return self._server.quoted(str(error)) or type(error).__name__

    def _server_text(self, answer: _Response) -> str:
        """Return the text that a server gives with its status, after a colon."""
        value, _ = wire.read_body(answer.body)
        text = self._server.quoted(answer.body[:1000] if value is None else wire.error_text(value))
        return f": {text.rstrip('.')}" if text else ""

    def _fail(self, reason: str) -> NoReturn:
        message = f"The server {self._server.host} of model {self._server.model} {reason}"
        raise ModelError(message.rstrip(".") + ".", retries=self.retries, seconds=self.seconds())


def _retry_after(headers: Mapping[str, str]) -> float:
    """Read the wait [s] of the Retry-After header, which holds seconds or a date; 0 if it is absent or unreadable."""
    given = headers.get("retry-after", "").strip()
    if not given:
        return 0.0
    try:
        seconds = float(given) if given[0].isdigit() else parsedate_to_datetime(given).timestamp() - time.time()
    except (ValueError, TypeError, OverflowError):
        return 0.0
    return max(0.0, seconds)
