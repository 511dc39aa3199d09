"""The chat completions protocol as plain data, without I/O.

The module makes bodies of requests and reads answers. It also lists the errors of servers by status and error code,
each with a sentence that says what to do.

Sources: the error pages of OpenAI, DeepSeek, Anthropic (529), OpenRouter (a 200 with an ``error`` object that holds the
status as its ``code``), vLLM and llama.cpp.
"""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sumo_adv.llm.chat import CUT_SHORT, ChatReply, ChatRequest, estimate_tokens, one_line

REASONING = ("reasoning_content", "reasoning")  # keys of a message that hold the model's thinking
LESS_THINKING: tuple[Mapping[str, Any], ...] = (
    {"reasoning_effort": "low"},
    {"chat_template_kwargs": {"enable_thinking": False, "thinking": False}},
    {"thinking": {"type": "disabled"}},
)
"""Fields that ask for less thinking: for OpenAI, Ollama and others; for vLLM, SGLang and llama.cpp; for DeepSeek and
Z.ai."""
TOKEN_LIMITS = ("max_tokens", "max_completion_tokens")  # OpenAI's newer models take the second
MAX_QUOTED_CHARACTERS = 200  # characters of a server's text that a message quotes
TRY_LATER = "try again later, or use another model"
_FORM = re.compile(r"response_?format|json_?schema|json_?object|guided_|grammar", re.IGNORECASE)
_LOADING_PATTERN = re.compile(r"\b(?:loading|starting)\b", re.IGNORECASE)
_CONTEXT_EXCEEDED_PATTERN = re.compile(r"maximum context length|context (?:length|size|window)", re.IGNORECASE)


class InvalidAnswer(Exception):
    """An answer that does not follow the protocol. The text says why."""


def chat_body(request: ChatRequest, model: str, mode: str, temperature: float | None) -> dict[str, Any]:
    """Make the body of POST chat/completions.

    The first message ends with the answer's schema in every mode, because some servers accept ``response_format`` and
    ignore it. The mode ``json_schema`` sends the schema as ``response_format`` as well.

    Args:
        request: The question.
        model: The name of the model on the server.
        mode: How the schema is sent: json_schema, json_object or text.
        temperature: The temperature; None means the server's own.
    """
    messages = [{"role": role, "content": content} for role, content in request.messages]
    body: dict[str, Any] = {"model": model, "messages": messages, "stream": False}
    if temperature is not None:
        body["temperature"] = temperature
    if request.schema is None:
        return body
    if mode == "json_schema":
        schema = {"name": request.schema_name or "answer", "strict": True, "schema": strict_schema(request.schema)}
        body["response_format"] = {"type": "json_schema", "json_schema": schema}
    elif mode == "json_object":
        body["response_format"] = {"type": "json_object"}
    text = json.dumps(request.schema, ensure_ascii=False)
    messages[0]["content"] += f"\n\nAnswer with one JSON object and nothing else. Its JSON schema:\n{text}"
    return body


def strict_schema(schema: Mapping[str, Any]) -> dict[str, Any]:
    """Adapt a JSON schema to the strict mode: close objects, require all properties, and remove defaults."""
    strict: dict[str, Any] = copy.deepcopy(dict(schema))
    stack: list[Any] = [strict]
    while stack:
        node = stack.pop()
        if isinstance(node, dict):
            if isinstance(node.get("properties"), dict):
                node["required"] = list(node["properties"])
                node["additionalProperties"] = False
                for each in node["properties"].values():
                    each.pop("default", None)
            stack.extend(node.values())
        elif isinstance(node, list):
            stack.extend(node)
    return strict


def read_body(raw: str) -> tuple[dict[str, Any] | None, str]:
    """Read the JSON object in a server's body.

    Returns:
        The object and an empty string, or None and why it cannot be read.
    """
    try:
        value = json.loads(raw)
    except (ValueError, RecursionError):
        return None, "its body is not JSON" if raw.strip() else "its body is empty"
    return (value, "") if isinstance(value, dict) else (None, "its body is not a JSON object")


