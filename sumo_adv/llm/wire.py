"""The chat completions protocol as plain data: bodies of requests, and what answers hold. No I/O."""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping, Sequence
from typing import Any

from sumo_adv.llm.chat import CUT, ChatReply, ChatRequest, estimate_tokens, one_line

REASONING = ("reasoning_content", "reasoning")  # keys of a message that hold the model's thinking
LESS_THINKING: tuple[Mapping[str, Any], ...] = (
    {"reasoning_effort": "low"},
    {"chat_template_kwargs": {"enable_thinking": False, "thinking": False}},
    {"thinking": {"type": "disabled"}},
)
"""Fields that ask for less thinking: of OpenAI, Ollama and others; of vLLM, SGLang and llama.cpp; of DeepSeek, Z.ai."""
TOKEN_LIMITS = (
    "max_tokens",
    "max_completion_tokens",
)  # fields that limit an answer; OpenAI's newer models take the second
MAX_QUOTED = 200  # characters of a server's text that a message quotes


class InvalidAnswer(Exception):
    """An answer that does not follow the protocol; the text says why."""


def chat_body(request: ChatRequest, model: str, mode: str, temperature: float | None) -> dict[str, Any]:
    """The body of POST chat/completions.

    By ``mode`` the answer's schema is sent as ``response_format`` (json_schema) or in the first message (others).
    """
    messages = [{"role": role, "content": content} for role, content in request.messages]
    body: dict[str, Any] = {"model": model, "messages": messages, "stream": False}
    temperature = request.temperature if request.temperature is not None else temperature
    if temperature is not None:
        body["temperature"] = temperature
    if request.schema is None:
        return body
    if mode == "json_schema":
        schema = {"name": request.schema_name or "answer", "strict": True, "schema": strict_schema(request.schema)}
        body["response_format"] = {"type": "json_schema", "json_schema": schema}
        return body
    if mode == "json_object":
        body["response_format"] = {"type": "json_object"}
    text = json.dumps(request.schema, ensure_ascii=False)
    messages[0]["content"] += f"\n\nAnswer with one JSON object and nothing else. Its JSON schema:\n{text}"
    return body


def strict_schema(schema: Mapping[str, Any]) -> dict[str, Any]:
    """A JSON schema for the strict mode: objects are closed, all properties are required, and defaults are absent."""
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


def read_json(raw: str) -> dict[str, Any]:
    """The object in a server's body. Raises InvalidAnswer."""
    try:
        value = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise InvalidAnswer("its body is no JSON" if raw.strip() else "its body is empty") from error
    if not isinstance(value, dict):
        raise InvalidAnswer("its body is no JSON object")
    return value


def read_reply(value: Mapping[str, Any], request: ChatRequest, mode: str) -> ChatReply:
    """The reply in a completion, without duration and retries.

    Raises InvalidAnswer, also if the model refuses to answer or the server withholds the answer.
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
        raise InvalidAnswer(f"the model refuses: {quoted(refusal)}")
    if finish == "content_filter":
        raise InvalidAnswer("its content filter withheld it; switch the filter off there, or choose another model")
    reasoning = next((v for k in REASONING if isinstance(v := message.get(k), str) and v), "")
    text = text or _arguments(message)
    if not text and finish in ("tool_calls", "function_call"):
        raise InvalidAnswer(
            "the model called a tool, and none was offered; switch tools off there, or use another model"
        )
    if not (text or reasoning or finish in ("", "stop", CUT)):
        raise InvalidAnswer(f"it is empty and ended with '{quoted(finish)}'; try again later, or use another model")
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


def read_vectors(value: Mapping[str, Any], count: int) -> list[list[float]]:
    """The ``count`` vectors of an embeddings answer, in the order of the texts. Raises InvalidAnswer."""
    try:
        data: Sequence[Mapping[str, Any]] = value["data"]
        by_index = {int(each.get("index", place)): each["embedding"] for place, each in enumerate(data)}
        vectors = [[float(x) for x in by_index[i]] for i in range(count)]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InvalidAnswer(f"its body has no data with {count} embeddings") from error
    if not vectors or len({len(v) for v in vectors}) != 1 or not vectors[0]:
        raise InvalidAnswer("its embeddings are not of one length")
    return vectors


def error_text(value: Any) -> str:
    """The text that a server gives in the body of an error."""
    error = value.get("error", value) if isinstance(value, dict) else value
    if isinstance(error, dict):
        error = error.get("message") or error.get("detail") or json.dumps(error)
    return str(error)


def quoted(text: str) -> str:
    """A server's text for a message: one line of at most ``MAX_QUOTED`` characters."""
    line = one_line(text)
    return line if len(line) <= MAX_QUOTED else line[: MAX_QUOTED - 3] + "..."


def _content(given: Any) -> str:
    if given is None:
        return ""
    if isinstance(given, list):
        return "".join(str(part.get("text", "")) for part in given)
    if not isinstance(given, str):
        raise TypeError
    return given


def _arguments(message: Mapping[str, Any]) -> str:
    """The arguments of the first tool that the message calls: where some servers put an answer of a given schema."""
    calls = message.get("tool_calls")
    first = calls[0] if isinstance(calls, list) and calls and isinstance(calls[0], dict) else {}
    function = first.get("function") or message.get("function_call")
    given = function.get("arguments") if isinstance(function, dict) else None
    return given if isinstance(given, str) else json.dumps(given) if isinstance(given, dict) else ""


def _count(given: Any) -> int | None:
    return int(given) if isinstance(given, int | float) and not isinstance(given, bool) and 0 <= given < 1e12 else None
