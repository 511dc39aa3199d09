"""The protocol of chat completions as plain data: what is sent, and what comes back. No I/O."""

from __future__ import annotations

import copy
import json
from collections.abc import Mapping, Sequence
from typing import Any

from sumo_adv.llm.chat import ChatReply, ChatRequest, estimate_tokens

SAID = 200  # characters of a server's own words in a message


class WrongShape(Exception):
    """What came is no answer of the protocol; the text says why."""


def chat_body(request: ChatRequest, model: str, mode: str, temperature: float | None) -> dict[str, Any]:
    """The body of POST chat/completions. The shape goes with ``response_format``, or else into the first message."""
    messages = [{"role": role, "content": content} for role, content in request.messages]
    body: dict[str, Any] = {"model": model, "messages": messages, "stream": False}
    heat = request.temperature if request.temperature is not None else temperature
    if heat is not None:
        body["temperature"] = heat
    if request.shape is None:
        return body
    if mode == "json_schema":
        schema = {"name": request.shape_name or "answer", "strict": True, "schema": strict_schema(request.shape)}
        body["response_format"] = {"type": "json_schema", "json_schema": schema}
        return body
    if mode == "json_object":
        body["response_format"] = {"type": "json_object"}
    shape = json.dumps(request.shape, ensure_ascii=False)
    messages[0]["content"] += f"\n\nAnswer with one JSON object and nothing else. Its JSON schema:\n{shape}"
    return body


def strict_schema(schema: Mapping[str, Any]) -> dict[str, Any]:
    """A JSON schema as the strict mode wants it: objects closed, all their properties required, no defaults."""
    closed: dict[str, Any] = copy.deepcopy(dict(schema))
    stack: list[Any] = [closed]
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
    return closed


def read_json(raw: bytes) -> dict[str, Any]:
    """The object in a server's body. Raises WrongShape."""
    try:
        value = json.loads(raw)
    except (ValueError, RecursionError) as error:
        raise WrongShape("its body is no JSON" if raw.strip() else "its body is empty") from error
    if not isinstance(value, dict):
        raise WrongShape("its body is no JSON object")
    return value


def read_reply(value: Mapping[str, Any], request: ChatRequest, mode: str) -> ChatReply:
    """The reply in a completion, without what it took. Raises WrongShape, also where the server says an error or the
    model refuses."""
    if value.get("error"):
        raise WrongShape(f"it says: {plain(error_words(value))}")
    try:
        message = value["choices"][0]["message"]
        text, refusal = _content(message.get("content")), message.get("refusal")
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise WrongShape("its body has no choices[0].message, is this a server of chat completions?") from error
    if not text and isinstance(refusal, str) and refusal:
        raise WrongShape(f"the model refuses: {plain(refusal)}")
    reasoning = next((v for k in ("reasoning_content", "reasoning") if isinstance(v := message.get(k), str) and v), "")
    given = value.get("usage")
    usage: Mapping[str, Any] = given if isinstance(given, dict) else {}
    details = usage.get("prompt_tokens_details")
    cached = _number(details.get("cached_tokens")) if isinstance(details, dict) else None
    prompt, completion = _number(usage.get("prompt_tokens")), _number(usage.get("completion_tokens"))
    return ChatReply(
        text=text,
        reasoning=reasoning,
        prompt_tokens=estimate_tokens(request.messages) if prompt is None else prompt,
        completion_tokens=estimate_tokens([("", text), ("", reasoning)]) if completion is None else completion,
        cached_tokens=cached if cached is not None else _number(usage.get("prompt_cache_hit_tokens")) or 0,
        mode=mode if request.shape is not None else "text",
    )


def read_vectors(value: Mapping[str, Any], count: int) -> list[list[float]]:
    """The vectors of an embeddings answer, in the order of the texts. Raises WrongShape."""
    if value.get("error"):
        raise WrongShape(f"it says: {plain(error_words(value))}")
    try:
        data: Sequence[Mapping[str, Any]] = value["data"]
        placed = {int(each.get("index", place)): each["embedding"] for place, each in enumerate(data)}
        vectors = [[float(x) for x in placed[i]] for i in range(count)]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise WrongShape(f"its body has no data with {count} embeddings") from error
    if not vectors or len({len(v) for v in vectors}) != 1 or not vectors[0]:
        raise WrongShape("its embeddings are not of one length")
    return vectors


def error_words(value: Any) -> str:
    """What a server says in an error's body."""
    found = value.get("error", value) if isinstance(value, dict) else value
    if isinstance(found, dict):
        found = found.get("message") or found.get("detail") or json.dumps(found)
    return str(found)


def plain(text: str) -> str:
    """Somebody else's words on one line, without control characters, at most ``SAID`` of them."""
    words = "".join(c if c.isprintable() else " " for c in text)
    words = " ".join(words.split())
    return words if len(words) <= SAID else words[: SAID - 3] + "..."


def _content(given: Any) -> str:
    if given is None:
        return ""
    if isinstance(given, list):
        return "".join(str(part.get("text", "")) for part in given)
    if not isinstance(given, str):
        raise TypeError
    return given


def _number(given: Any) -> int | None:
    return int(given) if isinstance(given, int | float) and not isinstance(given, bool) and 0 <= given < 1e12 else None
