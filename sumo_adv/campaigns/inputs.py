"""From what a plan names (files, patterns, folders, shipped names, Waymo records) to inputs known by their content.

An input that is not there is refused. Whatever is wrong with the content of one is kept in it: that input's episodes
fail by name, the others run.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from sumo_adv.campaigns.nouns import Input, Parts
from sumo_adv.episode.task import refuse_density
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.simulation.inputs import data_folder, input_name, resolve

MAGIC = re.compile(r"[*?\[]")
SHIPPED = ("scenarios", "networks")


def find_inputs(
    named: Sequence[str], folder: Path, records: Sequence[str], parts: Parts, density: float | None = None
) -> list[Input]:
    """The inputs that ``named`` means, relative paths counted from ``folder``. The shipped folders ``scenarios`` and
    ``networks`` are found from everywhere.

    records: only these of files of Waymo records (ids, or places from 0), empty = all. density: of generated traffic.

    Raises UsageError for a file, a name or a record that is not there, a pattern that matches nothing, and a density
    for an input that brings its own traffic.
    """
    inputs: list[Input] = []
    left = set(records)
    for name in named:
        for source in _sources(name, folder):
            if ".tfrecord" in source.name.lower():
                inputs += _records(source, records, left, parts)
            else:
                inputs.append(_plain(source, density, parts))
    if left:
        raise UsageError(f"No record '{min(left)}' that can be read is in the inputs; check --records.")
    return inputs


def _sources(name: str, folder: Path) -> list[Path]:
    """The files of a pattern, those of a folder, or the one file or shipped name."""
    given, shipped = folder / name, Path(name).parts[0]
    if shipped in SHIPPED and not (folder / shipped).exists():
        root = data_folder(shipped)
        return [
            Path(shipped) / p.relative_to(root) for p in _sources(str(root.joinpath(*Path(name).parts[1:])), Path())
        ]
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
    return [given if given.exists() else _known(name)]


def _known(name: str) -> Path:
    """A shipped name. Raises UsageError for another one."""
    resolve(Path(name))
    return Path(name)


def _plain(source: Path, density: float | None, parts: Parts) -> Input:
    """A network, configuration or scenario, also one of CommonRoad, with all its files."""
    try:
        given = parts.load(source, None)
    except (SumoAdvError, OSError) as error:
        return broken(source, None, str(error))
    refuse_density(given, density)
    try:
        content = hash_of(given.files)
        place = source.absolute() if source.is_file() else source  # a shipped one is found by its name anywhere
        return Input(given.name, place, None, content, notes=given.notes)
    except (SumoAdvError, OSError) as error:
        return broken(source, None, str(error))


def _records(source: Path, chosen: Sequence[str], left: set[str], parts: Parts) -> Iterator[Input]:
    """The records of a file; a broken one is an input that fails. Those that are there are removed from ``left``."""
    try:
        for k, record in enumerate(parts.records(source)):
            if isinstance(record, str):
                if not chosen or str(k) in chosen:
                    left.discard(str(k))
                    yield broken(source, str(k), record)
                continue
            name, content = record
            if not chosen or name in chosen or str(k) in chosen:
                left -= {name, str(k)}
                yield Input(name, source.absolute(), name, content)
    except SumoAdvError as error:
        left.clear()  # what cannot be read may hold them
        yield broken(source, None, str(error))


def broken(source: Path, record: str | None, error: str) -> Input:
    """An input that cannot be run; it is known by its name, for want of content."""
    name = input_name(source) if record is None else f"{input_name(source)}[{record}]"
    content = hashlib.sha256(f"broken {source.name} {record}".encode()).hexdigest()
    return Input(name, source, record, content, error)


def hash_of(files: Sequence[Path]) -> str:
    """SHA-256 over the contents of files in their order; places and names do not count."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()
