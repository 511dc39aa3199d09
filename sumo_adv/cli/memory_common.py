"""What the commands of ``memory`` share: their options, opening the bank, printing data."""

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

Bank = Annotated[Path | None, typer.Option("--memory", help="The bank (else the one in the user's data folder).")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]


def shipped_bank() -> Path:
    """The bank of the paper's seven intents that comes with the program."""
    from sumo_adv.world.inputs import data_folder

    return data_folder("memory_bank.sqlite")


def open_bank(path: Path | None) -> MemoryBank:
    """The bank at ``path`` or the user's own; where there is none, a copy of the shipped one."""
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.paths import default_bank_path

    return MemoryBank.open(path or default_bank_path(), seed_from=shipped_bank())


def known_intent(bank: MemoryBank, label: str) -> IntentRecord:
    """The intent of that label. Raises UsageError that names those there are."""
    from sumo_adv.errors import UsageError

    record = bank.intent(label)
    if record is None:
        known = ", ".join(r.label for r in bank.intents())
        raise UsageError(f"The bank has no intent '{label}'; it has: {known}.")
    return record


def parse_parameters(source: str) -> tuple[Parameter, ...]:
    """A planner's table, read without running it."""
    from sumo_adv.planning.source import parse_parameters as parse

    return parse(source)


def answer(value: dict[str, Any], as_json: bool, words: Callable[[], list[str]]) -> None:
    """Print ``value`` as JSON, or the lines that ``words`` makes for people."""
    for line in [json.dumps(value)] if as_json else words():
        typer.echo(line)
