"""Read the rounds of a hunt from their folders: outcomes, attacks of further kinds, and failures over time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sumo_adv.campaigns.results import OUTCOME_FILE, is_failed, read_csv, read_row
from sumo_adv.datatypes import Level
from sumo_adv.errors import UsageError
from sumo_adv.hunting.failures import Failure, FailureCell, failure_of
from sumo_adv.metrics.species import Discovery
from sumo_adv.parsing import read_json, read_object
from sumo_adv.report.index import HUNT
from sumo_adv.report.outcome import ATTACKS
from sumo_adv.report.staging import RESULTS_FILE

ROUNDS_FOLDER = "rounds"
FAILURE_LEVELS = (Level.VALID, Level.STRICT, Level.SERIOUS)
Rows = Sequence[Mapping[str, Any]]


def folder_of(hunt: Path, k: int) -> Path:
    """Return the folder of a round, which is the folder of a campaign.

    Args:
        hunt: The folder of the hunt.
        k: The index of the round, from 0.
    """
    return hunt / ROUNDS_FOLDER / f"{k + 1:04d}"


def further(runs: Path, rows: Rows) -> dict[str, list[Failure]]:
    """Read the attacks of further kinds of each episode. Their folders are inside the folder of the run.

    Args:
        runs: The folder of the runs.
        rows: The rows of the episodes.

    Returns:
        The failures by id of the episode.
    """
    more: dict[str, list[Failure]] = {}
    for row in rows:
        for folder in sorted((runs / str(row["id"]) / ATTACKS).glob("*")):
            attack = read_row(folder)
            failure = None if attack is None else failure_of({**attack, "id": folder.name}, folder.parent)
            if failure is not None:
                more.setdefault(str(row["id"]), []).append(failure)
    return more


def outcomes_of(runs: Path, rows: Rows) -> dict[str, Mapping[str, Any]]:
    """Read the ``outcome.json`` of each episode.

    Args:
        runs: The folder of the runs.
        rows: The rows of the episodes.

    Returns:
        The contents by id of the episode. Episodes without the file are left out.
    """
    files = {str(row["id"]): runs / str(row["id"]) / OUTCOME_FILE for row in rows}
    return {name: read_object(file, "The outcome") for name, file in files.items() if file.is_file()}


def cells_of(failures: Sequence[Failure]) -> frozenset[FailureCell]:
    """Return the cells of failures that are more than near-touches."""
    return frozenset(failure.cell for failure in failures if not failure.near_touch)


def kinds_by_encounter(hunt: Path) -> list[frozenset[FailureCell]]:
    """List the distinct failures of each encounter of a finished hunt, to evaluate the hunt's estimates.

    Args:
        hunt: The folder of the hunt.

    Returns:
        The cells of each encounter, in the hunt's order. Failed episodes are left out.

    Raises:
        UsageError: A table is damaged.
    """
    samples = []
    for file in sorted((hunt / ROUNDS_FOLDER).glob(f"*/{RESULTS_FILE}")):
        columns, runs = read_csv(file), file.parent / "runs"
        rows = [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]
        more = further(runs, rows)
        for row in rows:
            first = failure_of(row, runs)
            own = [*([] if first is None else [first]), *more.get(str(row["id"]), ())]
            if not is_failed(row):
                samples.append(cells_of(own))
    return samples


@dataclass(frozen=True, slots=True)
class AfterRound:
    """The state of a hunt after a round.

    Attributes:
        minutes: The time used so far [min].
        found: The number of distinct failures of each level or a higher one.
        discovery: The estimates of the failures left to find; None for hunts of an earlier version.
    """

    minutes: float
    found: Mapping[str, int]
    discovery: Discovery | None = None


def over_time(hunt: Path) -> list[AfterRound]:
    """Read the state of a hunt after each of its rounds.

    Args:
        hunt: The folder of the hunt.

    Returns:
        The states, in order.

    Raises:
        UsageError: The folder is not that of a hunt, is damaged, or has no finished round.
    """
    file = hunt / HUNT
    if not file.is_file():
        raise UsageError(f"{hunt} is not the folder of a hunt: it has no {HUNT}.")
    after, seconds = list[AfterRound](), 0.0
    try:
        for each in read_json(file)["rounds"]:
            seconds += float(each.get("took", 0.0))
            if "found" in each:
                found = {str(level): int(each["found"][str(level)]) for level in FAILURE_LEVELS}
                after.append(AfterRound(seconds / 60.0, found, _discovery(each.get("left"))))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(f"{file} is damaged ({error}).") from error
    if not after:
        raise UsageError(f"The hunt in {hunt} has finished no round: rerun its command.")
    return after


def _discovery(written: Mapping[str, Any] | None) -> Discovery | None:
    """Read the estimates of a round.

    Raises:
        TypeError: They are damaged.
        KeyError: They are incomplete.
    """
    if written is None:
        return None
    chance, high = (written[name] for name in ("chance", "high"))
    return Discovery(
        int(written["samples"]), int(written["kinds"]), int(written["once"]),
        math.nan if chance is None else float(chance), float(written["least"]), float(written["low"]),
        math.inf if high is None else float(high),
    )  # fmt: skip
