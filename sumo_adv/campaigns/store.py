"""Manage the folder of a batch: its plan, the snapshot of the bank, the folders of its runs, and the table.

OUT/plan.json      the plan, by which a changed plan is recognised
OUT/bank.sqlite    the memory bank as it was at the start, which every episode reads
OUT/inputs/        networks, demand ..., each content once; the files of runs are hard links to them
OUT/runs/ID/       a run, as ``run`` writes it
OUT/packs/         many runs in few files, for file systems that do not like many files
    0000.zip       ID/outcome.json ...; inputs/NAME once each
    0000.json      {"schema": 1, "runs": {ID: {"row": .., "inputs": [..]}}}, written last: a zip without it is ignored
OUT/results.csv    a row for each episode
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sumo_adv.campaigns.plan import checked_plan, plan_differences
from sumo_adv.campaigns.results import OUTCOME_FILE, Done, EpisodeJob, Row, checked_row, keep_failure, read_row
from sumo_adv.errors import UsageError
from sumo_adv.files import is_plain_name, refuse_links, scratch_prefix, sentences, write_text, write_whole
from sumo_adv.memory.store import open_database
from sumo_adv.parsing import MAX_UNPACKED_BYTES, read_json

PACK_SCHEMA = 1
DEFAULT_RUNS_IN_PACK = 1000
MAX_RUNS_IN_PACK = 10_000  # a run takes about 1.1 kB of the index, which cannot be read above 64 MiB
STORED = (".gz", ".png", ".zip")  # already compressed
ZIP_FAULTS = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError)  # of a damaged or encrypted zip file
ZIP_EPOCH = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class Packed:
    """What was packed.

    Attributes:
        runs: The number of runs.
        files: The number of files before and after.
        bytes: The size before and after.
    """

    runs: int
    files: tuple[int, int]
    bytes: tuple[int, int]


def packed_rows(folder: Path) -> dict[str, Row]:
    """Return the rows of all packed runs of a batch; of a run that is in several packs, that of the last one.

    Args:
        folder: The batch's folder.

    Returns:
        The rows, by the id of each run.

    Raises:
        UsageError: An index is damaged.
    """
    return {name: entry["row"] for index in _indices(folder) for name, entry in _read(index).items()}


def packed_texts(folder: Path, name: str) -> dict[str, str]:
    """Read one file of all packed runs. Of a run that is in several packs, the last one counts.

    Args:
        folder: The batch's folder.
        name: The name of the file.

    Returns:
        The texts, by the id of each run that has the file.

    Raises:
        UsageError: A pack is damaged.
    """
    texts: dict[str, str] = {}
    for index in _indices(folder):
        try:
            with zipfile.ZipFile(index.with_suffix(".zip")) as archive:
                inside = set(archive.namelist())
                for run in _read(index):
                    texts.pop(run, None)
                    if f"{run}/{name}" in inside:
                        texts[run] = _unpacked(archive, f"{run}/{name}").decode()
        except (*ZIP_FAULTS, OSError, ValueError) as error:
            raise _damaged(index.with_suffix(".zip"), error) from error
    return texts


def pack_runs(folder: Path, most: int = DEFAULT_RUNS_IN_PACK) -> Packed:
    """Move the finished runs of a batch into zip files.

    A run that was made again after it was packed goes into a later pack. Its earlier pack stays as it is.

    Args:
        folder: The batch's folder.
        most: The maximum number of runs in a zip file, at most ``MAX_RUNS_IN_PACK``.

    Returns:
        What was packed.

    Raises:
        UsageError: ``most`` is too large, an index is damaged, or a file cannot be written.
        SumoAdvError: There is no space left.
    """
    if most > MAX_RUNS_IN_PACK:
        raise UsageError(f"A pack holds at most {MAX_RUNS_IN_PACK} runs, not {most}; give a smaller --most.")
    done = packed_rows(folder)
    runs = [r for r in sorted((folder / "runs").iterdir()) if not r.name.startswith(".")]
    rows = {run: row for run in runs if (row := read_row(run)) is not None}
    for run in [r for r in rows if rows[r] == done.get(r.name)]:  # interrupted between writing and removing
        _remove(run)
        del rows[run]
    files, size, after = 0, 0, [0, 0]
    with sentences(folder / "packs"):
        (folder / "packs").mkdir(exist_ok=True)
        order = list(rows)
        for first in range(0, len(order), most):
            some = order[first : first + most]
            n, b = _measure(some)
            files, size = files + n, size + b
            for file in _pack_one(folder, some, rows):
                after[0], after[1] = after[0] + 1, after[1] + file.stat().st_size
        for file in (folder / "inputs").glob("*"):
            if file.stat().st_nlink == 1:  # no unpacked run is linked to it
                file.unlink()
    return Packed(len(rows), (files, after[0]), (size, after[1]))


def _measure(runs: Sequence[Path]) -> tuple[int, int]:
    """Return the number and the bytes of the runs' files; shared files count once in the bytes."""
    stats = [p.stat() for run in runs for p in run.rglob("*") if p.is_file()]
    return len(stats), sum({(s.st_dev, s.st_ino): s.st_size for s in stats}.values())


