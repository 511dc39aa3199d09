"""Options that only ``run`` has; those that it shares with ``batch`` are in ``options.py``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sumo_adv.cli.options import ATTACK, EGO, INPUT, MODEL, OUTPUT, SEARCH, option

Source = Annotated[
    Path | None,
    typer.Argument(
        metavar="INPUT",
        help="net.xml(.gz), .sumocfg, scenario .toml, .osm(.gz), .xodr, .tfrecord, CommonRoad .xml, or a shipped name.",
    ),
]
Record = Annotated[str | None, option(INPUT, "Record of a .tfrecord: its id, or its place from 0.", default="0")]
Begin = Annotated[float | None, option(INPUT, "Simulation begin, s.", default="first departure")]
End = Annotated[float | None, option(INPUT, "Look for an encounter until this time, s.", default="120 s after begin")]
SumoOption = Annotated[
    list[str] | None,
    option(INPUT, "An option of SUMO; may be repeated.", "--option", metavar="NAME=VALUE", default="the input's"),
]
Density = Annotated[
    float | None, option(INPUT, "Generated demand, for an input without any: departures a minute.", default="by lanes")
]
Background = Annotated[
    str | None,
    option(
        INPUT, "What drives recorded vehicles: log or sumo.",
        default="as the input says, else log for a replayed ego",
    ),
]  # fmt: skip
Ego = Annotated[
    str | None,
    option(
        EGO, "Driver under test: krauss, idm, eidm, careful, lattice, blind, fiss_plus, replay, module:Class.",
        default="as the input says, else idm",
    ),
]  # fmt: skip
EgoDeadline = Annotated[
    float | None,
    option(
        EGO, "Seconds in which its driver must answer in a step; 0: any time, for a debugger.", setting="ego_deadline"
    ),
]
EgoId = Annotated[str | None, option(EGO, "The vehicle under test.", default="chosen")]
Ask = Annotated[
    str | None, option(ATTACK, "The attack that is wanted, in words; needs --llm.", metavar="WORDS", default="none")
]
Adversary = Annotated[str | None, option(ATTACK, "The only vehicle that may attack.", default="any")]
Trigger = Annotated[float | None, option(ATTACK, "Attack from this time on, s.", default="found")]
TotalSeconds = Annotated[
    float | None,
    option(
        ATTACK, "Seconds after which no further encounter is begun; 0: the first one alone.", setting="total_seconds"
    ),
]
Tuner = Annotated[str | None, option(SEARCH, "builtin, or off: try only what the analyzer proposes.", setting="tuner")]
Learn = Annotated[str | None, option(SEARCH, "on or off: keep what was critical in the bank.", setting="learn")]
Recall = Annotated[
    str | None,
    option(SEARCH, "intent, or scene: try first what worked in a similar scene, without analysis.", setting="recall"),
]
Memory = Annotated[
    Path | None, option(SEARCH, "Memory bank; made from the shipped one if it does not exist.", default="your own")
]
Metric = Annotated[
    str | None,
    option(
        SEARCH, "Distance of intents: slots, endpoint:MODEL (embeddings of a server) or local:DIR.", setting="metric"
    ),
]
Seed = Annotated[int | None, option(SEARCH, "Of SUMO, demand, search and planners.", setting="seed")]
NoFork = Annotated[bool, option(SEARCH, "Load and repeat instead of forking (slower).", "--no-fork")]
Llm = Annotated[
    str | None,
    option(
        MODEL, "For analyzer, generator and modifier: deepseek-chat, ollama:NAME, replay:FILE ..",
        default="none: the built-in expert",
    ),
]  # fmt: skip
Analyzer = Annotated[str | None, option(MODEL, "builtin or a model, for this part alone.", default="as --llm")]
Generator = Annotated[str | None, option(MODEL, "builtin or a model, for planners of new intents.", default="as --llm")]
Modifier = Annotated[str | None, option(MODEL, "builtin or a model, for changes of a planner.", default="as --llm")]
Fallback = Annotated[
    str | None, option(MODEL, "builtin: the expert goes on where a model fails; or off.", setting="fallback")
]
Samples = Annotated[int | None, option(MODEL, "How often the analyzer's model is asked.", setting="samples")]
Evidence = Annotated[str | None, option(MODEL, "on or off: show a model the predictor's figures.", setting="evidence")]
Instruction = Annotated[
    str | None, option(MODEL, "In words, how generated planners shall shape their trajectories.", default="none")
]
ShowPrompts = Annotated[
    bool, option(MODEL, "Print what a model would be asked here, and ask nothing.", "--show-prompts")
]
Out = Annotated[Path | None, option(OUTPUT, "Folder to write.", default="runs/<input>-<seed>")]
Force = Annotated[bool, option(OUTPUT, "Replace another run's folder.", "--force")]
Replay = Annotated[
    Path | None, option(INPUT, "Run the attempt of that folder again, from its manifest.", default="none")
]
