"""Load suites, which are frozen, versioned lists of encounters: shipped ones, folders, scenario files, Waymo records.

    schema = 1                            # suite.toml
    name = "mine"
    version = "1"
    [[cases]]                             # one for each encounter
    name = "straight-01"
    kind = "leader"                       # any word; tables have a row for each
    group = "straight"                    # straight | intersection
    file = "straight-01.toml"             # a scenario, relative to the list's folder
    [files]                               # SHA-256 by path; without this table, nothing is checked
    "straight-01.toml" = "..."

A list may instead name cases of another list (``suite = "suite81"``, ``cases = ["straight-01", ..]``).

The file ``labels.json`` beside the list is not frozen. It has the most dangerous intents according to an oracle as
``{case: {ego: {"collision": [labels], "valid": [labels]}}}``. The annotations of people are under the ego ``people``
as ``{"annotated": [labels]}``.
"""

from __future__ import annotations

import csv
import hashlib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from sumo_adv.benchmark.nouns import GROUPS, Suite, SuiteCase
from sumo_adv.errors import UsageError
from sumo_adv.parsing import dotted, read_json, read_toml
from sumo_adv.simulation.inputs import data_folder, find_input, input_name, load_input
from sumo_adv.simulation.network import read_network

SUITE_FILE = "suite.toml"
LABEL_FILE = "labels.json"
WOMD_PREFIX = "womd:"
OWN_KIND = "own"
NAME_PATTERN = r"[A-Za-z0-9_.-]+"
SuiteName = Annotated[str, Field(pattern=f"^{NAME_PATTERN}$")]

LabelsFile = Mapping[str, Mapping[str, Mapping[str, tuple[str, ...]]]]
Criterion = Literal["collision", "valid", "annotated"]
LABELS_ADAPTER: TypeAdapter[Any] = TypeAdapter(dict[str, dict[str, dict[Criterion, tuple[str, ...]]]])


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Entry(_Table):
    name: SuiteName
    kind: SuiteName
    group: Literal["straight", "intersection"]
    file: str


class _List(_Table):
    schema_version: Literal[1] = Field(alias="schema")
    name: SuiteName
    version: str
    seed: int | None = None
    making: dict[str, Any] = Field(default_factory=dict)
    cases: Annotated[tuple[_Entry, ...], Field(min_length=1)]
    files: dict[str, str] = Field(default_factory=dict)


class _Choice(_Table):
    schema_version: Literal[1] = Field(alias="schema")
    name: SuiteName
    version: str
    suite: str
    cases: Annotated[tuple[SuiteName, ...], Field(min_length=1)]


def load_suite(*named: str) -> Suite:
    """Load a suite.

    Args:
        named: The name of a shipped suite, a list or its folder, ``womd:FOLDER``, or scenario files.

    Returns:
        The suite.

    Raises:
        UsageError: A file is missing, damaged, or changed since it was frozen.
    """
    if not named:
        raise UsageError(
            f"Name a suite: {', '.join(shipped_suites())}, a folder, scenario files or {WOMD_PREFIX}FOLDER."
        )
    try:
        return _named(named)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or error
        raise UsageError(f"The suite {' '.join(named)} cannot be read ({why}).") from error


def _named(named: Sequence[str]) -> Suite:
    if len(named) == 1:
        if named[0].startswith(WOMD_PREFIX):
            return _womd(Path(named[0].removeprefix(WOMD_PREFIX)))
        listing = _list_file(named[0])
        if listing is not None:
            return _listed(listing)
    whole = next((name for name in named if name.startswith(WOMD_PREFIX) or _list_file(name) is not None), None)
    if whole is not None:
        raise UsageError(
            f"The suite {whole} cannot be combined with others; repeat --suite only for scenario files or folders."
        )
    return _scenarios([path for name in named for path in _paths(name)])


