"""What the commands of ``memory`` share: their options, opening the bank, printing data."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from sumo_adv.config import Settings
    from sumo_adv.datatypes import Parameter
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.records import IntentRecord
    from sumo_adv.memory.similarity import Similarity

Bank = Annotated[Path | None, typer.Option("--memory", help="The bank (else the one in the user's data folder).")]
Json = Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")]
Metric = Annotated[
    str | None, typer.Option(help="tfidf, endpoint:MODEL (embeddings of a server) or local:DIR (default: tfidf).")
]


def shipped_bank() -> Path:
    """The bank of the paper's seven intents that comes with the program."""
    from sumo_adv.simulation.inputs import data_folder

    return data_folder("memory_bank.sqlite")


def open_bank(path: Path | None, *, make: bool = False, similarity: Similarity | None = None) -> MemoryBank:
    """The bank at ``path`` or the user's own; where that one is not there, a copy of the shipped one.

    A ``path`` that is not there is only made with ``make``. Raises BankError.
    """
    from sumo_adv.errors import BankError
    from sumo_adv.memory.bank import MemoryBank
    from sumo_adv.memory.paths import default_bank_path

    if path is not None and not make and not path.exists():
        raise BankError(f"There is no memory bank at {path}; check the path given with --memory.")
    return MemoryBank.open(path or default_bank_path(), seed_from=shipped_bank(), similarity=similarity)


def open_for_run(settings: Settings) -> MemoryBank:
    """The bank and the metric of a run's settings; one that is not there begins as a copy of the shipped one.

    Raises BankError, also for a metric that was never calibrated for it, and UsageError.
    """
    bank = open_bank(settings.memory, make=True, similarity=make_similarity(settings))
    try:
        bank.epsilon()
    except BaseException:
        bank.close()
        raise
    return bank


def make_similarity(settings: Settings) -> Similarity:
    """The metric that the settings name. Raises UsageError: no such model folder, or no server for the name."""
    from sumo_adv.memory.embeddings import Embedded
    from sumo_adv.memory.similarity import TfIdf

    kind, _, name = settings.metric.partition(":")
    if kind == "endpoint":
        from sumo_adv.llm.client import connect_embedder

        return Embedded(connect_embedder(name, settings), kind)
    if kind == "local":
        from sumo_adv.memory.sentence_model import SentenceModel

        return Embedded(SentenceModel(Path(name).expanduser()), kind)
    return TfIdf()


def chosen_similarity(metric: str | None) -> Similarity:
    """The metric of that name, or of the settings in the environment. Raises UsageError."""
    from sumo_adv.config import load_settings

    return make_similarity(load_settings(None, metric=metric))


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
    from sumo_adv.planners.source import parse_parameters as parse

    return parse(source)


def answer(value: dict[str, Any], as_json: bool, words: Callable[[], list[str]]) -> None:
    """Print ``value`` as JSON, or the lines that ``words`` makes for people."""
    for line in [json.dumps(value)] if as_json else words():
        typer.echo(line)
