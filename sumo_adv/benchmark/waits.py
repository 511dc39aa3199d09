"""How long a row has waited for a language model: its process notes it, and the bench does not count it."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sumo_adv.benchmark.jobs import Job, slug
from sumo_adv.files import write_text
from sumo_adv.llm.chat import Ledger

EVERY = 0.5  # s between two notes


def note_of(folder: Path, job: Job, row: str) -> Path:
    """The file in which the process of a row notes its wait."""
    return folder / f"{slug(f'{job.ego} {job.case.name} {row}')}.waited"


@contextmanager
def noted(ledger: Ledger, note: Path) -> Iterator[None]:
    """While it lasts, ``note`` says how long the ledger's questions have been open [s]."""
    over = threading.Event()

    def write() -> None:
        while not over.wait(EVERY):
            if waited := ledger.waited_so_far():
                with contextlib.suppress(OSError):  # a full disk shows where results are written
                    write_text(note, repr(waited))

    writer = threading.Thread(target=write, name="waits", daemon=True)
    writer.start()
    try:
        yield
    finally:
        over.set()
        writer.join()


def waited(note: Path) -> float:
    """What a row has waited so far [s]; 0 where nothing is noted."""
    try:
        return float(note.read_text())
    except (OSError, ValueError):
        return 0.0