def shipped_suites() -> tuple[str, ...]:
    """Return the names of the shipped suites, sorted."""
    folder = data_folder("suites")
    return tuple(sorted([p.stem for p in folder.glob("*.toml")] + [p.parent.name for p in folder.glob("*/suite.toml")]))


def hash_of_file(path: Path) -> str:
    """Return the SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _list_file(name: str) -> Path | None:
    """Return the list that a name means; None if it means none, such as a scenario or a folder of scenarios."""
    given = Path(name)
    if given.is_dir():
        return given / SUITE_FILE if (given / SUITE_FILE).is_file() else None
    if given.is_file():
        return given if given.suffix == ".toml" and "cases" in read_toml(given, "The file") else None
    if len(given.parts) == 1:
        stem = name.removesuffix(".toml")
        for shipped in (data_folder("suites") / stem / SUITE_FILE, data_folder("suites") / f"{stem}.toml"):
            if shipped.is_file():
                return shipped
    return None


def _paths(name: str) -> list[Path]:
    """Return the scenario files of a folder, or the one file or shipped scenario."""
    given = Path(name)
    if given.is_dir():
        files = sorted(given.glob("*.toml"))
        if not files:
            raise UsageError(f"The folder {given} holds neither a {SUITE_FILE} nor a scenario.")
        return files
    try:
        return [find_input(given)]
    except UsageError as error:
        names = ", ".join(shipped_suites())
        raise UsageError(f"There is no suite, folder or scenario '{name}'; shipped suites are {names}.") from error


def _listed(path: Path) -> Suite:
    """Load the suite of a list file."""
    table = read_toml(path, "The file")
    try:
        if "suite" in table:
            return _chosen(path, _Choice.model_validate(table))
        return _whole(path, _List.model_validate(table))
    except ValidationError as error:
        first = min(error.errors(), key=lambda fault: fault["type"] != "extra_forbidden")
        key = dotted(first["loc"])
        if first["type"] == "extra_forbidden":
            raise UsageError(f"The suite {path} has an unknown key '{key}'.") from error
        raise UsageError(
            f"The suite {path} has a bad '{key}': {first['msg'][:1].lower()}{first['msg'][1:]}."
        ) from error


def _whole(path: Path, given: _List) -> Suite:
    """Load a list with cases of its own, and check its files."""
    folder, names = path.parent, [entry.name for entry in given.cases]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(f"The suite {path} has the case '{twice}' twice.")
    labels = _labels(folder / LABEL_FILE, names, path)
    for name, frozen in given.files.items():
        if not (folder / name).is_file():
            raise UsageError(f"The suite {path} lists {name}, which is missing.")
        if hash_of_file(folder / name) != frozen:
            raise UsageError(
                f"{folder / name} was changed since the suite was frozen: restore it, or make a new suite."
            )
    cases, hashes = [], dict(given.files)
    for entry in given.cases:
        scenario = folder / entry.file
        if not scenario.is_file():
            raise UsageError(f"The suite {path} lists {entry.file}, which is missing.")
        if not given.files:
            hashes |= {f"{entry.name}/{k}": hash_of_file(f) for k, f in enumerate(load_input(scenario).files)}
        cases.append(SuiteCase(entry.name, scenario, None, entry.kind, entry.group, labels.get(entry.name, {})))
    return Suite(given.name, given.version, tuple(cases), _content(hashes))


def _chosen(path: Path, given: _Choice) -> Suite:
    """Load a list that names cases of another list."""
    beside = path.parent / given.suite
    chosen_from = _list_file(str(beside) if beside.exists() else given.suite)
    if chosen_from is None or "suite" in read_toml(chosen_from, "The file"):
        raise UsageError(f"The suite {path} chooses from '{given.suite}', which is not a list of scenarios.")
    whole = _listed(chosen_from)
    by_name = {case.name: case for case in whole.cases}
    missing = next((name for name in given.cases if name not in by_name), None)
    if missing is not None:
        raise UsageError(f"The suite {path} names '{missing}', which is not a case of {whole.name}.")
    content = _content({"suite": whole.content, "cases": " ".join(given.cases)})
    return Suite(given.name, given.version, tuple(by_name[name] for name in given.cases), content)


def _labels(path: Path, names: Collection[str], listed: Path) -> LabelsFile:
    """Read the labels of cases ``names``, if there is a file; ``listed`` is the list that errors name."""
    if not path.is_file():
        return {}
    try:
        labels: LabelsFile = LABELS_ADAPTER.validate_python(read_json(path))
    except (ValidationError, ValueError) as error:
        raise UsageError(
            f"{path} does not hold labels by case, ego and criterion (collision, valid, annotated)."
        ) from error
    unknown = next((name for name in labels if name not in names), None)
    if unknown is not None:
        raise UsageError(f"{path} labels '{unknown}', which is not a case of {listed}.")
    return labels


def _scenarios(paths: Sequence[Path]) -> Suite:
    """Make a suite of scenario files without a list; the group of each is derived from its network."""
    cases: list[SuiteCase] = []
    hashes: dict[str, str] = {}
    for path in paths:
        run_input = load_input(path)
        name = (
            run_input.name
            if all(run_input.name != case.name for case in cases)
            else f"{run_input.name}-{len(cases) + 1}"
        )
        hashes |= {f"{name}/{k}": hash_of_file(file) for k, file in enumerate(run_input.files)}
        annotated = run_input.label if run_input.label is not None and run_input.label.source == "annotated" else None
        labels = {} if annotated is None else {"people": {"annotated": annotated.intents}}
        cases.append(SuiteCase(name, path, None, OWN_KIND, _group(run_input.network), labels))
    content = _content(hashes)
    return Suite(input_name(paths[0]) if len(paths) == 1 else OWN_KIND, content[:8], tuple(cases), content)


def _group(network: Path) -> str:
    """Return ``intersection`` if one vehicle must give way to another in the network, otherwise ``straight``."""
    states = {c.state for lane in read_network(network).lanes.values() for c in lane.connections}
    return GROUPS[1] if states - {"M"} else GROUPS[0]


def _womd(folder: Path) -> Suite:
    """Make a suite of the records that a folder's manifest calls straight or intersection, by kind of future."""
    manifest = folder / "manifest.csv"
    if not manifest.is_file():
        raise UsageError(f"{folder} has no manifest.csv: give a folder of Waymo records that lists them.")
    with manifest.open(encoding="utf-8", newline="") as lines:
        rows = list(csv.DictReader(lines))
    lacking = {"id", "suite"} - set(rows[0] if rows else ())
    if lacking:
        raise UsageError(f"{manifest} lacks the column '{min(lacking)}'.")
    twice = next((name for name, many in Counter(row["id"] for row in rows).items() if many > 1), None)
    if twice is not None:
        raise UsageError(f"{manifest} lists '{twice}' twice.")
    labels = _labels(folder / LABEL_FILE, {row["id"] for row in rows}, manifest)
    cases, hashes = [], {manifest.name: hash_of_file(manifest)}
    for row in rows:
        if row["suite"] not in GROUPS:
            continue
        record = folder / f"{row['id']}.tfrecord"
        if not record.is_file():
            raise UsageError(f"{manifest} lists {record.name}, which is missing.")
        hashes[record.name] = hash_of_file(record)
        kind = (row.get("future") or "log").replace(" ", "_")
        name = row["id"]
        cases.append(SuiteCase(name, record, name.split(".")[0], kind, row["suite"], labels.get(name, {})))
    if not cases:
        raise UsageError(f"{manifest} lists no record that is straight or intersection.")
    content = _content(hashes)
    return Suite("womd", content[:8], tuple(cases), content)


def _content(hashes: Mapping[str, str]) -> str:
    """Return the SHA-256 of names and hashes, in any order."""
    text = "\n".join(f"{name} {value}" for name, value in sorted(hashes.items()))
    return hashlib.sha256(text.encode()).hexdigest()
