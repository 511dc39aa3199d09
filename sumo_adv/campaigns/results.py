"""Define the types of a batch (an input, an episode to run, its outcome), and turn runs' folders into one table.

The table has one row for each episode, including failed ones, in the plan's order.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sumo_adv.datatypes import ENDING_SENTENCES, FAILED_ENDINGS, Ending
from sumo_adv.errors import UsageError
from sumo_adv.files import cell_text, plain_cell, write_whole
from sumo_adv.outcome_schema import OUTCOME_SCHEMA, check_schema
from sumo_adv.parsing import read_json
from sumo_adv.scenario_names import COLUMNS as SCENARIO

if TYPE_CHECKING:
    from sumo_adv.simulation.inputs import RunInput

Row = Mapping[str, Any]
"""One line of ``results.csv``; see ``RESULT_COLUMNS``."""


class Learn(StrEnum):
    """When lessons from episodes are written into the memory bank."""

    OFF = "off"
    AFTER = "after"  # at the end, in the plan's order
    DURING = "during"  # at once, so the rows depend on the order


@dataclass(frozen=True, slots=True)
class Input:
    """One input of a plan.

    Attributes:
        name: The name for people.
        path: The path or the shipped name.
        record: The id of a Waymo record; None for other inputs.
        content: The SHA-256 of all its files.
        error: Why it cannot be run; '' if it can.
        notes: Sentences on what of the input was dropped or converted.
    """

    name: str
    path: Path
    record: str | None
    content: str
    error: str = ""
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class EpisodeJob:
    """One episode to run.

    Attributes:
        id: 16 hexadecimal digits of the hash of its content.
        input: The input.
        ego: The ego's driver; None for the input's own.
        seed: The seed.
        variant: The index of its settings in the plan.
    """

    id: str
    input: Input
    ego: str | None
    seed: int
    variant: int

    @property
    def words(self) -> str:
        """The episode in words."""
        return f"{self.input.name} {f'({self.ego}) ' if self.ego else ''}seed {self.seed}"


@dataclass(frozen=True, slots=True)
class Done:
    """The outcome of one try.

    Attributes:
        id: The id of the episode.
        row: The row; None if nothing was kept.
        bytes: The size of the run's folder, without its inputs.
        again: Why the try failed, if another try may succeed; then nothing was kept.
        text: A traceback, or what the try's processes printed.
    """

    id: str
    row: Row | None
    bytes: int = 0
    again: str = ""
    text: str = ""


@dataclass(frozen=True, slots=True)
class CampaignParts:
    """The functions that load, run and write an episode.

    All of them can be imported by name, because they are sent to other processes.

    Attributes:
        load: Loads an input from its path and the id of a record.
        records: Yields the records of a file.
        open_agents: Opens the agents of an episode.
        staged: Opens a folder that is written whole or not at all.
        write_run: Writes a run's folder.
        model_file: The name of the file with the exchanges with models.
    """

    load: Callable[[Path, str | None], RunInput]
    records: Callable[[Path], Iterator[tuple[str, str] | str]]  # of a file: id and content, or what is wrong with one
    open_agents: Callable[..., AbstractContextManager[Any]]
    staged: Callable[..., AbstractContextManager[Any]]
    write_run: Callable[..., dict[str, Any]]
    model_file: str


@dataclass(frozen=True, slots=True)
class WorkerSetup:
    """What every worker of a batch needs to know.

    Attributes:
        runs: The folder of runs.
        bank: The bank's snapshot, or the bank itself with ``Learn.DURING``.
        learn: When lessons are written into the bank.
        variants: The settings of each variant, as data.
        figures: Whether ``encounter.png`` is drawn.
        parts: The functions that load, run and write an episode.
        until: When episodes end, as ``time.time()`` [s]; None if they end when they are done.
    """

    runs: Path
    bank: Path
    learn: Learn
    variants: Sequence[Mapping[str, Any]]
    figures: bool
    parts: CampaignParts
    until: float | None = None


OUTCOME_FILE, TRACEBACK_FILE, LEARNT_FILE = "outcome.json", "traceback.txt", "learnt.json"
RESULT_COLUMNS = (
    "id", "network", "seed", "ego", "intent", "raw_min_ttc", "min_ttc", "collided", "valid", "critical", "ending",
    "attempts", "seconds", "failure", "traceback", "level", "strict", "preventable_by", "inconclusive",
    "ego_stationary", "humanlike", "delta_v", "impact_speed", "severity", "serious", "fault", "contact_time",
    "adversary", "relation", "kind", "road", "ego_speed", "supports", "composition", "cause", "cause_sentence",
    "robust", "overlap", "warning", "red_light", "right_of_way", *SCENARIO,
    "driver_calls", "driver_seconds", "driver_p99_ms",
)  # fmt: skip
"""The columns of the table. Settings that vary follow them, as ``set_NAME``.

