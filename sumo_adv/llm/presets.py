"""Which server a model's name means."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pydantic import SecretStr

from sumo_adv.config_model import ModelSettings, one_word
from sumo_adv.errors import UsageError

MODES = ("json_schema", "json_object", "text")
"""How the shape of an answer is asked for, best first."""


@dataclass(frozen=True, slots=True)
class Server:
    """Where to ask for ``model``. ``key`` is None for none; ``mode`` is the first of ``MODES`` worth trying."""

    model: str
    base_url: str
    key: SecretStr | None = None
    mode: str = "json_schema"


@dataclass(frozen=True, slots=True)
class _Hosted:
    prefixes: tuple[str, ...]
    base_url: str
    key_variable: str
    mode: str = "json_schema"


HOSTED = (
    _Hosted(("deepseek-",), "https://api.deepseek.com/v1", "DEEPSEEK_API_KEY", "json_object"),
    _Hosted(("gpt-", "chatgpt-", "o1", "o3", "o4", "text-embedding-"), "https://api.openai.com/v1", "OPENAI_API_KEY"),
)
LOCAL = {
    "ollama:": "http://localhost:11434/v1",
    "vllm:": "http://localhost:8000/v1",
    "llamacpp:": "http://localhost:8080/v1",
}


def find_server(name: str, settings: ModelSettings, environment: Mapping[str, str]) -> Server:
    """The server of a model. A base URL in the settings goes before the presets', a provider's own key variable is
    read only for that provider. Raises UsageError that says which setting is missing."""
    for prefix, base_url in LOCAL.items():
        if name.startswith(prefix):
            model = name.removeprefix(prefix)
            if not model:
                raise UsageError(f"The model '{name}' needs a name behind the colon, such as {name}llama3.")
            return Server(model, settings.llm_base_url or base_url, settings.llm_api_key)
    hosted = next((preset for preset in HOSTED if name.startswith(preset.prefixes)), None)
    if settings.llm_base_url is not None:
        return Server(name, settings.llm_base_url, settings.llm_api_key, hosted.mode if hosted else MODES[0])
    if hosted is None:
        raise UsageError(
            f"The model '{name}' has no known server; set SUMO_ADV_LLM_BASE_URL, or use deepseek-chat, "
            "deepseek-reasoner, gpt-.., ollama:NAME, vllm:NAME, llamacpp:NAME or replay:FILE."
        )
    try:
        key = settings.llm_api_key or one_word(environment.get(hosted.key_variable, ""))
    except ValueError as error:
        raise UsageError(f"{hosted.key_variable} cannot be used: {error}.") from error
    if key is None:
        raise UsageError(f"The model '{name}' needs a key; set SUMO_ADV_LLM_API_KEY or {hosted.key_variable}.")
    return Server(name, hosted.base_url, key, hosted.mode)
