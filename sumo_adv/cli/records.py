"""The input of ``run``, Waymo records included: those are converted first, or found converted in the cache."""

from __future__ import annotations

import atexit
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sumo_adv.errors import UsageError

if TYPE_CHECKING:
    from sumo_adv.simulation.inputs import RunInput
    from sumo_adv.womd.reader import Choice
    from sumo_adv.womd.record import Record

INDEX_DIGITS = 9  # a longer number is an id


def load(source: Path, record: str | None) -> RunInput:
    """The input at ``source``; of a file of Waymo records the one that ``record`` names (id, or place from 0).

    Raises SumoAdvError for what cannot be read or converted.
    """
    from sumo_adv.simulation.inputs import load_input

    if ".tfrecord" not in source.name.lower() or not source.is_file():
        if record is not None:
            raise UsageError(f"--record chooses among the records of a TFRecord file, which {source} is not.")
        return load_input(source)
    from sumo_adv.womd.convert import conversion

    chosen = find_record(source, choice_of(record))
    stack = ExitStack()  # a conversion that could not be cached is gone at exit
    atexit.register(stack.close)
    made = stack.enter_context(conversion(chosen, traffic=False))
    return replace(load_input(made.scenario), name=chosen.scenario_id)


def find_record(source: Path, choice: Choice) -> Record:
    """The chosen record; an id is looked for past records that cannot be read. Raises UsageError."""
    from sumo_adv.womd.reader import read_records

    wrong: list[UsageError] = []
    try:
        return next(read_records(source, choice, None if choice.id is None else wrong.append))
    except UsageError as error:
        if wrong:
            raise UsageError(f"{str(error).rstrip('.')} that can be read. {wrong[0]}") from error
        raise


def choice_of(record: str | None) -> Choice:
    """The record that ``--record`` means; the first one if it was not given."""
    from sumo_adv.womd.reader import Choice

    if record is None:
        return Choice(index=0)
    if record.isascii() and record.isdigit() and len(record) <= INDEX_DIGITS:
        return Choice(index=int(record))
    return Choice(id=record)
