"""Many runs in few files, for file systems that do not like many: zip files of runs, each with an index beside it.

OUT/packs/0000.zip   ID/outcome.json ...; inputs/NAME once each
OUT/packs/0000.json  {"schema": 1, "runs": {ID: {"row": .., "inputs": [..]}}}, written last: a zip without it is none
"""

from __future__ import annotations

import json
import shutil
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sumo_adv.campaigns.nouns import Row
from sumo_adv.campaigns.results import OUTCOME, checked_row, read_row
from sumo_adv.errors import UsageError
from sumo_adv.files import sentences, write_text, write_whole
from sumo_adv.parsing import parse_json

SCHEMA = 1
MOST_RUNS = 1000
STORED = (".gz", ".png", ".zip")  # compressed already
BROKEN = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError)  # of a zip file that is damaged or enciphered
EPOCH = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class Packed:
    """What was packed: runs, files before and after, bytes before and after."""

    runs: int
    files: tuple[int, int]
    bytes: tuple[int, int]


def packed_rows(folder: Path) -> dict[str, Row]:
    """The rows of all packed runs of a batch. Raises UsageError for a damaged index."""
    return {name: entry["row"] for index in _indices(folder) for name, entry in _read(index).items()}


def packed_texts(folder: Path, name: str) -> dict[str, str]:
    """The file called ``name`` of all packed runs that have one. Raises UsageError for a damaged pack."""
    texts = {}
    for index in _indices(folder):
        try:
            with zipfile.ZipFile(index.with_suffix(".zip")) as source:
                inside = set(source.namelist())
                for run in _read(index):
                    if f"{run}/{name}" in inside:
                        texts[run] = source.read(f"{run}/{name}").decode()
        except (*BROKEN, OSError, ValueError) as error:
            raise _damaged(index.with_suffix(".zip"), error) from error
    return texts


def pack(folder: Path, most: int = MOST_RUNS) -> Packed:
    """Move the finished runs of a batch into zip files of ``most`` runs. Raises UsageError, SumoAdvError."""
    done = packed_rows(folder)
    runs = [r for r in sorted((folder / "runs").iterdir()) if not r.name.startswith(".")]
    for run in [r for r in runs if r.name in done]:  # broken off between writing and removing
        shutil.rmtree(run)
    rows = {run: row for run in runs if run.name not in done and (row := read_row(run)) is not None}
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
        _drop_unused_inputs(folder)
    return Packed(len(rows), (files, after[0]), (size, after[1]))


def _measure(runs: Sequence[Path]) -> tuple[int, int]:
    """Files and bytes of runs, those that are shared counted once."""
    stats = [p.stat() for run in runs for p in run.rglob("*") if p.is_file()]
    return len(stats), sum({(s.st_dev, s.st_ino): s.st_size for s in stats}.values())


def _pack_one(folder: Path, runs: Sequence[Path], rows: dict[Path, Row]) -> tuple[Path, Path]:
    number = 1 + max((int(i.stem) for i in (folder / "packs").glob("*.zip") if i.stem.isdecimal()), default=-1)
    target = folder / "packs" / f"{number:04d}.zip"
    index = {run.name: {"row": rows[run], "inputs": sorted(p.name for p in (run / "inputs").glob("*"))} for run in runs}
    write_whole(target, lambda part: _zip(part, runs))
    write_text(target.with_suffix(".json"), json.dumps({"schema": SCHEMA, "runs": index}) + "\n")
    for run in runs:
        shutil.rmtree(run)
    return target, target.with_suffix(".json")


def _zip(target: Path, runs: Sequence[Path]) -> None:
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
    entry = zipfile.ZipInfo(name, EPOCH)
    entry.external_attr = 0o644 << 16
    entry.compress_type = zipfile.ZIP_STORED if file.suffix in STORED else zipfile.ZIP_DEFLATED
    out.writestr(entry, file.read_bytes())


def _drop_unused_inputs(folder: Path) -> None:
    """Remove shared inputs that no unpacked run is linked to."""
    for file in (folder / "inputs").glob("*"):
        if file.stat().st_nlink == 1:
            file.unlink()


def unpack(
    folder: Path, names: Sequence[str], into: Path, staged: Callable[..., AbstractContextManager[Any]]
) -> list[Path]:
    """Put packed runs (all if none is named) into folders below ``into``, as they were; packs stay as they are.

    Raises UsageError for a run that is in no pack, SumoAdvError.
    """
    left, made = set(names), []
    for index in _indices(folder):
        entries = _read(index)
        chosen = [n for n in entries if not names or n in left]
        left -= set(chosen)
        if chosen:
            made += list(
                _unpack_one(index.with_suffix(".zip"), {n: entries[n]["inputs"] for n in chosen}, into, staged)
            )
    if left:
        raise UsageError(f"No pack in {folder / 'packs'} holds the run {sorted(left)[0]}.")
    return made


def _unpack_one(
    file: Path, runs: dict[str, list[str]], into: Path, staged: Callable[..., AbstractContextManager[Any]]
) -> Iterator[Path]:
    try:
        with zipfile.ZipFile(file) as source:
            names = source.namelist()
            for run, inputs in runs.items():
                if (into / run / OUTCOME).exists():
                    continue
                members = {n: n.removeprefix(f"{run}/") for n in names if n.startswith(f"{run}/")}
                members |= {f"inputs/{n}": f"inputs/{n}" for n in inputs}
                if not all(is_plain_name(part) for outside in members.values() for part in outside.split("/")):
                    raise KeyError("it names what is no file in a run's folder")
                with staged(into / run, force=True, marker=OUTCOME) as folder:
                    for inside, outside in members.items():
                        target = folder.stage / outside
                        target.parent.mkdir(parents=True, exist_ok=True)
                        target.write_bytes(source.read(inside))
                    folder.keep(force=True)
                yield into / run
    except (*BROKEN, FileNotFoundError, KeyError) as error:
        raise _damaged(file, error) from error


def is_plain_name(name: Any) -> bool:
    """Whether it names an entry of a folder, and no place elsewhere."""
    return isinstance(name, str) and name not in ("", ".", "..") and not set(name) & {"/", "\\", "\0"}


def _damaged(file: Path, error: Exception) -> UsageError:
    return UsageError(f"The pack {file} is missing or damaged ({error}); restore it from a copy.")


def _indices(folder: Path) -> list[Path]:
    return sorted((folder / "packs").glob("*.json")) if (folder / "packs").is_dir() else []


def _read(index: Path) -> dict[str, Any]:
    try:
        runs = dict(parse_json(index.read_text(encoding="utf-8"))["runs"])
        names = [name for run, entry in runs.items() for name in (run, *entry["inputs"])]
        if not all(is_plain_name(name) for name in names):
            raise ValueError("it names what is no file in a folder")
        return {run: {"row": checked_row(entry["row"]), "inputs": entry["inputs"]} for run, entry in runs.items()}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"The index {index} of a pack is damaged ({error}); restore it from a copy.") from error
