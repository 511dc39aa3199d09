"""Check whether the server of a model can be used.

The check asks for the list of models, and then one question that is as long as a run's longest ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sumo_adv.config import ModelSettings
from sumo_adv.errors import ModelError
from sumo_adv.llm.chat import ChatRequest, Ledger
from sumo_adv.llm.client import HttpModel, Server
from sumo_adv.llm.transport import Clock, ServerConnection
from sumo_adv.llm.wire import quoted_reply

PROBE_QUESTION_TOKENS = 8_000  # the longest question of the shipped recordings has 7,600
MIN_CONTEXT_TOKENS = 11_000  # for the longest question, and the longest answer of 3,000 tokens
PROBE_ANSWER_TOKENS = 2
LIST_TIMEOUT_S = 10.0
ONE_TOKEN_WORD = "road "  # one token of most models
CONTEXT_KEYS = ("max_model_len", "context_length", "loaded_context_length", "context_window", "n_ctx")
"""Keys with which servers report a model's context: vLLM and SGLang, OpenRouter, LM Studio, Groq, llama.cpp."""
KEY_REFUSED_STATUSES = (401, 403)  # statuses for a wrong key
CUT_QUESTION_TOKENS = (1_000, 6_000)  # counts of a server that cut the question; smaller ones count something else


@dataclass(frozen=True, slots=True)
class ServerCheck:
    """The result of a server's check.

    Attributes:
        listed: The names of its models; empty if it gives no list.
        context: Its context for the model [tokens]; None if it does not report one.
        mode: How it accepted the schema: json_schema, json_object or text.
    """

    listed: tuple[str, ...]
    context: int | None
    mode: str


def check_server(name: str, server: Server, settings: ModelSettings, schema: Mapping[str, Any]) -> ServerCheck:
    """Ask a server for its models, and then one question with an answer of at most ``PROBE_ANSWER_TOKENS``.

    The question is short if the server reports a context that is long enough.

    Args:
        name: The name of the model in messages.
        server: The server.
        settings: The settings.
        schema: The JSON schema of the answer.

    Raises:
        ModelError: The server cannot be used. The message names the fault: the key, the context, the model, or the
            server.
    """
    status, listing = ServerConnection(name, server.base_url, server.key, settings, Clock()).models(LIST_TIMEOUT_S)
    if status in KEY_REFUSED_STATUSES:
        raise ModelError(
            f"The server of model {name} does not accept the key for its list of models (status {status}); set "
            "SUMO_ADV_LLM_API_KEY."
        )
    entries = _entries(listing) if status == 200 else []
    listed = tuple(quoted_reply(str(entry["id"])) for entry in entries)
    context = _context(entries, server.model)
    if context is not None and context < MIN_CONTEXT_TOKENS:
        raise ModelError(_too_short(name, f"has a context of {context:,} tokens"))
    words = 1 if context is not None else PROBE_QUESTION_TOKENS
    asked = ChatRequest(
        "doctor", (("system", "Answer with one JSON object."), ("user", ONE_TOKEN_WORD * words)), schema, "Analysis"
    )  # fmt: skip
    limited = settings.model_copy(update={"llm_answer_tokens": PROBE_ANSWER_TOKENS})
    reply = HttpModel(name, server, limited, Ledger(), Clock()).complete(asked)
    if context is None and CUT_QUESTION_TOKENS[0] <= reply.prompt_tokens <= CUT_QUESTION_TOKENS[1]:
        raise ModelError(_too_short(name, f"cut a question of {words:,} tokens to {reply.prompt_tokens:,}"))
    return ServerCheck(listed, context, reply.mode)


def _too_short(name: str, what: str) -> str:
    return (
        f"The server of model {name} {what}, and a question takes up to {MIN_CONTEXT_TOKENS:,} with its answer; start "
        "it with a longer context (vLLM --max-model-len, llama.cpp -c, Ollama num_ctx)."
    )


def _entries(listing: Mapping[str, Any] | None) -> list[Mapping[str, Any]]:
    data = listing.get("data") if listing is not None else None
    return [e for e in data if isinstance(e, dict) and "id" in e] if isinstance(data, list) else []


def _context(entries: list[Mapping[str, Any]], model: str) -> int | None:
    """Read the context from the model's entry. A single entry counts as the model's, whatever its name."""
    of_model = [e for e in entries if e["id"] == model] or (entries if len(entries) == 1 else [])
    for entry in of_model:
        meta = entry.get("meta")
        said = {**(meta if isinstance(meta, dict) else {}), **entry}
        for key in CONTEXT_KEYS:
            if isinstance(said.get(key), int) and said[key] > 0:
                return int(said[key])
    return None
