"""The folder of a batch: its plan, the snapshot of the bank, the folders of its runs, the table.

OUT/plan.json      the plan; a changed plan is told apart by it
OUT/bank.sqlite    the memory bank as it was at the start, which every episode reads
OUT/inputs/        networks, demand ..., each content once: those of the runs are links to them
OUT/runs/ID/       a run as ``run`` writes it
OUT/packs/         runs that were packed (``pack.py``)
OUT/results.csv    a row an episode
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from sumo_adv.campaigns.nouns import Done, Job, Row
from sumo_adv.campaigns.pack import packed_rows
from sumo_adv.campaigns.plan import checked_plan, differences
from sumo_adv.campaigns.results import OUTCOME, failed, read_row, write_failure
from sumo_adv.errors import UsageError
from sumo_adv.files import sentences, write_text
from sumo_adv.memory.store import connect
from sumo_adv.parsing import parse_json

PLAN, BANK, TAUGHT, LOCK = "plan.json", "bank.sqlite", "taught.json", ".lock"


class Store:
    """A batch's folder, held by one program at a time. Use :func:`open_store`."""

    def __init__(self, folder: Path, staged: Callable[..., AbstractContextManager[Any]]) -> None:
        self.folder, self.runs, self.bank = folder, folder / "runs", folder / BANK
        self._staged = staged

    def known_plan(self) -> Mapping[str, Any] | None:
        """The plan that this folder is about, or None for a new one. Raises UsageError for what is no batch."""
        file = self.folder / PLAN
        if not file.is_file():
            return None
        try:
            return checked_plan(parse_json(file.read_text(encoding="utf-8")))
        except (OSError, ValueError) as error:
            raise UsageError(f"{file} is not the plan of a batch ({error}); give another --out.") from error

    def check(self, plan: Mapping[str, Any], *, force: bool) -> None:
        """Raises UsageError if the folder holds another plan's results, and says what differs. With ``force`` inputs,
        egos, seeds and settings may; not what all rows depend on: the bank, learning, versions."""
        previous = self.known_plan()
        if previous is None:
            return
        grown, common = differences(previous, plan)
        if common:
            changes = "; ".join((*common, *grown))
            raise UsageError(f"One cannot go on with the results in {self.folder}: {changes}. Give another --out.")
        if grown and not force:
            raise UsageError(
                f"The plan is not the one of the results in {self.folder}: {'; '.join(grown)}. Say --force to go on "
                "there with this plan (episodes of both are not run again), or give another --out."
            )

    def keep_plan(self, plan: Mapping[str, Any]) -> None:
        """Write the plan down. Raises OSError."""
        write_text(self.folder / PLAN, json.dumps(plan, indent=1, ensure_ascii=False) + "\n")

    def snapshot(self, bank: Path) -> None:
        """Copy the bank, once; what is there already stays. Raises OSError, sqlite3.Error."""
        if self.bank.exists():
            return
        part = self.bank.with_name(f".{BANK}.part")
        with suppress(FileNotFoundError):
            part.unlink()
        with closing(connect(bank, "mode=ro")) as source, closing(sqlite3.connect(part)) as target:
            source.backup(target)
            target.execute("PRAGMA journal_mode = DELETE").fetchone()
        part.replace(self.bank)

    def rows(self, jobs: Mapping[str, Job]) -> dict[str, Row]:
        """The rows of those jobs that are finished, packed ones too. Damaged rows count as missing."""
        packed = packed_rows(self.folder)
        rows = {name: row for name, row in packed.items() if name in jobs}
        for entry in self.runs.iterdir():
            if entry.name in jobs and (row := read_row(entry)) is not None:
                rows[entry.name] = row
        return rows

    def forget_failed(self, rows: dict[str, Row]) -> None:
        """Take failed episodes for missing. Raises OSError."""
        for name in [name for name, row in rows.items() if failed(row)]:
            del rows[name]
            discard(self.runs / name)

    def clear(self, names: Iterable[str]) -> None:
        """Remove what lies at the places of runs that are missing: what is left of damaged ones. Raises OSError."""
        for name in names:
            discard(self.runs / name)

    def fail(self, job: Job, why: str, text: str) -> Done:
        """Write down an episode that could not be run. Raises SumoAdvError."""
        self.sweep(job.id)
        with self._staged(self.runs / job.id, force=True, marker=OUTCOME) as folder:
            row = write_failure(folder.stage, job, why, text)
            folder.keep(force=True)
        return Done(job.id, row)

    def sweep(self, name: str = "") -> None:
        """Remove what broken-off runs left half-written."""
        for left in self.runs.glob(f".{name}*"):
            shutil.rmtree(left, ignore_errors=True)


def discard(place: Path) -> None:
    """Remove the folder, file or link at ``place``, if there is one. Raises OSError."""
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place, ignore_errors=True)
    else:
        place.unlink(missing_ok=True)


@contextmanager
def open_store(folder: Path, staged: Callable[..., AbstractContextManager[Any]]) -> Iterator[tuple[Store, Path]]:
    """The batch's folder, made if it is not there, and a scratch folder that is gone at the end.

    Raises UsageError: the folder cannot be written, is something else's, or another program is at it.
    """
    with sentences(folder):
        if folder.exists() and not folder.is_dir():
            raise UsageError(f"{folder} is not a folder; give another --out.")
        if folder.exists() and any(folder.iterdir()) and not any((folder / n).exists() for n in (PLAN, LOCK)):
            raise UsageError(f"{folder} holds something else than a batch's results; give another --out.")
        made = not folder.exists()
        (folder / "runs").mkdir(parents=True, exist_ok=True)
        lock = _locked(folder)
    store = Store(folder, staged)
    try:
        _left_behind(folder)
        with sentences(folder), tempfile.TemporaryDirectory(prefix="sumo_adv-batch-") as scratch:
            store.sweep()
            _write(lock, scratch)
            yield store, Path(scratch)
    finally:
        store.sweep()
        os.close(lock)
        with suppress(OSError):
            (folder / LOCK).unlink()
        if made and not (folder / PLAN).exists():
            shutil.rmtree(folder, ignore_errors=True)


def _locked(folder: Path) -> int:
    """An open file that no other program has locked. Raises UsageError, OSError."""
    lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        import fcntl

        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(lock)
        raise UsageError(f"Another batch is writing to {folder}; wait for it, or give another --out.") from error
    except (ImportError, OSError):
        pass  # no such locks on this system or file system
    return lock


def _write(lock: int, scratch: str) -> None:
    os.ftruncate(lock, 0)
    os.pwrite(lock, scratch.encode(), 0)


def _left_behind(folder: Path) -> None:
    """Remove the scratch folder of a batch that was killed."""
    with suppress(OSError, ValueError):
        before = Path((folder / LOCK).read_text(encoding="utf-8"))
        if before.name.startswith("sumo_adv-batch-") and before.is_dir():
            shutil.rmtree(before, ignore_errors=True)