def read_reply(value: Mapping[str, Any], request: ChatRequest, mode: str) -> ChatReply:
    """Read the reply in a completion, without duration and retries.

    Args:
        value: The JSON object of the server's answer.
        request: The question.
        mode: How the schema was sent.

    Raises:
        InvalidAnswer: The answer does not follow the protocol, the model refuses to answer, or the server withholds the
            answer.
    """
    try:
        choice = value["choices"][0]
        message, finish = choice["message"], choice.get("finish_reason")
        text, refusal = _content(message.get("content")), message.get("refusal")
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise InvalidAnswer(
            "its body has no choices[0].message; check that SUMO_ADV_LLM_BASE_URL is a server of chat completions"
        ) from error
    finish = finish if isinstance(finish, str) else ""
    if not text and isinstance(refusal, str) and refusal:
        raise InvalidAnswer(f"the model refuses: {quoted_reply(refusal)}")
    if finish == "content_filter":
        raise InvalidAnswer("its content filter withheld it; switch the filter off there, or choose another model")
    reasoning = next((v for k in REASONING if isinstance(v := message.get(k), str) and v), "")
    text = text or _arguments(message)
    if not text and finish in ("tool_calls", "function_call"):
        raise InvalidAnswer(
            "the model called a tool, and none was offered; switch tools off there, or use another model"
        )
    if not (text or reasoning or finish in ("", "stop", CUT_SHORT)):
        raise InvalidAnswer(
            f"it is empty and ended with '{quoted_reply(finish)}'; try again later, or use another model"
        )
    given = value.get("usage")
    usage: Mapping[str, Any] = given if isinstance(given, dict) else {}
    details = usage.get("prompt_tokens_details")
    cached = _count(details.get("cached_tokens")) if isinstance(details, dict) else None
    prompt, completion = _count(usage.get("prompt_tokens")), _count(usage.get("completion_tokens"))
    return ChatReply(
        text=text,
        reasoning=reasoning,
        prompt_tokens=estimate_tokens(request.messages) if prompt is None else prompt,
        completion_tokens=estimate_tokens([("", text), ("", reasoning)]) if completion is None else completion,
        cached_tokens=cached if cached is not None else _count(usage.get("prompt_cache_hit_tokens")) or 0,
        mode=mode if request.schema is not None else "text",
        finish=finish,
    )


def error_text(value: Any) -> str:
    """Return the text that a server gives in the body of an error."""
    error = value.get("error", value) if isinstance(value, dict) else value
    if isinstance(error, dict):
        error = error.get("message") or error.get("detail") or json.dumps(error)
    return str(error)


def quoted_reply(text: str) -> str:
    """Shorten a server's text for a message to one line of at most ``MAX_QUOTED_CHARACTERS`` characters."""
    line = one_line(text)
    return line if len(line) <= MAX_QUOTED_CHARACTERS else line[: MAX_QUOTED_CHARACTERS - 3] + "..."


def _content(given: Any) -> str:
    if given is None:
        return ""
    if isinstance(given, list):
        return "".join(str(part.get("text", "")) for part in given)
    if not isinstance(given, str):
        raise TypeError
    return given


def _arguments(message: Mapping[str, Any]) -> str:
    """Return the arguments of the message's first tool call. Some servers put an answer with a schema there."""
    calls = message.get("tool_calls")
    first = calls[0] if isinstance(calls, list) and calls and isinstance(calls[0], dict) else {}
    function = first.get("function") or message.get("function_call")
    given = function.get("arguments") if isinstance(function, dict) else None
    return given if isinstance(given, str) else json.dumps(given) if isinstance(given, dict) else ""


def _count(given: Any) -> int | None:
    return int(given) if isinstance(given, int | float) and not isinstance(given, bool) and 0 <= given < 1e12 else None


@dataclass(frozen=True, slots=True)
class ServerFault:
    """An error of a server.

    Attributes:
        says: What the server did, as words that follow its name.
        advice: What the user can do.
        retried: Whether the same question may be answered a little later.
        passes: Whether the error will pass, so that the question is repeated until the deadline.
        of_a_field: Whether the server may have refused one field of the question.
    """

    says: str
    advice: str
    retried: bool = False
    passes: bool = False
    of_a_field: bool = False


QUOTA_USED = ServerFault(
    "has no quota left for this key", "add credit to the account or raise its limit, or choose another model"
)
CONTEXT_EXCEEDED = ServerFault(
    "finds the question longer than the model's context",
    "start the server with a longer context (vLLM --max-model-len, llama.cpp -c, Ollama num_ctx), or choose a model "
    "with one",
)
UNKNOWN_MODEL = ServerFault("does not know this model", "check the name '{model}'")
KEY_REFUSED = ServerFault("does not accept the key", "set SUMO_ADV_LLM_API_KEY")
RATE_LIMITED = ServerFault(
    "limits how often it is asked", "lower llm_concurrency or raise llm_question_seconds, or try again later", True
)
OVERLOADED = ServerFault("is overloaded or still starting", TRY_LATER, True)
LOADING = ServerFault("is still loading its model", "raise llm_question_seconds to wait longer", True, passes=True)
FAILED_INSIDE = ServerFault("failed inside", f"look at its own log; {TRY_LATER}", True)
REJECTED = ServerFault(
    "rejected the question", "correct what it names, or choose another model or server", of_a_field=True
)

