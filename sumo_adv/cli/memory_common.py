"""What the commands of ``memory`` share: their options, looking an intent up, printing data."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from sumo_adv.datatypes import Parameter
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.records import IntentRecord

Bank = Annotated[
    Path | None,
    typer.Option(
        "--memory", envvar="SUMO_ADV_MEMORY", show_envvar=False,
        help="The bank (default: SUMO_ADV_MEMORY, else the one in the user's data folder).",
    ),
]  # fmt: skip
Json = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]


def known_intent(bank: MemoryBank, label: str) -> IntentRecord:
    """The intent of that label. Raises UsageError that names those there are."""
    from sumo_adv.errors import UsageError

    record = bank.intent(label)
    if record is None:
        labels = ", ".join(r.label for r in bank.intents())
        raise UsageError(f"The bank has no intent '{label}'; it has: {labels}.")
    return record


def parse_parameters(source: str) -> tuple[Parameter, ...]:
    """A planner's table, read without running it."""
    from sumo_adv.planners.source import parse_parameters as parse

    return parse(source)


def answer(value: dict[str, Any], as_json: bool, words: Callable[[], list[str]]) -> None:
    """Print ``value`` as JSON, or the lines that ``words`` makes for people."""
    for line in [json.dumps(value)] if as_json else words():
        typer.echo(line)
