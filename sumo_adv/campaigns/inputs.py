"""From what a plan names (files, patterns, folders, shipped names, Waymo records) to inputs known by their content.

Whatever is wrong with one is kept in it: that input's episodes fail by name, the others run.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from sumo_adv.campaigns.nouns import Input, Parts
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.simulation.inputs import input_name, load_input

MAGIC = re.compile(r"[*?\[]")


def find_inputs(named: Sequence[str], folder: Path, records: Sequence[str], parts: Parts) -> list[Input]:
    """The inputs that ``named`` means, relative paths counted from ``folder``; ``records``: only these of files of
    Waymo records (ids, or places from 0), empty = all.

    Raises UsageError for a pattern that matches nothing.
    """
    found: list[Input] = []
    for name in named:
        for source in _sources(name, folder):
            if ".tfrecord" in source.name.lower():
                found += _records(source, records, parts)
            else:
                found.append(_plain(source))
    return found


def _sources(name: str, folder: Path) -> list[Path]:
    """The files of a pattern, those of a folder, or the one file or shipped name."""
    given = folder / name
    if given.is_dir():
        files = [p for p in sorted(given.iterdir()) if p.name.lower().endswith((".toml", ".sumocfg", ".sumo.cfg"))]
        files += sorted(given.glob("*/scenario.toml"))
        files = files or sorted((*given.glob("*.net.xml"), *given.glob("*.net.xml.gz")))
        if not files:
            raise UsageError(f"The folder {given} holds no scenario, .sumocfg or network.")
        return files
    if MAGIC.search(name) and not given.exists():
        place = given.absolute()
        matches = [p for p in sorted(Path(place.anchor).glob(str(place.relative_to(place.anchor)))) if p.is_file()]
        if not matches:
            raise UsageError(f"Nothing matches '{name}' in {folder}.")
        return matches
    return [given if given.exists() else Path(name)]


def _plain(source: Path) -> Input:
    """A network, configuration or scenario with all its files."""
    try:
        given = load_input(source)
        content = hash_of(given.files)
        place = source.absolute() if source.is_file() else source  # a shipped one is found by its name anywhere
        return Input(given.name, place, None, content)
    except (SumoAdvError, OSError) as error:
        return broken(source, None, str(error))


def _records(source: Path, wanted: Sequence[str], parts: Parts) -> Iterator[Input]:
    """The records of a file; a broken one is an input that fails."""
    left = set(wanted)
    try:
        for k, record in enumerate(parts.records(source)):
            if isinstance(record, str):
                if not wanted or str(k) in left:
                    left.discard(str(k))
                    yield broken(source, str(k), record)
                continue
            name, content = record
            if not wanted or {name, str(k)} & left:
                left -= {name, str(k)}
                yield Input(name, source.absolute(), name, content)
    except SumoAdvError as error:
        yield broken(source, None, str(error))
        return
    for record in sorted(left):
        yield broken(source, record, f"{source} has no record '{record}' that can be read.")


def broken(source: Path, record: str | None, error: str) -> Input:
    """An input that cannot be run; it is known by its name, for want of content."""
    name = input_name(source) if record is None else f"{input_name(source)}[{record}]"
    content = hashlib.sha256(f"broken {source.name} {record}".encode()).hexdigest()
    return Input(name, source, record, content, error)


def hash_of(files: Sequence[Path]) -> str:
    """SHA-256 over the contents of files in their order; where they lie and what they are called does not count."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()
