"""Read the plan of a batch: lists that are multiplied into episodes. The id of an episode is a hash of its content.

    schema = 1
    inputs = ["scenarios/*.toml", "motorway", "records.tfrecord"]   # files, patterns, folders, shipped names
    records = [0, "19a486cd29abd7a7"]     # only these of files of Waymo records
    seeds = 10                            # 0 to 9, or a list
    egos = ["idm", "careful"]             # default: as the scenario says
    learn = "off"                         # off | after | during
    memory = "bank.sqlite"                # the bank; default: the user's
    figures = false                       # draw encounter.png
    [settings]                            # of every episode, as in a file of settings
    [vary]                                # settings with lists; each is one more dimension

An input that does not exist is refused. If the content of an input is wrong, the episodes of this input fail by name
and the others run. Relative paths are relative to the plan's folder. The rows are ordered by input, ego, variant and
seed; the seed varies fastest.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sumo_adv.campaigns.results import CampaignParts, EpisodeJob, Input, Learn
from sumo_adv.config import Settings, load_settings, refuse_address
from sumo_adv.drivers.registry import check_name
from sumo_adv.episode.task import refuse_density
from sumo_adv.errors import SumoAdvError, UsageError
from sumo_adv.parsing import first_fault, parse_toml, read_toml
from sumo_adv.simulation.inputs import data_folder, find_input, input_name

MAGIC = re.compile(r"[*?\[]")
SHIPPED_FOLDERS = ("scenarios", "networks")
OF_THE_INPUT = ("horizon", "step_length", "ego_sensing", "adversaries")
"""Settings that an input may bring. Those of the plan count if it gives them."""


def find_inputs(
    named: Sequence[str], folder: Path, records: Sequence[str], parts: CampaignParts, density: float | None = None
) -> list[Input]:
    """Find the inputs of a plan. The shipped folders ``scenarios`` and ``networks`` are found from everywhere.

    Args:
        named: Files, patterns, folders and shipped names.
        folder: The folder that relative paths are relative to.
        records: Only these records of files of Waymo records (ids, or positions from 0); empty takes all.
        parts: The functions that load inputs.
        density: The density of generated traffic; None if not given.

    Returns:
        The inputs.

    Raises:
        UsageError: A file, a name or a record does not exist, a pattern matches nothing, or there is a density for an
            input that has its own traffic.
    """
    inputs: list[Input] = []
    left = set(records)
    for name in named:
        for path in _paths(name, folder):
            if ".tfrecord" in path.name.lower():
                inputs += _records(path, records, left, parts)
            else:
                inputs.append(_file(path, density, parts))
    if left:
        raise UsageError(f"No record '{min(left)}' that can be read is in the inputs; check --records.")
    return inputs


def _paths(name: str, folder: Path) -> list[Path]:
    """Return the files of a pattern or a folder, or the one file or shipped name."""
    given, shipped = folder / name, next(iter(Path(name).parts), "")  # "." has no parts
    if shipped in SHIPPED_FOLDERS and not (folder / shipped).exists():
        root = data_folder(shipped)
        return [Path(shipped) / p.relative_to(root) for p in _paths(str(root.joinpath(*Path(name).parts[1:])), Path())]
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
    if given.exists():
        return [given]
    find_input(Path(name))  # raises UsageError if it is no shipped name either
    return [Path(name)]


def _file(path: Path, density: float | None, parts: CampaignParts) -> Input:
    """Make the input of a network, configuration or scenario (CommonRoad's, too) with all its files."""
    try:
        run_input = parts.load(path, None)
    except (SumoAdvError, OSError) as error:
        return broken(path, None, str(error))
    refuse_density(run_input, density)
    try:
        content = files_hash(run_input.files)
        place = path.absolute() if path.is_file() else path  # a shipped one is found by its name everywhere
        return Input(run_input.name, place, None, content, notes=run_input.notes)
    except (SumoAdvError, OSError) as error:
        return broken(path, None, str(error))


def _records(path: Path, chosen: Sequence[str], left: set[str], parts: CampaignParts) -> Iterator[Input]:
    """Yield the records of a file, a broken one as an input that fails; remove those that exist from ``left``."""
    try:
        for k, record in enumerate(parts.records(path)):
            if isinstance(record, str):
                if not chosen or str(k) in chosen:
                    left.discard(str(k))
                    yield broken(path, str(k), record)
                continue
            name, content = record
            if not chosen or name in chosen or str(k) in chosen:
                left -= {name, str(k)}
                yield Input(name, path.absolute(), name, content)
    except SumoAdvError as error:
        left.clear()  # the unreadable part may hold them
        yield broken(path, None, str(error))


def broken(path: Path, record: str | None, error: str) -> Input:
    """Make an input that cannot be run. Its content is a hash of its name, because it has no content that can be read.

    Args:
        path: The file.
        record: The id of a record; None for the whole file.
        error: Why it cannot be run.

    Returns:
        The input.
    """
    name = input_name(path) if record is None else f"{input_name(path)}[{record}]"
    content = hashlib.sha256(f"broken {path.name} {record}".encode()).hexdigest()
    return Input(name, path, record, content, error)


def files_hash(files: Sequence[Path]) -> str:
    """Return the SHA-256 of the contents of files, in order."""
    digest = hashlib.sha256()
    for file in files:
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


# -- the plan


PLAN_SCHEMA = 1
ID_DIGITS = 16
OWN_KEYS = {"ego": "egos", "seed": "seeds", "learn": "learn", "memory": "memory"}
Seed = Annotated[int, Field(ge=0, le=2**31 - 1)]


class PlanFile(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    schema_version: Literal[1] = Field(default=1, alias="schema")
    inputs: Annotated[tuple[str, ...], Field(min_length=1)]
    records: tuple[int | str, ...] = ()
    seeds: Annotated[int, Field(ge=1, le=10_000_000)] | Annotated[tuple[Seed, ...], Field(min_length=1)] | None = None
    egos: tuple[str, ...] = ()
    learn: Learn = Learn.OFF
    memory: Path | None = None
    figures: bool = False
    settings: dict[str, Any] = Field(default_factory=dict)
    vary: dict[str, Annotated[list[Any], Field(min_length=1)]] = Field(default_factory=dict)


@dataclass(frozen=True)
class CampaignPlan:
    """Lists that are multiplied into episodes.

    Attributes:
        inputs: The inputs.
        egos: The ego drivers; None means the input's own.
        seeds: The seeds.
        variants: The settings of each variant, as data.
        varied: The settings that differ between variants, for each variant.
        learn: When lessons are written into the bank.
        memory: The bank; None for the user's.
        figures: Whether ``encounter.png`` is drawn.
    """

    inputs: Sequence[Input]
    egos: Sequence[str | None]
    seeds: Sequence[int]
    variants: Sequence[Mapping[str, Any]]
    varied: Sequence[Mapping[str, Any]]
    learn: Learn
    memory: Path | None
    figures: bool

    @cached_property
    def jobs(self) -> list[EpisodeJob]:
        """The episodes in order. Of equal ones (the same content twice), only one is kept."""
        return list({job.id: job for job in reversed(list(self._product()))}.values())[::-1]

    @property
    def size(self) -> int:
        """The number of episodes, equal ones counted separately."""
        return len(self.inputs) * len(self.egos) * len(self.variants) * len(self.seeds)

    def _product(self) -> Iterator[EpisodeJob]:
        shaped = [json.dumps(v, sort_keys=True) for v in self.variants]
        for given, ego, k, seed in itertools.product(self.inputs, self.egos, range(len(shaped)), self.seeds):
            content = json.dumps([given.content, ego, seed, shaped[k]])
            yield EpisodeJob(hashlib.sha256(content.encode()).hexdigest()[:ID_DIGITS], given, ego, seed, k)

    def as_dict(self) -> dict[str, Any]:
        """Return what a folder of results stores of its plan, by which two plans are compared."""
        return {
            "schema": PLAN_SCHEMA,
            "inputs": [{"name": i.name, "content": i.content, "broken": i.error} for i in self.inputs],
            "egos": list(self.egos), "seeds": list(self.seeds), "settings": list(self.variants),
            "learn": str(self.learn), "memory": None if self.memory is None else str(self.memory.absolute()),
        }  # fmt: skip


def read_plan(path: Path) -> dict[str, Any]:
    """Read the TOML table of a plan.

    Args:
        path: The plan.

    Returns:
        The table. Its ``memory`` is relative to the plan's folder.

    Raises:
        UsageError: The plan cannot be read, or it gives the address of a model's server.
    """
    table = read_toml(path, "The plan")
    for part in (table.get("settings"), table.get("vary")):
        if isinstance(part, dict):
            refuse_address(part, f"The plan {path}")
    if isinstance(table.get("memory"), str):
        table["memory"] = str(path.parent / table["memory"])
    return table


def is_plan(path: Path) -> bool:
    """Return whether a file is a plan and not a scenario: it ends in ``.toml`` and has no key ``network``.

    A file that cannot be read counts as a plan, so that its error is reported as a plan's.
    """
    if not path.name.lower().endswith(".toml") or not path.is_file():
        return False
    try:
        return "network" not in parse_toml(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return True  # its error is reported as a plan's


def make_plan(
    table: Mapping[str, Any], folder: Path, said: str, parts: CampaignParts, settings_file: Path | None = None
) -> CampaignPlan:
    """Make a plan from its table.

    Args:
        table: The table.
        folder: The folder that relative inputs are relative to.
        said: What errors call the plan.
        parts: The functions that load inputs.
        settings_file: A file of settings that the plan's settings override; None for no file.

    Returns:
        The plan.

    Raises:
        UsageError: There are unknown keys or bad values, inputs, egos or settings that do not exist, or nothing to run.
    """
    try:
        file = PlanFile.model_validate(table)
    except ValidationError as error:
        known = [info.alias or name for name, info in PlanFile.model_fields.items()]
        raise UsageError(f"{said} {first_fault(error, known)}") from error
    for key in (*file.settings, *file.vary):
        if key in OWN_KEYS:
            raise UsageError(f"{said} has '{key}' among its settings; in a plan, write '{OWN_KEYS[key]}' instead.")
    for key in file.vary:
        if key in file.settings:
            raise UsageError(f"{said} has '{key}' both in [settings] and in [vary]; keep one.")
    varied = [dict(zip(file.vary, values, strict=True)) for values in itertools.product(*file.vary.values())]
    loaded = [load_settings(settings_file, **file.settings, **each) for each in varied]
    first = loaded[0]
    given = first.model_fields_set
    seeds = file.seeds if file.seeds is not None else (first.seed,)
    egos: Sequence[str | None] = file.egos or ((first.ego,) if "ego" in given else (None,))
    memory = file.memory or first.memory
    for ego in file.egos:
        check_name(ego)
    density = next((s.density for s in loaded if s.density is not None), None)
    inputs = find_inputs(file.inputs, folder, [str(r) for r in file.records], parts, density)
    return CampaignPlan(
        inputs, tuple(egos), tuple(range(seeds)) if isinstance(seeds, int) else tuple(seeds),
        [_as_data(s) for s in loaded], varied, file.learn, memory, file.figures,
    )  # fmt: skip


def _as_data(settings: Settings) -> dict[str, Any]:
    """Return all settings that shape an episode, without input, seed and ego.

    Those of ``OF_THE_INPUT`` are included only if they were given. The key of a model's server is not included.
    """
    data = settings.model_dump(mode="json", exclude={"memory", "learn", "seed", "ego"})
    for name in OF_THE_INPUT:
        if name not in settings.model_fields_set:
            del data[name]
    return data


def checked_plan(value: Any) -> dict[str, Any]:
    """Check what a folder stores of its plan, as ``CampaignPlan.as_dict`` gives it.

    Args:
        value: The content of ``plan.json``.

    Returns:
        The value.

    Raises:
        ValueError: The value is no such plan.
    """
    if not isinstance(value, dict) or value.get("schema") != PLAN_SCHEMA:
        raise ValueError(f"it is not a table with schema {PLAN_SCHEMA}")
    for key in ("inputs", "egos", "seeds", "settings"):
        if not isinstance(value.get(key), list):
            raise ValueError(f"it has no list '{key}'")
    for given in value["inputs"]:
        if not isinstance(given, dict) or not all(isinstance(given.get(k), str) for k in ("name", "content", "broken")):
            raise ValueError("an input in it has no name, content and broken")
    if not all(isinstance(variant, dict) for variant in value["settings"]):
        raise ValueError("its settings are not tables")
    return value


def plan_differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """Compare two plans. An input that was broken and is not any more makes no difference.

    Args:
        before: The one plan, as ``CampaignPlan.as_dict`` gives it.
        now: The other plan.

    Returns:
        Sentences on what differs in the list of episodes, and sentences on what differs in the things that all episodes
            depend on (learning, bank and versions). Both are empty for the same plan.
    """
    changes = _inputs_differ(before["inputs"], now["inputs"])
    for key in ("egos", "seeds"):
        if before[key] != now[key]:
            changes.append(f"{key} were {_few(before[key])}, now {_few(now[key])}")
    if before["settings"] != now["settings"]:
        changes.append(_settings_differ(before["settings"], now["settings"]))
    common = [
        f"{key}: {_plain(before.get(key))} then, {_plain(now.get(key))} now"
        for key in ("learn", "memory", "versions")
        if before.get(key) != now.get(key)
    ]
    return changes, common


def _inputs_differ(before: Sequence[Mapping[str, Any]], now: Sequence[Mapping[str, Any]]) -> list[str]:
    mended = {i["name"].split("[")[0] for i in before if i["broken"]}
    old = {i["content"]: i["name"] for i in before if not i["broken"]}
    new = {i["content"]: i["name"] for i in now if i["name"].split("[")[0] not in mended or i["content"] in old}
    gone = [n for c, n in old.items() if c not in new]
    come = [n for c, n in new.items() if c not in old]
    both = [n for n in gone if n in come]
    words = (
        ("changed", both),
        ("no longer there", [n for n in gone if n not in both]),
        ("new", [n for n in come if n not in both]),
    )
    return [f"inputs {change}: {_few(names)}" for change, names in words if names]


def _settings_differ(before: Sequence[Mapping[str, Any]], now: Sequence[Mapping[str, Any]]) -> str:
    if len(before) != len(now):
        return f"there were {len(before)} variants of the settings, now {len(now)}"
    pairs = zip(before, now, strict=True)
    keys = sorted({k for a, b in pairs for k in {*a, *b} if a.get(k) != b.get(k)})
    return f"settings changed: {_few(keys)}"


def _few(values: Sequence[Any]) -> str:
    shown = ", ".join("as the input says" if v is None else str(v) for v in values[:5])
    return shown + (f" and {len(values) - 5} more" if len(values) > 5 else "")


def _plain(value: Any) -> str:
    return ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else str(value)