def _pack_one(folder: Path, runs: Sequence[Path], rows: dict[Path, Row]) -> tuple[Path, Path]:
    """Pack some runs into a new zip file with its index, then remove their folders."""
    number = 1 + max((int(i.stem) for i in (folder / "packs").glob("*.zip") if i.stem.isdecimal()), default=-1)
    target = folder / "packs" / f"{number:04d}.zip"
    index = {run.name: {"row": rows[run], "inputs": sorted(p.name for p in (run / "inputs").glob("*"))} for run in runs}
    write_whole(target, lambda part: _zip(part, runs))
    write_text(target.with_suffix(".json"), json.dumps({"schema": PACK_SCHEMA, "runs": index}) + "\n")
    for run in runs:
        _remove(run)
    return target, target.with_suffix(".json")


def _remove(run: Path) -> None:
    """Remove a run's folder. It is hidden first, so a folder that is only partly removed never counts as a run."""
    hidden = run.with_name(f".{run.name}.packed")
    run.rename(hidden)
    shutil.rmtree(hidden)


def _zip(target: Path, runs: Sequence[Path]) -> None:
    """Write runs into a zip file, each input once."""
    inputs: set[str] = set()
    with zipfile.ZipFile(target, "w") as out:
        for run in runs:
            for file in sorted(p for p in run.rglob("*") if p.is_file()):
                inner = file.relative_to(run)
                if inner.parts[0] == "inputs":
                    if file.name not in inputs:
                        _add(out, f"inputs/{file.name}", file)
                    inputs.add(file.name)
                else:
                    _add(out, f"{run.name}/{inner.as_posix()}", file)


def _add(out: zipfile.ZipFile, name: str, file: Path) -> None:
    entry = zipfile.ZipInfo(name, ZIP_EPOCH)
    entry.external_attr = 0o644 << 16
    entry.compress_type = zipfile.ZIP_STORED if file.suffix in STORED else zipfile.ZIP_DEFLATED
    out.writestr(entry, file.read_bytes())


def unpack_runs(
    folder: Path, names: Sequence[str], into: Path, staged: Callable[..., AbstractContextManager[Any]]
) -> list[Path]:
    """Restore packed runs as folders. The packs stay. Of a run that is in several packs, the last one counts.

    Args:
        folder: The batch's folder.
        names: The ids of the runs; empty means all.
        into: The folder of the restored folders.
        staged: Opens a folder that is written whole or not at all.

    Returns:
        The restored folders. Runs that exist already are left out.

    Raises:
        UsageError: A run is in no pack, there is a link in the folders, or a pack is damaged.
        SumoAdvError: There is no space left.
    """
    refuse_links(folder / "packs")
    refuse_links(into)
    left, chosen = set(names), dict[Path, dict[str, list[str]]]()
    seen = set[str]()
    for index in reversed(_indices(folder)):
        entries = {run: entry["inputs"] for run, entry in _read(index).items() if run not in seen}
        seen |= entries.keys()
        chosen[index] = {run: inputs for run, inputs in entries.items() if not names or run in left}
    if left - seen:
        raise UsageError(f"No pack in {folder / 'packs'} holds the run {min(left - seen)}.")
    made = list[Path]()
    for index, runs in sorted(chosen.items()):
        if runs:
            made += _unpack_one(index.with_suffix(".zip"), runs, into, staged)
    return made