Times are in s, speeds in m/s. An empty ``min_ttc`` means *never*. An empty ``valid``, ``strict`` or ``serious`` means
that there was no collision.

- ``road`` and ``ego_speed`` are those of the encounter.
- ``impact_speed`` is the speed at which a pedestrian, a cyclist or a motorcyclist is hit; it is empty for a car.
- ``supports`` lists the other adversaries with their roles, as ``id:role``, and ``composition`` names what all of them
  do together. Both are empty for a single adversary.
- ``cause`` is the kind of cause (``metrics/cause.py``). It is empty if there was neither a contact nor a near miss.
- ``robust`` says whether most of the attempt's neighbours succeed, too. It is empty if none was simulated.
- ``overlap`` is a share of the touching face.
- ``warning`` is the time from the alarm of ``cc_human`` to the contact [s].
- ``red_light`` and ``right_of_way`` say who broke them (``episode/rules_broken.py``).
- ``motion``, ``nhtsa``, ``iso_34502`` and ``euro_ncap`` name what the attempt that counts shows
  (``scenario_names.py``).
- ``driver_calls``, ``driver_seconds`` and ``driver_p99_ms`` are the number of answers that the ego's driver gave in all
  attempts, the time that they took, and the time within which 99 % of them came.
"""
CLOCK_COLUMNS = ("seconds", "driver_seconds", "driver_p99_ms")
"""The columns with wall times, which differ from run to run."""


INTEGER_COLUMNS = ("seed", "attempts")
NUMERIC_COLUMNS = (
    "raw_min_ttc", "min_ttc", "seconds", "delta_v", "impact_speed", "contact_time", "ego_speed", "overlap", "warning",
    "driver_calls", "driver_seconds", "driver_p99_ms",
)  # fmt: skip
BOOLEAN_COLUMNS = ("collided", "valid", "critical", "strict", "serious", "ego_stationary", "humanlike", "robust")
"""Columns of whole numbers, of numbers, and of true or false. All other columns hold text.

