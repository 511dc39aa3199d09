"""Define the settings of a run.

The command line comes first, then ``SUMO_ADV_*`` variables, then a TOML file, then these defaults.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field, SecretStr, ValidationError, field_validator, model_validator
from pydantic_core import ErrorDetails
from pydantic_settings import (
    BaseSettings,
    NoDecode,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from sumo_adv.config_odd import Odd
from sumo_adv.datatypes import MAX_ADVERSARIES, Level, Limits, Relation
from sumo_adv.ego_sensing import EgoSensing
from sumo_adv.errors import UsageError, nearest
from sumo_adv.goal import Goal
from sumo_adv.parsing import read_toml
from sumo_adv.road_users import Sized, limits_of
from sumo_adv.scenario_names import ScenarioName, wanted
from sumo_adv.times import whole_milliseconds

ResponseFormat = Literal["json_schema", "json_object", "text"]
"""How a model's server learns the schema of an answer: as a schema, or from the first message."""


class ModelSettings(BaseModel):
    """The server of a language model, its key, and limits. Times are in s. The key is in no dump, repr or message."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, hide_input_in_errors=True)

    llm_base_url: str | None = None
    llm_api_key: SecretStr | None = Field(default=None, exclude=True, repr=False)
    llm_connect_timeout: float = Field(default=10.0, gt=0)
    llm_read_timeout: float = Field(default=120.0, gt=0)
    llm_question_seconds: float = Field(default=120.0, gt=0)  # of one question with all its retries
    llm_retries: int = Field(default=3, ge=0, le=20)
    llm_concurrency: int = Field(default=4, ge=1, le=64)
    llm_temperature: float | None = Field(default=None, ge=0, le=2)  # None: the server's
    llm_answer_tokens: int | None = Field(default=None, ge=1)  # per answer, with its thinking; None: the server's
    llm_response_format: ResponseFormat | None = None  # tried first; None: the best one that the server accepts
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
            raise ValueError("a key does not belong in the address; set SUMO_ADV_LLM_API_KEY")
        return given.strip().rstrip("/")

    @field_validator("llm_api_key")
    @classmethod
    def _is_one_word(cls, given: SecretStr | None) -> SecretStr | None:
        return None if given is None else one_word(given.get_secret_value())


def one_word(key: str) -> SecretStr | None:
    """Strip spaces from a key.

    Returns:
        The key; None if nothing is left.

    Raises:
        ValueError: The key cannot be part of an HTTP header.
    """
    key = key.strip()
    if not key:
        return None
    if not (key.isascii() and key.isprintable()) or " " in key:
        raise ValueError("a key is one word of plain letters, digits and signs")
    return SecretStr(key)


SETTING_PREFIX = "SUMO_ADV_"  # of environment variables that are settings
API_KEY_VARIABLE = f"{SETTING_PREFIX}LLM_API_KEY"  # written to no plan: workers read it from the environment
BASE_URL_VARIABLE = f"{SETTING_PREFIX}LLM_BASE_URL"
SECRET = ("llm_api_key", "llm_base_url")  # the values of these settings are never printed

BUILTIN = "builtin"
MAX_TTC_S = 20.0
MAX_ATTACK_DELAY_S = 60.0  # latest begin of an attack after the trigger


class Until(StrEnum):
    """The level that an attempt must reach for an episode to have succeeded; ``ttc`` is an alias of ``critical``."""

    TTC = "ttc"
    CRITICAL = "critical"
    COLLISION = "collision"
    VALID = "valid"
    STRICT = "strict"
    SERIOUS = "serious"

    @property
    def level(self) -> Level:
        return Level.CRITICAL if self is Until.TTC else Level[self.name]


class LimitSettings(BaseModel):
    """The limits of an adversary's motion: accelerations [m/s2], curvature [1/m] and jerk [m/s3]."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    braking: float = Field(default=8.0, gt=0, le=12)
    acceleration: float = Field(default=4.0, gt=0, le=8)
    lateral: float = Field(default=4.0, gt=0, le=10)
    curvature: float = Field(default=0.2, gt=0, le=1)
    jerk: float = Field(default=12.0, gt=1, le=50)

    def limits(self) -> Limits:
        """Return these limits, which are those of a car, as a ``Limits``."""
        return Limits(self.braking, self.acceleration, self.lateral, self.curvature, self.jerk)

    def of(self, adversary: Sized) -> Limits:
        """Return the limits of an adversary with this box: these for a car, otherwise those of ``road_users``."""
        return limits_of(adversary, self.limits())