def _unpack_one(
    file: Path, runs: dict[str, list[str]], into: Path, staged: Callable[..., AbstractContextManager[Any]]
) -> Iterator[Path]:
    try:
        with zipfile.ZipFile(file) as archive:
            names = archive.namelist()
            for run, inputs in runs.items():
                if (into / run / OUTCOME_FILE).exists():
                    continue
                members = {n: n.removeprefix(f"{run}/") for n in names if n.startswith(f"{run}/")}
                members |= {f"inputs/{n}": f"inputs/{n}" for n in inputs}
                if not all(is_plain_name(part) for outside in members.values() for part in outside.split("/")):
                    raise KeyError("it names something other than a file in a run's folder")
                with staged(into / run, force=True, inside=True) as folder:
                    for inside, outside in members.items():
                        target = folder.stage / outside
                        target.parent.mkdir(parents=True, exist_ok=True)
                        target.write_bytes(_unpacked(archive, inside))
                    folder.keep(force=True)
                yield into / run
    except (*ZIP_FAULTS, FileNotFoundError, KeyError, ValueError) as error:
        raise _damaged(file, error) from error


def _unpacked(archive: zipfile.ZipFile, name: str) -> bytes:
    """Read a member of a pack, at most as many bytes as its header says. Raise ValueError if that is too many."""
    if archive.getinfo(name).file_size > MAX_UNPACKED_BYTES:
        raise ValueError(f"{name} holds more than {MAX_UNPACKED_BYTES // 2**20} MiB")
    return archive.read(name)


def _damaged(file: Path, error: Exception) -> UsageError:
    """Return the error that says that a pack is damaged."""
    return UsageError(f"The pack {file} is missing or damaged ({error}); restore it from a copy.")


def _indices(folder: Path) -> list[Path]:
    """Return the indices of all packs in the order in which they were written. Other files do not count."""
    named = [index for index in (folder / "packs").glob("*.json") if index.stem.isdecimal()]
    return sorted(named, key=lambda index: int(index.stem))


def _read(index: Path) -> dict[str, Any]:
    """Read and check the index of a pack."""
    try:
        runs = dict(read_json(index)["runs"])
        names = [name for run, entry in runs.items() for name in (run, *entry["inputs"])]
        if not all(is_plain_name(name) for name in names):
            raise ValueError("it names something other than a file in a folder")
        return {run: {"row": checked_row(entry["row"]), "inputs": entry["inputs"]} for run, entry in runs.items()}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"The index {index} of a pack is damaged ({error}); restore it from a copy.") from error


PLAN_FILE, BANK_FILE, TAUGHT_FILE, LOCK_FILE = "plan.json", "bank.sqlite", "taught.json", ".lock"


# -- the folder