Only the columns of whole numbers cannot be empty.
"""


def result_row(name: str, outcome: Mapping[str, Any], traceback: bool) -> Row:
    """Make the row of an episode.

    Args:
        name: The name of the episode's folder.
        outcome: The content of its ``outcome.json``.
        traceback: Whether the folder has a traceback.

    Returns:
        The row.
    """
    best, raw, intent = (outcome[key] or {} for key in ("outcome", "raw", "intent"))
    failure, preventable_by = outcome.get("failure") or "", best.get("preventable_by")
    if not failure and outcome["ending"] in FAILED_ENDINGS:
        failure = str(outcome["reason"])
    return {
        "id": name, "network": outcome["network"], "seed": outcome["seed"], "ego": outcome["ego"]["controller"],
        "intent": intent.get("label"), "raw_min_ttc": raw.get("min_ttc"),
        **{key: best.get(key) for key in ("min_ttc", "collided", "valid", "critical")},
        "ending": outcome["ending"], "attempts": len(outcome["attempts"]),
        "seconds": (outcome["timing"] or {}).get("total"), "failure": failure,
        "traceback": f"runs/{name}/{TRACEBACK_FILE}" if traceback else None,
        "level": best.get("level"), "strict": best.get("strict"),
        "preventable_by": None if preventable_by is None else " ".join(preventable_by),
        **{
            key: best.get(key)
            for key in ("inconclusive", "ego_stationary", "humanlike", "delta_v", "impact_speed", "severity")
        },
        "serious": best["level"] == "serious" if best.get("collided") else None,
        "fault": best.get("fault"), "contact_time": best.get("contact_time"), **_attack(outcome),
        **{key: best.get(key) for key in ("overlap", "warning", "red_light", "right_of_way")},
        **{key: (outcome.get("named_scenario") or {}).get(key) for key in SCENARIO},
        **{f"driver_{key}": (outcome.get("driver_time") or {}).get(key) for key in ("calls", "seconds", "p99_ms")},
    }  # fmt: skip


def _attack(outcome: Mapping[str, Any]) -> dict[str, Any]:
    """Return the columns about the adversaries and the encounter; they are None without an attempt or an encounter."""
    encounter, best = outcome["encounter"] or {}, outcome["best"]
    adversary = outcome["adversaries"][0]["id"] if outcome["adversaries"] else None
    attempt = None if best is None else outcome["attempts"][best]
    supports = " ".join(f"{each['id']}:{each['role']}" for each in outcome["adversaries"][1:])
    relations = {each["id"]: each["relation"] for each in encounter.get("ranking", ())}
    cause = (outcome["outcome"] or {}).get("cause") or {}
    return {
        "adversary": adversary, "relation": relations.get(adversary),
        "kind": None if attempt is None else attempt.get("kind"),
        "road": encounter.get("road"), "ego_speed": encounter.get("ego_speed"),
        "supports": supports or None, "composition": None if attempt is None else attempt.get("composition") or None,
        "cause": cause.get("kind"), "cause_sentence": cause.get("sentence"),
        "robust": (outcome.get("robust") or {}).get("robust"),
    }  # fmt: skip


def checked_row(row: Any) -> Row:
    """Check a row that was read from a file. A row of an earlier version may lack some columns.

    Args:
        row: The row.

    Returns:
        The row.

    Raises:
        ValueError: A value or the row has the wrong type, or the ending is unknown.
        KeyError: The ending is missing.
        TypeError: The row is no table.
    """
    for name in RESULT_COLUMNS:
        value = dict(row).get(name)
        kind = (
            float
            if name in NUMERIC_COLUMNS
            else int
            if name in INTEGER_COLUMNS
            else bool
            if name in BOOLEAN_COLUMNS
            else str
        )
        ok = isinstance(value, int | float) if kind is float else isinstance(value, kind)
        if value is not None and (not ok or (isinstance(value, bool) and kind is not bool)):
            raise ValueError(f"its {name} cannot be {str(value)[:40]!r}")
    if row["ending"] not in set(Ending):
        raise ValueError("its ending is unknown")
    return dict(row)


def is_failed(row: Row) -> bool:
    """Return whether the episode failed; a failed episode stays in the table and in every denominator."""
    return row["ending"] in FAILED_ENDINGS


def read_row(folder: Path) -> Row | None:
    """Read the row of a run's folder.

    Args:
        folder: The folder.

    Returns:
        The row; None if there is none, or it is damaged.

    Raises:
        UsageError: The ``outcome.json`` has schema 1.
    """
    try:
        outcome = read_json(folder / OUTCOME_FILE)
        check_schema(outcome, folder / OUTCOME_FILE)
        return checked_row(result_row(folder.name, outcome, (folder / TRACEBACK_FILE).exists()))
    except (OSError, ValueError, LookupError, TypeError, AttributeError):
        return None


def write_failure(stage: Path, job: EpisodeJob, failure: str, text: str) -> Row:
    """Write the files of an episode that could not be run: an outcome with the reason, and a traceback.

    Args:
        stage: The folder to write into.
        job: The episode.
        failure: The reason.
        text: The traceback; '' takes the reason.

    Returns:
        The row.
    """
    outcome = {
        "schema": OUTCOME_SCHEMA, "ending": str(Ending.SIMULATION_FAILED),
        "reason": f"{ENDING_SENTENCES[Ending.SIMULATION_FAILED]} {failure}", "network": job.input.name,
        "seed": job.seed, "ego": {"id": None, "controller": job.ego}, "adversaries": [], "trigger_time": None,
        "encounter": None, "agents": None, "intent": None, "intents": [], "raw": None, "attempts": [], "best": None,
        "outcome": None, "realism": {}, "timing": {"total": None}, "llm": None, "notes": [], "failure": failure,
    }  # fmt: skip
    (stage / TRACEBACK_FILE).write_text(text or f"{failure}\n", encoding="utf-8")
    (stage / OUTCOME_FILE).write_text(json.dumps(outcome, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    return result_row(job.id, outcome, True)


def keep_failure(
    staged: Callable[..., AbstractContextManager[Any]], runs: Path, job: EpisodeJob, failure: str, text: str
) -> Done:
    """Write the files of an episode that could not be run as its folder.

    Args:
        staged: Opens a folder that is written whole or not at all.
        runs: The folder of runs.
        job: The episode.
        failure: The reason.
        text: The traceback.

    Returns:
        The outcome.
    """
    with staged(runs / job.id, force=True, inside=True) as folder:
        row = write_failure(folder.stage, job, failure, text)
        folder.keep(force=True)
    return Done(job.id, row)


def results_table(
    jobs: Sequence[EpisodeJob], rows: Mapping[str, Row], varied: Sequence[Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Return the finished rows in the plan's order, with the settings that vary.

    Args:
        jobs: All episodes.
        rows: The finished rows, by id.
        varied: The settings that differ between variants, for each variant.

    Returns:
        The table.
    """
    shown = [{f"set_{name}": value for name, value in each.items()} for each in varied]
    return [{**rows[job.id], **shown[job.variant]} for job in jobs if job.id in rows]


