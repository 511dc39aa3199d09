"""Chat models of any OpenAI-compatible server, and the server that belongs to a model's name."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, get_args

from pydantic import SecretStr

from sumo_adv.config import ModelSettings, ResponseFormat, one_word
from sumo_adv.errors import UsageError
from sumo_adv.llm import wire
from sumo_adv.llm.chat import CUT_SHORT, BudgetedModel, ChatModel, ChatReply, ChatRequest, Ledger, without_thought
from sumo_adv.llm.recording import Replay
from sumo_adv.llm.transport import Clock, Question, ServerConnection

REPLAY = "replay:"
MODES: tuple[str, ...] = get_args(ResponseFormat)
"""Ways to send the schema of an answer, best first."""


@dataclass(frozen=True, slots=True)
class Server:
    """The server of a model.

    Attributes:
        model: The name of the model on the server.
        base_url: The server's address.
        key: The key; None if the server needs none.
        mode: The first of ``MODES`` to try.
    """

    model: str
    base_url: str
    key: SecretStr | None = None
    mode: str = MODES[0]


@dataclass(frozen=True, slots=True)
class _Provider:
    prefixes: tuple[str, ...]
    base_url: str
    key_variable: str
    mode: str = MODES[0]


PROVIDERS = (
    _Provider(("deepseek-",), "https://api.deepseek.com/v1", "DEEPSEEK_API_KEY", "json_object"),
    _Provider(("gpt-", "chatgpt-", "o1", "o3", "o4"), "https://api.openai.com/v1", "OPENAI_API_KEY"),
)
LOCAL_SERVERS = {
    "ollama:": "http://localhost:11434/v1",
    "vllm:": "http://localhost:8000/v1",
    "llamacpp:": "http://localhost:8080/v1",
}


def find_server(name: str, settings: ModelSettings, environment: Mapping[str, str]) -> Server:
    """Find the server of a model.

    The base URL of the settings has precedence over the built-in ones. A provider's own key variable is read only for
    the provider's own address.

    Args:
        name: The name of the model, with the prefix of a local server if there is one.
        settings: The settings.
        environment: The environment variables.

    Raises:
        UsageError: A setting is missing; the message names it.
    """
    for prefix, base_url in LOCAL_SERVERS.items():
        if name.startswith(prefix):
            model = name.removeprefix(prefix)
            if not model:
                raise UsageError(f"The model '{name}' needs a name behind the colon, such as {name}llama3.")
            return Server(model, settings.llm_base_url or base_url, settings.llm_api_key)
    provider = next((each for each in PROVIDERS if name.startswith(each.prefixes)), None)
    if settings.llm_base_url is not None:
        return Server(name, settings.llm_base_url, settings.llm_api_key, provider.mode if provider else MODES[0])
    if provider is None:
        raise UsageError(
            f"The model '{name}' has no known server; set SUMO_ADV_LLM_BASE_URL, or use deepseek-chat, "
            "deepseek-reasoner, gpt-.., ollama:NAME, vllm:NAME, llamacpp:NAME or replay:FILE."
        )
    try:
        key = settings.llm_api_key or one_word(environment.get(provider.key_variable, ""))
    except ValueError as error:
        raise UsageError(f"{provider.key_variable} cannot be used: {error}.") from error
    if key is None:
        raise UsageError(f"The model '{name}' needs a key; set SUMO_ADV_LLM_API_KEY or {provider.key_variable}.")
    return Server(name, provider.base_url, key, provider.mode)


def open_model(
    name: str,
    settings: ModelSettings,
    ledger: Ledger,
    *,
    clock: Clock | None = None,
    environment: Mapping[str, str] = os.environ,
) -> ChatModel:
    """Open a model or, for ``replay:FILE``, a recording. This sends nothing yet.

    Args:
        name: The name of the model.
        settings: The settings.
        ledger: Counts the model's questions and limits them.
        clock: The clock for waits and deadlines.
        environment: The environment variables.

    Raises:
        UsageError: A setting is missing, or the recording cannot be used.
    """
    if name.startswith(REPLAY):
        return BudgetedModel(Replay.open(name.removeprefix(REPLAY)), ledger)
    server = find_server(name, settings, environment)
    return BudgetedModel(HttpModel(name, server, settings, ledger, clock or Clock()), ledger)


class HttpModel:
    """A chat model behind HTTP.

    It remembers what the server supports of ``MODES`` (from the mode of the settings on) and of ``wire.TOKEN_LIMITS``.
    If the model thinks too long, it also remembers what helps of ``wire.LESS_THINKING``.
    """

    def __init__(self, name: str, server: Server, settings: ModelSettings, ledger: Ledger, clock: Clock) -> None:
        """Prepare the connection without sending anything.

        Args:
            name: The name of the model in messages and files.
            server: The server.
            settings: The settings.
            ledger: The run's ledger, which limits the time of a question.
            clock: The clock for waits and deadlines.
        """
        self.name = name
        self._model = server.model
        self._temperature = settings.llm_temperature
        self._answer_tokens = settings.llm_answer_tokens
        self._ledger = ledger
        self._modes = MODES[MODES.index(settings.llm_response_format or server.mode) :]
        self._limits: tuple[str, ...] = wire.TOKEN_LIMITS
        self._less_thinking: Mapping[str, Any] = {}
        self._ways = wire.LESS_THINKING  # ways that are not tried yet
        self._connection = ServerConnection(name, server.base_url, server.key, settings, clock)

    def complete(self, request: ChatRequest) -> ChatReply:
        """Answer a question.

        If the server rejects the schema, it is sent again in the next of ``MODES``. If the model only thinks and gives
        no answer, the question is repeated with a request for less thinking. The ways of ``wire.LESS_THINKING`` are
        tried in order, once in a run, and the first that helps is kept. The tokens of all tries are summed.

        Raises:
            ModelError: The server or the model failed.
            BudgetError: The run's time ended during the question.
        """
        with Question(self._connection, self._ledger.seconds_left()) as question:
            reply = self._in_a_mode(question, request, self._less_thinking)
            assert reply is not None
            ways, self._ways = (self._ways, ()) if only_thought(reply) else ((), self._ways)
            for fields in ways:
                less = self._in_a_mode(question, request, fields, or_none=True)
                if less is None:
                    continue
                question.retries += 1
                reply = replace(
                    less,
                    prompt_tokens=reply.prompt_tokens + less.prompt_tokens,
                    completion_tokens=reply.completion_tokens + less.completion_tokens,
                    cached_tokens=reply.cached_tokens + less.cached_tokens,
                )
                if not only_thought(less):
                    self._less_thinking = fields
                    break
            blank = self._connection.blank
            return replace(
                reply, text=blank(reply.text), reasoning=blank(reply.reasoning), seconds=question.seconds(),
                retries=question.retries,
            )  # fmt: skip

    def _in_a_mode(
        self, question: Question, request: ChatRequest, fields: Mapping[str, Any], *, or_none: bool = False
    ) -> ChatReply | None:
        """Send the question in the first mode, and with the first name of the token limit, that the server accepts.

        Args:
            question: The open question.
            request: The request.
            fields: Additional fields of the body.
            or_none: If true, try only the first mode and name, which have worked before, and return None if the server
                refuses ``fields``. If false, a refusal raises ModelError.
        """
        modes = self._modes if request.schema is not None else MODES[-1:]
        limits: Sequence[str | None] = (None,) if self._answer_tokens is None else self._limits
        tries = [(mode, limit) for mode in modes for limit in limits][: 1 if or_none else None]
        for mode, limit in tries:
            body = {**wire.chat_body(request, self._model, mode, self._temperature), **fields}
            if limit is not None:
                body[limit] = self._answer_tokens
            read = partial(wire.read_reply, request=request, mode=mode)
            last = (mode, limit) == tries[-1] and not or_none
            reply = question.post(body, read, none_if_rejected=not last)
            if reply is not None:
                if request.schema is not None:
                    self._modes = MODES[MODES.index(mode) :]
                if limit is not None:
                    self._limits = wire.TOKEN_LIMITS[wire.TOKEN_LIMITS.index(limit) :]
                return reply
        return None


def only_thought(reply: ChatReply) -> bool:
    """Return whether the model thought and gave no answer.

    This is so if the text holds no answer, and the thinking was cut off or contains no JSON object.
    """
    thought = reply.reasoning or reply.text
    return not without_thought(reply.text) and bool(thought) and (reply.finish == CUT_SHORT or "{" not in thought)