class Settings(ModelSettings, BaseSettings):
    """All settings that shape a run. Times are in s."""

    model_config = SettingsConfigDict(
        env_prefix=SETTING_PREFIX,
        env_nested_delimiter="__",
        env_ignore_empty=True,
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
    )

    ego: str = "idm"
    ego_id: str | None = None
    ego_parameters: dict[str, float] = Field(default_factory=dict)
    ego_deadline: float = Field(60.0, ge=0, le=86_400)  # wall-clock time in which the driver must answer; 0: no limit
    ego_latency: Annotated[float, Field(ge=0, le=5)] | Literal["measured"] = 0.0  # time until an answer takes effect
    ego_sensing: EgoSensing = Field(default_factory=EgoSensing)
    attempt_memory: float = Field(4096.0, ge=0, le=1_048_576)  # MiB that a fork may add; 0: no limit
    adversary: str | None = None
    adversaries: int = Field(1, ge=1, le=MAX_ADVERSARIES)  # maximum of an attack: a collider and supports
    trigger: float | None = Field(None, ge=0)
    begin: float | None = Field(None, ge=0)
    end: float | None = Field(None, ge=0)
    until: Until = Until.TTC
    attempts: int = Field(400, ge=1, le=10_000)
    seconds: float = Field(60.0, gt=0, le=86_400)  # maximum time of the attempts in an encounter
    total_seconds: float = Field(300.0, ge=0, le=604_800)  # time after which no further encounter begins
    diverse: int = Field(1, ge=1, le=20)  # wanted number of successes of different kinds
    ttc: tuple[float, float] | None = None  # a near miss is wanted, with a minimum TTC in this band
    critical_ttc: float = Field(1.0, gt=0, le=MAX_TTC_S)
    min_delta_v: float = Field(0.0, ge=0, le=60)  # m/s
    intents: Annotated[tuple[str, ...], NoDecode] = ()  # labels that may be tried; empty: all
    exclude: Annotated[tuple[str, ...], NoDecode] = ()  # labels that may not
    ask: str | None = None  # the wanted attack in words, for a language model
    kind: Annotated[tuple[Relation, ...], NoDecode] = ()  # relations that the adversary may have; empty: all
    scenario: Annotated[tuple[str, ...], NoDecode] = ()  # an attack must show one of these; empty: any
    tuner: Literal["builtin", "off"] = "builtin"
    llm: str | None = None  # plays all roles that are not named below
    analyzer: str | None = None
    generator: str | None = None
    modifier: str | None = None
    fallback: Literal["builtin", "off"] = "off"
    samples: int = Field(1, ge=1, le=50)
    evidence: Literal["on", "off"] = "on"
    generations: int = Field(3, ge=0, le=20)
    instruction: str | None = None
    learn: Literal["on", "off"] = "on"
    recall: Literal["intent", "scene"] = "intent"
    memory: Path | None = None
    seed: int = Field(0, ge=0, le=2**31 - 1)
    density: float | None = Field(None, gt=0)
    background: Literal["log", "sumo"] | None = None  # drives recorded BVs; None: what the scenario says
    odd: Odd | None = None  # encounters outside it are not attacked
    sumo_options: dict[str, str] = Field(default_factory=dict)  # SUMO's options by their long names
    fork: bool = True
    bubblewrap: bool = True

    step_length: float = Field(0.1, gt=0, le=0.5)
    history: float = Field(1.1, gt=0.3, le=10)
    horizon: float = Field(8.0, ge=1, le=30)
    duration: float = Field(12.0, ge=1, le=60)
    replan: float = Field(0.5, ge=0.1, le=60)
    forecast: Literal["model", "constant"] = "model"  # predicts the ego with its driver model or at constant speed
    delays: tuple[float, ...] = (0.0, 1.5, 3.0)
    shortlist: int = Field(5, ge=1, le=20)
    search: float = Field(600.0, gt=0)
    cell_seconds: float = Field(900.0, gt=0)
    proposals: int = Field(80, ge=4, le=2000)
    per_planner: int = Field(8, ge=1)
    modifications: int = Field(3, ge=0)
    questions: int = Field(8, ge=1)  # to models per encounter; repetitions and samples do not count
    questions_familiar: int = Field(3, ge=1)  # the same if the analysis has no new intent
    limits: LimitSettings = Field(default_factory=LimitSettings)

    @field_validator("intents", "exclude", "kind", "scenario", mode="before")
    @classmethod
    def _listed(cls, given: Any) -> Any:
        """Split a text at its commas."""
        return tuple(w.strip() for w in given.split(",") if w.strip()) if isinstance(given, str) else given

    @field_validator("scenario")
    @classmethod
    def _has_known_names(cls, given: tuple[str, ...]) -> tuple[str, ...]:
        wanted(given)
        return given

    @field_validator("step_length")
    @classmethod
    def _as_sumo_steps(cls, given: float) -> float:
        """Round the step as SUMO does."""
        if whole_milliseconds(given) == 0.0:
            raise ValueError("it is shorter than SUMO's shortest step of 0.001 s")
        return whole_milliseconds(given)

    @field_validator("ttc", mode="before")
    @classmethod
    def _is_a_band(cls, given: Any) -> Any:
        if isinstance(given, int | float):
            raise ValueError("it takes a band, LOW and HIGH; the min TTC that is critical is the setting critical_ttc")
        return given

    @model_validator(mode="after")
    def _fits_the_step(self) -> Settings:
        """Refuse times that do not fit the step.

        Times that are counted in steps must be at least one step long. There must be at least one delay, and none may
        be negative.
        """
        for name in ("replan", "history", "duration", "horizon"):
            if getattr(self, name) < self.step_length:
                raise ValueError(f"{name} is shorter than a step of {self.step_length:g} s")
        if self.ego_latency != "measured" and self.ego_latency > 0 and self.steps(self.ego_latency) == 0:
            raise ValueError(f"ego_latency is less than half a step of {self.step_length:g} s; 0 is none")
        if not self.delays or min(self.delays) < 0:
            raise ValueError("delays needs at least one time, and no time may be negative")
        if max(self.delays) > MAX_ATTACK_DELAY_S:
            raise ValueError(f"delays has a time of more than {MAX_ATTACK_DELAY_S:g} s")
        return self

    @model_validator(mode="after")
    def _has_one_goal(self) -> Settings:
        """Refuse a near miss that is combined with a wish for a collision."""
        if self.ttc is None:
            return self
        if not 0 <= self.ttc[0] < self.ttc[1] <= MAX_TTC_S:
            raise ValueError(f"ttc is a band: LOW is 0 s or more, HIGH is larger and at most {MAX_TTC_S:g} s")
        if self.until.level > Level.CRITICAL:
            raise ValueError(f"ttc wants a near miss and until = {self.until} a collision; give one of the two")
        if self.min_delta_v > 0:
            raise ValueError("ttc wants a near miss and min_delta_v a collision; give one of the two")
        return self

    @property
    def goal(self) -> Goal:
        """The goal of an attempt."""
        return Goal(self.until.level, self.min_delta_v, self.ttc)

    @property
    def scenario_names(self) -> tuple[ScenarioName, ...]:
        """The named scenarios of which an attack must show one; empty for any."""
        return wanted(self.scenario)

    @property
    def harmless_ttc(self) -> float:
        """The minimum TTC [s] that a run without an attack must exceed; otherwise the attack would show nothing."""
        return max(self.critical_ttc, self.ttc[1] if self.ttc is not None else 0.0)

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Order the sources: command line, environment, file."""
        file = _chosen_file[-1] if _chosen_file else None
        return init_settings, env_settings, TomlConfigSettingsSource(settings_cls, file)

    def player(self, role: str) -> str | None:
        """Return the model that plays a role.

        Args:
            role: ``analyzer``, ``generator`` or ``modifier``.

        Returns:
            The name of the model; None for the built-in expert.
        """
        name: str | None = getattr(self, role) or self.llm
        return None if name in (None, "", BUILTIN) else name

    def steps(self, seconds: float) -> int:
        """Return how many simulation steps ``seconds`` are, rounded."""
        return round(seconds / self.step_length)


def reachable(settings: Settings) -> bool:
    """Return whether the level can be reached. ``strict`` is judged against the driver ``careful`` itself."""
    return settings.ego != "careful" or settings.until.level < Level.STRICT


def forget_environment() -> None:
    """Remove the settings from this process's environment, apart from the model's key.

    Workers call it, because their plan contains the settings of the environment in which it was made.
    """
    for name in [n for n in os.environ if n.upper().startswith(SETTING_PREFIX) and n.upper() != API_KEY_VARIABLE]:
        del os.environ[name]


def refuse_address(table: Mapping[str, Any], said: str, *, own_key: bool = False) -> None:
    """Refuse a file that names a model's server while the key comes from elsewhere: the file's author would get the
    key.

    Args:
        table: The settings in the file.
        said: What the error calls the file.
        own_key: Whether a key was given beside the file.

    Raises:
        UsageError: The file names a server that the environment does not name, and there is a key.
    """
    environ = {name.upper(): value for name, value in os.environ.items()}
    address, known = table.get("llm_base_url"), environ.get(BASE_URL_VARIABLE)
    if address and address != known and (own_key or environ.get(API_KEY_VARIABLE)):
        raise UsageError(
            f"{said} names llm_base_url, a server that would receive your key: "
            f"set {BASE_URL_VARIABLE} yourself if you trust that server, or unset {API_KEY_VARIABLE}."
        )


_chosen_file: list[Path] = []  # the file from which settings are being loaded


def load_settings(file: Path | None = None, /, **given: Any) -> Settings:
    """Load settings from arguments, the environment and a TOML file.

    Args:
        file: The TOML file; None for no file.
        **given: Settings that override all others; None means that a setting is not given.

    Returns:
        The settings.

    Raises:
        UsageError: A name is unknown, or a value is out of range.
    """
    _refuse_capitals(given)
    if file is not None:
        if not file.is_file():
            raise UsageError(f"The settings file {file} does not exist.")
        table = read_toml(file, "The settings file")
        _refuse_capitals(table)
        # an empty variable counts as unset
        named = any(name.upper() == BASE_URL_VARIABLE and value for name, value in os.environ.items())
        if not named and not given.get("llm_base_url"):  # these override the file's address
            refuse_address(table, f"The settings file {file}", own_key=bool(given.get("llm_api_key")))
        _chosen_file.append(file)
    try:
        return Settings(**{k: v for k, v in given.items() if v is not None})
    except ValidationError as error:
        raise UsageError(_sentence(error.errors()[0])) from error
    except ValueError as error:
        raise UsageError(f"The settings could not be read ({error}).") from error
    finally:
        if file is not None:
            _chosen_file.pop()


def _refuse_capitals(names: Iterable[str]) -> None:
    """Refuse names in capitals. pydantic would take them, but files are checked for one name per setting."""
    for name in names:
        if name not in Settings.model_fields and name.lower() in Settings.model_fields:
            raise UsageError(f"There is no setting '{name}'; the nearest is '{name.lower()}'.")


def _sentence(detail: ErrorDetails) -> str:
    """Say what is wrong with the settings, naming the setting, or the known one most like an unknown one."""
    names = [part for part in detail["loc"] if isinstance(part, str)]
    message, name = detail["msg"].removeprefix("Value error, "), ".".join(names)
    if not name:
        return f"The settings do not fit together: {message}."
    if detail["type"] == "extra_forbidden":
        tables: dict[str, type[BaseModel]] = {"limits": LimitSettings, "ego_sensing": EgoSensing}
        model = tables.get(names[0], Settings) if len(names) > 1 else Settings
        return f"There is no setting '{name}'{nearest(names[-1], model.model_fields)}."
    if detail["type"] == "enum" and names[0] == "kind":
        kinds = ", ".join(Relation)
        like = nearest(str(detail["input"]), Relation)
        return f"There is no kind '{detail['input']}'{like}; known kinds are {kinds}."
    given = "used" if name in SECRET else repr(detail.get("input"))[:200]
    return f"Setting '{name}' cannot be {given}: {message}."