class Store:
    """A batch's folder, which one program holds at a time. Use :func:`open_store` to get one."""

    def __init__(self, folder: Path, staged: Callable[..., AbstractContextManager[Any]]) -> None:
        self.folder, self.runs, self.bank = folder, folder / "runs", folder / BANK_FILE
        self._staged = staged

    def known_plan(self) -> Mapping[str, Any] | None:
        """Read the plan that this folder's results belong to.

        Returns:
            The plan; None for a new folder.

        Raises:
            UsageError: The file is not the plan of a batch.
        """
        file = self.folder / PLAN_FILE
        if not file.is_file():
            return None
        try:
            return checked_plan(read_json(file))
        except (OSError, ValueError) as error:
            raise UsageError(f"{file} is not the plan of a batch ({error}); give another --out.") from error

    def check(self, plan: Mapping[str, Any], *, force: bool) -> None:
        """Check that a plan may continue the folder's results.

        Args:
            plan: The plan.
            force: Whether inputs, egos, seeds and settings may differ. What all rows depend on may never differ: the
                bank, learning and versions.

        Raises:
            UsageError: The folder holds another plan's results. The message says what differs.
        """
        previous = self.known_plan()
        if previous is None:
            return
        grown, common = plan_differences(previous, plan)
        if common:
            changes = "; ".join((*common, *grown))
            raise UsageError(f"The results in {self.folder} cannot be continued: {changes}. Give another --out.")
        if grown and not force:
            raise UsageError(
                f"The plan differs from that of the results in {self.folder}: {'; '.join(grown)}. Give --force to "
                "continue there with this plan (episodes of both plans are not rerun), or give another --out."
            )

    def snapshot(self, bank: Path) -> None:
        """Copy the bank, unless the folder has a copy.

        Args:
            bank: The bank.

        Raises:
            OSError: A file cannot be written.
            sqlite3.Error: The bank cannot be copied.
        """
        if self.bank.exists():
            return
        part = self.bank.with_name(f".{BANK_FILE}.part")
        with suppress(FileNotFoundError):
            part.unlink()
        with closing(open_database(bank, "mode=ro")) as original, closing(sqlite3.connect(part)) as target:
            original.backup(target)
            target.execute("PRAGMA journal_mode = DELETE").fetchone()
        part.replace(self.bank)

    def rows(self, jobs: Mapping[str, EpisodeJob]) -> dict[str, Row]:
        """Read the rows of finished episodes, packed ones included. Damaged rows count as missing.

        Args:
            jobs: The episodes, by id.

        Returns:
            The rows, by id.
        """
        packed = packed_rows(self.folder)
        rows = {name: row for name, row in packed.items() if name in jobs}
        for entry in self.runs.iterdir():
            if entry.name in jobs and (row := read_row(entry)) is not None:
                rows[entry.name] = row
        return rows

    def fail(self, job: EpisodeJob, why: str, text: str) -> Done:
        """Record an episode that could not be run; ``why`` is the reason and ``text`` the traceback."""
        self.sweep(job.id)
        return keep_failure(self._staged, self.runs, job, why, text)

    def sweep(self, name: str = "") -> None:
        """Remove the half-written folders of interrupted runs; ``name`` limits this to one run."""
        for left in self.runs.glob(f".{name}*"):
            shutil.rmtree(left, ignore_errors=True)


def discard(place: Path) -> None:
    """Remove the folder, file or link at ``place``, if there is one. Raise OSError if that fails."""
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place, ignore_errors=True)
    else:
        place.unlink(missing_ok=True)


@contextmanager
def open_store(folder: Path, staged: Callable[..., AbstractContextManager[Any]]) -> Iterator[tuple[Store, Path]]:
    """Open the folder of a batch, which is created if it does not exist.

    Args:
        folder: The folder.
        staged: Opens a folder that is written whole or not at all.

    Yields:
        The store, and a scratch folder that is removed at the end.

    Raises:
        UsageError: The folder cannot be written, holds something else or a link, or another program uses it.
    """
    with sentences(folder):
        if folder.exists() and not folder.is_dir():
            raise UsageError(f"{folder} is not a folder; give another --out.")
        if folder.exists() and any(folder.iterdir()) and not any((folder / n).exists() for n in (PLAN_FILE, LOCK_FILE)):
            raise UsageError(f"{folder} holds something other than a batch's results; give another --out.")
        refuse_links(folder)
        made = not folder.exists()
        (folder / "runs").mkdir(parents=True, exist_ok=True)
        lock = _locked(folder)
    store = Store(folder, staged)
    try:
        with sentences(folder), tempfile.TemporaryDirectory(prefix=scratch_prefix()) as scratch:
            store.sweep()
            yield store, Path(scratch)
    finally:
        store.sweep()
        os.close(lock)
        with suppress(OSError):
            (folder / LOCK_FILE).unlink()
        if made and not (folder / PLAN_FILE).exists():
            shutil.rmtree(folder, ignore_errors=True)


def _locked(folder: Path) -> int:
    """Open and lock the lock file. Raise UsageError if another program has locked it; raise OSError."""
    lock = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        import fcntl

        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(lock)
        raise UsageError(f"Another batch is writing to {folder}; wait for it, or give another --out.") from error
    except (ImportError, OSError):
        pass  # this system or file system has no such locks
    return lock