def write_csv(target: Path, table: Iterable[Mapping[str, Any]], varied: Sequence[str]) -> None:
    """Write the table as CSV, whole or not at all.

    Args:
        target: The file.
        table: The rows.
        varied: The names of the settings that vary.

    Raises:
        OSError: The file cannot be written.
    """

    def write(part: Path) -> None:
        with part.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, [*RESULT_COLUMNS, *(f"set_{name}" for name in varied)], lineterminator="\n")
            writer.writeheader()
            writer.writerows({key: _cell(value) for key, value in row.items()} for row in table)

    write_whole(target, write)


def _cell(value: Any) -> Any:
    if isinstance(value, bool):
        return "true" if value else "false"
    return plain_cell(json.dumps(value) if isinstance(value, list | dict) else value)


def read_csv(file: Path) -> dict[str, list[Any]]:
    """Read the columns of a ``results.csv`` with their types.

    Args:
        file: The file.

    Returns:
        The columns; empty cells are None.

    Raises:
        UsageError: The file is damaged.
    """
    try:
        with file.open(newline="", encoding="utf-8") as text:
            reader = csv.DictReader(text)
            columns: dict[str, list[Any]] = {name: [] for name in reader.fieldnames or ()}
            for row in reader:
                for name, column in columns.items():
                    column.append(_value(name, row[name]))
            return columns
    except (OSError, ValueError, csv.Error) as error:
        raise UsageError(f"{file} is not the table of a batch ({error}); rerun the batch's command.") from error


def _value(name: str, text: str) -> Any:
    if not text:
        return None
    if name in BOOLEAN_COLUMNS:
        return text == "true"
    return int(text) if name in INTEGER_COLUMNS else float(text) if name in NUMERIC_COLUMNS else cell_text(text)


def check_parquet() -> None:
    """Check that Parquet can be written.

    Raises:
        UsageError: pyarrow is not installed.
    """
    try:
        import pyarrow  # noqa: F401
    except ImportError as error:
        raise UsageError("Parquet needs pyarrow, which is not installed: pip install 'sumo-adv[batch]'.") from error


def write_parquet(target: Path, table: Sequence[Mapping[str, Any]], varied: Sequence[str]) -> None:
    """Write the table as typed Parquet, whole or not at all.

    Args:
        target: The file.
        table: The rows.
        varied: The names of the settings that vary.

    Raises:
        UsageError: pyarrow is not installed.
        OSError: The file cannot be written.
    """
    check_parquet()
    import pyarrow as pa
    from pyarrow import parquet

    kinds = {
        **dict.fromkeys(INTEGER_COLUMNS, pa.int64()), **dict.fromkeys(NUMERIC_COLUMNS, pa.float64()),
        **dict.fromkeys(BOOLEAN_COLUMNS, pa.bool_()),
    }  # fmt: skip
    # packed rows of old versions lack some columns
    columns = {name: [row.get(name) for row in table] for name in RESULT_COLUMNS}
    columns |= {f"set_{name}": [str(_cell(row[f"set_{name}"])) for row in table] for name in varied}
    arrays = {name: pa.array(values, kinds.get(name, pa.string())) for name, values in columns.items()}
    write_whole(target, lambda part: parquet.write_table(pa.table(arrays), part, compression="zstd"))