BY_STATUS = {
    400: REJECTED,
    401: KEY_REFUSED,
    402: ServerFault("demands a payment", "add credit to the account, or choose another model"),
    403: ServerFault("does not let this key use the model", "set SUMO_ADV_LLM_API_KEY, or choose another model"),
    404: ServerFault("does not know this model or address", "check the name '{model}' and SUMO_ADV_LLM_BASE_URL"),
    405: ServerFault("takes no questions at this address", "check SUMO_ADV_LLM_BASE_URL, which often ends in /v1"),
    408: ServerFault("gave up waiting for the question", TRY_LATER, True),
    409: ServerFault("has a conflict with another question", f"lower llm_concurrency; {TRY_LATER}", True),
    413: ServerFault("finds the question too large", "raise the server's limit, or choose another server"),
    422: REJECTED,
    429: RATE_LIMITED,
    500: FAILED_INSIDE,
    502: ServerFault("has a gateway that gets no answer from the model", TRY_LATER, True),
    503: OVERLOADED,
    504: ServerFault("has a gateway that waited too long for the model", f"use a faster model; {TRY_LATER}", True),
    529: OVERLOADED,
}
BY_CODE = {
    "insufficient_quota": QUOTA_USED,
    "billing_hard_limit_reached": QUOTA_USED,
    "billing_not_active": QUOTA_USED,
    "context_length_exceeded": CONTEXT_EXCEEDED,
    "exceed_context_size_error": CONTEXT_EXCEEDED,  # llama.cpp
    "model_not_found": UNKNOWN_MODEL,
    "invalid_api_key": KEY_REFUSED,
    "authentication_error": KEY_REFUSED,
    "permission_error": BY_STATUS[403],
    "not_found_error": BY_STATUS[404],
    "request_too_large": BY_STATUS[413],
    "rate_limit_exceeded": RATE_LIMITED,
    "rate_limit_error": RATE_LIMITED,
    "server_error": FAILED_INSIDE,
    "api_error": FAILED_INSIDE,
    "overloaded_error": OVERLOADED,
    "content_filter": ServerFault(
        "refused the question by its content filter", "switch the filter off there, or choose another model"
    ),
}
"""The errors by ``error.code`` or ``error.type``."""


def fault_of(status: int, body: Mapping[str, Any] | None) -> ServerFault | None:
    """Find the error that a server's answer reports.

    Args:
        status: The status of the answer.
        body: The JSON object of the answer, or None if it is not one.

    Returns:
        The error, or None.
    """
    error = body.get("error") if body is not None else None
    if status == 200 and not error:
        return None
    codes = [error.get("code"), error.get("type")] if isinstance(error, dict) else []
    for code in codes:
        if isinstance(code, str) and code in BY_CODE:
            return BY_CODE[code]
    if status in (200, 400) and isinstance(error, dict) and _CONTEXT_EXCEEDED_PATTERN.search(str(error.get("message"))):
        return CONTEXT_EXCEEDED
    if status == 503 and body is not None and _LOADING_PATTERN.search(error_text(body)):  # llama.cpp
        return LOADING
    if status == 200:  # the error's own code may be a status
        numbers = [int(str(code)) for code in codes if str(code).isdecimal() and len(str(code)) == 3]
        return _by_status(numbers[0]) if numbers else ServerFault("reports an error", TRY_LATER)
    return _by_status(status)


def refuses_the_form(text: str) -> bool:
    """Return whether the text of an error names the way in which the schema of the answer was sent.

    Servers give such errors any status: 400, 404 (no provider supports it), 422, 500 (llama-cpp-python), 501.
    """
    return _FORM.search(text) is not None


def _by_status(status: int) -> ServerFault:
    if status in BY_STATUS:
        return BY_STATUS[status]
    if 300 <= status < 400:
        return ServerFault("redirects to another address", "set SUMO_ADV_LLM_BASE_URL to that address")
    return FAILED_INSIDE if status >= 500 else REJECTED
