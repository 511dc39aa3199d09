"""What servers of chat completions report as errors: by status and error code, one sentence that says what to do.

Sources: the error pages of OpenAI, DeepSeek, Anthropic (529), OpenRouter (a 200 with an ``error`` object that holds the
status as its ``code``), vLLM and llama.cpp.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

LATER = "try again later, or use another model"


@dataclass(frozen=True, slots=True)
class ServerFault:
    """An error of a server.

    says: what the server did, after its name. advice: what the user can do. retried: whether the same question may be
    answered a little later. of_a_field: whether the server may have refused one field of the question.
    """

    says: str
    advice: str
    retried: bool = False
    of_a_field: bool = False


QUOTA = ServerFault(
    "has no quota left for this key",
    "add credit to the account or raise its limit, or choose another model",
)
CONTEXT = ServerFault(
    "finds the question longer than the model's context",
    "start the server with a longer context (vLLM --max-model-len, llama.cpp -c, Ollama num_ctx), or choose a model "
    "with one",
)
MODEL = ServerFault("does not know this model", "check the name '{model}'")
KEY = ServerFault("does not accept the key", "set SUMO_ADV_LLM_API_KEY")
RATE = ServerFault(
    "limits how often it is asked", "lower llm_concurrency or raise llm_question_seconds, or try again later", True
)
OVERLOADED = ServerFault("is overloaded or still starting", LATER, True)
FAILED = ServerFault("failed inside", f"look at its own log; {LATER}", True)
REJECTED = ServerFault(
    "rejected the question", "correct what it names, or choose another model or server", of_a_field=True
)

BY_STATUS = {
    400: REJECTED,
    401: KEY,
    402: ServerFault("demands a payment", "add credit to the account, or choose another model"),
    403: ServerFault("does not let this key use the model", "set SUMO_ADV_LLM_API_KEY, or choose another model"),
    404: ServerFault("does not know this model or address", "check the name '{model}' and SUMO_ADV_LLM_BASE_URL"),
    405: ServerFault("takes no questions at this address", "check SUMO_ADV_LLM_BASE_URL, which often ends in /v1"),
    408: ServerFault("gave up waiting for the question", LATER, True),
    409: ServerFault("has a conflict with another question", f"lower llm_concurrency; {LATER}", True),
    413: ServerFault("finds the question too large", "raise the server's limit, or choose another server"),
    422: REJECTED,
    429: RATE,
    500: FAILED,
    502: ServerFault("has a gateway that gets no answer from the model", LATER, True),
    503: OVERLOADED,
    504: ServerFault("has a gateway that waited too long for the model", f"use a faster model; {LATER}", True),
    529: OVERLOADED,
}
BY_CODE = {
    "insufficient_quota": QUOTA,
    "billing_hard_limit_reached": QUOTA,
    "billing_not_active": QUOTA,
    "context_length_exceeded": CONTEXT,
    "exceed_context_size_error": CONTEXT,  # llama.cpp
    "model_not_found": MODEL,
    "invalid_api_key": KEY,
    "authentication_error": KEY,
    "permission_error": BY_STATUS[403],
    "not_found_error": BY_STATUS[404],
    "request_too_large": BY_STATUS[413],
    "rate_limit_exceeded": RATE,
    "rate_limit_error": RATE,
    "server_error": FAILED,
    "api_error": FAILED,
    "overloaded_error": OVERLOADED,
    "content_filter": ServerFault(
        "refused the question by its content filter", "switch the filter off there, or choose another model"
    ),
}
"""By ``error.code`` or ``error.type``."""
_LONG = re.compile(r"maximum context length|context (?:length|size|window)", re.IGNORECASE)


def fault_of(status: int, body: Mapping[str, Any] | None) -> ServerFault | None:
    """The error in an answer, None if it reports none. ``body``: the JSON object, None if it is no JSON object."""
    error = body.get("error") if body is not None else None
    if status == 200 and not error:
        return None
    codes = [error.get("code"), error.get("type")] if isinstance(error, dict) else []
    for code in codes:
        if isinstance(code, str) and code in BY_CODE:
            return BY_CODE[code]
    if status in (200, 400) and isinstance(error, dict) and _LONG.search(str(error.get("message"))):
        return CONTEXT
    if status == 200:  # the error's own code may be a status
        numbers = [int(str(code)) for code in codes if str(code).isdecimal() and len(str(code)) == 3]
        return _by_status(numbers[0]) if numbers else ServerFault("reports an error", LATER)
    return _by_status(status)


def _by_status(status: int) -> ServerFault:
    if status in BY_STATUS:
        return BY_STATUS[status]
    if 300 <= status < 400:
        return ServerFault("redirects to another address", "set SUMO_ADV_LLM_BASE_URL to that address")
    return FAILED if status >= 500 else REJECTED
