"""Which memory bank a row has: the library as it is, two intents of it, or a bank that grows as encounters go by."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sumo_adv.benchmark.jobs import Job, Setup, slug
from sumo_adv.benchmark.methods import FIXED_LIBRARY, Method
from sumo_adv.errors import UsageError
from sumo_adv.memory.bank import MemoryBank


@contextmanager
def bank_of(method: Method, job: Job, setup: Setup, library: MemoryBank, scratch: Path) -> Iterator[MemoryBank]:
    """The bank for a row's attack on one encounter. Raises BankError, UsageError."""
    if method.learns:
        with _growing(job, setup) as bank:
            yield bank
    elif method.fixed:
        with _fixed(setup.bank, scratch) as bank:
            yield bank
    else:
        yield library


@contextmanager
def _fixed(library: Path, scratch: Path) -> Iterator[MemoryBank]:
    """A copy in which every intent but LLM-F's two is retired."""
    copy = scratch / "fixed.sqlite"
    if not copy.exists():
        shutil.copyfile(library, copy)
        with MemoryBank.open(copy) as bank:
            missing = set(FIXED_LIBRARY) - {i.label for i in bank.intents()}
            if missing:
                raise UsageError(f"The memory bank has no intent '{sorted(missing)[0]}', so there is no row llm-f.")
            for intent in bank.intents():
                if intent.label not in FIXED_LIBRARY:
                    bank.retire(intent.label)
    with MemoryBank.open(copy, read_only=True) as bank:
        yield bank


@contextmanager
def _growing(job: Job, setup: Setup) -> Iterator[MemoryBank]:
    """The bank as the encounters before left it; what this one learns is kept for the next.

    ``K.sqlite`` is the bank before encounter K.  It stays until encounter K has its cell, so that an
    interrupted encounter is done again from the same bank.  An encounter that broke, or that was none, leaves no bank:
    the next one has the newest there is.
    """
    place = job.place or 0
    folder = _folder(job, setup)
    folder.mkdir(parents=True, exist_ok=True)
    before = folder / f"{known_place(job, setup)}.sqlite"
    if place == 0 or not before.exists():
        shutil.copyfile(setup.bank, before)
    for leftover in folder.iterdir():  # of finished encounters, or of an interrupted one
        if leftover != before:
            leftover.unlink()
    part, after = folder / f"{place + 1}.part", folder / f"{place + 1}.sqlite"
    shutil.copyfile(before, part)
    with MemoryBank.open(part) as bank:
        yield bank
    part.replace(after)


def known_place(job: Job, setup: Setup) -> int:
    """The place, at most the job's, from which a row that learns can go on: the newest with a bank, else the first."""
    places = (int(file.stem) for file in _folder(job, setup).glob("*.sqlite"))
    return max((k for k in places if k <= (job.place or 0)), default=0)


def _folder(job: Job, setup: Setup) -> Path:
    return setup.folder / "banks" / slug(job.ego) / slug(job.rows[0])
