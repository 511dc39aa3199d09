"""How language models are reached and what a run may spend on them: ``SUMO_ADV_LLM_*``, or ``llm_*`` in a TOML file."""

from __future__ import annotations

from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field, SecretStr, field_validator


class ModelSettings(BaseModel):
    """The server, its key, and limits; times in s. The key is in no dump, repr or message."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, hide_input_in_errors=True)

    llm_base_url: str | None = None
    llm_api_key: SecretStr | None = Field(default=None, exclude=True, repr=False)
    llm_connect_timeout: float = Field(default=10.0, gt=0)
    llm_read_timeout: float = Field(default=120.0, gt=0)
    llm_question_seconds: float = Field(default=120.0, gt=0)  # one question with all its retries
    llm_retries: int = Field(default=3, ge=0, le=20)
    llm_concurrency: int = Field(default=4, ge=1, le=64)
    llm_temperature: float | None = Field(default=None, ge=0, le=2)  # None: as the server has it
    llm_answer_tokens: int | None = Field(default=None, ge=1)  # of one answer with its thinking; None: the server's
    llm_max_calls: int | None = Field(default=None, ge=0)
    llm_max_tokens: int | None = Field(default=None, ge=0)
    llm_max_seconds: float | None = Field(default=None, ge=0)

    @field_validator("llm_base_url")
    @classmethod
    def _is_an_address(cls, given: str | None) -> str | None:
        if not given or not given.strip():
            return None
        try:
            parts = urlsplit(given.strip())
            good = parts.scheme in ("http", "https") and bool(parts.hostname) and (parts.port is None or parts.port > 0)
        except ValueError:
            good = False
        if not good or parts.query or parts.fragment:
            raise ValueError("it should be an address such as http://localhost:8000/v1")
        if parts.username or parts.password:
            raise ValueError("a key does not belong into the address; set SUMO_ADV_LLM_API_KEY")
        return given.strip().rstrip("/")

    @field_validator("llm_api_key")
    @classmethod
    def _is_one_word(cls, given: SecretStr | None) -> SecretStr | None:
        return None if given is None else one_word(given.get_secret_value())


def one_word(key: str) -> SecretStr | None:
    """A key without spaces around it, None for nothing. Raises ValueError for what cannot go into an HTTP header."""
    key = key.strip()
    if not key:
        return None
    if not (key.isascii() and key.isprintable()) or " " in key:
        raise ValueError("a key is one word of plain letters, digits and signs")
    return SecretStr(key)
