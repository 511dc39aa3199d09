"""Define the options of commands, each with its panel of the help and its default from the settings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from sumo_adv.config import Settings, Until
from sumo_adv.errors import UsageError
from sumo_adv.parsing import parse_toml

INPUT_PANEL, EGO_PANEL, ATTACK_PANEL, SEARCH_PANEL, MODEL_PANEL, OUTPUT_PANEL = (
    "Input",
    "Ego",
    "Attack",
    "Search",
    "Language model",
    "Output",
)
RUNNING_PANEL = "Running"
"""Panels of the help."""


def option(panel: str, help: str, *flags: str, setting: str = "", default: str = "", **more: Any) -> Any:
    """Define an option whose help tells its default.

    Args:
        panel: The panel of the help.
        help: What the option does.
        *flags: The option's names; empty for the parameter's name.
        setting: The setting whose default is told.
        default: The default in words, if no setting is given.
        **more: Further arguments of ``typer.Option``.
    """
    if setting:
        value = Settings.model_fields[setting].default
        default = f"{value:g}" if isinstance(value, float) else str(value)
    text = f"{help} (default: {default})" if default else help
    return typer.Option(*flags, help=text, rich_help_panel=panel, show_default=False, **more)


# -- which attack is wanted

UntilLevel = Annotated[
    Until | None,
    option(
        ATTACK_PANEL, "What an attempt must reach: critical (alias ttc), collision, valid, strict or serious.",
        metavar="LEVEL", default="critical",
    ),
]  # fmt: skip
Ttc = Annotated[
    tuple[float, float] | None,
    option(
        ATTACK_PANEL, "Look for a near miss instead: no collision, and a min TTC between LOW and HIGH, s.",
        metavar="LOW HIGH", default="none",
    ),
]  # fmt: skip
CriticalTtc = Annotated[
    float | None, option(ATTACK_PANEL, "Highest min TTC that is critical, s.", setting="critical_ttc")
]
MinDeltaV = Annotated[
    float | None,
    option(ATTACK_PANEL, "Minimum delta-v of the ego in a successful collision, m/s.", setting="min_delta_v"),
]
Diverse = Annotated[
    int | None,
    option(ATTACK_PANEL, "Continue until attacks of this many different kinds succeeded.", setting="diverse"),
]
Intents = Annotated[
    str | None, option(ATTACK_PANEL, "Intents that may be tried, with commas between.", metavar="A,B", default="all")
]
Exclude = Annotated[str | None, option(ATTACK_PANEL, "Intents that may not be tried.", metavar="A,B", default="none")]
Kind = Annotated[
    str | None,
    option(
        ATTACK_PANEL, "Relation of the adversary to the ego: leader, follower, neighbour, oncoming, crossing, merging; "
        "several with commas between.", metavar="RELATION", default="all",
    ),
]  # fmt: skip
Scenario = Annotated[
    str | None,
    option(
        ATTACK_PANEL, "Named scenarios that an attack must show: CCFtap,cut-in,nhtsa-25 (Euro NCAP, ISO 34502, NHTSA).",
        metavar="A,B", default="any",
    ),
]  # fmt: skip
Adversaries = Annotated[
    int | None,
    option(
        ATTACK_PANEL,
        "Maximum number of adversaries in an attack, 1 to 3: a collider and supports.",
        setting="adversaries",
    ),
]
Attempts = Annotated[int | None, option(ATTACK_PANEL, "Maximum number of attempts per encounter.", setting="attempts")]
Seconds = Annotated[float | None, option(ATTACK_PANEL, "Maximum seconds of attempts per encounter.", setting="seconds")]

# -- where it is looked for

SettingsFile = Annotated[Path | None, option(INPUT_PANEL, "TOML file of settings.", "--settings", default="none")]
AsJson = Annotated[bool, option(OUTPUT_PANEL, "One JSON object on stdout, nothing else.", "--json")]

# -- how it is run

Workers = Annotated[int | None, option(RUNNING_PANEL, "Processes.", default="one per core", min=1)]
RayCluster = Annotated[
    str | None,
    option(RUNNING_PANEL, "Run on this Ray cluster: auto, HOST:PORT.", metavar="ADDRESS", default="none"),
]


Source = Annotated[
    Path | None,
    typer.Argument(
        metavar="INPUT",
        help="net.xml(.gz), .sumocfg, scenario .toml, .osm(.gz), .xodr, .tfrecord, CommonRoad .xml, or a shipped name.",
    ),
]
Record = Annotated[
    str | None, option(INPUT_PANEL, "Record of a .tfrecord: its id, or its position from 0.", default="0")
]
Begin = Annotated[
    float | None, option(INPUT_PANEL, "Simulation begin, s.", default="a .sumocfg's, or the first departure")
]
Density = Annotated[
    float | None,
    option(INPUT_PANEL, "Generated demand, for an input without any: departures per minute.", default="by lanes"),
]
Ego = Annotated[
    str | None,
    option(
        EGO_PANEL, "Driver under test: krauss, idm, eidm, careful, lattice, blind, fiss_plus, replay, module:Class.",
        default="as the input says, or idm",
    ),
]  # fmt: skip
Adversary = Annotated[str | None, option(ATTACK_PANEL, "The only vehicle that may attack.", default="any")]
Trigger = Annotated[float | None, option(ATTACK_PANEL, "Attack from this time on, s.", default="found")]
Learn = Annotated[str | None, option(SEARCH_PANEL, "on or off: keep what was critical in the bank.", setting="learn")]
Memory = Annotated[
    Path | None,
    option(SEARCH_PANEL, "Memory bank; made from the shipped one if it does not exist.", default="your own"),
]
Seed = Annotated[int | None, option(SEARCH_PANEL, "Seed of SUMO, demand, search and planners.", setting="seed")]
Llm = Annotated[
    str | None,
    option(
        MODEL_PANEL, "Model for analyzer, generator and modifier: deepseek-chat, ollama:NAME, replay:FILE ..",
        default="none: the built-in expert",
    ),
]  # fmt: skip


# -- the groups of ``run``; other commands share some of the options above


@dataclass(frozen=True)
class AttackOptions:
    """Options that say which attack is wanted."""

    ask: Annotated[
        str | None,
        option(ATTACK_PANEL, "The attack that is wanted, in words; needs --llm.", metavar="WORDS", default="none"),
    ] = None
    until: UntilLevel = None
    ttc: Ttc = None
    critical_ttc: CriticalTtc = None
    min_delta_v: MinDeltaV = None
    intents: Intents = None
    exclude: Exclude = None
    kind: Kind = None
    scenario: Scenario = None
    adversary: Adversary = None
    adversaries: Adversaries = None
    trigger: Trigger = None
    diverse: Diverse = None
    attempts: Attempts = None
    seconds: Seconds = None
    total_seconds: Annotated[
        float | None,
        option(
            ATTACK_PANEL,
            "Seconds after which no further encounter is begun; 0: only one is attacked.",
            setting="total_seconds",
        ),
    ] = None


@dataclass(frozen=True)
class InputOptions:
    """Options that say where an attack is looked for."""

    record: Record = None
    begin: Begin = None
    end: Annotated[
        float | None,
        option(INPUT_PANEL, "Look for an encounter until this time, s.", default="600 s after the first vehicle"),
    ] = None
    density: Density = None
    background: Annotated[
        str | None,
        option(
            INPUT_PANEL,
            "What drives recorded vehicles: log or sumo.",
            default="as the input says, or log for a replayed ego",
        ),
    ] = None
    sumo_option: Annotated[
        list[str] | None,
        option(
            INPUT_PANEL, "An option of SUMO; may be repeated.", "--option", metavar="NAME=VALUE", default="the input's"
        ),
    ] = None
    settings_file: SettingsFile = None
    replay: Annotated[
        Path | None, option(INPUT_PANEL, "Rerun the attempt of this folder from its manifest.", default="none")
    ] = None


@dataclass(frozen=True)
class EgoOptions:
    """Options that say what drives the ego."""

    ego: Ego = None
    ego_id: Annotated[str | None, option(EGO_PANEL, "The vehicle under test.", default="chosen")] = None
    ego_deadline: Annotated[
        float | None,
        option(
            EGO_PANEL,
            "Seconds in which the ego's driver must answer in a step; 0: no limit, for a debugger.",
            setting="ego_deadline",
        ),
    ] = None
    ego_latency: Annotated[
        str | None,
        option(
            EGO_PANEL,
            "Seconds until an answer of the ego's driver takes effect, or measured: the time that the answer took.",
            setting="ego_latency",
        ),
    ] = None


@dataclass(frozen=True)
class SearchOptions:
    """Options that say how an attack is searched for."""

    tuner: Annotated[
        str | None, option(SEARCH_PANEL, "builtin, or off: try only what the analyzer proposes.", setting="tuner")
    ] = None
    seed: Seed = None
    learn: Learn = None
    recall: Annotated[
        str | None,
        option(
            SEARCH_PANEL,
            "intent, or scene: try first what worked in a similar scene, without analysis.",
            setting="recall",
        ),
    ] = None
    memory: Memory = None
    no_fork: Annotated[bool, option(SEARCH_PANEL, "Load and repeat instead of forking (slower).", "--no-fork")] = False


@dataclass(frozen=True)
class ModelOptions:
    """Options that say which language model plays which role, and how."""

    llm: Llm = None
    analyzer: Annotated[
        str | None, option(MODEL_PANEL, "builtin or a model, for this part alone.", default="as --llm")
    ] = None
    generator: Annotated[
        str | None, option(MODEL_PANEL, "builtin or a model, for planners of new intents.", default="as --llm")
    ] = None
    modifier: Annotated[
        str | None, option(MODEL_PANEL, "builtin or a model, for changes of a planner.", default="as --llm")
    ] = None
    fallback: Annotated[
        str | None, option(MODEL_PANEL, "builtin: the expert continues if a model fails; or off.", setting="fallback")
    ] = None
    samples: Annotated[
        int | None, option(MODEL_PANEL, "Number of samples of the analyzer's model.", setting="samples")
    ] = None
    evidence: Annotated[
        str | None, option(MODEL_PANEL, "on or off: show a model the predictor's figures.", setting="evidence")
    ] = None
    instruction: Annotated[
        str | None,
        option(MODEL_PANEL, "Instruction in words for the trajectories of generated planners.", default="none"),
    ] = None
    show_prompts: Annotated[bool, option(MODEL_PANEL, "Print the prompts, and call no model.", "--show-prompts")] = (
        False
    )


@dataclass(frozen=True)
class OutputOptions:
    """Options that say what is written and printed."""

    out: Annotated[Path | None, option(OUTPUT_PANEL, "Folder to write.", default="runs/<input>-<seed>")] = None
    force: Annotated[bool, option(OUTPUT_PANEL, "Replace another run's folder.", "--force")] = False
    as_json: AsJson = False


def words(text: str) -> list[str]:
    """Split a text at its commas."""
    return [word.strip() for word in text.split(",") if word.strip()]


def set_values(given: Sequence[str], example: str) -> dict[str, Any]:
    """Parse the values of ``--set``.

    Args:
        given: Texts ``NAME=VALUE``. A value is parsed as TOML or, if that fails, taken as text.
        example: An example for the error.

    Returns:
        The values by name.

    Raises:
        UsageError: A text has no ``=`` or no name.
    """
    values: dict[str, Any] = {}
    for each in given:
        name, equals, value = (word.strip() for word in each.partition("="))
        if not equals or not name:
            raise UsageError(f"--set takes NAME=VALUE, such as {example}, not '{each}'.")
        try:
            values[name] = parse_toml(f"value = {value}")["value"]
        except ValueError:
            values[name] = value
    return values
