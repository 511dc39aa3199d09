"""Options that commands share, each with its panel of the help and its default from the settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from sumo_adv.config import Settings, Until

INPUT, EGO, ATTACK, SEARCH, MODEL, OUTPUT = "Input", "Ego", "Attack", "Search", "Language model", "Output"
RUNNING = "Running"
"""Panels of the help."""
CHOICE = (
    "until", "ttc", "critical_ttc", "min_delta_v", "diverse", "intents", "exclude", "kind", "attempts", "seconds",
    "adversaries",
)  # fmt: skip
"""Settings that say which attack is wanted; ``run`` and ``batch`` have an option for each."""


def option(panel: str, help: str, *flags: str, setting: str = "", default: str = "", **more: Any) -> Any:
    """An option in a panel of the help, which tells its default: that of a ``setting``, or in words."""
    shown = default or (_default_of(setting) if setting else "")
    text = f"{help} (default: {shown})" if shown else help
    return typer.Option(*flags, help=text, rich_help_panel=panel, show_default=False, **more)


def _default_of(name: str) -> str:
    value = Settings.model_fields[name].default
    return f"{value:g}" if isinstance(value, float) else str(value)


def given(params: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """The settings among the parameters of a command that were given."""
    return {name: params[name] for name in names if params.get(name) is not None}


# -- which attack is wanted

UntilLevel = Annotated[
    Until | None,
    option(
        ATTACK, "What an attempt must reach: critical (alias ttc), collision, valid, strict or serious.",
        metavar="LEVEL", default="critical",
    ),
]  # fmt: skip
Ttc = Annotated[
    tuple[float, float] | None,
    option(
        ATTACK, "Look for a near miss instead: no collision, and a min TTC between LOW and HIGH, s.",
        metavar="LOW HIGH", default="none",
    ),
]  # fmt: skip
CriticalTtc = Annotated[
    float | None, option(ATTACK, "A min TTC of at most this is critical, s.", setting="critical_ttc")
]
MinDeltaV = Annotated[
    float | None, option(ATTACK, "Least delta-v of the ego in a collision that succeeds, m/s.", setting="min_delta_v")
]
Diverse = Annotated[
    int | None, option(ATTACK, "Go on until attacks of this many different kinds succeeded.", setting="diverse")
]
Intents = Annotated[
    str | None, option(ATTACK, "Intents that may be tried, with commas between.", metavar="A,B", default="all")
]
Exclude = Annotated[str | None, option(ATTACK, "Intents that may not be tried.", metavar="A,B", default="none")]
Kind = Annotated[
    str | None,
    option(
        ATTACK, "Relation of the adversary to the ego: leader, follower, neighbour, oncoming, crossing, merging; "
        "several with commas between.", metavar="RELATION", default="all",
    ),
]  # fmt: skip
Adversaries = Annotated[
    int | None,
    option(ATTACK, "Most adversaries of an attack, 1 to 3: a collider and supports.", setting="adversaries"),
]
Attempts = Annotated[int | None, option(ATTACK, "Maximum number of attempts per encounter.", setting="attempts")]
Seconds = Annotated[float | None, option(ATTACK, "Seconds of attempts per encounter at most.", setting="seconds")]

# -- where it is looked for

SettingsFile = Annotated[Path | None, option(INPUT, "TOML file of settings.", "--settings", default="none")]
AsJson = Annotated[bool, option(OUTPUT, "One JSON object on stdout, nothing else.", "--json")]

# -- how it is run

Workers = Annotated[int | None, option(RUNNING, "Processes.", default="one a core", min=1)]
RayCluster = Annotated[
    str | None,
    option(RUNNING, "Run on this Ray cluster: auto, HOST:PORT, ray://HOST:PORT.", metavar="ADDRESS", default="none"),
]
